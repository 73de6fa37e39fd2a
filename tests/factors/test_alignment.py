"""Alignment factors: derivatives, constants, one factor a match as oracle, whole estimates."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from sst_graph.factors import (
    Alignment,
    FactorError,
    GroupedBias,
    PinholeCamera,
    RobustKernel,
    alignment_cost,
    check_gradient,
    check_jacobians,
    frame_factor,
    pixel_to_point_factor,
    point_to_pixel_factor,
    residuals,
    silhouette_factor,
    stacked,
    time_offset_prior,
    twist_jerk_factor,
)

E, D, V, B, B2 = (gtsam.symbol(*name) for name in (("e", 0), ("d", 0), ("v", 0), ("b", 0), ("b", 1)))
CAMERA = PinholeCamera(100.0, 100.0, 50.0, 40.0, 101, 81)
FACTORIES = {"point_to_pixel": point_to_pixel_factor, "pixel_to_point": pixel_to_point_factor}


def nearby(cTl, time_offset_s, twist, bias=None, seed=0):
    rng = np.random.default_rng(seed)
    values = gtsam.Values()
    values.insert(E, cTl.retract(rng.normal(0.0, 0.01, 6)))
    values.insert(D, np.array([time_offset_s + rng.normal(0.0, 0.01)]))
    values.insert(V, twist + rng.normal(0.0, 0.1, 6))
    if bias is not None:
        values.insert(B, np.array([bias]))
    return values


@pytest.mark.parametrize("factory", FACTORIES.values(), ids=FACTORIES)
def test_jacobians_at_100_states(make_scene, factory):
    for seed in range(100):
        alignment, *state = make_scene(seed, 4, per_point=bool(seed % 2))
        check_jacobians(stacked(factory(alignment, E, D, V)), nearby(*state, seed=seed), 1e-6)


@pytest.mark.parametrize("factory", FACTORIES.values(), ids=FACTORIES)
def test_predicted_less_measured(make_scene, factory):
    alignment, *state = make_scene(1, 5, noise_px=0.0)
    shifted = replace(alignment, pixels=alignment.pixels - [2.0, -1.0], sigmas_px=1.0)
    factor = stacked(factory(shifted, E, D, V))
    values = gtsam.Values()
    for key, value in zip((E, D, V), state, strict=True):
        values.insert(key, np.atleast_1d(value) if key == D else value)
    np.testing.assert_allclose(factor.unwhitenedError(values), [2.0] * 5 + [-1.0] * 5 + [0.0], atol=1e-9)


@pytest.mark.parametrize("kind", ["none", "huber", "cauchy", "geman_mcclure", "tukey"])
@pytest.mark.parametrize("condensed", [True, False])
@pytest.mark.parametrize("normals", [True, False])
def test_gradient_is_that_of_the_robust_cost(make_scene, kind, condensed, normals):
    for seed in range(4):
        scene = make_scene(
            seed, 25, normals=normals, per_point=bool(seed % 2), kernel=RobustKernel(kind, 4.0)
        )
        bias = B if normals else None
        factor = frame_factor([scene[0]], E, D, V, bias)
        factor = factor if condensed else stacked(factor)
        # a short step: the kernels' second derivatives jump
        check_gradient(factor, nearby(*scene[1:], bias=0.2 if normals else None, seed=seed), 1e-5, step=1e-6)


def test_cost_is_the_sum_of_one_factor_a_match(make_scene):
    alignment, *state = make_scene(3, 20, kernel=RobustKernel("cauchy", 2.0))
    values = nearby(*state)
    whole = point_to_pixel_factor(alignment, E, D, V)
    information, error = np.zeros((14, 14)), 0.0
    for i in range(20):
        single = replace(
            alignment,
            lPs=alignment.lPs[[i]],
            base_taus_s=alignment.base_taus_s[[i]],
            pixels=alignment.pixels[[i]],
            sigmas_px=alignment.sigmas_px[[i]],
            weights=alignment.weights[[i]],
        )
        factor = point_to_pixel_factor(single, E, D, V)
        error += factor.error(values)
        information += factor.linearize(values).augmentedInformation()
    assert whole.error(values) == pytest.approx(error, rel=1e-12)
    found = whole.linearize(values).augmentedInformation()
    np.testing.assert_allclose(found, information, atol=1e-9 * np.abs(information).max())


def test_a_gtsam_reprojection_factor_says_the_same(make_scene):
    # standing, and the extrinsic as the inverse of the "camera pose" that gtsam's factor estimates
    alignment, cTl, *_ = make_scene(4, 12)
    alignment = replace(alignment, c_acceleration=np.zeros(6))
    camera = alignment.camera
    K = gtsam.Cal3_S2(camera.fx, camera.fy, 0.0, camera.cx, camera.cy)
    lTc, expected, information = cTl.inverse(), 0.0, np.zeros((6, 6))
    values = gtsam.Values()
    values.insert(E, lTc)
    for i in range(12):
        noise = gtsam.noiseModel.Isotropic.Sigma(2, alignment.sigmas_px[i])
        values.insert(100 + i, alignment.lPs[i])
        factor = gtsam.GenericProjectionFactorCal3_S2(alignment.pixels[i], noise, E, 100 + i, K)
        expected += factor.error(values)
        A, _ = factor.linearize(values).jacobian()
        information += A[:, :6].T @ A[:, :6]
    ours = gtsam.Values()
    ours.insert(E, cTl)
    factor = point_to_pixel_factor(alignment, E)
    assert factor.error(ours) == pytest.approx(expected, rel=1e-10)
    # lTc Exp(x) is the inverse of cTl Exp(y) for y = -Ad_lTc x
    adjoint = lTc.AdjointMap()
    found = adjoint.T @ factor.linearize(ours).information() @ adjoint
    np.testing.assert_allclose(found, information, atol=1e-9 * np.abs(information).max())


def test_constants_stand_in_for_variables(make_scene):
    alignment, cTl, time_offset_s, twist = make_scene(6)
    values = nearby(cTl, time_offset_s, twist)
    full = point_to_pixel_factor(alignment, E, D, V).linearize(values).augmentedInformation()
    pose, offset, twist = values.atPose3(E), float(values.atVector(D)[0]), values.atVector(V)
    cases = {
        (E,): (range(6), point_to_pixel_factor(alignment, E, offset, twist)),
        (E, D): (range(7), point_to_pixel_factor(alignment, E, D, twist)),
        (E, V): ([*range(6), *range(7, 13)], point_to_pixel_factor(alignment, E, offset, V)),
        (D, V): (range(6, 13), point_to_pixel_factor(alignment, pose, D, V)),
    }
    for keys, (columns, factor) in cases.items():
        assert tuple(factor.keys()) == keys
        chosen = [*columns, 13]
        found = factor.linearize(values).augmentedInformation()
        np.testing.assert_allclose(
            found, full[np.ix_(chosen, chosen)], rtol=1e-9, atol=1e-9 * np.abs(full).max()
        )
    still = point_to_pixel_factor(alignment, E)
    assert still.error(values) == pytest.approx(alignment_cost(alignment, pose, 0.0, np.zeros(6)))


def test_a_frame_is_the_sum_of_its_alignments(make_scene):
    points, *state = make_scene(10)
    contours = [make_scene(seed, normals=True, per_point=True)[0] for seed in (11, 12)]
    values = nearby(*state, bias=0.3)
    values.insert(B2, np.array([-0.2]))
    frame = frame_factor([points, *contours], E, D, V, [None, B, B2])
    singles = [
        point_to_pixel_factor(points, E, D, V),
        silhouette_factor(contours[0], E, D, V, B),
        silhouette_factor(contours[1], E, D, V, B2),
    ]
    assert tuple(frame.keys()) == (E, D, V, B, B2)
    assert frame.error(values) == pytest.approx(sum(f.error(values) for f in singles), rel=1e-12)
    graphs = []
    for factors in ([frame], singles):
        graph = gtsam.NonlinearFactorGraph()
        for factor in factors:
            graph.add(factor)
        graphs.append(graph.linearize(values).hessian())
    (H, g), (expected_H, expected_g) = graphs
    np.testing.assert_allclose(H, expected_H, atol=1e-9 * np.abs(expected_H).max())
    np.testing.assert_allclose(g, expected_g, atol=1e-9 * np.abs(expected_g).max())


@pytest.mark.parametrize("per_point", [False, True])
@pytest.mark.parametrize("second", [B2, 0.4])
def test_objects_with_a_bias_each_are_alignments_of_their_own(make_scene, per_point, second):
    alignment, *state = make_scene(14, normals=True, per_point=per_point)
    alignment = replace(alignment, kernel=RobustKernel("geman_mcclure", 2.0))
    values = nearby(*state, bias=0.3)
    values.insert(B2, np.array([-0.2]))
    groups = np.arange(len(alignment)) % 3 % 2
    whole = frame_factor([alignment], E, D, V, [GroupedBias((B, second), groups)])
    parts = [alignment.take(np.flatnonzero(groups == k)) for k in (0, 1)]
    split = frame_factor(parts, E, D, V, [B, second])
    assert list(whole.keys()) == list(split.keys())
    assert whole.error(values) > 0.0
    assert whole.error(values) == pytest.approx(split.error(values), rel=1e-12)
    found, expected = (f.linearize(values).information() for f in (whole, split))
    np.testing.assert_allclose(found, expected, atol=1e-9 * np.abs(expected).max())
    tall = stacked(frame_factor([alignment], E, D, V, [GroupedBias((B, second), groups)]))
    assert tall.error(values) == pytest.approx(split.error(values), rel=1e-12)


def test_extrinsic_and_delay_are_found_again(make_scene):
    alignment, cTl, time_offset_s, _ = make_scene(20, 80, noise_px=0.0)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    rng = np.random.default_rng(0)
    values.insert(E, cTl.retract([0.05, -0.05, 0.04, 0.1, -0.1, 0.1]))
    values.insert(D, np.array([time_offset_s + 0.1]))
    for _ in range(5):  # the same scene seen at other speeds
        twist = rng.normal(0.0, 1.0, 6) * [0.2, 0.5, 0.2, 1.0, 0.5, 8.0]
        pixels, _ = residuals(alignment, cTl, time_offset_s, twist, jacobians=False)
        seen = replace(alignment, pixels=pixels.reshape(2, -1).T + alignment.pixels, sigmas_px=1.0)
        graph.add(point_to_pixel_factor(seen, E, D, twist))
    result = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    assert np.abs(cTl.localCoordinates(result.atPose3(E))).max() < 1e-6
    assert abs(result.atVector(D)[0] - time_offset_s) < 1e-6


def test_every_point_behind_the_camera_leaves_a_constant(make_scene):
    alignment, cTl, *_ = make_scene(2, 10)
    values = gtsam.Values()
    values.insert(E, gtsam.Pose3(gtsam.Rot3.Ry(np.pi), np.zeros(3)) * cTl)
    condensed = point_to_pixel_factor(alignment, E)
    for factor in (condensed, stacked(condensed)):
        A, b = factor.linearize(values).jacobian()
        assert (A == 0.0).all()
        assert 0.5 * b @ b == pytest.approx(factor.error(values))
        assert factor.error(values) > 0.0


def test_refuses_what_makes_no_factor(make_scene):
    points, contour = make_scene(1)[0], make_scene(1, normals=True)[0]
    with pytest.raises(FactorError, match="one or more"):
        frame_factor([], E)
    with pytest.raises(FactorError, match="constants only"):
        frame_factor([points], gtsam.Pose3(), 0.1, np.zeros(6))
    with pytest.raises(FactorError, match="only silhouettes"):
        frame_factor([points], E, biases_px=[B])
    with pytest.raises(FactorError, match="2 entries"):
        frame_factor([contour], E, biases_px=[B, B2])
    with pytest.raises(FactorError, match="silhouette_factor"):
        point_to_pixel_factor(contour, E)
    with pytest.raises(FactorError, match=r"shape \(3,\)"):
        point_to_pixel_factor(points, E, 0.1, np.zeros(3))


def test_outside_is_positive_and_a_dilated_mask_hides_more_of_it():
    # predicted at u = 60, contour at u = 57 with the outside to the right, mask dilated by 2 px: the
    # outline is at u = 55
    alignment = Alignment(CAMERA, [[1.0, 0.0, 10.0]], 0.0, [[57.0, 40.0]], 1.0, [[1.0, 0.0]])
    values = gtsam.Values()
    values.insert(E, gtsam.Pose3())
    values.insert(B, np.array([2.0]))
    factor = stacked(silhouette_factor(alignment, E, bias_px=B))
    np.testing.assert_allclose(factor.unwhitenedError(values), [5.0, 0.0], atol=1e-12)
    assert silhouette_factor(alignment, E, bias_px=2.0).error(values) == pytest.approx(12.5)
    assert silhouette_factor(alignment, E).error(values) == pytest.approx(4.5)


@pytest.mark.slow
def test_silhouette_jacobians_at_100_states(make_scene):
    for seed in range(100):
        alignment, cTl, time_offset_s, twist = make_scene(seed, 4, normals=True, per_point=bool(seed % 2))
        values = gtsam.Values()
        values.insert(E, cTl.retract(np.full(6, 0.01)))
        values.insert(D, np.array([time_offset_s + 0.01]))
        values.insert(V, twist)
        values.insert(B, np.array([0.4]))
        check_jacobians(stacked(silhouette_factor(alignment, E, D, V, B)), values, 1e-6)


def test_silhouettes_of_a_circle_give_the_distance_to_it():
    # nearest contour points and normals of a circular mask: the factor's error is |uv - centre| - radius
    rng, centre, radius = np.random.default_rng(0), np.array([50.0, 40.0]), 20.0
    lPs = rng.uniform([-4, -3, 8], [4, 3, 12], (50, 3))
    outward = CAMERA.project(lPs) - centre
    distance = np.linalg.norm(outward, axis=1)
    normals = outward / distance[:, None]
    alignment = Alignment(CAMERA, lPs, 0.0, centre + radius * normals, 1.0, normals)
    values = gtsam.Values()
    values.insert(E, gtsam.Pose3())
    error = stacked(silhouette_factor(alignment, E)).unwhitenedError(values)
    np.testing.assert_allclose(error[:-1], distance - radius, atol=1e-9)


def test_a_silhouette_needs_normals(make_scene):
    with pytest.raises(FactorError, match="no normals"):
        silhouette_factor(make_scene(0)[0], E)


def test_a_factor_is_condensed_and_stacked_has_the_rows_of_its_matches(make_scene):
    points, contour = make_scene(0)[0], make_scene(0, normals=True)[0]
    for make in (*FACTORIES.values(), lambda *args: frame_factor([args[0]], *args[1:])):
        assert make(points, E, D, V).noiseModel().dim() == 13 + 2
        assert stacked(make(points, E, D, V)).noiseModel().dim() == 2 * len(points) + 1
        assert make(points, E).noiseModel().dim() == 6 + 2  # offset and twist are zero
    assert silhouette_factor(contour, E, D, V, B).noiseModel().dim() == 14 + 2
    assert stacked(silhouette_factor(contour, E, D, V, B)).noiseModel().dim() == len(contour) + 1


def test_offset_and_twist_are_zero_where_they_are_not_given(make_scene):
    points, contour = make_scene(0)[0], make_scene(0, normals=True)[0]
    values = gtsam.Values()
    values.insert(E, make_scene(0)[1])
    for make, alignment in ((point_to_pixel_factor, points), (silhouette_factor, contour)):
        expected = alignment_cost(alignment, values.atPose3(E), 0.0, np.zeros(6))
        assert make(alignment, E).error(values) == pytest.approx(expected, rel=1e-12)


def test_one_bias_belongs_to_the_silhouettes_alone(make_scene):
    (points, cTl, time_offset_s, twist), (contour, *_) = make_scene(3), make_scene(3, normals=True)
    values = nearby(cTl, time_offset_s, twist, 0.7)
    alone = frame_factor([points, contour], E, D, V, [None, B])
    both = frame_factor([points, contour], E, D, V, B)
    assert both.error(values) == alone.error(values)
    np.testing.assert_array_equal(*(f.linearize(values).augmentedInformation() for f in (alone, both)))


def test_only_alignments_are_stacked():
    prior = time_offset_prior(D, 0.0, 1.0)
    jerk = twist_jerk_factor(V, 1, 2, (0.1, 0.1), 1.0, 1.0)
    for factor, found in ((prior, "a PriorFactorVector"), (jerk, "twist_jerk_factor")):
        with pytest.raises(FactorError, match=f"to be stacked: found {found}, expected an alignment factor"):
            stacked(factor)

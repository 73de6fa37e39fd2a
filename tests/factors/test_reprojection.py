"""Reprojection residuals: signs, derivatives, gtsam as oracle, points behind the camera."""

from __future__ import annotations

import dataclasses

import gtsam
import numpy as np
import pytest

from sst_graph.factors import (
    Alignment,
    FactorError,
    PinholeCamera,
    RobustKernel,
    alignment_cost,
    frame_factor,
    residuals,
    weighted_residuals,
)

CAMERA = PinholeCamera(100.0, 100.0, 50.0, 40.0, 101, 81)
STILL = np.zeros(6)


def match(lP, pixel, **options):
    options = {"base_taus_s": 0.0, "sigmas_px": 1.0} | options
    return Alignment(CAMERA, np.array([lP]), pixels=np.array([pixel]), **options)


def test_predicted_less_measured():
    r, _ = residuals(match([1.0, -0.5, 10.0], [57.0, 37.0]), gtsam.Pose3(), 0.0, STILL)
    np.testing.assert_allclose(r, [3.0, -2.0], atol=1e-12)


def test_signed_distance_to_the_contour_and_how_far_the_outline_lies_within():
    alignment = match([1.0, -0.5, 10.0], [57.0, 37.0], normals=np.array([[0.6, -0.8]]))
    r, J = residuals(alignment, gtsam.Pose3(), 0.0, STILL, bias_px=0.5)
    np.testing.assert_allclose(r, [0.6 * 3.0 + 0.8 * 2.0 + 0.5])
    assert J.shape == (1, 14)
    assert J[0, 13] == 1.0


def test_a_later_image_sees_a_point_further_out():
    # 10 m/s forward and 0.1 s: Z from 10 m to 9 m
    r, J = residuals(
        match([1.0, 0.0, 10.0], [50.0, 40.0]), gtsam.Pose3(), 0.1, np.array([0, 0, 0, 0, 0, 10.0])
    )
    np.testing.assert_allclose(r, [100.0 / 9.0, 0.0], atol=1e-12)
    assert J[0, 6] == pytest.approx(10.0 * 100.0 / 81.0)  # px/s: v fx X / Z^2


@pytest.mark.parametrize("normals", [False, True])
@pytest.mark.parametrize("per_point", [False, True])
@pytest.mark.parametrize("model", ["se3", "translation"])
def test_jacobian_at_100_points(make_scene, normals, per_point, model):
    alignment, cTl, time_offset_s, twist = make_scene(
        5, 100, normals=normals, per_point=per_point, motion_model=model
    )
    bias = 0.4 if normals else None
    _, J = residuals(alignment, cTl, time_offset_s, twist, bias)
    assert J.shape == (100 if normals else 200, 14 if normals else 13)

    def r(x):
        moved_bias = bias + x[13] if normals else None
        state = cTl.retract(x[:6]), time_offset_s + x[6], twist + x[7:13], moved_bias
        return residuals(alignment, *state, jacobians=False)[0]

    for column in range(J.shape[1]):
        step = 1e-4 * np.eye(J.shape[1])[column]
        coarse, fine = (r(step) - r(-step)) / 2e-4, (r(step / 2) - r(-step / 2)) / 1e-4
        numerical = (4.0 * fine - coarse) / 3.0
        scale = max(np.abs(numerical).max(), 1.0)
        np.testing.assert_allclose(J[:, column] / scale, numerical / scale, atol=1e-6)


@pytest.mark.parametrize("per_point", [False, True])
def test_pixels_are_those_of_a_gtsam_camera(make_scene, per_point):
    alignment, cTl, time_offset_s, twist = make_scene(8, per_point=per_point)
    r, _ = residuals(alignment, cTl, time_offset_s, twist)
    camera = alignment.camera
    K = gtsam.Cal3_S2(camera.fx, camera.fy, 0.0, camera.cx, camera.cy)
    for i, tau in enumerate(time_offset_s + alignment.base_taus_s):
        motion = gtsam.Pose3.Expmap(tau * (twist - 0.5 * tau * alignment.c_acceleration))
        lTc = cTl.inverse() * motion  # pose of the camera at its instant in the LiDAR at the point's
        expected = gtsam.PinholeCameraCal3_S2(lTc, K).project(alignment.lPs[i]) - alignment.pixels[i]
        np.testing.assert_allclose(r.reshape(2, -1)[:, i], expected, atol=1e-8)


def test_weighted_rows_and_constant_make_the_robust_cost(make_scene):
    kernel = RobustKernel("geman_mcclure", 1.5)
    alignment, *state = make_scene(2, kernel=kernel, weights=3.0)
    r, J = residuals(alignment, *state)
    rw, Jw, constant = weighted_residuals(alignment, *state)
    x = np.linalg.norm(r.reshape(2, -1), axis=0) / alignment.sigmas_px
    scale = np.tile(np.sqrt(3.0 * kernel.weight(x)) / alignment.sigmas_px, 2)
    np.testing.assert_allclose(rw, scale * r)
    np.testing.assert_allclose(Jw, scale[:, None] * J)
    expected = 3.0 * kernel.loss(x).sum()
    assert 0.5 * (rw @ rw + constant) == pytest.approx(expected, rel=1e-12)
    assert alignment_cost(alignment, *state) == pytest.approx(expected, rel=1e-12)


def test_behind_the_camera_pulls_nowhere_and_costs_a_diagonal():
    alignment = Alignment(CAMERA, [[1.0, 0.0, 10.0], [1.0, 0.0, -10.0]], 0.0, [[57.0, 40.0], [0.0, 0.0]], 2.0)
    r, J = residuals(alignment, gtsam.Pose3(), 0.0, STILL)
    np.testing.assert_allclose(r, [3.0, 0.0, 0.0, 0.0])
    assert np.isfinite(J).all()
    assert (J[[1, 3]] == 0.0).all()
    assert (J[[0, 2]] != 0.0).any()
    diagonal = np.hypot(101, 81)
    expected = 0.5 * (3.0 / 2.0) ** 2 + 0.5 * (diagonal / 2.0) ** 2
    assert alignment_cost(alignment, gtsam.Pose3(), 0.0, STILL) == pytest.approx(expected)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("point", [[0.0, 0.0, 0.0], [1.0, 2.0, 0.0], [1.0, 2.0, -0.1]])
def test_a_point_in_the_plane_of_the_camera_is_behind_without_a_division_by_zero(point):
    alignment = Alignment(CAMERA, [[1.0, 0.0, 10.0], point], 0.0, [[57.0, 40.0], [0.0, 0.0]], 2.0)
    r, J = residuals(alignment, gtsam.Pose3(), 0.0, STILL)
    np.testing.assert_allclose(r, [3.0, 0.0, 0.0, 0.0])
    assert np.isfinite(J).all() and (J[[1, 3]] == 0.0).all()


@pytest.mark.parametrize("kind", ["none", "huber", "cauchy", "geman_mcclure", "tukey"])
def test_no_match_in_the_image_is_worse_than_one_behind(kind):
    # the cost must never fall when a step pushes a match that is seen behind the camera
    kernel = RobustKernel(kind, 3.0)
    behind = alignment_cost(match([0.0, 0.0, -1.0], [50.0, 40.0], kernel=kernel), gtsam.Pose3(), 0.0, STILL)
    for lP in ([5.0, 4.0, 10.0], [-5.0, -4.0, 10.0], [0.1, 0.1, 10.0]):
        seen = alignment_cost(match(lP, [100.0, 80.0], kernel=kernel), gtsam.Pose3(), 0.0, STILL)
        assert seen <= behind


@pytest.mark.parametrize("kind", ["geman_mcclure", "tukey"])
@pytest.mark.parametrize("normals", [None, np.array([[1.0, 0.0]])])
def test_bounded_kernels_do_not_jump_at_the_image_plane(kind, normals):
    alignment = match([1.0, 0.0, 0.0], [50.0, 40.0], kernel=RobustKernel(kind, 3.0), normals=normals)

    def cost(depth):
        return alignment_cost(alignment, gtsam.Pose3(gtsam.Rot3(), [0, 0, depth]), 0.0, STILL)

    assert cost(0.1001) == pytest.approx(cost(0.0999), rel=2e-3)


def test_no_match_at_all():
    alignment = Alignment(CAMERA, np.empty((0, 3)), np.empty(0), np.empty((0, 2)), np.empty(0))
    r, J = residuals(alignment, gtsam.Pose3(), 0.1, np.ones(6))
    assert r.shape == (0,)
    assert J.shape == (0, 13)
    assert alignment_cost(alignment, gtsam.Pose3(), 0.1, np.ones(6)) == 0.0


def test_points_have_no_bias():
    with pytest.raises(FactorError, match="only silhouettes"):
        residuals(match([1.0, 0.0, 10.0], [50.0, 40.0]), gtsam.Pose3(), 0.0, STILL, bias_px=0.0)


@pytest.mark.parametrize("normals", [False, True])
@pytest.mark.parametrize("per_point", [False, True])
@pytest.mark.parametrize("model", ["se3", "translation"])
def test_many_images_at_once_are_each_by_itself(make_scene, normals, per_point, model):
    """Residuals and derivatives of three images' matches in one alignment, a twist for each match."""
    options = {"normals": normals, "per_point": per_point, "motion_model": model}
    parts = [make_scene(seed, 30 + 10 * seed, **options) for seed in range(3)]
    _, cTl, time_offset_s, _ = parts[0]
    counts = [len(alignment) for alignment, *_ in parts]

    def column(name):
        values = [getattr(alignment, name) for alignment, *_ in parts]
        return None if values[0] is None else np.concatenate(values)

    accelerations = np.repeat([alignment.c_acceleration for alignment, *_ in parts], counts, axis=0)
    names = ("lPs", "base_taus_s", "pixels", "sigmas_px", "normals", "weights")
    together = Alignment(
        parts[0][0].camera,
        **{name: column(name) for name in names},
        c_acceleration=accelerations,
        motion_model=model,
    )
    twists = np.repeat([twist for *_, twist in parts], counts, axis=0).T
    bias = np.linspace(-1.0, 1.0, len(together)) if normals else None
    r, J = residuals(together, cTl, time_offset_s, twists, bias)
    rows = together.rows_per_match
    r, J = r.reshape(rows, -1), J.reshape(rows, len(together), -1)
    start = 0
    for (alignment, _, _, twist), count in zip(parts, counts, strict=True):
        own = slice(start, start + count)
        expected, H = residuals(alignment, cTl, time_offset_s, twist, None if bias is None else bias[own])
        np.testing.assert_allclose(r[:, own], expected.reshape(rows, -1), atol=1e-10)
        scale = np.maximum(np.abs(H).max(axis=0), 1.0)
        np.testing.assert_allclose(J[:, own] / scale, H.reshape(rows, count, -1) / scale, atol=1e-12)
        # And apart again.
        back = together.of_one_image(own, alignment.c_acceleration)
        np.testing.assert_array_equal(
            residuals(back, cTl, time_offset_s, twist)[0], residuals(alignment, cTl, time_offset_s, twist)[0]
        )
        start += count
    assert together.take(np.arange(5)).c_acceleration.shape == (5, 6)


def test_a_factor_has_the_matches_of_one_image(make_scene):
    alignment, *_ = make_scene(0, 5)
    several = dataclasses.replace(alignment, c_acceleration=np.zeros((5, 6)))
    with pytest.raises(FactorError, match=r"found shape \(5, 6\), expected shape \(6,\)"):
        frame_factor([several], gtsam.symbol("E", 0), gtsam.symbol("D", 0))
    with pytest.raises(FactorError, match=r"c_acceleration of an alignment.*expected shape \(5, 6\)"):
        dataclasses.replace(alignment, c_acceleration=np.zeros((4, 6)))

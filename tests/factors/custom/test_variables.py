"""Keys, variables and constants of every factor: what is accepted, and how the rest is refused."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from factor_bench import COVARIANCE, NAMES, NEAR, POSE, TWIST, B, Bench, D, E, V, X

from sst_graph.factors import (
    Between,
    DirectionSigmas,
    FactorError,
    GncParams,
    GroupedBias,
    Vector,
    beta_regularizer,
    check_gradient,
    check_jacobians,
    custom_factor,
    extrinsic_drift,
    frame_factor,
    gnc,
    mean_velocity_factor,
    pose_alignment_factor,
    silhouette_factor,
    stacked,
    time_offset_drift,
    time_offset_prior,
    twist_jerk_factor,
    twist_smoothness_factor,
    velocity_direction_factor,
    velocity_factor,
)

NEXT = Between(X[0], X[1], 0.1, 0.02)


@pytest.fixture
def bench(make_scene):
    return Bench(make_scene)


@pytest.mark.parametrize("name", NAMES)
def test_an_offset_may_be_a_vector_or_a_double(bench, name):
    factor = bench.makers()[name](E, D)
    vector, double = bench.values(), bench.values(float(bench.time_offset_s))
    # one factor on both by turns: the type is looked up again where it changes
    for values in (double, vector, double):
        assert factor.error(values) == pytest.approx(factor.error(vector), rel=1e-12)
        np.testing.assert_allclose(
            factor.linearize(values).jacobian()[0], factor.linearize(vector).jacobian()[0], rtol=1e-12
        )


def test_a_graph_with_a_double_offset_is_solved(bench):
    factor = bench.makers()["pose_alignment_factor"](E, D)
    found = {}
    for double in (False, True):
        graph = gtsam.NonlinearFactorGraph()
        graph.add(factor)
        graph.add(time_offset_prior(D, 0.1, 0.05, double=double))
        graph.add(gtsam.PriorFactorPose3(E, bench.cTl, gtsam.noiseModel.Isotropic.Sigma(6, 0.01)))
        for k in range(3):
            pose = gtsam.Pose3.Expmap(0.1 * k * TWIST)
            graph.add(gtsam.PriorFactorPose3(X[k], pose, gtsam.noiseModel.Isotropic.Sigma(6, 1e-3)))
        start = bench.values(0.1 if double else np.array([0.1]))
        solved = gtsam.LevenbergMarquardtOptimizer(graph, start).optimize()
        found[double] = solved.atDouble(D) if double else solved.atVector(D)[0]
    assert found[True] == pytest.approx(found[False], abs=1e-9) and abs(found[True] - 0.1) > 1e-4


def test_drift_of_a_double():
    values = gtsam.Values()
    values.insert(1, 0.3)
    values.insert(2, 0.5)
    assert time_offset_drift(1, 2, 4.0, 0.1, double=True).error(values) == pytest.approx(0.5)


@pytest.mark.parametrize("name", NAMES)
def test_a_symbol_is_its_key(bench, name):
    maker = bench.makers()[name]
    symbols = maker(gtsam.Symbol("E", 0), gtsam.Symbol("D", 0))
    assert symbols.keys() == maker(E, D).keys()
    assert symbols.error(bench.values()) == maker(E, D).error(bench.values())


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    ("wrong", "found"),
    [
        (None, "None"),
        (1.5, "1.5"),
        (True, "True"),
        (-1, "-1"),
        (2**64, str(2**64)),
        ("E0", "the text 'E0'"),
        (np.eye(4), r"shape \(4, 4\)"),
        (np.zeros(6), r"shape \(6,\)"),
        (gtsam.Rot3(), "a Rot3"),
        ([1, 2], "a list of 2"),
    ],
)
def test_what_is_no_extrinsic_is_refused_at_once(bench, name, wrong, found):
    with pytest.raises(FactorError, match=f"of .*: found .*{found}.*, expected .*key"):
        bench.makers()[name](wrong, D)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("wrong", ["D0", True, -1, np.zeros(2), gtsam.Pose3(), [0.1, 0.2]])
def test_what_is_no_offset_is_refused_at_once(bench, name, wrong):
    with pytest.raises(FactorError, match=r"(time_offset_s|D|D_key) of .*: found .*, expected .*key"):
        bench.makers()[name](E, wrong)


@pytest.mark.parametrize("name", NAMES[:8])
def test_an_integer_zero_is_no_offset(bench, name):
    with pytest.raises(
        FactorError, match=r"time_offset_s of .*: found the int 0, expected 0\.0 for the constant"
    ):
        bench.makers()[name](E, 0)
    factor = bench.makers()[name](E, 0.0)
    assert 0 not in factor.keys() and D not in factor.keys()  # noqa: SIM118  (a gtsam factor, no dict)


def test_a_constant_written_as_an_int_is_told(bench):
    factor = silhouette_factor(bench.contour, E, D, V[0], 2)
    with pytest.raises(
        FactorError, match=r"bias 1\) of frame_factor.*no such variable.*2\.0 is the constant"
    ):
        factor.error(bench.values())
    with pytest.raises(FactorError, match="biases_px of frame_factor: found the int 0"):
        silhouette_factor(bench.contour, E, D, V[0], 0)


@pytest.mark.parametrize("name", NAMES)
def test_one_key_for_two_variables_is_refused(bench, name):
    with pytest.raises(
        FactorError, match=r"keys of \w+: found E0.*(cTl and time_offset_s|E and D|E_key and D_key)"
    ):
        bench.makers()[name](E, E)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    ("key", "stored", "found", "expected"),
    [
        (E, np.zeros(6), r"Vector", "Pose3"),
        (E, np.eye(4), "Matrix", "Pose3"),
        (E, gtsam.Rot3(), "Rot3", "Pose3"),
        (E, gtsam.NavState(), "NavState", "Pose3"),
        (E, gtsam.imuBias.ConstantBias(), "ConstantBias", "Pose3"),
        (E, 0.1, "Double", "Pose3"),
        (E, None, "no such variable", "Pose3"),
        (D, np.zeros(2), r"Vector\(2\)", r"Vector\(1\) or double"),
        (D, gtsam.Pose3(), "Pose3", r"Vector\(1\) or double"),
        (D, gtsam.Rot2(), "Rot2", r"Vector\(1\) or double"),
        (D, None, "no such variable", r"Vector\(1\) or double"),
    ],
)
def test_a_variable_of_another_type_is_refused(bench, name, key, stored, found, expected):
    factor, values = bench.makers()[name](E, D), bench.values()
    values.erase(key)
    if stored is not None:
        values.insert(key, stored)
    message = (
        rf"variable {gtsam.DefaultKeyFormatter(key)} \(\w+\) of \w+: found {found}.*, expected {expected}"
    )
    for call in (factor.error, factor.linearize, factor.unwhitenedError):
        with pytest.raises(FactorError, match=message):
            call(values)


def test_a_twist_must_be_a_vector(bench):
    factor, values = mean_velocity_factor(V[0], V[1], TWIST, COVARIANCE), bench.values()
    values.erase(V[0])
    values.insert(V[0], gtsam.Pose3())
    with pytest.raises(FactorError, match=r"V0 \(V_a\) of mean_velocity_factor: found Pose3.*Vector\(6\)"):
        factor.error(values)


@pytest.mark.parametrize(
    "make",
    [
        lambda key: velocity_factor(key, TWIST, COVARIANCE),
        lambda key: velocity_direction_factor(
            key, TWIST[:3], TWIST[3:], 5.0, DirectionSigmas(0.01, 0.01, 0.1)
        ),
        lambda key: mean_velocity_factor(V[1], key, TWIST, COVARIANCE),
        lambda key: twist_smoothness_factor(V[1], key, 0.1, 1.0, 1.0),
        lambda key: twist_jerk_factor(V[1], V[2], key, (0.1, 0.1), 1.0, 1.0),
        lambda key: beta_regularizer(key, POSE, 1.0, 1.0),
        lambda key: time_offset_prior(key, 0.0, 0.1),
        lambda key: time_offset_drift(V[1], key, 1.0, 0.1),
        lambda key: extrinsic_drift(V[1], key, 1.0, 0.1, 0.1),
        lambda key: Between(V[1], key, 0.1, 0.0),
        lambda key: Between(key, V[1], 0.1, 0.0),
        lambda key: custom_factor(
            gtsam.noiseModel.Unit.Create(1), [key], lambda x, *, jacobians: (np.zeros(1), None), [1], 1
        ),
    ],
)
def test_every_key_is_checked(make):
    for wrong in (None, 1.5, "x", True, -3, 2**64, np.zeros(3), POSE):
        with pytest.raises(FactorError, match=r"of \w+.*: found .*, expected a key"):
            make(wrong)
    make(gtsam.Symbol("K", 4))


def test_keys_of_poses_are_checked(bench):
    for wrong in (None, 0.5, "X", POSE):
        for poses in ((wrong, X[1]), (X[0], wrong)):
            with pytest.raises(FactorError, match=r"X_. of Between: found .*, expected a key"):
                Between(*poses, 0.1, 0.0)
        if wrong is not None:
            with pytest.raises(FactorError, match="X_scan of Between"):
                Between(X[0], X[1], 0.1, 0.0, X_scan=wrong)
    for seconds in (None, "1", -1.0, float("nan"), True):
        with pytest.raises(FactorError, match="seconds"):
            Between(X[0], X[1], seconds, 0.0)
    with pytest.raises(FactorError, match="bTl of Between: found an array"):
        Between(X[0], X[1], 0.1, 0.0, bTl=np.eye(4))
    with pytest.raises(FactorError, match="alignments of frame_factor: found a Pose3"):
        frame_factor([POSE], E)
    with pytest.raises(FactorError, match="c_twist of frame_factor: found a Pose3"):
        frame_factor([bench.points], E, D, POSE)


def test_biases_may_share_a_key_but_nothing_else(bench):
    groups = np.arange(len(bench.contour)) % 2
    shared = frame_factor([bench.contour] * 2, E, D, V[0], [B, B])
    assert shared.keys() == [E, D, V[0], B]
    assert frame_factor([bench.contour], E, D, V[0], [GroupedBias((B, B), groups)]).keys() == [E, D, V[0], B]
    with pytest.raises(FactorError, match="D0 for time_offset_s and bias"):
        frame_factor([bench.contour], E, D, V[0], D)
    with pytest.raises(FactorError, match="X1 for X_b and bias 1"):
        pose_alignment_factor([bench.contour], NEXT, E, D, X[1])


# --- custom_factor: any variable that gtsam.Values holds


VARIABLES = {
    "Pose3": NEAR,
    "Rot3": NEAR.rotation(),
    "Pose2": gtsam.Pose2(1.0, 2.0, 0.3),
    "Rot2": gtsam.Rot2(0.4),
    "Point2": gtsam.Point2(1.0, 2.0),
    "Point3": gtsam.Point3(1.0, 2.0, 3.0),
    "Vector": np.arange(7.0),
    "Unit3": gtsam.Unit3(np.array([0.6, 0.0, 0.8])),
    "NavState": gtsam.NavState(NEAR, np.array([1.0, 2.0, 3.0])),
    "ConstantBias": gtsam.imuBias.ConstantBias(np.ones(3), 0.1 * np.ones(3)),
    "Cal3_S2": gtsam.Cal3_S2(700.0, 710.0, 0.1, 600.0, 180.0),
    "Cal3DS2": gtsam.Cal3DS2(700.0, 710.0, 0.1, 600.0, 180.0, 0.01, -0.02, 0.001, 0.002),
    "Cal3Bundler": gtsam.Cal3Bundler(700.0, 0.01, -0.02, 600.0, 180.0),
    "Cal3Fisheye": gtsam.Cal3Fisheye(700.0, 710.0, 0.1, 600.0, 180.0, 0.1, 0.01, 0.0, 0.0),
    "Cal3Unified": gtsam.Cal3Unified(700.0, 710.0, 0.1, 600.0, 180.0, 0.01, -0.02, 0.001, 0.002, 0.3),
    "Similarity3": gtsam.Similarity3(NEAR.rotation(), np.ones(3), 1.5),
    "EssentialMatrix": gtsam.EssentialMatrix(NEAR.rotation(), gtsam.Unit3(np.array([0.6, 0.0, 0.8]))),
    "double": 0.7,
}


def local(reference, value):
    """Tangent coordinates of a value about a reference."""
    if isinstance(reference, float | np.ndarray):
        return np.atleast_1d(value - reference)
    return np.asarray(reference.localCoordinates(value))


@pytest.mark.parametrize("kind", VARIABLES)
def test_any_variable_of_gtsam_may_be_one_of_a_custom_factor(kind):
    """|localCoordinates(reference, x)|^2 / 2, pulled to the reference by LM from a point beside it."""
    reference, values = VARIABLES[kind], gtsam.Values()
    values.insert(4, reference)
    dim = values.dim()
    seen = set()

    def function(x, *, jacobians):
        seen.add(type(x).__name__)
        return local(reference, x), [np.eye(dim)] if jacobians else None

    factor = custom_factor(gtsam.noiseModel.Unit.Create(dim), {"x": 4}, function, [dim], dim)
    step = gtsam.VectorValues()
    step.insert(4, 1e-3 * np.arange(1.0, dim + 1.0))
    graph = gtsam.NonlinearFactorGraph()
    graph.add(factor)
    beside = values.retract(step)
    assert factor.error(beside) > 1e-7
    found = gtsam.LevenbergMarquardtOptimizer(graph, beside).optimize()
    assert factor.error(found) < 1e-12
    expected = "ndarray" if isinstance(reference, float | np.ndarray) else type(reference).__name__
    assert seen == {expected}


@pytest.mark.parametrize("kind", ["Pose3", "NavState", "ConstantBias", "Unit3", "Cal3DS2"])
def test_a_class_may_be_asked_for(kind):
    value = VARIABLES[kind]
    values = gtsam.Values()
    values.insert(4, value)
    dim = values.dim()
    factor = custom_factor(
        gtsam.noiseModel.Unit.Create(dim),
        {"x": 4},
        lambda x, *, jacobians: (local(value, x), [np.eye(dim)] if jacobians else None),
        [type(value)],
        dim,
        "my_factor",
    )
    check_jacobians(factor, values, tolerance=1e-5)
    other = gtsam.Values()
    other.insert(4, np.zeros(dim))
    with pytest.raises(FactorError, match=rf"variable 4 \(x\) of my_factor: found Vector, expected {kind}"):
        factor.error(other)


@pytest.mark.parametrize("kind", [0, -1, None, "6", 2.5, True, float, int, list, gtsam.NonlinearFactorGraph])
def test_what_is_no_kind_of_variable_is_refused(kind):
    with pytest.raises(FactorError, match="kind of a variable"):
        custom_factor(
            gtsam.noiseModel.Unit.Create(1), [1], lambda *x, jacobians: (np.zeros(1), None), [kind], 1
        )


def test_vector_is_a_kind():
    factor = custom_factor(
        gtsam.noiseModel.Unit.Create(3), [1], lambda x, *, jacobians: (x, [np.eye(3)]), [Vector(3)], 3
    )
    values = gtsam.Values()
    values.insert(1, gtsam.Rot3())
    with pytest.raises(FactorError, match=r"found Rot3, expected Vector\(3\)"):
        factor.error(values)


def test_what_is_no_noise_is_refused():
    for wrong in (None, 1.0, np.eye(2)):
        with pytest.raises(FactorError, match="noise of a factor"):
            custom_factor(wrong, [1], lambda x, *, jacobians: (np.zeros(2), None), [1], 2)


# --- noise of a whole image


def test_a_noise_scales_a_whole_image(bench):
    values = bench.values()
    arguments = ([bench.points], NEXT, E, D)
    plain = pose_alignment_factor(*arguments)
    wider = pose_alignment_factor(*arguments, noise=gtsam.noiseModel.Isotropic.Sigma(1, 3.0))
    assert wider.error(values) == pytest.approx(plain.error(values) / 9.0)
    information = [f.linearize(values).information() for f in (plain, wider)]
    np.testing.assert_allclose(information[1], information[0] / 9.0, rtol=1e-9)


@pytest.mark.parametrize("condensed", [True, False])
def test_a_robust_noise_weighs_an_image_by_its_distance(bench, condensed):
    values = bench.values()
    arguments = ([bench.points], NEXT, E, D)
    plain = pose_alignment_factor(*arguments)
    plain = plain if condensed else stacked(plain)
    distance, k = np.sqrt(2.0 * plain.error(values)), 2.0
    huber = gtsam.noiseModel.Robust.Create(
        gtsam.noiseModel.mEstimator.Huber.Create(k), gtsam.noiseModel.Unit.Create(1)
    )
    robust = pose_alignment_factor(*arguments, noise=huber)
    robust = robust if condensed else stacked(robust)
    assert distance > 2 * k
    assert robust.error(values) == pytest.approx(k * (distance - 0.5 * k))
    information = [f.linearize(values).information() for f in (plain, robust)]
    np.testing.assert_allclose(information[1], information[0] * k / distance, rtol=1e-9)


@pytest.mark.parametrize("noise", [1.0, np.eye(1), gtsam.noiseModel.Unit.Create(2), "unit"])
def test_what_is_no_noise_of_an_image_is_refused(bench, noise):
    with pytest.raises(FactorError, match=r"noise of pose_alignment_factor: found .*dimension"):
        pose_alignment_factor([bench.points], NEXT, E, D, noise=noise)


def test_a_value_of_another_kind_than_a_factor_wants_is_named():
    """Of a factor of gtsam, too: before a graph is solved, or Jacobians are compared."""
    noise = gtsam.noiseModel.Isotropic.Sigma(6, 0.1)
    graph = gtsam.NonlinearFactorGraph()
    graph.add(gtsam.PriorFactorPose3(7, gtsam.Pose3(), noise))
    scalar = gtsam.PriorFactorVector(8, np.zeros(1), gtsam.noiseModel.Isotropic.Sigma(1, 0.1))
    values = gtsam.Values()
    values.insert(7, gtsam.Rot3())
    for call in (
        lambda: gnc(graph, values, GncParams(6.0)),
        lambda: check_jacobians(graph.at(0), values),
        lambda: check_gradient(graph.at(0), values),
    ):
        with pytest.raises(FactorError, match="found Rot3 for 7, expected Pose3"):
            call()
    for value, said in ((0.0, "found double for 8, expected Vector"), (np.zeros(2), "a size for 8")):
        values = gtsam.Values()
        values.insert(8, value)
        with pytest.raises(FactorError, match=said):
            check_jacobians(scalar, values)


def test_what_the_callback_of_another_raises_passes():
    def broken(this, values, H):
        raise ZeroDivisionError("a user's own")

    factor = gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(1), [8], broken)
    values = gtsam.Values()
    values.insert(8, 0.0)
    with pytest.raises(ZeroDivisionError, match="a user's own"):
        check_gradient(factor, values)


def test_reports_compare_by_identity():
    values = gtsam.Values()
    values.insert(8, np.zeros(1))
    scalar = gtsam.PriorFactorVector(8, np.zeros(1), gtsam.noiseModel.Isotropic.Sigma(1, 0.1))
    one, other = check_jacobians(scalar, values), check_jacobians(scalar, values)
    assert one == one and one != other and len({one, other, one.blocks[0]}) == 3

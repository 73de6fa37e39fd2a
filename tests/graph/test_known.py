"""What is known beside the matches: a Gaussian that follows parameters of assumptions."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from sst_graph.assumptions import ASSUMPTIONS
from sst_graph.factors.camera import PinholeCamera
from sst_graph.graph.known import KnownCalibration, motion_steps
from sst_graph.graph.state import EXTRINSIC, State, nuisance_key, time_offset_key

CAMERA = PinholeCamera(700.0, 720.0, 610.0, 170.0, 1242, 375)
AXES = gtsam.Rot3(np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]))
cTl = gtsam.Pose3(AXES * gtsam.Rot3.Expmap(np.array([0.01, -0.02, 0.03])), np.array([0.1, -0.3, -0.2]))
OFFSET_S = 0.05
SIGMAS = np.array([0.01, 0.02, 0.03, 0.1, 0.2, 0.3, 0.005])
STEPS = {"cx": np.array([0.01, 0.0, 0.02, 0.0, 0.1, 0.0, 0.0]), "skew": np.array([*[0.0] * 6, 2.0])}


def known() -> KnownCalibration:
    rng = np.random.default_rng(7)
    root = np.diag(SIGMAS) @ (np.eye(7) + 0.2 * rng.standard_normal((7, 7)))
    return KnownCalibration(State(cTl, (OFFSET_S,)), root @ root.T, STEPS)


def values(step: np.ndarray, **parameters: float) -> gtsam.Values:
    at = gtsam.Values()
    at.insert(EXTRINSIC, cTl.retract(step[:6]))
    at.insert(time_offset_key(), np.array([OFFSET_S + step[6]]))
    for name, theta in parameters.items():
        at.insert(nuisance_key(name), np.array([theta]))
    return at


def test_a_gaussian_by_hand() -> None:
    """At the mean it costs nothing; half of the squared whitened step beside it."""
    factor = KnownCalibration(State(cTl, (OFFSET_S,)), np.diag(SIGMAS**2)).factor()
    step = np.array([0.0, 0.0, 0.0, 0.1, 0.0, 0.0, 0.01])
    assert factor.error(values(np.zeros(7))) == pytest.approx(0.0, abs=1e-12)
    assert factor.error(values(step)) == pytest.approx(0.5 * (1.0 + 4.0))


def test_the_mean_follows_parameters_that_are_free() -> None:
    factor = known().factor(["skew", "cx", "k1"])
    assert set(factor.keys()) == {EXTRINSIC, time_offset_key(), nuisance_key("cx"), nuisance_key("skew")}
    there = -0.3 * STEPS["cx"] + 0.02 * STEPS["skew"]
    assert factor.error(values(there, cx=0.3, skew=-0.02)) == pytest.approx(0.0, abs=1e-5)
    assert factor.error(values(there, cx=0.0, skew=0.0)) > 1.0
    assert known().factor(["cx"]).error(values(0.0 * there, cx=0.3)) == pytest.approx(
        0.5 * 0.09 * STEPS["cx"] @ known().information @ STEPS["cx"]
    )


def test_information_shared_with_parameters_is_that_of_the_factor() -> None:
    factor = known().factor(["cx"]).linearize(values(np.zeros(7), cx=0.0))
    ordering = gtsam.Ordering()
    for key in (EXTRINSIC, time_offset_key(), nuisance_key("cx")):
        ordering.push_back(key)
    graph = gtsam.GaussianFactorGraph()
    graph.add(factor)
    H, _ = graph.hessian(ordering)
    np.testing.assert_allclose(H[:7, 7:], known().shared(["cx"]), rtol=1e-6)
    np.testing.assert_array_equal(known().shared(["k1"]), np.zeros((7, 1)))
    np.testing.assert_allclose(known().with_share(0.5).information, 0.5 * known().information, rtol=1e-9)


@pytest.mark.parametrize("name", ["cx", "cy"])
def test_a_principal_point_turns_the_camera_that_motion_sees(name: str) -> None:
    """Pixels of points ahead, made by the true camera and read by the given one, are rays of a camera that is
    turned: so a camera that moves along its axis seems to move in that direction, too."""
    assert {each for each in ASSUMPTIONS if each in motion_steps(CAMERA, cTl)} == {"cx", "cy"}
    pixels, axis = 4.0, ["cx", "cy"].index(name)
    focal = [CAMERA.fx, CAMERA.fy][axis]
    seen = cTl.compose(gtsam.Pose3.Expmap(pixels * motion_steps(CAMERA, cTl)[name][:6]))
    ahead = np.asarray(seen.transformFrom(cTl.inverse().transformFrom(np.array([0.0, 0.0, 20.0]))))
    expected = np.zeros(2)
    expected[axis] = pixels / focal
    np.testing.assert_allclose(ahead[:2] / ahead[2], expected, atol=1e-7)
    # The camera itself stays where it is.
    np.testing.assert_allclose(seen.inverse().translation(), cTl.inverse().translation(), atol=1e-9)

"""The twist transfer: sign by hand, derivatives, and gtsam's conjugation as an oracle."""

from __future__ import annotations

from itertools import pairwise

import gtsam
import numpy as np
import pytest

from sst_graph.factors import FactorError, LidarTwist, check_jacobians, twist_transfer_factor
from sst_graph.factors.velocity import transferred

V, E, D = gtsam.symbol("V", 0), gtsam.symbol("E", 0), gtsam.symbol("D", 0)


def values_at(twist: np.ndarray, cTl: gtsam.Pose3, time_offset_s: float) -> gtsam.Values:
    values = gtsam.Values()
    values.insert(V, twist)
    values.insert(E, cTl)
    values.insert(D, np.array([time_offset_s]))
    return values


def random_pose(rng: np.random.Generator) -> gtsam.Pose3:
    return gtsam.Pose3(gtsam.Rot3.Expmap(rng.normal(0.0, 1.2, 3)), rng.normal(0.0, 2.0, 3))


def random_covariance(rng: np.random.Generator) -> np.ndarray:
    A = rng.normal(0.0, 1.0, (6, 6))
    return A @ A.T + 0.5 * np.eye(6)


def test_signs_by_hand() -> None:
    # LiDAR x forward, y left, z up; the camera looks along x, and its z axis is the LiDAR's x.
    cRl = gtsam.Rot3(np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]))
    # The camera sits 2 m before the LiDAR: the LiDAR's origin is 2 m behind it.
    cTl = gtsam.Pose3(cRl, np.array([0.0, 0.0, -2.0]))
    forward_and_left_turn = np.array([0.0, 0.0, 0.5, 10.0, 0.0, 0.0])
    braking = np.array([0.0, 0.0, 0.0, -3.0, 0.0, 0.0])
    factor = twist_transfer_factor(V, E, D, LidarTwist(forward_and_left_turn, braking, 0.1), np.eye(6))
    # 0.3 s later it drives 9.1 m/s; a left turn of 0.5 rad/s swings the camera leftward by 1 m/s.
    expected = np.array([0.0, -0.5, 0.0, -1.0, 0.0, 9.1])
    error = factor.unwhitenedError(values_at(expected, cTl, 0.4))
    np.testing.assert_allclose(error, 0.0, atol=1e-12)
    faster = expected + np.array([0.0, 0.0, 0.0, 0.0, 0.0, 2.0])
    assert factor.unwhitenedError(values_at(faster, cTl, 0.4))[5] == pytest.approx(2.0)
    # A later instant is a slower one, so the same V is then too fast.
    assert factor.unwhitenedError(values_at(expected, cTl, 0.5))[5] == pytest.approx(0.3)


@pytest.mark.parametrize("seed", range(100))
def test_jacobians(seed: int) -> None:
    rng = np.random.default_rng(seed)
    twist, rate = rng.normal(0.0, 3.0, (2, 6))
    lidar_twist = LidarTwist(twist, rate, rng.normal(0.0, 0.1))
    factor = twist_transfer_factor(V, E, D, lidar_twist, random_covariance(rng))
    values = values_at(rng.normal(0.0, 3.0, 6), random_pose(rng), rng.normal(0.0, 0.3))
    assert check_jacobians(factor, values).error < 1e-6


@pytest.mark.parametrize("seed", range(20))
def test_conjugated_motion(seed: int) -> None:
    rng = np.random.default_rng(seed)
    cTl, seconds = random_pose(rng), 0.05
    l_twist = rng.normal(0.0, 2.0, 6)
    aTb = gtsam.Pose3.Expmap(seconds * l_twist)
    c_motion = cTl.compose(aTb).compose(cTl.inverse())
    c_twist = np.asarray(gtsam.Pose3.Logmap(c_motion)) / seconds
    factor = twist_transfer_factor(V, E, D, LidarTwist(l_twist, np.zeros(6), 0.2), np.eye(6))
    values = values_at(c_twist, cTl, rng.normal())
    np.testing.assert_allclose(factor.unwhitenedError(values), 0.0, atol=1e-10)


def test_whitened_by_the_covariance() -> None:
    rng = np.random.default_rng(3)
    covariance, l_twist, twist = random_covariance(rng), rng.normal(size=6), rng.normal(size=6)
    factor = twist_transfer_factor(V, E, D, LidarTwist(l_twist, np.zeros(6), 0.0), covariance)
    error = twist - l_twist
    cost = factor.error(values_at(twist, gtsam.Pose3(), 0.0))
    assert cost == pytest.approx(0.5 * error @ np.linalg.solve(covariance, error))


@pytest.mark.parametrize(
    ("twist", "rate", "covariance"),
    [
        (np.zeros(5), np.zeros(6), np.eye(6)),
        (np.zeros(6), np.full(6, np.nan), np.eye(6)),
        (np.zeros(6), np.zeros(6), -np.eye(6)),
        (np.zeros(6), np.zeros(6), np.eye(3)),
    ],
)
def test_bad_arguments(twist: np.ndarray, rate: np.ndarray, covariance: np.ndarray) -> None:
    with pytest.raises(FactorError):
        twist_transfer_factor(V, E, D, LidarTwist(twist, rate, 0.0), covariance)


def test_many_images_at_once_are_each_by_itself() -> None:
    rng = np.random.default_rng(5)
    l_twists, rates, c_twists = rng.normal(0.0, 3.0, (3, 7, 6))
    cTl, time_offset_s = random_pose(rng), 0.13
    found = transferred(l_twists, rates, np.full((7, 1), time_offset_s - 0.1), c_twists, cTl, True)
    for k, (error, by_cTl, by_offset) in enumerate(zip(*found, strict=True)):
        factor = twist_transfer_factor(V, E, D, LidarTwist(l_twists[k], rates[k], 0.1), np.eye(6))
        values = values_at(c_twists[k], cTl, time_offset_s)
        np.testing.assert_allclose(error, factor.unwhitenedError(values), atol=1e-12)
        linear = factor.linearize(values)
        A, _ = linear.jacobian()
        columns = {key: A[:, place] for key, place in zip(linear.keys(), _places(linear), strict=True)}
        np.testing.assert_allclose(by_cTl, columns[E], atol=1e-12)
        np.testing.assert_allclose(by_offset[:, None], columns[D], atol=1e-12)


def _places(linear: gtsam.JacobianFactor) -> list[slice]:
    """Columns of each key."""
    ends = np.cumsum([0, *({V: 6, E: 6, D: 1}[key] for key in linear.keys())])  # noqa: SIM118
    return [slice(a, b) for a, b in pairwise(ends)]

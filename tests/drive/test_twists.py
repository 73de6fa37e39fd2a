"""Twists over time, and from one sensor to the other."""

from __future__ import annotations

from collections.abc import Callable

import gtsam
import numpy as np
import pytest

from sst_graph.drive.twists import SensorTwists, TwistSample, camera_twist
from sst_graph.types import RelativeMotion

EPOCH_NS = 1_700_000_000_123_456_789
SCREW = np.array([0.1, -0.2, 0.4, 3.0, 0.5, -0.2])
SIGMAS = np.array([1e-3, 2e-3, 3e-3, 0.01, 0.02, 0.03])


def way(seconds: np.ndarray | float) -> np.ndarray | float:
    """Way along the screw, at a constant acceleration."""
    return 2.0 * seconds + 0.5 * 1.5 * seconds**2


def speed(seconds: float) -> float:
    return 2.0 + 1.5 * seconds


def motions(stamps_s: list[float], along: Callable = way) -> list[RelativeMotion]:
    stamps_ns = [EPOCH_NS + round(t * 1e9) for t in stamps_s]
    return [
        RelativeMotion(a_ns, b_ns, gtsam.Pose3.Expmap(SCREW * (along(b) - along(a))), np.diag(SIGMAS**2))
        for a, b, a_ns, b_ns in zip(stamps_s, stamps_s[1:], stamps_ns, stamps_ns[1:], strict=False)
    ]


@pytest.mark.parametrize("t", [0.06, 0.1, 0.137, 0.21, 0.3])
def test_exact_under_constant_acceleration(t: float) -> None:
    twists = SensorTwists(motions([0.0, 0.1, 0.22, 0.3, 0.41]))
    sample = twists.at(EPOCH_NS + round(t * 1e9))
    np.testing.assert_allclose(sample.twist, SCREW * speed(t), atol=1e-6)
    np.testing.assert_allclose(sample.acceleration, SCREW * 1.5, atol=1e-5)


def test_both_ends_of_the_drive_are_reached() -> None:
    twists = SensorTwists(motions([0.0, 0.1, 0.2, 0.3]))
    for t in (0.0, 0.3):
        np.testing.assert_allclose(twists.at(EPOCH_NS + round(t * 1e9)).twist, SCREW * speed(t), atol=1e-6)
    # Beyond them the twist is held, and known less and less as far as the acceleration goes.
    late, later = (twists.at(EPOCH_NS + round(t * 1e9)) for t in (0.35, 2.0))
    np.testing.assert_allclose(late.twist, SCREW * speed(0.3), atol=1e-6)
    np.testing.assert_allclose(later.twist, late.twist)
    inside = twists.at(EPOCH_NS + 200_000_000)
    assert (np.diag(later.covariance) > np.diag(inside.covariance)).all()


def test_covariance_between_two_measured_intervals() -> None:
    twists = SensorTwists(motions([0.0, 0.1, 0.2]))
    rate = np.diag(SIGMAS**2) / 0.1**2
    np.testing.assert_allclose(twists.at(EPOCH_NS + 50_000_000).covariance, rate, rtol=1e-5)
    # The errors of neighbours may be one.
    np.testing.assert_allclose(twists.at(EPOCH_NS + 100_000_000).covariance, rate, rtol=1e-5)


@pytest.mark.parametrize("count", [1, 5])
def test_many_stamps_at_once_are_each_by_itself(count: int) -> None:
    twists = SensorTwists(motions([0.0, 0.1, 0.22, 0.3, 0.41, 0.5][: count + 1], lambda t: way(t) + t**3))
    stamps = [EPOCH_NS + round(t * 1e9) for t in (-1.0, 0.31, 0.02, 0.16, 0.31, 0.47, 3.0)]
    found = twists.at_all(stamps)
    assert len(found) == len(stamps)
    for k, stamp in enumerate(stamps):
        one = twists.at(stamp)
        np.testing.assert_allclose(found.twists[k], one.twist, rtol=1e-12)
        np.testing.assert_allclose(found.accelerations[k], one.acceleration, rtol=1e-12)
        np.testing.assert_allclose(found.covariances[k], one.covariance, rtol=1e-12)


def test_a_pitching_that_is_just_seen_is_followed() -> None:
    """1.5 Hz at 10 Hz: straight lines through the means of the intervals are 15 % short at the stamps."""
    turned = 2.0 * np.pi * 1.5
    twists = SensorTwists(motions(np.arange(0.0, 2.01, 0.1).tolist(), lambda t: np.sin(turned * t) / turned))
    times = np.arange(0.4, 1.6, 0.013)
    found = twists.at_all([EPOCH_NS + round(t * 1e9) for t in times])
    expected = SCREW * np.cos(turned * times)[:, None]
    assert np.abs(found.twists - expected).max() < 0.025 * np.abs(SCREW).max()
    rates = -turned * SCREW * np.sin(turned * times)[:, None]
    assert np.abs(found.accelerations - rates).max() < 0.15 * turned * np.abs(SCREW).max()


def test_exact_under_a_steady_jerk_where_neighbours_are_known() -> None:
    stamps = [0.0, 0.1, 0.22, 0.3, 0.41, 0.5]
    twists = SensorTwists(motions(stamps, lambda t: 2.0 * t + t**3))
    for t in (0.16, 0.2, 0.25, 0.3):
        sample = twists.at(EPOCH_NS + round(t * 1e9))
        np.testing.assert_allclose(sample.twist, SCREW * (2.0 + 3.0 * t**2), atol=1e-6)
        np.testing.assert_allclose(sample.acceleration, SCREW * 6.0 * t, atol=1e-5)


def test_standstill_stays_exactly_still() -> None:
    stamps = np.arange(0.0, 1.01, 0.1).tolist()
    twists = SensorTwists(motions(stamps, lambda t: max(t - 0.5, 0.0) ** 2))
    before = [EPOCH_NS + round(t * 1e9) for t in (0.05, 0.2, 0.33, 0.4, 0.45)]
    assert not twists.at_all(before).twists.any()


def test_a_single_motion_is_held() -> None:
    twists = SensorTwists(motions([0.0, 0.1]))
    for t in (-1.0, 0.05, 3.0):
        sample = twists.at(EPOCH_NS + round(t * 1e9))
        np.testing.assert_allclose(sample.twist, SCREW * speed(0.05), atol=1e-9)
        assert not sample.acceleration.any()


def test_camera_twist_by_hand() -> None:
    # The camera looks along the LiDAR's x axis, 2 m before it (its z axis is the LiDAR's x).
    cRl = gtsam.Rot3(np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]))
    cTl = gtsam.Pose3(cRl, np.array([0.0, 0.0, -2.0]))
    turning = TwistSample(
        np.array([0.0, 0.0, 0.5, 10.0, 0.0, 0.0]), np.array([0.0, 0.0, 0.0, -3.0, 0.0, 0.0]), np.eye(6) * 0.01
    )
    sample = camera_twist(turning, cTl)
    # A left turn: about -y, and the camera ahead swings to its left.
    np.testing.assert_allclose(sample.twist, [0.0, -0.5, 0.0, -1.0, 0.0, 10.0], atol=1e-12)
    np.testing.assert_allclose(sample.acceleration, [0.0, 0.0, 0.0, 0.0, 0.0, -3.0], atol=1e-12)
    # Sideways and vertical velocities of the camera take in the turn's noise over the 2 m arm.
    expected = 0.01 * np.array([1.0, 1.0, 1.0, 5.0, 5.0, 1.0])
    np.testing.assert_allclose(np.diag(sample.covariance), expected, atol=1e-12)

"""Frames at standstill, from motions."""

from __future__ import annotations

import gtsam
import numpy as np

from sst_graph.odometry.standstill import standstill_frames
from sst_graph.types import RelativeMotion

PERIOD_NS = 100_000_000


def motions_at(
    speeds_mps: list[float], sigma_mps: float = 0.01, turn_radps: float = 0.0, ok: bool = True
) -> list[RelativeMotion]:
    """Motions along z at these speeds."""
    covariance = np.diag(np.repeat([1e-4, 0.1 * sigma_mps], 3) ** 2)
    return [
        RelativeMotion(
            k * PERIOD_NS,
            (k + 1) * PERIOD_NS,
            gtsam.Pose3.Expmap(0.1 * np.array([0, turn_radps, 0, 0, 0, speed])),
            covariance,
            ok,
        )
        for k, speed in enumerate(speeds_mps)
    ]


def test_a_stop_between_driving() -> None:
    found = standstill_frames(motions_at([2.0, 1.0, 0.4, 0.01, 0.0, 0.02, 0.5, 2.0]))
    # frame 3 still rolled up to it, frame 6 rolls on from it
    assert np.flatnonzero(found).tolist() == [4, 5]
    assert len(found) == 9


def test_both_ends_of_a_drive_may_stand() -> None:
    assert np.flatnonzero(standstill_frames(motions_at([0.0, 0.0, 3.0, 0.0, 0.0]))).tolist() == [0, 1, 4, 5]


def test_slow_turning_failed_or_uncertain_motion_is_no_standstill() -> None:
    assert not standstill_frames(motions_at([0.2] * 6)).any()
    assert not standstill_frames(motions_at([0.0] * 6, turn_radps=0.1)).any()
    assert not standstill_frames(motions_at([0.0] * 6, ok=False)).any()
    assert not standstill_frames(motions_at([0.0] * 6, sigma_mps=0.3)).any()


def test_one_quiet_motion_is_no_stop() -> None:
    assert not standstill_frames(motions_at([1.0, 0.0, 1.0])).any()
    assert standstill_frames(motions_at([1.0, 0.0, 0.0, 1.0])).tolist() == [False, False, True, False, False]
    assert not standstill_frames(motions_at([0.0])).any()


def test_no_motion_at_all() -> None:
    assert standstill_frames([]).tolist() == [False]


def test_false_alarms_at_a_slow_roll_with_noise() -> None:
    # 0.25 m/s measured with 0.05 m/s noise: far enough from standstill never to be taken for it
    rng = np.random.default_rng(0)
    speeds = (0.25 + rng.normal(0.0, 0.05, 2000)).tolist()
    assert not standstill_frames(motions_at(speeds, sigma_mps=0.05)).any()


def test_noise_of_one_motion_does_not_end_a_standstill() -> None:
    """Pose errors of 5 mm: every motion seems to go at 5 cm/s or more, forth and back."""
    found, rolling = [], []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        poses = 0.005 * rng.normal(size=13)
        for speed, frames in ((0.0, found), (0.3, rolling)):
            seen = np.diff(poses) / 0.1 + speed
            frames.append(standstill_frames(motions_at(seen.tolist(), sigma_mps=0.07)))
    assert np.mean(found) > 0.9
    assert not np.any(rolling)

"""The LiDAR's path between its stamps: exact at stamps, smooth between them, honest about its noise."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
import pytest

from sst_graph.drive.path import PathSteps, SensorPath
from sst_graph.types import RelativeMotion

PERIOD_NS = 100_000_000
COVARIANCE = np.diag([1e-6] * 3 + [4e-6] * 3)


def weaving(t: float) -> gtsam.Pose3:
    """Pose at a time [s]: 8 m/s, swaying and turning."""
    rotation = gtsam.Rot3.RzRyRx(0.01 * np.sin(7.0 * t), 0.01 * np.sin(8.0 * t), 0.5 * np.sin(0.8 * t))
    return gtsam.Pose3(rotation, np.array([8.0 * t, 2.0 * np.sin(0.7 * t), 0.1 * np.sin(1.1 * t)]))


def pitching(t: float) -> gtsam.Pose3:
    """Pose at a time [s]: 8 m/s, pitching and heaving at 1.5 Hz."""
    wave = np.sin(2.0 * np.pi * 1.5 * t)
    return gtsam.Pose3(gtsam.Rot3.RzRyRx(0.0, 0.03 * wave, 0.0), np.array([8.0 * t, 0.0, 0.02 * wave]))


def motions(pose: Callable[[float], gtsam.Pose3], stamps_ns: list[int]) -> list[RelativeMotion]:
    return [
        RelativeMotion(a, b, pose(a * 1e-9).between(pose(b * 1e-9)), COVARIANCE)
        for a, b in itertools.pairwise(stamps_ns)
    ]


def step_of(path: SensorPath, from_ns: int, to_ns: int) -> PathSteps | None:
    """The motion from one time to a later one by itself; None where the path does not reach."""
    steps = path.steps(np.array([from_ns], np.int64), np.array([to_ns], np.int64))
    return steps if len(steps) else None


def evenly(count: int) -> list[int]:
    return [k * PERIOD_NS for k in range(count)]


def test_at_a_stamp_it_is_the_measured_pose() -> None:
    path = SensorPath(motions(weaving, evenly(8)))
    for k in range(8):
        step = step_of(path, 0, k * PERIOD_NS)
        assert step is not None
        assert gtsam.Pose3(step.aTbs[0]).equals(weaving(0.0).between(weaving(0.1 * k)), 1e-9)


@pytest.mark.parametrize("jitter", [0, 9_000_000])
def test_between_stamps_it_follows_the_motion(jitter: int) -> None:
    stamps = [k * PERIOD_NS + jitter * (k % 3) for k in range(40)]
    path = SensorPath(motions(weaving, stamps))
    for t in np.arange(0.15, 3.6, 0.037):
        step = step_of(path, round(t * 1e9), round((t + 0.1) * 1e9))
        assert step is not None
        error = weaving(t).between(weaving(t + 0.1)).localCoordinates(gtsam.Pose3(step.aTbs[0]))
        assert np.abs(error[:3]).max() < 4e-4 and np.abs(error[3:]).max() < 4e-3
        h = 1e-5
        twist = gtsam.Pose3.Logmap(weaving(t - h).between(weaving(t + h))) / (2.0 * h)
        np.testing.assert_allclose(step.twists_a[0, :3], twist[:3], atol=0.02)
        np.testing.assert_allclose(step.twists_a[0, 3:], twist[3:], atol=0.1)


@pytest.mark.parametrize("jitter", [0, 9_000_000])
@pytest.mark.parametrize(
    ("way", "bounds"), [(weaving, (3e-5, 1e-4, 2e-3, 4e-3)), (pitching, (2e-4, 7e-4, 0.008, 0.02))]
)
def test_far_from_the_ends_it_follows_closely(
    way: Callable[[float], gtsam.Pose3], bounds: tuple[float, ...], jitter: int
) -> None:
    path = SensorPath(motions(way, [k * PERIOD_NS + jitter * (k % 3) for k in range(40)]))
    for t in np.arange(0.35, 3.4, 0.0371):
        step = step_of(path, round(t * 1e9), round((t + 0.1) * 1e9))
        assert step is not None
        error = way(t).between(way(t + 0.1)).localCoordinates(gtsam.Pose3(step.aTbs[0]))
        twist = gtsam.Pose3.Logmap(way(t - 1e-5).between(way(t + 1e-5))) / 2e-5 - step.twists_a[0]
        found = [np.abs(part).max() for part in (error[:3], error[3:], twist[:3], twist[3:])]
        assert (np.array(found) < bounds).all()


def test_twists_are_continuous_at_stamps() -> None:
    path = SensorPath(motions(weaving, evenly(12)))
    for k in range(2, 10):
        step = step_of(path, k * PERIOD_NS - 1000, k * PERIOD_NS + 1000)
        assert step is not None
        np.testing.assert_allclose(step.twists_a[0], step.twists_b[0], atol=2e-2)


def test_steady_motion_by_hand() -> None:
    """2 m/s along x: from 0.13 s to 0.27 s it moves 0.28 m."""
    path = SensorPath(motions(lambda t: gtsam.Pose3(gtsam.Rot3(), np.array([2.0 * t, 0, 0])), evenly(5)))
    step = step_of(path, 130_000_000, 270_000_000)
    assert step is not None
    np.testing.assert_allclose(gtsam.Pose3(step.aTbs[0]).translation(), [0.28, 0, 0], atol=1e-12)
    np.testing.assert_allclose(step.twists_b[0], [0, 0, 0, 2.0, 0, 0], atol=1e-12)


def test_no_path_beyond_the_ends_or_over_a_failure() -> None:
    found = motions(weaving, evenly(8))
    path = SensorPath(found)
    assert step_of(path, -1, 50_000_000) is None and step_of(path, 650_000_000, 710_000_000) is None
    broken = SensorPath([replace(m, ok=k != 3) for k, m in enumerate(found)])
    assert step_of(broken, 340_000_000, 360_000_000) is None
    assert step_of(broken, 250_000_000, 450_000_000) is None
    assert step_of(broken, 110_000_000, 290_000_000) is not None
    assert step_of(broken, 410_000_000, 690_000_000) is not None
    assert step_of(SensorPath([]), 0, 0) is None


@pytest.mark.parametrize("failed", [0, 3, 6])
def test_with_equal_stamps_only_the_failed_motion_is_lost(failed: int) -> None:
    """The one before it ends where it begins."""
    stamps = np.array(evenly(8), np.int64)
    path = SensorPath([replace(m, ok=k != failed) for k, m in enumerate(motions(weaving, stamps.tolist()))])
    assert path.steps(stamps[:-1], stamps[1:]).found.tolist() == [k for k in range(7) if k != failed]
    assert len(path.steps(stamps[:-2], stamps[2:])) == 6 - len({failed - 1, failed} & set(range(6)))


def test_noise_between_stamps_by_simulation() -> None:
    """White noise of the poses gives the claimed covariance of a step, at a stamp and between two."""
    rng, sigma = np.random.default_rng(5), np.sqrt(0.5 * COVARIANCE[0, 0])
    for fraction in (0.0, 0.3, 0.5):
        a = round((3 + fraction) * PERIOD_NS)
        turns, claimed, twists, of_twist = [], None, [], None
        for _ in range(400):
            noise = sigma * rng.standard_normal((9, 3))
            poses = [gtsam.Pose3(gtsam.Rot3.Expmap(n), np.zeros(3)) for n in noise]
            path = SensorPath(motions(lambda t, poses=poses: poses[round(10 * t)], evenly(9)))
            step, later = step_of(path, a, a + PERIOD_NS), step_of(path, a + 1000, a + 1000 + PERIOD_NS)
            assert step is not None and later is not None
            turns.append(gtsam.Rot3.Logmap(gtsam.Pose3(step.aTbs[0]).rotation()))
            twists.append((gtsam.Rot3.Logmap(gtsam.Pose3(later.aTbs[0]).rotation()) - turns[-1]) / 1e-6)
            claimed, of_twist = step.covariances[0, 0, 0], step.twist_covariances[0, 0, 0]
        assert np.var(turns) == pytest.approx(claimed, rel=0.15)
        assert np.var(twists) == pytest.approx(of_twist, rel=0.15)


def test_rate_of_the_noise_is_that_of_the_poses_whatever_is_stated() -> None:
    """The derivative of the covariance, by the noise that the poses have."""
    rng, sigma = np.random.default_rng(6), 0.3 * np.sqrt(0.5 * COVARIANCE[0, 0])
    poses = [weaving(0.1 * k).retract(sigma * rng.standard_normal(6)) for k in range(200)]
    path = SensorPath(motions(lambda t: poses[round(10 * t)], evenly(200)))
    for fraction in (0.1, 0.25, 0.4, 0.8):
        a, h = round((103 + fraction) * PERIOD_NS), 10_000
        before, here, after = (step_of(path, t, t + PERIOD_NS) for t in (a - h, a, a + h))
        assert before is not None and here is not None and after is not None
        stated = (after.covariances - before.covariances)[0, 0, 0] / (2e-9 * h)
        np.testing.assert_allclose(here.noise_rates[0, :3], 0.09 * stated, rtol=0.4)
    assert after.covariances[0, 0, 0] < COVARIANCE[0, 0]


def rocking(t: float) -> gtsam.Pose3:
    """Pose at a time [s]: stops at 1.5 s and rocks back, 0.5 deg within 0.3 s."""
    angle = np.radians(0.5) * np.exp(-6.0 * max(t - 1.5, 0.0)) * np.sin(10.0 * max(t - 1.5, 0.0))
    return gtsam.Pose3(gtsam.Rot3.Ry(angle), np.array([8.0 * min(t, 1.5), 0.0, 0.0]))


def test_what_is_between_stamps_is_in_the_covariance() -> None:
    """Errors in the middle between stamps, at all phases of the stamps, over what is said of them."""
    starts = np.arange(4, 34) * PERIOD_NS + PERIOD_NS // 2
    by_noise = SensorPath(motions(weaving, evenly(40))).steps(starts, starts + PERIOD_NS).covariances[:, 1, 1]
    errors, variances = [], []
    for phase_ns in range(0, PERIOD_NS, PERIOD_NS // 10):
        path = SensorPath(motions(lambda t, phase=phase_ns: rocking(t + 1e-9 * phase), evenly(40)))
        steps = path.steps(starts, starts + PERIOD_NS)
        for a, aTb in zip(starts, steps.aTbs, strict=True):
            ends = [rocking(1e-9 * (t + phase_ns)) for t in (a, a + PERIOD_NS)]
            turn = gtsam.Pose3(aTb).rotation().between(ends[0].between(ends[1]).rotation())
            errors.append(gtsam.Rot3.Logmap(turn)[1])
        variances += (steps.covariances[:, 1, 1] - by_noise).tolist()
    assert np.abs(errors).max() > np.radians(0.05)
    assert 0.5 < np.sqrt(np.mean(np.square(errors)) / np.mean(variances)) < 2.0


def test_noise_is_hardly_taken_for_what_is_between_stamps() -> None:
    rng, sigma = np.random.default_rng(7), np.sqrt(0.5 * COVARIANCE[0, 0])
    turns = rng.standard_normal((200, 3))
    noisy = [gtsam.Pose3(gtsam.Rot3.Expmap(sigma * turn), np.zeros(3)) for turn in turns]
    found = []
    for poses in (noisy, [gtsam.Pose3()] * 200):
        path = SensorPath(motions(lambda t, poses=poses: poses[round(10 * t)], evenly(200)))
        starts = np.arange(5, 190) * PERIOD_NS + PERIOD_NS // 2
        found.append(path.steps(starts, starts + PERIOD_NS).covariances[:, 0, 0].mean())
    assert 1.0 <= found[0] / found[1] < 1.25


def test_at_stamps_nothing_is_between() -> None:
    starts = np.arange(40) * PERIOD_NS
    still = SensorPath(motions(weaving, evenly(42))).steps(starts, starts + PERIOD_NS)
    rocks = SensorPath(motions(rocking, evenly(42))).steps(starts, starts + PERIOD_NS)
    np.testing.assert_allclose(rocks.covariances, still.covariances, rtol=1e-9)


@pytest.mark.parametrize(("hz", "most_s"), [(1.5, 1e-5), (2.5, 5e-4), (3.1, 2e-3)])
@pytest.mark.parametrize("fraction", [0.2, 0.8])
def test_fast_motion_is_not_held_near_the_stamps(hz: float, most_s: float, fraction: float) -> None:
    """The path is where the motion is at that time, and not earlier or later, at all phases of the motion."""

    def angle(t: Any) -> Any:
        return 0.002 * np.sin(2.0 * np.pi * hz * t)

    def pose(t: float) -> gtsam.Pose3:
        return gtsam.Pose3(gtsam.Rot3.Ry(angle(t)), np.zeros(3))

    path = SensorPath(motions(pose, evenly(70)))
    stamps = np.arange(5, 65) * PERIOD_NS
    times = stamps + round(fraction * PERIOD_NS)
    steps = path.steps(stamps, times)
    found = angle(1e-9 * stamps) + np.array([gtsam.Rot3.Logmap(gtsam.Rot3(T[:3, :3]))[1] for T in steps.aTbs])
    rates = (angle(1e-9 * times + 1e-5) - angle(1e-9 * times - 1e-5)) / 2e-5
    late_s = rates @ (found - angle(1e-9 * times)) / (rates @ rates)
    assert abs(late_s) < most_s


@pytest.mark.parametrize(("hz", "least", "most"), [(2.5, 1.2, 2.0), (3.1, 1.0, 1.5), (3.5, 0.8, 1.2)])
def test_what_is_smoothed_away_of_fast_motion(hz: float, least: float, most: float) -> None:
    """It has the sense of the error, and covers it up to 3.1 Hz seen at 10 Hz; at stamps there is none."""

    def fast(t: float) -> gtsam.Pose3:
        wave = np.sin(2.0 * np.pi * hz * t)
        return gtsam.Pose3(
            gtsam.Rot3.RzRyRx(0.0, 0.002 * wave, 0.2 * t), np.array([8.0 * t, 0.0, 0.02 * wave])
        )

    path = SensorPath(motions(fast, evenly(60)))
    starts = np.arange(8, 50) * PERIOD_NS + PERIOD_NS // 4
    steps = path.steps(starts, starts + PERIOD_NS)
    truth = [fast(a * 1e-9).between(fast(a * 1e-9 + 0.1)) for a in starts.tolist()]
    lacking = np.array(
        [gtsam.Pose3.Logmap(gtsam.Pose3(T).between(t)) for T, t in zip(steps.aTbs, truth, strict=True)]
    )
    for axis in (1, 5):
        error, told = lacking[:, axis], steps.smoothed_away[:, axis]
        assert least < (told @ error) / (error @ error) < most
    at_stamps = path.steps(starts - PERIOD_NS // 4, starts + 3 * PERIOD_NS // 4)
    np.testing.assert_allclose(at_stamps.smoothed_away, 0.0, atol=1e-12)

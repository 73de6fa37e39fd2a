"""Motions smoothed forth and back."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from sst_graph.odometry.smoothing import MotionSmoother
from sst_graph.types import RelativeMotion

PERIOD_S = 0.1
SIGMAS = np.array([1e-3, 1e-3, 1e-3, 0.02, 0.02, 0.02])


def drive(n: int, seed: int, scale: float = 1.0) -> tuple[list[RelativeMotion], np.ndarray]:
    """Motions between noisy poses whose claimed sigmas are SIGMAS, and the true mean twists (n, 6)."""
    rng = np.random.default_rng(seed)
    t = (np.arange(n) + 0.5) * PERIOD_S
    twists = np.zeros((n, 6))
    twists[:, 3] = 5.0 + 2.0 * np.sin(0.8 * t)
    twists[:, 1] = 0.03 * np.sin(6.0 * t)
    twists[:, 2] = 0.2 * np.sin(0.5 * t)
    poses = scale * SIGMAS / np.sqrt(2.0) * rng.normal(size=(n + 1, 6))
    steps = PERIOD_S * twists + np.diff(poses, axis=0)
    stamps = (np.arange(n + 1) * PERIOD_S * 1e9).astype(np.int64)
    motions = [
        RelativeMotion(int(a), int(b), gtsam.Pose3.Expmap(step), np.diag(SIGMAS**2))
        for a, b, step in zip(stamps, stamps[1:], steps, strict=False)
    ]
    return motions, twists


def of(motions: list[RelativeMotion]) -> tuple[np.ndarray, np.ndarray]:
    """(n, 6) mean twists and their sigmas."""
    sigmas = [np.sqrt(np.diag(m.covariance)) / m.seconds for m in motions]
    return np.stack([m.mean_twist for m in motions]), np.stack(sigmas)


@pytest.mark.parametrize("scale", [0.5, 1.0, 2.0])
def test_smoothing_removes_noise_as_its_sigma_claims(scale: float) -> None:
    before, after, squares = [], [], []
    for seed in range(8):
        motions, truth = drive(60, seed, scale)
        found, sigmas = of(MotionSmoother().smoothed(motions))
        before.append(of(motions)[0] - truth)
        after.append(found - truth)
        squares.append(((found - truth) / sigmas) ** 2)
    gain = np.std(before, axis=(0, 1)) / np.std(after, axis=(0, 1))
    # Even the pitch, at nearly 1 Hz and hardly above its noise, gains.
    assert (gain[[0, 3, 4, 5]] > 3.0).all() and (gain > 1.5).all()
    normalised = np.mean(squares, axis=(0, 1))
    # A sine is smoother than the model thinks.
    assert (normalised > 0.25).all() and (normalised < 1.5).all()


def test_a_rough_motion_errs_by_its_noise_at_most() -> None:
    """Kicks of 2 m/s in 0.1 s are far from a white jerk; what is claimed of the noise bounds the error."""
    rng = np.random.default_rng(0)
    motions, _ = drive(60, 0, scale=0.01)
    speeds = 2.0 * np.cumsum(rng.normal(size=60))
    rough = []
    for motion, speed in zip(motions, speeds, strict=True):
        step = gtsam.Pose3.Expmap(np.array([0.0, 0.0, 0.0, 0.0, 0.0, speed * PERIOD_S]))
        rough.append(RelativeMotion(motion.from_ns, motion.to_ns, step, motion.covariance))
    error = of(MotionSmoother().smoothed(rough))[0][:, 5] - speeds
    assert np.sqrt(np.mean(error**2)) < SIGMAS[5] / PERIOD_S


def test_standstill_failures_and_short_runs_stay() -> None:
    motions, _ = drive(12, 1)
    still = RelativeMotion(motions[4].from_ns, motions[4].to_ns, gtsam.Pose3(), motions[4].covariance)
    failed = RelativeMotion(
        motions[11].from_ns, motions[11].to_ns, motions[11].aTb, motions[11].covariance, ok=False
    )
    given = [*motions[:4], still, *motions[5:11], failed]
    found = MotionSmoother().smoothed(given)
    assert [a is b for a, b in zip(found, given, strict=True)] == [True] * 5 + [False] * 6 + [True]
    assert MotionSmoother().smoothed([]) == []


def test_uneven_intervals() -> None:
    """A constant acceleration over intervals of any length is no noise."""
    stamps = np.cumsum([0.0, 0.1, 0.22, 0.08, 0.1, 0.31, 0.1, 0.1, 0.05])
    way = 3.0 * stamps + 0.7 * stamps**2
    motions = [
        RelativeMotion(
            round(a * 1e9), round(b * 1e9), gtsam.Pose3.Expmap([0, 0, 0, q - p, 0, 0]), np.diag(SIGMAS**2)
        )
        for a, b, p, q in zip(stamps, stamps[1:], way, way[1:], strict=False)
    ]
    np.testing.assert_allclose(of(MotionSmoother().smoothed(motions))[0], of(motions)[0], atol=1e-4)


def test_motion_by_motion() -> None:
    """A smoother that has seen the motions before ends where one that sees them all at once does."""
    motions, _ = drive(60, 3)
    smoother = MotionSmoother(reach=25)
    for k in range(5, 61):
        window = smoother.smoothed(motions[max(0, k - 40) : k])
    expected, sigmas = of(MotionSmoother().smoothed(motions)[-40:])
    assert len(window) == 40
    assert np.abs((of(window)[0] - expected) / sigmas).max() < 1.5
    # The latest, whose future no one knows, are the same to the digit.
    np.testing.assert_allclose(of(window)[0][-20:], expected[-20:], atol=1e-9)


def test_motions_that_have_left_are_forgotten() -> None:
    motions, _ = drive(60, 3)
    smoother = MotionSmoother(reach=10)
    for k in range(5, 61):
        smoother.smoothed(motions[max(0, k - 15) : k])
    (run,) = smoother._runs
    assert len(run.motions) == len(run.smoothed) == len(run._steps) == 15


def test_a_motion_that_later_counts_as_standstill() -> None:
    """The latest motions are at rest as soon as the next one is, too."""
    motions, _ = drive(20, 4)
    rests = [RelativeMotion(m.from_ns, m.to_ns, gtsam.Pose3(), m.covariance) for m in motions[15:]]
    smoother = MotionSmoother(reach=25)
    smoother.smoothed(motions[:17])
    found = smoother.smoothed([*motions[:15], *rests])
    np.testing.assert_allclose(
        of(found)[0], of(MotionSmoother().smoothed([*motions[:15], *rests]))[0], atol=1e-9
    )

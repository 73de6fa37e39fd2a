"""Motions between frames at standstill become the identity."""

from __future__ import annotations

import gtsam
import numpy as np

from sst_graph.odometry.standstill import SIGMA_M, SIGMA_RAD, ZeroVelocityUpdate, zero_velocity_update
from sst_graph.types import RelativeMotion

PERIOD_NS = 100_000_000
COVARIANCE = np.diag(np.repeat([1e-4, 1e-3], 3) ** 2)


def motions(*speeds_mps: float) -> list[RelativeMotion]:
    return [
        RelativeMotion(
            k * PERIOD_NS,
            (k + 1) * PERIOD_NS,
            gtsam.Pose3(gtsam.Rot3(), np.array([0.1 * speed, 0.0, 0.0])),
            COVARIANCE,
        )
        for k, speed in enumerate(speeds_mps)
    ]


def test_only_the_stop_is_replaced() -> None:
    given = motions(2.0, 1.0, 0.01, 0.03, 0.02, 0.01, 0.5, 2.0)
    found = zero_velocity_update(given)
    # The first and the last quiet motion touch a frame that still, or again, rolls.
    still = [k for k, (a, b) in enumerate(zip(given, found, strict=True)) if a is not b]
    assert still == [3, 4]
    for k in still:
        assert found[k].aTb.equals(gtsam.Pose3(), 0.0)
        assert (found[k].from_ns, found[k].to_ns) == (given[k].from_ns, given[k].to_ns) and found[k].ok
        sigmas = np.sqrt(np.diag(found[k].covariance))
        np.testing.assert_allclose(sigmas, np.repeat([SIGMA_RAD, SIGMA_M], 3))
    # What was given stays as it was.
    assert given[3].aTb.translation()[0] > 0.0 and (given[3].covariance == COVARIANCE).all()


def test_a_drive_at_standstill_and_a_moving_one() -> None:
    assert all(not motion.mean_twist.any() for motion in zero_velocity_update(motions(0.01, -0.02, 0.03)))
    driving = motions(1.0, 2.0, 3.0)
    assert all(a is b for a, b in zip(zero_velocity_update(driving), driving, strict=True))
    assert zero_velocity_update([]) == []


def test_motions_that_come_one_by_one() -> None:
    """The result is that of all motions together, and unchanged motions stay the same objects."""
    stop = [0.03, -0.02, 0.05, 0.0, 0.02]
    given = motions(2.0, 1.0, 0.3, *stop, 0.4, 0.01, 0.02, 1.0, *stop, 0.1, 2.0, 3.0, 3.0, 3.0, 3.0, 3.0, 3.0)
    update, latest = ZeroVelocityUpdate(), []
    for k in range(1, len(given) + 1):
        before, latest = latest, update.apply(given[:k])
        assert [m.aTb.equals(gtsam.Pose3(), 0.0) for m in latest] == [
            m.aTb.equals(gtsam.Pose3(), 0.0) for m in zero_velocity_update(given[:k])
        ]
    assert sum(a is b for a, b in zip(before, latest, strict=False)) >= len(given) - 7
    # The oldest leave, as from a window.
    assert all(a is b for a, b in zip(update.apply(given[5:])[:8], latest[5:13], strict=True))
    assert update.apply(motions(1.0, 2.0))[0].aTb.translation()[0] > 0.0 and update.apply([]) == []

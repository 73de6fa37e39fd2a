"""Twist of a sensor at any time, from its motions between stamps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.odometry.smoothing import MotionSmoother
from sst_graph.odometry.standing import Rest
from sst_graph.types import RelativeMotion

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class TwistSample:
    """Twist of a sensor at an instant, in its own frame.

    Attributes:
        twist: (6,) [rad/s, m/s].
        acceleration: (6,) rate of change [rad/s^2, m/s^2].
        covariance: (6, 6) of the twist.
    """

    twist: FloatArray
    acceleration: FloatArray
    covariance: FloatArray


class TwistTrack:
    """Twists over time: linear between the middles of the measured intervals,
    carried on for half an interval beyond the ends, constant from there.

    The mean twist over an interval equals the twist at its middle up to the third derivative of the
    motion, so two intervals give twist and acceleration at the stamp between them.
    """

    def __init__(self, motions: Sequence[RelativeMotion]) -> None:
        """motions: consecutive, at least one, stamps rising [ns]."""
        self._epoch = motions[0].from_ns
        middles = [0.5 * (m.from_ns - self._epoch + m.to_ns - self._epoch) * 1e-9 for m in motions]
        self._middles = np.array(middles)
        self._motions = motions

    def at(self, stamp_ns: int) -> TwistSample:
        """Twist and acceleration at a stamp of the sensor's clock."""
        t = (stamp_ns - self._epoch) * 1e-9
        n = len(self._middles)
        if n == 1:
            return TwistSample(self._motions[0].mean_twist, np.zeros(6), _covariance(self._motions[0]))
        i = int(np.clip(np.searchsorted(self._middles, t) - 1, 0, n - 2))
        span = self._middles[i + 1] - self._middles[i]
        before, after = self._motions[i : i + 2]
        slope = (after.mean_twist - before.mean_twist) / span
        fraction = float(np.clip((t - self._middles[i]) / span, -0.5, 1.5))
        a, b = 1.0 - fraction, fraction
        # As if both erred together, which smoothed motions nearly do.
        covariance = abs(a) * _covariance(before) + abs(b) * _covariance(after)
        if not 0.0 <= fraction <= 1.0:
            overshoot = span * (max(-fraction, fraction - 1.0))
            covariance = covariance + np.diag((slope * overshoot) ** 2)
        return TwistSample(before.mean_twist + fraction * span * slope, slope, covariance)


class GrowingTrack:
    """Tracks of a LiDAR's motions of which some are new each time: smoothed, exactly zero while it stands."""

    def __init__(self, reach: int | None = None) -> None:
        """reach: how many of the latest motions are smoothed anew each time; None: all."""
        self._rest, self._smoother = Rest(), MotionSmoother(reach)

    def of(self, motions: Sequence[RelativeMotion]) -> TwistTrack | None:
        """The track of consecutive motions; None without any. Those of the call before are known again by
        being the same objects."""
        return TwistTrack(self._smoother.smoothed(self._rest.told(motions))) if motions else None


def _covariance(motion: RelativeMotion) -> FloatArray:
    """(6, 6) of the mean twist of a motion."""
    return motion.covariance / motion.seconds**2


def camera_twist(sample: TwistSample, cTl: gtsam.Pose3) -> TwistSample:
    """The camera's twist from the LiDAR's: c_twist = Ad(cTl) l_twist (rigidly joined sensors)."""
    Ad = np.asarray(cTl.AdjointMap())
    covariance = Ad @ sample.covariance @ Ad.T
    return TwistSample(Ad @ sample.twist, Ad @ sample.acceleration, 0.5 * (covariance + covariance.T))

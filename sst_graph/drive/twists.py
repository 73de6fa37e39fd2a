"""Twist of a sensor at any time, from its motions between stamps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from sst_graph.odometry.smoothing import MotionSmoother
from sst_graph.odometry.standstill import ZeroVelocityUpdate
from sst_graph.types import FloatArray, RelativeMotion


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


@dataclass(frozen=True)
class TwistSamples:
    """Twists of a sensor at k instants.

    Attributes:
        twists, accelerations: (k, 6) [rad/s, m/s], and their rates of change.
        covariances: (k, 6, 6) of the twists.
    """

    twists: FloatArray
    accelerations: FloatArray
    covariances: FloatArray

    def __len__(self) -> int:
        return len(self.twists)

    def __getitem__(self, number: int) -> TwistSample:
        return TwistSample(self.twists[number], self.accelerations[number], self.covariances[number])


class SensorTwists:
    """Twists over time: cubics between the middles of the measured intervals, carried on for half an interval
    beyond the ends, constant from there. Poses, only where the motion is known:
    :class:`~sst_graph.drive.path.SensorPath`.

    At each middle, twist and acceleration are those of the parabola whose means over the interval and its two
    neighbours are the measured ones. Straight lines through the means would be 15 % short of a pitching
    at 1.5 Hz that is seen at 10 Hz; these are 2 % short.
    """

    def __init__(self, motions: Sequence[RelativeMotion]) -> None:
        """motions: consecutive, at least one, stamps rising [ns]."""
        self._epoch = motions[0].from_ns
        middles = [0.5 * (m.from_ns - self._epoch + m.to_ns - self._epoch) * 1e-9 for m in motions]
        self._middles = np.array(middles)
        self._motions = motions

    def at(self, stamp_ns: int) -> TwistSample:
        """Twist and acceleration at a stamp of the sensor's clock."""
        return self.at_all([stamp_ns])[0]

    def at_all(self, stamps_ns: Sequence[int]) -> TwistSamples:
        """Twists and accelerations at several stamps of the sensor's clock."""
        t = np.array([stamp - self._epoch for stamp in stamps_ns], np.float64) * 1e-9
        k, n = len(t), len(self._middles)
        if n == 1 or k == 0:
            twist, covariance = self._motions[0].mean_twist, _covariance(self._motions[0])
            return TwistSamples(np.tile(twist, (k, 1)), np.zeros((k, 6)), np.tile(covariance, (k, 1, 1)))
        i = np.minimum(np.maximum(np.searchsorted(self._middles, t) - 1, 0), n - 2)
        first, place = int(i.min()), np.array([i, i + 1]) - i.min()
        twists, rates, known = self._at_middles(first, int(i.max()) + 2)
        (before, after), (rate_before, rate_after) = twists[place], rates[place]
        spans = self._middles[i + 1] - self._middles[i]
        fractions = np.minimum(np.maximum((t - self._middles[i]) / spans, -0.5), 1.5)
        inside = np.minimum(np.maximum(fractions, 0.0), 1.0)
        # The cubic of Hermite by its coefficients, and its derivative.
        h, s = spans[:, None], (inside * spans)[:, None]
        slopes = (after - before) / h
        square = (3.0 * slopes - 2.0 * rate_before - rate_after) / h
        cube = (rate_before + rate_after - 2.0 * slopes) / h**2
        value = before + s * (rate_before + s * (square + s * cube))
        rate = rate_before + s * (2.0 * square + 3.0 * s * cube)
        # As if both errors were equal, as they nearly are for smoothed motions.
        weights = np.abs([1.0 - fractions, fractions])[:, :, None, None]
        covariances = weights * known[place]
        total = covariances[0] + covariances[1]
        beyond = (fractions - inside) * spans
        total[:, _AXES, _AXES] += (rate * beyond[:, None]) ** 2
        return TwistSamples(value + rate * beyond[:, None], rate, total)

    def _at_middles(self, first: int, end: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(k, 6) twists and accelerations, and (k, 6, 6) covariances, at the middles of some intervals in a
        row: by the cubic of the pose through four stamps, in the manner of Newton; of the first and the last
        interval of all by a parabola."""
        numbers, last, start = np.arange(first, end), len(self._motions) - 1, max(first - 1, 0)
        around = np.minimum(np.maximum(numbers[:, None] + [-1, 0, 1], 0), last) - start
        known = self._motions[start : end + 1]
        means = np.array([motion.mean_twist for motion in known])[around]
        h = np.array([motion.seconds for motion in known])[around][..., None]
        covariances = np.array([_covariance(motion) for motion in known])[around[:, 1]]
        before = (means[:, 1] - means[:, 0]) / (h[:, 0] + h[:, 1])
        after = (means[:, 2] - means[:, 1]) / (h[:, 1] + h[:, 2])
        inner = (numbers > 0) & (numbers < last)
        third = np.where(inner[:, None], (after - before) / h.sum(axis=1), 0.0)
        before = np.where((numbers == 0)[:, None], after, before)
        still = ~means[:, 1].any(axis=1)
        twists = means[:, 1] - 0.25 * h[:, 1] ** 2 * third
        rates = 2.0 * before + third * (2.0 * h[:, 0] + h[:, 1])
        twists[still], rates[still] = 0.0, 0.0
        return twists, rates, covariances


_AXES = np.arange(6)


class GrowingTwists:
    """Twists by a LiDAR's motions of which some are new each time: smoothed, exactly zero at standstill."""

    def __init__(self, reach: int | None = None) -> None:
        """reach: how many of the latest motions are smoothed again each time; None: all."""
        self._zero_velocity, self._smoother = ZeroVelocityUpdate(), MotionSmoother(reach)

    def of(self, motions: Sequence[RelativeMotion]) -> SensorTwists | None:
        """Twists by consecutive motions; None without any. Motions of the call before are recognised by
        identity."""
        return SensorTwists(self._smoother.smoothed(self._zero_velocity.apply(motions))) if motions else None


def _covariance(motion: RelativeMotion) -> FloatArray:
    """(6, 6) of the mean twist of a motion."""
    return motion.covariance / motion.seconds**2


def camera_twist(sample: TwistSample, cTl: gtsam.Pose3) -> TwistSample:
    """The camera's twist from the LiDAR's: c_twist = Ad(cTl) l_twist (rigidly joined sensors)."""
    Ad = np.asarray(cTl.AdjointMap())
    covariance = camera_covariances(sample.covariance, cTl)
    return TwistSample(Ad @ sample.twist, Ad @ sample.acceleration, covariance)


def camera_covariances(l_covariances: FloatArray, cTl: gtsam.Pose3) -> FloatArray:
    """(..., 6, 6) of the camera's twists, from those of the LiDAR's."""
    Ad = np.asarray(cTl.AdjointMap())
    covariances = Ad @ l_covariances @ Ad.T
    return np.asarray(0.5 * (covariances + np.swapaxes(covariances, -1, -2)))

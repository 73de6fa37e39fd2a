"""Pose and twist of a sensor at any time, from its motions between stamps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.types import RelativeMotion

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class PathStep:
    """Motion of a sensor over an interval that need not begin or end at a stamp.

    Attributes:
        aTb: pose of the sensor at the end in its frame at the beginning.
        twist_a, twist_b: (6,) its twist at both ends, in its own frame [rad/s, m/s].
        covariance: (6, 6) of aTb, [rot rad, trans m], right perturbation.
        covariance_rate: (6, 6) its change as both ends move on in time [1/s]: between two stamps the noise
            of their poses is averaged, at a stamp it is not.
        twist_covariance: (6, 6) of the rate at which aTb changes as both ends move on.
    """

    aTb: gtsam.Pose3
    twist_a: FloatArray
    twist_b: FloatArray
    covariance: FloatArray
    covariance_rate: FloatArray
    twist_covariance: FloatArray


class SensorPath:
    """Poses at stamps, joined smoothly: Exp of a cubic through the four nearest poses' logarithms.

    Each cubic blends the parabolas around the interval's two ends (Overhauser), so that twists are
    continuous, too, and follow an acceleration. None is known across a motion that failed, or beyond the
    ends.
    """

    def __init__(self, motions: Sequence[RelativeMotion]) -> None:
        """motions: consecutive, stamps rising [ns]."""
        self._motions = motions
        self._stamps = np.array([m.from_ns for m in motions] + [m.to_ns for m in motions[-1:]], np.int64)
        self._poses = [gtsam.Pose3()]
        for motion in motions:
            self._poses.append(self._poses[-1].compose(motion.aTb))
        broken = np.array([not motion.ok for motion in motions], np.int64)
        self._piece = np.concatenate([[0], np.cumsum(broken)])
        self._cubics: dict[int, _Cubic] = {}

    def at(self, stamp_ns: int) -> tuple[gtsam.Pose3, FloatArray] | None:
        """Pose in the first stamp's frame, and twist (6,); None where the path does not reach."""
        i = self._interval(stamp_ns)
        if i is None:
            return None
        log, rate = self._powers(i, stamp_ns) @ self._cubic(i).coefficients
        pose = self._poses[i].compose(gtsam.Pose3.Expmap(log))
        return pose, np.asarray(gtsam.Pose3.ExpmapDerivative(log)) @ rate

    def step(self, from_ns: int, to_ns: int) -> PathStep | None:
        """Motion from one time to a later one; None where the path does not reach."""
        a, b = self.at(from_ns), self.at(to_ns)
        if a is None or b is None:
            return None
        first, last = self._interval(from_ns), self._interval(to_ns)
        if first is None or last is None or self._piece[first + 1] != self._piece[last]:
            return None
        # Every pose errs by itself: what the step takes from each of them, and how that changes.
        of_a, of_b = self._weights(first, from_ns), self._weights(last, to_ns)
        shares = {k: np.zeros(2) for k in (*of_a, *of_b)}
        for weights, sign in ((of_a, -1.0), (of_b, 1.0)):
            for k, weight in weights.items():
                shares[k] += sign * weight
        share = np.stack(list(shares.values()))
        of_pose = 0.5 * np.mean([self._motions[i].covariance for i in range(first, last + 1)], axis=0)
        return PathStep(
            a[0].between(b[0]),
            a[1],
            b[1],
            of_pose * (share[:, 0] @ share[:, 0]),
            of_pose * (2.0 * share[:, 0] @ share[:, 1]),
            of_pose * (share[:, 1] @ share[:, 1]),
        )

    def _interval(self, stamp_ns: int) -> int | None:
        """Number of the measured interval that holds a time."""
        n = len(self._motions)
        if n == 0 or not self._stamps[0] <= stamp_ns <= self._stamps[-1]:
            return None
        i = min(int(np.searchsorted(self._stamps, stamp_ns, side="right")) - 1, n - 1)
        return i if self._motions[i].ok else None

    def _cubic(self, i: int) -> _Cubic:
        """The polynomial of interval i."""
        if i not in self._cubics:
            around = [
                k
                for k in range(max(i - 1, 0), min(i + 3, len(self._poses)))
                if self._piece[k] == self._piece[i + 1]
            ]
            times = (self._stamps[around] - self._stamps[i]) * 1e-9
            logs = [gtsam.Pose3.Logmap(self._poses[i].between(self._poses[k])) for k in around]
            inverse = _blended(times, around.index(i))
            self._cubics[i] = _Cubic(tuple(around), inverse, inverse @ np.stack(logs))
        return self._cubics[i]

    def _powers(self, i: int, stamp_ns: int) -> FloatArray:
        """(2, m) powers of the seconds since interval i began, and their derivatives."""
        t, m = (stamp_ns - int(self._stamps[i])) * 1e-9, len(self._cubic(i).poses)
        powers = t ** np.arange(m)
        return np.stack([powers, np.arange(m) * np.concatenate([[0.0], powers[:-1]])])

    def _weights(self, i: int, stamp_ns: int) -> dict[int, FloatArray]:
        """By pose: its weight (2,) in the interpolated one, and the weight's derivative [1/s]."""
        cubic = self._cubic(i)
        return dict(zip(cubic.poses, (self._powers(i, stamp_ns) @ cubic.inverse).T, strict=True))


@dataclass(frozen=True)
class _Cubic:
    """Polynomial of one interval.

    Attributes:
        poses: numbers of the m <= 4 poses that it passes through.
        inverse: (m, m) from values at these poses to coefficients by power of the seconds.
        coefficients: (m, 6) of the logarithm in the frame of the interval's first pose.
    """

    poses: tuple[int, ...]
    inverse: FloatArray
    coefficients: FloatArray


def _blended(times: FloatArray, first: int) -> FloatArray:
    """(m, m) from values at times (m,) to coefficients by power: two parabolas blended from one to the next.

    The interval lies between ``times[first]``, which is 0, and the time after it.
    """
    m = len(times)
    parabolas = [list(range(k - 1, k + 2)) for k in (first, first + 1) if 0 < k < m - 1]
    if not parabolas:
        return np.asarray(np.linalg.inv(np.vander(times, increasing=True)))
    result = np.zeros((max(m, len(parabolas) + 2), m))
    for number, nodes in enumerate(parabolas):
        through = np.linalg.inv(np.vander(times[nodes], increasing=True))
        if len(parabolas) == 1:
            result[np.ix_(range(3), nodes)] += through
            break
        # times (1 - u) for the first, u for the second, u from 0 to 1 over the interval
        slope = (1.0 if number else -1.0) / times[first + 1]
        result[np.ix_(range(3), nodes)] += through * (0.0 if number else 1.0)
        result[np.ix_(range(1, 4), nodes)] += through * slope
    return result

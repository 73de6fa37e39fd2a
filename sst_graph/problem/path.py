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
    """

    aTb: gtsam.Pose3
    twist_a: FloatArray
    twist_b: FloatArray
    covariance: FloatArray


class SensorPath:
    """Poses at stamps, joined by cubics: Exp of the polynomial through the four nearest poses' logarithms.

    A mean twist over an interval would be late where the motion begins or ends; the cubic follows
    accelerations that last two intervals. Nothing is told across a motion that failed, or beyond the ends.
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
        self._cubics: dict[int, FloatArray] = {}

    def at(self, stamp_ns: int) -> tuple[gtsam.Pose3, FloatArray] | None:
        """Pose in the first stamp's frame, and twist (6,); None where the path does not reach."""
        i = self._interval(stamp_ns)
        if i is None:
            return None
        coefficients = self._cubic(i)
        t = (stamp_ns - int(self._stamps[i])) * 1e-9
        powers = t ** np.arange(len(coefficients))
        slopes = np.arange(len(coefficients)) * np.concatenate([[0.0], powers[:-1]])
        log, rate = powers @ coefficients, slopes @ coefficients
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
        covariance = np.zeros((6, 6))
        for i in range(first, last + 1):
            motion = self._motions[i]
            shared = min(to_ns, motion.to_ns) - max(from_ns, motion.from_ns)
            covariance += motion.covariance * (max(shared, 0) / (motion.to_ns - motion.from_ns))
        return PathStep(a[0].between(b[0]), a[1], b[1], covariance)

    def _interval(self, stamp_ns: int) -> int | None:
        """Number of the measured interval that holds a time."""
        n = len(self._motions)
        if n == 0 or not self._stamps[0] <= stamp_ns <= self._stamps[-1]:
            return None
        i = min(int(np.searchsorted(self._stamps, stamp_ns, side="right")) - 1, n - 1)
        return i if self._motions[i].ok else None

    def _cubic(self, i: int) -> FloatArray:
        """Coefficients (m, 6), by power of the seconds since the interval's start, m <= 4."""
        if i not in self._cubics:
            around = [
                k
                for k in range(max(i - 1, 0), min(i + 3, len(self._poses)))
                if self._piece[k] == self._piece[i + 1]
            ]
            times = (self._stamps[around] - self._stamps[i]) * 1e-9
            logs = [gtsam.Pose3.Logmap(self._poses[i].between(self._poses[k])) for k in around]
            powers = np.vander(times, increasing=True)
            self._cubics[i] = np.linalg.solve(powers, np.stack(logs))
        return self._cubics[i]

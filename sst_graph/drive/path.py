"""Pose and twist of a sensor at any time, from its motions between stamps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.types import FloatArray, IntArray, RelativeMotion

_REACH = 4
"""Poses to either side of one that determine the twist there. With 4, a time between
stamps of 10 Hz seems up to 1.6 ms nearer to its stamp than it is, by a pitching of 3.1 Hz; with 2, up to
4.2 ms. Where accelerations are white, both err alike."""
_NODES = 2 * _REACH + 2
"""Most poses that such a polynomial of an interval follows from."""
_LONG_REACH = 6
_LONG_NODES = 2 * _LONG_REACH + 2
"""The same of the longer polynomials that show how far fast motion is smoothed away."""
_SMOOTHED_AWAY = 2.0
"""What is smoothed away over the difference of longer and usual polynomials: in the middle between stamps of
10 Hz, 1.3 for a sine of 2.5 Hz, 1.7 for 3.1 Hz, 2.3 for 3.5 Hz."""
_ERROR_POSES = 8
"""Poses from which the error between stamps is estimated: by the distance of two polynomials, through all but
the first and all but the last of them."""
_ERROR = 1.5
"""Error between stamps over that distance: 0.2 for a sine of 2.5 Hz at 10 Hz, 0.4 for one of 3.1 Hz, 1.3
where rates of turn jump, 2.0 where accelerations do, 2.2 where they are white."""
_MEDIAN_CHI2 = 0.455
"""Median of the chi-squared distribution of one degree of freedom."""


@dataclass(frozen=True)
class PathSteps:
    """Motions of a sensor over m intervals.

    Attributes:
        found: (m,) which of the intervals that were asked for these are: the path does not reach the others.
        aTbs: (m, 4, 4) poses of the sensor at the end in its frame at the beginning.
        twists_a, twists_b: (m, 6) its twist at both ends, in its own frame [rad/s, m/s].
        covariances: (m, 6, 6) of aTb, [rot rad, trans m], right perturbation: by the noise of the poses and
            by what is between the stamps and not known.
        noise_rates: (m, 6) change of the variances of aTb as both ends move on in time [1/s]: between two
            stamps the noise of their poses is averaged, at a stamp it is not. By the noise that the poses
            show, which is at most what they state; 0 where they are too few to show it.
        twist_covariances: (m, 6, 6) of the rate at which aTb changes as both ends move on.
        smoothed_away: (m, 6) what aTb lacks, about, of motion that is fast against the stamps, as a right
            perturbation [rad, m]. Between stamps it is lessened, at them it is not: an error of one sense in
            all steps.
    """

    found: IntArray
    aTbs: FloatArray
    twists_a: FloatArray
    twists_b: FloatArray
    covariances: FloatArray
    noise_rates: FloatArray
    twist_covariances: FloatArray
    smoothed_away: FloatArray

    def __len__(self) -> int:
        return len(self.found)

    @classmethod
    def joined(cls, parts: Sequence[PathSteps]) -> PathSteps:
        """Steps of several paths, one after the other; ``found`` counts through all."""
        columns = zip(*(vars(part).values() for part in parts), strict=True)
        return cls(*(np.concatenate(column) for column in columns))


class SensorPath:
    """Poses at stamps, joined smoothly: Exp of a polynomial through the nearest poses' logarithms.

    Each blends the polynomials through nine poses around the interval's two ends (in the manner of
    Overhauser, who blends parabolas), so that twists are continuous, too. Polynomials through few poses hold
    fast motion near to the stamps: a time within an interval seems nearer to its stamp than it is, and a time
    offset that is estimated from the path errs away from the stamps. None is known across a motion that
    failed, or beyond the ends.

    What a vehicle does between two stamps shows in the next poses, too: polynomials through all but the first
    and all but the last of eight differ by as much as the interpolation errs, and by noise of the poses,
    whose usual size is taken off.
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
        self._polynomials: dict[tuple[int, int], _Polynomial] = {}
        self._differences: dict[int, _Polynomial] = {}
        self._ok = np.array([motion.ok for motion in motions], np.bool_)
        self._covariances = np.array([motion.covariance for motion in motions]).reshape(-1, 6, 6)
        self._matrices = np.array([pose.matrix() for pose in self._poses])

    def steps(self, from_ns: NDArray[np.int64], to_ns: NDArray[np.int64]) -> PathSteps:
        """Motions from some times to later ones [ns], (n,) each, where the path reaches."""
        first, last = self._intervals(from_ns), self._intervals(to_ns)
        joined = self._piece[first + 1] == self._piece[last]
        found = np.flatnonzero((first >= 0) & (last >= 0) & joined)
        first, last, n = first[found], last[found], len(found)
        # Each time once: mostly, one step ends where the next begins.
        times, place = np.unique(np.concatenate([from_ns[found], to_ns[found]]), return_inverse=True)
        place = place.reshape(2, n)
        intervals = self._intervals(times)
        poses, twists, weights = self._interpolated(intervals, times)
        between = self._squared_errors(intervals, times)[place].sum(axis=0)
        lacking_a, lacking_b = self._smoothed_away(intervals, times)[place]
        # Every pose errs by itself: what the step takes from each of them, and how that changes.
        oldest = np.maximum(np.array([first, last]) - _REACH, 0)
        ahead = oldest[1] - oldest[0]
        shares = np.zeros((n, int(ahead.max(initial=0)) + _NODES, 2))
        columns, rows = np.arange(_NODES), np.arange(n)[:, None]
        shares[rows, columns] -= weights[place[0]]
        shares[rows, ahead[:, None] + columns] += weights[place[1]]
        products = np.swapaxes(shares, 1, 2) @ shares
        of_pose = 0.5 * self._mean_covariances(first, last)
        a, b = poses[place[0]], poses[place[1]]
        aTbs = np.tile(np.eye(4), (n, 1, 1))
        back = np.swapaxes(a[:, :3, :3], 1, 2)
        aTbs[:, :3, :3] = back @ b[:, :3, :3]
        aTbs[:, :3, 3] = (back @ (b[:, :3, 3] - a[:, :3, 3])[..., None])[..., 0]
        return PathSteps(
            found,
            aTbs,
            twists[place[0]],
            twists[place[1]],
            of_pose * products[:, 0, 0, None, None] + between[:, :, None] * np.eye(6),
            2.0 * products[:, 0, 1, None] * np.minimum(np.einsum("nii->ni", of_pose), self._pose_noise),
            of_pose * products[:, 1, 1, None, None],
            lacking_b - _moved_to_the_end(lacking_a, aTbs),
        )

    def _intervals(self, stamps_ns: NDArray[np.int64]) -> IntArray:
        """(n,) number of the measured interval that holds each time (n,) [ns]; -1 where none does."""
        n = len(self._motions)
        if n == 0:
            return np.full(len(stamps_ns), -1)
        inside = (self._stamps[0] <= stamps_ns) & (stamps_ns <= self._stamps[-1])
        i = np.clip(np.searchsorted(self._stamps, stamps_ns, side="right") - 1, 0, n - 1)
        # At a stamp where a failed motion begins, the one that ends there is known.
        ended = (stamps_ns == self._stamps[i]) & ~self._ok[i]
        i = np.maximum(i - ended, 0)
        return np.where(inside & self._ok[i], i, -1)

    def _interpolated(
        self, intervals: IntArray, stamps_ns: NDArray[np.int64]
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(n, 4, 4) poses, (n, 6) twists, and (n, _NODES, 2) weights of the poses from the oldest one
        around the interval on, with the weights' derivatives [1/s], at times (n,) in intervals (n,).
        """
        if not len(stamps_ns):
            return np.zeros((0, 4, 4)), np.zeros((0, 6)), np.zeros((0, _NODES, 2))
        polynomials = [self._polynomial(i, _REACH) for i in intervals.tolist()]
        seconds = (stamps_ns - self._stamps[intervals]) * 1e-9
        powers = seconds[:, None] ** np.arange(_NODES)
        rates = np.arange(_NODES) * np.column_stack([np.zeros(len(seconds)), powers[:, :-1]])
        both = np.stack([powers, rates], axis=1)
        logs, slopes = np.swapaxes(both @ np.array([each.coefficients for each in polynomials]), 0, 1)
        weights = both @ np.array([each.inverse for each in polynomials])
        starts = self._matrices[intervals]
        moved = np.array([gtsam.Pose3.Expmap(log).matrix() for log in logs])
        derivatives = np.array([gtsam.Pose3.ExpmapDerivative(log) for log in logs])
        return starts @ moved, (derivatives @ slopes[..., None])[..., 0], np.swapaxes(weights, 1, 2)

    def _smoothed_away(self, intervals: IntArray, stamps_ns: NDArray[np.int64]) -> FloatArray:
        """(n, 6) what the interpolated poses lack of fast motion, at times (n,) in intervals (n,)."""
        seconds = (stamps_ns - self._stamps[intervals])[:, None] * 1e-9
        lacking = np.zeros((len(seconds), _LONG_NODES, 6))
        for own, i in zip(lacking, intervals.tolist(), strict=True):
            own += self._polynomial(i, _LONG_REACH).coefficients
            own[:_NODES] -= self._polynomial(i, _REACH).coefficients
        found: FloatArray = np.einsum("np,npk->nk", seconds ** np.arange(_LONG_NODES), lacking)
        return _SMOOTHED_AWAY * found

    def _squared_errors(self, intervals: IntArray, stamps_ns: NDArray[np.int64]) -> FloatArray:
        """(n, 6) expected squares of the errors between stamps, at times (n,) in intervals (n,)."""
        squares, by_noise = self._distances(intervals, stamps_ns)
        return np.asarray(_ERROR**2 * np.maximum(squares - by_noise[:, None] * self._pose_noise, 0.0))

    @cached_property
    def _pose_noise(self) -> FloatArray:
        """(6,) variances of the poses that would make the median distance in the middle of intervals."""
        intervals = np.flatnonzero(self._ok)
        middles = self._stamps[intervals] + np.diff(self._stamps)[intervals] // 2
        squares, by_noise = self._distances(intervals, middles)
        known = by_noise > 0.0
        ratios = squares[known] / by_noise[known, None]
        return np.asarray(np.median(ratios, axis=0) / _MEDIAN_CHI2 if len(ratios) else np.zeros(6))

    def _distances(self, intervals: IntArray, stamps_ns: NDArray[np.int64]) -> tuple[FloatArray, FloatArray]:
        """(n, 6) squared distances of the two polynomials of :data:`_ERROR_POSES`, and (n,) their variance by
        a unit one of the poses, at times (n,) in intervals (n,).

        At an end of the path they are those of the nearest interval that has four poses to either side; 0
        where none has.
        """
        if not len(intervals):
            return np.zeros((0, 6)), np.zeros(0)
        differences = [self._difference(i) for i in intervals.tolist()]
        seconds = 1e-9 * (stamps_ns - self._stamps[intervals])
        powers = (seconds[:, None] ** np.arange(_ERROR_POSES - 1))[:, None]
        apart = (powers @ np.array([each.coefficients for each in differences]))[:, 0]
        weights = (powers @ np.array([each.inverse for each in differences]))[:, 0]
        return apart**2, (weights**2).sum(axis=1)

    def _difference(self, i: int) -> _Polynomial:
        """Difference of the two polynomials of :data:`_ERROR_POSES` at interval i."""
        if i not in self._differences:
            begin, end = self._ends(i)
            m, half = _ERROR_POSES, _ERROR_POSES // 2
            inverse, coefficients = np.zeros((m - 1, m)), np.zeros((m - 1, 6))
            if end - begin >= m:
                nearest = min(max(i, begin + half - 1), end - half - 1)
                times, logs = self._around(nearest, slice(nearest + 1 - half, nearest + 1 + half))
                inverse = _difference_of_two(times)
                coefficients = inverse @ logs
            self._differences[i] = _Polynomial(inverse, coefficients)
        return self._differences[i]

    def _ends(self, i: int) -> tuple[int, int]:
        """The first pose of the piece of interval i, and the one after its last."""
        begin, end = np.searchsorted(self._piece, self._piece[i + 1] + np.arange(2)).tolist()
        return begin, end

    def _around(self, i: int, poses: slice) -> tuple[FloatArray, FloatArray]:
        """(m,) times after pose i [s], and (m, 6) logarithms in its frame, of the poses of a slice."""
        logs = [gtsam.Pose3.Logmap(self._poses[i].between(pose)) for pose in self._poses[poses]]
        return 1e-9 * (self._stamps[poses] - self._stamps[i]), np.stack(logs)

    def _mean_covariances(self, first: IntArray, last: IntArray) -> FloatArray:
        """(n, 6, 6) mean over the motions from the first to the last of each step."""
        total, longest = np.zeros((len(first), 6, 6)), int((last - first).max(initial=0))
        for k in range(longest + 1):
            within = (first + k <= last)[:, None, None]
            total += np.where(within, self._covariances[np.minimum(first + k, last)], 0.0)
        return np.asarray(total / (last - first + 1)[:, None, None])

    def _polynomial(self, i: int, reach: int) -> _Polynomial:
        """The polynomial of interval i by so many poses to either side of both its ends."""
        if (i, reach) not in self._polynomials:
            begin, end = self._ends(i)
            around = slice(max(i - reach, begin), min(i + 2 + reach, end))
            times, logs = self._around(i, around)
            blended, most = _blended(times, i - around.start, reach), 2 * reach + 2
            coefficients, inverse = np.zeros((most, 6)), np.zeros((most, most))
            coefficients[: len(blended)] = blended @ logs
            oldest = around.start - max(i - reach, 0)
            inverse[: len(blended), oldest : oldest + len(times)] = blended
            self._polynomials[i, reach] = _Polynomial(inverse, coefficients)
        return self._polynomials[i, reach]


def _moved_to_the_end(steps: FloatArray, aTbs: FloatArray) -> FloatArray:
    """(n, 6) right perturbations of poses a as such of the poses b behind motions (n, 4, 4)."""
    back = np.swapaxes(aTbs[:, :3, :3], 1, 2)
    turns, shifts = steps[:, :3], steps[:, 3:] - np.cross(aTbs[:, :3, 3], steps[:, :3])
    return np.asarray(np.concatenate([back @ turns[..., None], back @ shifts[..., None]], axis=1)[..., 0])


@dataclass(frozen=True)
class _Polynomial:
    """Polynomial of one interval, or the difference of two.

    Attributes:
        inverse: (k, m) from values at m poses, the oldest first, to k coefficients by power of the seconds; 0
            for poses that it does not follow from.
        coefficients: (k, 6) of the logarithm in the frame of the interval's first pose.
    """

    inverse: FloatArray
    coefficients: FloatArray


def _difference_of_two(times: FloatArray) -> FloatArray:
    """(m - 1, m) from values at times (m,) to coefficients by power: the polynomial through all but the last
    less that through all but the first."""
    m = len(times)
    result = np.zeros((m - 1, m))
    result[:, :-1] += np.linalg.inv(np.vander(times[:-1], increasing=True))
    result[:, 1:] -= np.linalg.inv(np.vander(times[1:], increasing=True))
    return result


def _blended(times: FloatArray, first: int, most_reach: int) -> FloatArray:
    """(m, m) from values at times (m,) to coefficients by power: the polynomials around both ends of an
    interval, blended from one to the next.

    The interval lies between ``times[first]``, which is 0, and the time after it. An end that has poses to
    one side only has no polynomial of its own.
    """
    m = len(times)
    ends = [k for k in (first, first + 1) if 0 < k < m - 1]
    if not ends:
        return np.asarray(np.linalg.inv(np.vander(times, increasing=True)))
    result = np.zeros((max(m, 2 * most_reach + 2), m))
    for k in ends:
        reach = min(most_reach, k, m - 1 - k)
        nodes = np.arange(k - reach, k + reach + 1)
        through = np.linalg.inv(np.vander(times[nodes], increasing=True))
        powers = np.arange(len(nodes))
        if len(ends) == 1:
            result[np.ix_(powers, nodes)] += through
            break
        # times (1 - u) for the first, u for the second, u from 0 to 1 over the interval
        slope = (-1.0 if k == first else 1.0) / times[first + 1]
        result[np.ix_(powers, nodes)] += through * (1.0 if k == first else 0.0)
        result[np.ix_(powers + 1, nodes)] += through * slope
    return result

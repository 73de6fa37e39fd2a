"""Motions of a sensor on a vehicle, smoothed forwards and backwards.

Registration errs at each stamp: a pose that is 1 cm too far ahead makes one interval too long and the next
too short. A vehicle's twist does not jump like that, so most of it can be separated: the twist is an
integrated Wiener process (white jerk), observed as its mean over each interval plus the difference of two
pose errors,

    z_k = w_k + (n_{k+1} - n_k) / h_k,

each of the six axes by itself. The motions themselves determine how rough the motion is, and by how much the
claimed covariance errs: both are averaged over under their posterior (Saerkkae, Bayesian Filtering and
Smoothing, 2013, ch. 4, 8 and 12).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import gtsam
import numpy as np

from sst_graph.odometry.standstill import overlap
from sst_graph.types import FloatArray, RelativeMotion

_SHORTEST = 5
"""Fewest motions in a row that determine how smooth they are."""
_ROUGHNESS = np.logspace(-5.0, 3.0, 9)
"""Candidates for the variance that the jerk adds to the twist in an interval, over the noise's."""
_SCALES = 2.0 ** np.arange(-4, 2)
"""Candidates for the true over the claimed covariance: what is far beyond it is motion, not noise."""
_PRIOR_WEIGHT = 4.0
"""Weight of the prior that the claimed covariance is right, in motions."""
_DIFFUSE = (1e8, 1e6)
"""Variances of twist and acceleration before the first motion, in units of the noise."""


class MotionSmoother:
    """Takes from motions the noise that a vehicle cannot follow; some of them may be new in each call.

    What is known of a motion hardly changes once a ``reach`` of others has followed; then it stays as it is.
    """

    def __init__(self, reach: int | None = None) -> None:
        """reach: how many of the latest motions are smoothed again in each call; None: all."""
        self._reach = reach
        self._runs: list[_Run] = []

    def smoothed(self, motions: Sequence[RelativeMotion]) -> list[RelativeMotion]:
        """The motions without that noise; standstill and failures stay as they are.

        Args:
            motions: consecutive, stamps rising; exactly the identity at standstill. One that an earlier call
                had is known by being the same object.

        Returns:
            As many motions; the covariance of a smoothed one is diagonal, and nearly common to its
            neighbours.
        """
        result, runs = list(motions), []
        for start, end in _ranges(motions):
            run = self._continued(motions[start:end])
            run.smooth(self._reach)
            result[start:end] = run.smoothed
            runs.append(run)
        self._runs = runs
        return result

    def _continued(self, motions: Sequence[RelativeMotion]) -> _Run:
        """The run of these motions: an earlier one that they continue, or a new one."""
        for run in self._runs:
            first, alike = overlap(run.motions, motions)
            if alike:
                run.forget(first)
                run.cut(alike)
                run.extend(motions[alike:])
                return run
        run = _Run(motions[0])
        run.extend(motions)
        return run


def _ranges(motions: Sequence[RelativeMotion]) -> Iterator[tuple[int, int]]:
    """Ranges of usable, moving motions in a row that are long enough."""
    usable = [motion.ok and bool(motion.mean_twist.any()) for motion in motions]
    edges = np.flatnonzero(np.diff(np.array([False, *usable, False], dtype=np.int8)))
    for start, end in edges.reshape(-1, 2).tolist():
        if end - start >= _SHORTEST:
            yield start, end


@dataclass(frozen=True)
class _Step:
    """The filter after a motion, for each axis and roughness (6, r).

    Attributes:
        mean, covariance: (6, r, 4), (6, r, 4, 4) of [twist, acceleration, pose errors before and after].
        transition: (4, 4) that led here from the motion before.
        ahead: (6, r, 4, 4) covariance that it led to, before this motion was used.
        gain: (6, r, 4, 4) of the smoother (Rauch, Tung, Striebel) from here to the motion before.
        squares, log_sizes: (6, r) sums so far of squared, whitened innovations, and of their log variances.
    """

    stored_apart: ClassVar[bool] = True

    mean: FloatArray
    covariance: FloatArray
    transition: FloatArray
    ahead: FloatArray
    gain: FloatArray
    squares: FloatArray
    log_sizes: FloatArray


class _Run:
    """Consecutive motions, filtered forwards and smoothed backwards.

    Inside, lengths of time are in units of the first interval, twists in units of its noise.
    """

    def __init__(self, first: RelativeMotion) -> None:
        self.motions: list[RelativeMotion] = []
        self.smoothed: list[RelativeMotion] = []
        self._steps: list[_Step] = []
        self._forgotten = 0
        self._seconds = first.seconds
        self._sigmas = np.sqrt(np.diag(first.covariance)) / first.seconds

    def forget(self, count: int) -> None:
        """Drop the first motions; their information on the others stays."""
        del self.motions[:count], self.smoothed[:count], self._steps[:count]
        self._forgotten += count

    def cut(self, length: int) -> None:
        """Forget all motions but the first ones."""
        del self.motions[length:], self.smoothed[length:], self._steps[length:]

    def extend(self, motions: Sequence[RelativeMotion]) -> None:
        """Filter the motions that follow."""
        for motion in motions:
            predicted = self._predicted(motion) if self.motions else self._initial(motion)
            self._steps.append(self._updated(predicted, motion))
            self.motions.append(motion)
            self.smoothed.append(motion)

    def smooth(self, reach: int | None) -> None:
        """Smooth the latest motions, all where ``reach`` is None."""
        last = self._steps[-1]
        mean, covariance = last.mean, last.covariance
        oldest = 0 if reach is None else max(0, len(self._steps) - reach)
        twists, variances = [mean[..., 0]], [covariance[..., 0, 0]]
        for k in range(len(self._steps) - 1, oldest, -1):
            # Rauch, Tung, Striebel.
            step, before = self._steps[k], self._steps[k - 1]
            mean = before.mean + (step.gain @ (mean - before.mean @ step.transition.T)[..., None])[..., 0]
            closer = step.gain @ (covariance - step.ahead) @ np.swapaxes(step.gain, -1, -2)
            covariance = before.covariance + closer
            twists.append(mean[..., 0])
            variances.append(covariance[..., 0, 0])
        found = self._smoothed_motions(oldest, np.stack(twists[::-1]), np.stack(variances[::-1]))
        self.smoothed[oldest:] = found

    def _initial(self, motion: RelativeMotion) -> _Step:
        """What is known before the first motion."""
        shape = (6, len(_ROUGHNESS))
        covariance = np.zeros((*shape, 4, 4))
        covariance[..., 0, 0], covariance[..., 1, 1] = _DIFFUSE
        covariance[..., 2, 2] = covariance[..., 3, 3] = self._pose_variances(motion)[:, None]
        nothing, none = np.zeros(shape), np.zeros((*shape, 4, 4))
        return _Step(np.zeros((*shape, 4)), covariance, np.eye(4), covariance, none, nothing, nothing)

    def _predicted(self, motion: RelativeMotion) -> _Step:
        before, last = self._steps[-1], self.motions[-1]
        step = 0.5 * (motion.to_ns + motion.from_ns - last.to_ns - last.from_ns) * 1e-9 / self._seconds
        F = np.zeros((4, 4))
        F[:2, :2] = [[1.0, step], [0.0, 1.0]]
        F[2, 3] = 1.0
        Q = np.zeros_like(before.covariance)
        jerk = np.array([[step**3 / 3.0, step**2 / 2.0], [step**2 / 2.0, step]])
        Q[..., :2, :2] = 3.0 * _ROUGHNESS[:, None, None] * jerk
        Q[..., 3, 3] = self._pose_variances(motion)[:, None]
        moved = F @ before.covariance
        ahead = moved @ F.T + Q
        gain = np.swapaxes(np.linalg.solve(ahead, moved), -1, -2)
        return _Step(before.mean @ F.T, ahead, F, ahead, gain, before.squares, before.log_sizes)

    def _updated(self, predicted: _Step, motion: RelativeMotion) -> _Step:
        seconds = motion.seconds / self._seconds
        h = np.array([1.0, 0.0, -1.0 / seconds, 1.0 / seconds])
        claimed = self._pose_variances(motion)
        before = self._pose_variances(self.motions[-1]) if self.motions else claimed
        excess = np.maximum(claimed - before, 0.0) / seconds**2
        innovation = (motion.mean_twist / self._sigmas)[:, None] - predicted.mean @ h
        cross = predicted.covariance @ h
        size = cross @ h + excess[:, None]
        gain = cross / size[..., None]
        return replace(
            predicted,
            mean=predicted.mean + gain * innovation[..., None],
            covariance=predicted.covariance - gain[..., :, None] * cross[..., None, :],
            squares=predicted.squares + innovation**2 / size,
            log_sizes=predicted.log_sizes + np.log(size),
        )

    def _pose_variances(self, motion: RelativeMotion) -> FloatArray:
        """(6,) of the error at the end of a motion: half of what the motion claims."""
        return np.asarray(0.5 * np.diag(motion.covariance) / (self._sigmas * self._seconds) ** 2)

    def _weights(self, last: _Step) -> tuple[FloatArray, FloatArray]:
        """(6, r) posterior of the roughness, and the mean scale of the noise's covariance under each."""
        freedom = self._forgotten + len(self._steps) - 2 + _PRIOR_WEIGHT
        squares = (last.squares + _PRIOR_WEIGHT)[..., None] / _SCALES
        log_posterior = -0.5 * (last.log_sizes[..., None] + freedom * np.log(_SCALES) + squares)
        shares = np.exp(log_posterior - log_posterior.max(axis=(1, 2), keepdims=True))
        by_roughness = shares.sum(axis=2)
        scale = (shares * _SCALES).sum(axis=2) / np.maximum(by_roughness, 1e-300)
        return by_roughness / by_roughness.sum(axis=1, keepdims=True), scale

    def _smoothed_motions(
        self, first: int, twists: FloatArray, variances: FloatArray
    ) -> list[RelativeMotion]:
        """Motions from the first one on, from their twists and variances (k, 6, r) under each roughness."""
        shares, scale = self._weights(self._steps[-1])
        mean = (shares * twists).sum(axis=2)
        spread = scale * np.maximum(variances, 0.0) + (twists - mean[..., None]) ** 2
        squares = (shares * spread).sum(axis=2)
        answers = []
        for motion, m, square in zip(self.motions[first:], mean, squares, strict=True):
            unit = self._sigmas * motion.seconds
            covariance = np.diag(unit**2 * square)
            answers.append(replace(motion, aTb=gtsam.Pose3.Expmap(unit * m), covariance=covariance))
        return answers

"""The sums of the cluster-robust covariance, frame by frame; their size does not grow with the drive.

A frame that leaves the window is added to them and forgotten; sides that were not seen lately are closed.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sst_graph.covariance.error_model import ErrorModel, SideResiduals, fit_error_model
from sst_graph.covariance.image_shifts import NO_MOMENTS, shift_variances
from sst_graph.covariance.jackknife import bounded_ratio, curvature_ratio
from sst_graph.covariance.sums import ScoreSums, total
from sst_graph.tracker.sums.linearized_pair import LinearizedPair
from sst_graph.tracker.sums.object_sums import ObjectSums
from sst_graph.tracker.window.gaussian import with_room
from sst_graph.tracker.window.window import OBJECT_MEMORY
from sst_graph.types import FloatArray, IntArray

_RECENT = 150
"""The error model is fitted to so many of the latest frames and to those of the window."""


@dataclass
class RunningSums:
    """The sums over all frames that have left the window, in the columns of the Gaussian that holds them.

    Attributes:
        scores: over the unknowns and, behind them, the held parameters.
        last_seen: by the number of each side that is not closed, the scan that saw it last.
        recent: residuals of the latest frames.
        objects: the matches object by object.
        weight, curvature: sums over all matches, see :class:`LinearizedPair`.
        held: number of held parameters.
        shifts: (3, 7) moments of the shifts of pictures and stamps, see :class:`LinearizedPair`.
        by_shifts: (3, n, n) variance of the score, held parameters included, by a unit of each in all images.
    """

    scores: ScoreSums
    last_seen: dict[int, int] = field(default_factory=dict)
    recent: deque[SideResiduals] = field(default_factory=lambda: deque(maxlen=_RECENT))
    objects: ObjectSums = field(default_factory=lambda: ObjectSums.empty(0))
    weight: float = 0.0
    curvature: float = 0.0
    held: int = 0
    shifts: FloatArray = field(default_factory=NO_MOMENTS.copy)
    by_shifts: FloatArray = field(default_factory=lambda: np.zeros((3, 0, 0)))

    @classmethod
    def empty(cls, n: int, held: int = 0) -> RunningSums:
        """n: unknowns; held: further parameters."""
        nothing = np.zeros((3, n + held, n + held))
        return cls(ScoreSums.none(n + held), objects=ObjectSums.empty(n), held=held, by_shifts=nothing)

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return len(self.scores.independent) - self.held

    def add(self, pair: LinearizedPair, columns: IntArray, scan: int, by_object: bool = True) -> None:
        """Add a pair that leaves the window; sides that were not seen lately are closed.

        Args:
            columns: of the pair's unknowns, and of what it holds if the sums do, among those of these.
            by_object: keep its matches object by object, too.
        """
        own = replace(pair, scores=pair.scores.columns(slice(len(columns))))
        more = self.with_pairs([own], [columns])
        self.weight, self.curvature = more.weight, more.curvature
        self.shifts, self.by_shifts = more.shifts, more.by_shifts
        self.last_seen.update(dict.fromkeys(pair.scores.sides.tolist(), scan))
        closed = [side for side, last in self.last_seen.items() if last < scan - OBJECT_MEMORY]
        for side in closed:
            del self.last_seen[side]
        self.scores = more.scores.without_sides(closed)
        self.recent.append(pair.residuals)
        if by_object and pair.objects is not None:
            self.objects.add(pair.objects)

    def with_pairs(self, pairs: Sequence[LinearizedPair], columns: Sequence[IntArray]) -> RunningSums:
        """With the scores of pairs of the window, which stay open.

        Args:
            columns: of the unknowns of each pair and of what it holds, among those of these.
        """
        n = self.size + self.held
        return replace(
            self,
            scores=total(n, [self.scores, *(pair.scores for pair in pairs)], [np.arange(n), *columns]),
            weight=self.weight + sum(pair.weight for pair in pairs),
            curvature=self.curvature + sum(pair.curvature for pair in pairs),
            shifts=sum((pair.shifts for pair in pairs), self.shifts),
            by_shifts=self.by_shifts + _squares(pairs, columns, n),
        )

    @property
    def weight_curvature_ratio(self) -> float:
        """Mean robust weight over mean curvature, of all matches."""
        return curvature_ratio(self.weight, self.curvature)

    def grow(self, n: int) -> None:
        """Make room for further unknowns, n in all."""
        self.transform(with_room(self.size, n, self.held))

    def transform(self, T: FloatArray) -> None:
        """Follow the Gaussian: through a random walk (:meth:`Gaussian.transition`), or to other unknowns."""
        self.scores = self.scores.transformed(T)
        self.by_shifts = T @ self.by_shifts @ T.T
        self.objects.transform(T[: len(T) - self.held, : T.shape[1] - self.held])

    def carried(self, T: FloatArray) -> RunningSums:
        """Through a random walk; the matches object by object stay as they are.

        Args:
            T: (n, n) of :meth:`Gaussian.transition`, held parameters included.
        """
        return replace(self, scores=self.scores.transformed(T), by_shifts=T @ self.by_shifts @ T.T)

    def copy(self) -> RunningSums:
        recent = deque(self.recent, self.recent.maxlen)
        return replace(self, last_seen=dict(self.last_seen), recent=recent, objects=self.objects.copy())

    def error_model(self, window: Iterable[LinearizedPair]) -> ErrorModel:
        """The error model by the latest frames and those of the window."""
        return fit_error_model(SideResiduals.joined([*self.recent, *(pair.residuals for pair in window)]))

    def excess(self, model: ErrorModel, with_held: bool = False) -> FloatArray:
        """(n, n) variance of the score beyond that of independent matches.

        Args:
            with_held: over the held parameters, too.
        """
        return (self.scores if with_held else self.scores.columns(slice(self.size))).excess(model)

    @property
    def shift_variances(self) -> FloatArray:
        """(3,) variances of the shifts of pictures [px^2, px^2] and of their stamps [s^2] over the images."""
        return shift_variances(self.shifts) * bounded_ratio(self.weight_curvature_ratio) ** 2

    @property
    def shift_excess(self) -> FloatArray:
        """(3, n, n) what each adds to the variance of the score, over the held parameters, too."""
        return self.shift_variances[:, None, None] * self.by_shifts


def _squares(pairs: Sequence[LinearizedPair], columns: Sequence[IntArray], n: int) -> FloatArray:
    """(3, n, n) variance of the score of some pairs, each in its own columns, by a unit of each shift."""
    rows = np.zeros((3, len(pairs), n))
    for k, (pair, own) in enumerate(zip(pairs, columns, strict=True)):
        rows[:, k, own] = pair.by_shifts[: len(own)].T
    return np.asarray(rows.transpose(0, 2, 1) @ rows)

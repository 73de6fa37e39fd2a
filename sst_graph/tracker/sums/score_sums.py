"""The cluster-robust covariance, frame by frame: sums that stay small however long the drive.

The batch's model (:mod:`sst_graph.covariance.cluster_robust`) needs, of all matches, the sum of J'J, the
sums of the scores over each side of an object within a frame, and over each side in all frames. A frame
that leaves the window adds to these and is forgotten; sides that were not seen lately are closed.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from sst_graph.association.edge_matching import SIDES
from sst_graph.covariance.cluster_robust import (
    ErrorModel,
    effective_views,
    flatness_of,
    freedom_of_sides,
    spread_beyond,
    with_floors,
)
from sst_graph.tracker.sums.linearized_pair import LinearizedPair, summed_rows
from sst_graph.tracker.sums.object_sums import ObjectSums
from sst_graph.tracker.window.gaussian import scattered, with_room

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]


@dataclass
class ScoreSums:
    """The sums over all frames that have left the window, in the columns of the belief that took them in.

    Attributes:
        JJ, frames, closed: (n, n) sums of J'J, of squared scores by side and frame, by closed side; in the
            columns of the belief, those of what it holds included.
        live: running score of each side seen lately, and the scan that saw it last.
        recent: (k, 6) [side, mean, weights, weights2, within, moved] of the latest sides.
        objects: what each object says.
        weight, curvature: sums over all matches, see :class:`LinearizedPair`.
        held: how many parameters the belief holds.
    """

    JJ: FloatArray
    frames: FloatArray
    closed: FloatArray
    live: dict[int, tuple[FloatArray, int]] = field(default_factory=dict)
    recent: deque[FloatArray] = field(default_factory=lambda: deque(maxlen=150))
    objects: ObjectSums = field(default_factory=lambda: ObjectSums.empty(0))
    weight: float = 0.0
    curvature: float = 0.0
    held: int = 0

    @classmethod
    def empty(cls, n: int, held: int = 0) -> ScoreSums:
        """n: unknowns; held: further parameters."""
        nothing = np.zeros((n + held, n + held))
        return cls(nothing, nothing, nothing, objects=ObjectSums.empty(n), held=held)

    def add(
        self, score: LinearizedPair, columns: IntArray, scan: int, memory: int = 50, by_object: bool = True
    ) -> None:
        """Take in a pair that leaves the window; sides not seen for ``memory`` scans are closed.

        Args:
            columns: where the pair's unknowns, and what it holds if the sums do, stand among those of these.
            by_object: keep what each object says, too.
        """
        self.JJ, self.frames, n = self.JJ.copy(), self.frames.copy(), len(columns)
        self.JJ[np.ix_(columns, columns)] += score.JJ[:n, :n]
        self.frames[np.ix_(columns, columns)] += score.sums[:n, :n]
        rows = np.zeros((len(score.sides.sides), len(self.JJ)))
        rows[:, columns] = score.sides.scores[:, :n]
        for side, row in zip(score.sides.sides.tolist(), rows, strict=True):
            before = self.live.get(side)
            self.live[side] = (row if before is None else before[0] + row, scan)
        for side in [side for side, (_, last) in self.live.items() if last < scan - memory]:
            row, _ = self.live.pop(side)
            self.closed = self.closed + np.outer(row, row)
        self.recent.append(score.sides.rows)
        if by_object and score.objects is not None:
            self.objects.add(score.objects)
        self.weight, self.curvature = self.weight + score.weight, self.curvature + score.curvature

    def flatness(self, window: Sequence[LinearizedPair] = ()) -> float:
        """Mean robust weight over mean curvature, of all matches."""
        curvature = self.curvature + sum(score.curvature for score in window)
        weight = self.weight + sum(score.weight for score in window)
        return flatness_of(weight, curvature)

    def grow(self, n: int) -> None:
        """Make room for further unknowns, n in all."""
        self.transform(with_room(len(self.JJ) - self.held, n, self.held))

    def transform(self, T: FloatArray) -> None:
        """Follow the belief: through a random walk (:meth:`Gaussian.transition`), or to other unknowns."""
        self.JJ, self.frames, self.closed = (T @ M @ T.T for M in (self.JJ, self.frames, self.closed))
        self.objects.transform(T[: len(T) - self.held, : T.shape[1] - self.held])
        self.live = {side: (T @ row, last) for side, (row, last) in self.live.items()}

    def copy(self) -> ScoreSums:
        recent = deque(self.recent, self.recent.maxlen)
        return replace(self, live=dict(self.live), recent=recent, objects=self.objects.copy())

    def error_model(self, window: Iterable[LinearizedPair]) -> ErrorModel:
        """Variances of the error model from the latest frames."""
        rows = [*self.recent, *(score.sides.rows for score in window)]
        return fit_sides(np.concatenate(rows))

    def surplus(
        self,
        window: Sequence[LinearizedPair],
        columns: Sequence[IntArray],
        model: ErrorModel,
        with_held: bool = False,
    ) -> FloatArray:
        """(n, n) variance of the score beyond that of independent matches.

        Args:
            window: pairs beside those taken in.
            columns: where their unknowns stand, and what they hold where that is asked for.
            with_held: over what is held, too.
        """
        n = len(self.JJ) if with_held else len(self.JJ) - self.held
        parts = [(score, slice(len(own))) for score, own in zip(window, columns, strict=True)]
        of_matches = [score.JJ[own, own] for score, own in parts]
        of_sides = [score.sums[own, own] for score, own in parts]
        JJ, frames = scattered(n, columns, of_matches, of_sides)
        JJ, frames = self.JJ[:n, :n] + JJ, self.frames[:n, :n] + frames
        total = (model.match - 1.0) * JJ + model.side_frame * frames
        sides = [np.array(list(self.live), dtype=np.intp), *(score.sides.sides for score in window)]
        rows = np.zeros((sum(len(part) for part in sides), n))
        for i, (row, _) in enumerate(self.live.values()):
            rows[i] = row[:n]
        start = len(self.live)
        for score, own in zip(window, columns, strict=True):
            rows[start : start + len(score.sides.sides), own] = score.sides.scores[:, : len(own)]
            start += len(score.sides.sides)
        by_side = summed_rows(rows, np.concatenate(sides))
        return np.asarray(total + model.side * (self.closed[:n, :n] + by_side.T @ by_side))


def fit_sides(rows: FloatArray) -> ErrorModel:
    """The batch's error model from the rows of sides, (k, 6) as in :class:`ScoreSums`."""
    names, sides = np.unique(rows[:, 0], return_inverse=True)
    sides = sides.reshape(-1)
    means, weights, weights2, within, moved = rows[:, 1:].T
    freedom = float((weights - weights2 / np.maximum(weights, 1e-12)).sum())
    match = max(0.05, float(within.sum()) / max(freedom, 1e-9))
    count = weights**2 / np.maximum(weights2, 1e-12)
    side_frame = spread_beyond(means, match / count, sides)
    v = 1.0 / (match / count + side_frame)
    total = np.bincount(sides, v)
    side_means = np.bincount(sides, v * means) / np.maximum(total, 1e-12)
    side = spread_beyond(side_means, 1.0 / total, np.zeros(len(total), dtype=np.intp), centre=0.0)
    side /= freedom_of_sides(len(names), len(np.unique(names // SIDES)))
    return with_floors(side, side_frame, match, effective_views(sides, weights, moved > 0.5))

"""Sums over matches for the cluster-robust covariance; batch, tracker and a user's graph fill the same sums.

With a match's whitened Jacobian row J, robust weight w and a = sqrt(w) J, an error e of its residual changes
the gradient by its score, sqrt(w) a e. Under the error model (:mod:`sst_graph.covariance.error_model`) the
gradient of all matches varies by

    M = match * sum a a' + side_frame * sum s_kf s_kf' + side * sum s_k s_k' + sum share_k l_k l_k',

s_kf the sum of sqrt(w) a over the matches of side k in frame f, and s_k that over all frames; l_k that of
sqrt(w) a e, e the error of a level edge that may stay in all frames
(:mod:`sst_graph.covariance.level_edges`). With H the information of the whole problem and A = sum a a' the
part of it that the matches claim, the covariance is

    H^-1 + H^-1 (M - A) H^-1.

A batch fills the sums with all its matches at once, a tracker adds the frames that leave its window, a graph
of the user's own adds term by term.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_array

from sst_graph.covariance.error_model import ErrorModel, by_side_and_frame
from sst_graph.covariance.level_edges import MOMENTS, LevelEdges, shares_that_stay
from sst_graph.graph.linear import scattered
from sst_graph.types import FloatArray, IntArray


@dataclass(frozen=True)
class ScoreSums:
    """Sums over the matches of some frames, in n unknowns.

    Attributes:
        independent: (n, n) variance of the score if every match errs by itself, A above.
        side_frames: (n, n) the same by a unit error of each side in each frame.
        closed: (n, n) the same by a unit error that a side keeps over all frames, of sides that are closed:
            no frame will see them again.
        sides: (k,) numbers of the other sides, rising.
        scores: (k, n) sum of sqrt(w) a of each of them.
        level: (k, n) sum of sqrt(w) a e of each, e the error of level edges.
        moments: (k, MOMENTS) of the heights of level edges.
        closed_level: (n, n) variance of the score by the errors of level edges that are closed.
    """

    independent: FloatArray
    side_frames: FloatArray
    closed: FloatArray
    sides: IntArray
    scores: FloatArray
    level: FloatArray
    moments: FloatArray
    closed_level: FloatArray

    @classmethod
    def none(cls, n: int) -> ScoreSums:
        """Of no match."""
        square, rows = np.zeros((n, n)), np.zeros((0, n))
        return cls(square, square, square, np.zeros(0, np.intp), rows, rows, np.zeros((0, MOMENTS)), square)

    @classmethod
    def of(
        cls,
        J: FloatArray | csr_array,
        roots: FloatArray,
        sides: IntArray,
        frames: IntArray,
        level: LevelEdges | None = None,
    ) -> ScoreSums:
        """Of matches, from rows a (m, n), roots of the weights, sides and numbers of the frames (m,).

        Args:
            level: which of them lie on level edges; None where nothing is known of that.
        """
        level = LevelEdges.none(len(roots)) if level is None else level
        first, which = by_side_and_frame(sides, frames)
        by_frame = _members(which, len(first), roots) @ J
        names, side = np.unique(sides[first], return_inverse=True)
        of_sides, square = _members(side.reshape(-1), len(names), np.ones(len(first))), (J.shape[1],) * 2
        return cls(
            gram(J),
            gram(by_frame),
            np.zeros(square),
            names,
            dense(of_sides @ by_frame),
            dense(of_sides @ (_members(which, len(first), roots * level.errors) @ J)),
            dense(of_sides @ level.moments(roots**2, which, len(first))),
            np.zeros(square),
        )

    @classmethod
    def of_frame(
        cls, J: FloatArray, roots: FloatArray, sides: IntArray, level: LevelEdges | None = None
    ) -> ScoreSums:
        """Of the matches of one frame, from dense rows."""
        level = LevelEdges.none(len(roots)) if level is None else level
        names, scores = summed_rows(J * roots[:, None], sides)
        square, numbers = np.zeros((J.shape[1],) * 2), np.searchsorted(names, sides)
        _, errors = summed_rows(J * (roots * level.errors)[:, None], sides)
        moments = level.moments(roots**2, numbers, len(names))
        return cls(J.T @ J, scores.T @ scores, square, names, scores, errors, moments, square)

    def __add__(self, other: ScoreSums) -> ScoreSums:
        """These matches and others, of other frames."""
        every = np.arange(len(self.independent))
        return total(len(every), (self, other), (every, every))

    def __sub__(self, other: ScoreSums) -> ScoreSums:
        """These matches without those of some of the frames, none of whose sides is closed."""
        rows, places = self._rows.copy(), np.searchsorted(self.sides, other.sides)
        rows[places] -= other._rows
        return replace(
            self._with_rows(self.sides, rows),
            independent=self.independent - other.independent,
            side_frames=self.side_frames - other.side_frames,
        )

    def columns(self, some: IntArray | slice) -> ScoreSums:
        """In some of the unknowns, the others known."""
        A, B, C, D = (M[some][:, some] for M in self._squares)
        rows = self.scores[:, some], self.level[:, some]
        return ScoreSums(A, B, C, self.sides, *rows, self.moments, D)

    def transformed(self, T: FloatArray) -> ScoreSums:
        """In other unknowns, whose score is T (m, n) times that of these."""
        A, B, C, D = (T @ M @ T.T for M in self._squares)
        return ScoreSums(A, B, C, self.sides, self.scores @ T.T, self.level @ T.T, self.moments, D)

    def scaled(self, weight: float) -> ScoreSums:
        """With the weights of all matches multiplied: the scores by as much, their variance by its square."""
        A, B, C, D = (weight**2 * M for M in self._squares)
        rows = weight * self.scores, weight * self.level
        return ScoreSums(A, B, C, self.sides, *rows, self.moments, D)

    def without_sides(self, gone: Collection[int]) -> ScoreSums:
        """With some sides closed: no frame will see them again."""
        if not gone:
            return self
        leaving = np.isin(self.sides, list(gone))
        closing = self._with_rows(self.sides[leaving], self._rows[leaving])
        return replace(
            self._with_rows(self.sides[~leaving], self._rows[~leaving]),
            closed=self.closed + closing._by_side(),
            closed_level=self.closed_level + closing._by_level_edges(),
        )

    def variance(self, model: ErrorModel) -> FloatArray:
        """(n, n) of the score of all matches, M above."""
        by_side, by_level_edges = self.closed + self._by_side(), self.closed_level + self._by_level_edges()
        whole = model.match * self.independent + model.side_frame * self.side_frames + model.side * by_side
        return np.asarray(whole + by_level_edges)

    def excess(self, model: ErrorModel) -> FloatArray:
        """(n, n) variance of the score beyond that of independent matches, M - A."""
        return self.variance(model) - self.independent

    def _by_side(self) -> FloatArray:
        return np.asarray(self.scores.T @ self.scores)

    def _by_level_edges(self) -> FloatArray:
        rows = self.level_steps
        return np.asarray(rows.T @ rows)

    @property
    def level_steps(self) -> FloatArray:
        """(k, n) score by one deviation of what stays of a level edge's error."""
        return np.asarray(np.sqrt(shares_that_stay(self.moments))[:, None] * self.level)

    @property
    def _squares(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        return self.independent, self.side_frames, self.closed, self.closed_level

    @property
    def _rows(self) -> FloatArray:
        """(k, 2 n + MOMENTS) all that is summed by side."""
        return np.concatenate([self.scores, self.level, self.moments], axis=1)

    def _with_rows(self, sides: IntArray, rows: FloatArray) -> ScoreSums:
        n = len(self.independent)
        scores, level, moments = rows[:, :n], rows[:, n : 2 * n], rows[:, 2 * n :]
        return replace(self, sides=sides, scores=scores, level=level, moments=moments)


def total(n: int, parts: Sequence[ScoreSums], columns: Sequence[IntArray]) -> ScoreSums:
    """Sums over frames, each in its own columns (m,) of n unknowns."""
    independent, side_frames = scattered(
        n, columns, [part.independent for part in parts], [part.side_frames for part in parts]
    )
    closed, closed_level = np.zeros((n, n)), np.zeros((n, n))
    for part, own in zip(parts, columns, strict=True):
        if part.closed.any():
            closed[np.ix_(own, own)] += part.closed
            closed_level[np.ix_(own, own)] += part.closed_level
    sides = [np.zeros(0, np.intp), *(part.sides for part in parts)]
    rows = np.zeros((sum(len(own) for own in sides), 2 * n + MOMENTS))
    start = 0
    for part, own in zip(parts, columns, strict=True):
        some = slice(start, start + len(part.sides))
        rows[some, own], rows[some, n + own], rows[some, 2 * n :] = part.scores, part.level, part.moments
        start += len(part.sides)
    names, rows = summed_rows(rows, np.concatenate(sides))
    of_sides = rows[:, :n], rows[:, n : 2 * n], rows[:, 2 * n :]
    return ScoreSums(independent, side_frames, closed, names, *of_sides, closed_level)


def dense(rows: FloatArray | csr_array) -> FloatArray:
    return np.asarray(rows if isinstance(rows, np.ndarray) else rows.toarray())


def _members(groups: IntArray, count: int, weights: FloatArray) -> csr_array:
    """(count, m) weights of the members (m,) of each group."""
    return csr_array((weights, groups, np.arange(len(groups) + 1)), shape=(len(groups), count)).T.tocsr()


def summed_rows(rows: FloatArray, names: IntArray) -> tuple[IntArray, FloatArray]:
    """(k,) different names, rising, and (k, n) sums of the rows (m, n) of each; names (m,)."""
    if len(names) == 0:
        return names, rows
    order = np.argsort(names, kind="stable")
    firsts = np.append(0, np.flatnonzero(np.diff(names[order])) + 1)
    return names[order[firsts]], np.asarray(np.add.reduceat(rows[order], firsts))


def gram(J: FloatArray | csr_array) -> FloatArray:
    """(n, n) J^T J of rows (m, n)."""
    if isinstance(J, np.ndarray):
        return np.asarray(J.T @ J)
    m, n = J.shape
    some, whole = max(1, _DENSE // max(n, 1)), np.zeros((n, n))
    # Rows are multiplied much faster when they are dense, and some at a time take little memory.
    for start in range(0, m, some):
        rows = J[start : start + some].toarray()
        whole += rows.T @ rows
    return whole


_DENSE = 500_000
"""Numbers of a dense part of the rows."""

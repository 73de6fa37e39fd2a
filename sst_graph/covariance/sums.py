"""Sums over matches for the cluster-robust covariance; batch, tracker and a user's graph fill the same sums.

With a match's whitened Jacobian row J, robust weight w and a = sqrt(w) J, an error e of its residual changes
the gradient by its score, sqrt(w) a e. Under the error model (:mod:`sst_graph.covariance.error_model`) the
gradient of all matches varies by

    M = match * sum a a' + side_frame * sum s_kf s_kf' + side * sum s_k s_k' + L,

s_kf the sum of sqrt(w) a over the matches of side k in frame f, s_k that over all frames, and L by what stays
of the errors of level edges (:mod:`sst_graph.covariance.level_edges`). With H the information of the whole
problem and A = sum a a' the part of it that the matches claim, the covariance is

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
from sst_graph.covariance.level_edges import MOMENTS, LevelEdges, LevelSums
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
        level: of the errors of level edges, by the same sides.
    """

    independent: FloatArray
    side_frames: FloatArray
    closed: FloatArray
    sides: IntArray
    scores: FloatArray
    level: LevelSums

    @classmethod
    def none(cls, n: int) -> ScoreSums:
        """Of no match."""
        nothing, level = np.zeros((n, n)), LevelSums.none(n)
        return cls(nothing, nothing, nothing, np.zeros(0, np.intp), np.zeros((0, n)), level)

    @classmethod
    def of(
        cls,
        J: FloatArray | csr_array,
        roots: FloatArray,
        sides: IntArray,
        frames: IntArray,
        level: LevelEdges,
    ) -> ScoreSums:
        """Of matches, from rows a (m, n), roots of the weights, sides and numbers of the frames (m,).

        Args:
            level: which of them lie on level edges.
        """
        first, which = by_side_and_frame(sides, frames)
        by_frame = _members(which, len(first), roots) @ J
        names, side = np.unique(sides[first], return_inverse=True)
        sides_of = _members(side.reshape(-1), len(names), np.ones(len(first)))
        by_edge = sides_of @ (_members(which, len(first), roots * level.errors) @ J)
        errors = LevelSums.of_open(_dense(by_edge), sides_of @ level.moments(roots**2, which, len(first)))
        scores, square = _dense(sides_of @ by_frame), (J.shape[1],) * 2
        return cls(gram(J), gram(by_frame), np.zeros(square), names, scores, errors)

    @classmethod
    def of_frame(cls, J: FloatArray, roots: FloatArray, sides: IntArray, level: LevelEdges) -> ScoreSums:
        """Of the matches of one frame, from dense rows."""
        names, side = np.unique(sides, return_inverse=True)
        members = np.zeros((len(names), len(sides)))
        members[side, np.arange(len(sides))] = roots
        scores = members @ J
        moments = level.moments(roots**2, side, len(names))
        errors = LevelSums.of_open((members * level.errors) @ J, moments)
        return cls(J.T @ J, scores.T @ scores, np.zeros((J.shape[1],) * 2), names, scores, errors)

    def __add__(self, other: ScoreSums) -> ScoreSums:
        """These matches and others, of other frames."""
        every = np.arange(len(self.independent))
        return total(len(every), (self, other), (every, every))

    def __sub__(self, other: ScoreSums) -> ScoreSums:
        """These matches without those of some of the frames, none of whose sides is closed."""
        scores, places = self.scores.copy(), np.searchsorted(self.sides, other.sides)
        scores[places] -= other.scores
        independent, side_frames = self.independent - other.independent, self.side_frames - other.side_frames
        level = self.level.without(other.level, places)
        return ScoreSums(independent, side_frames, self.closed, self.sides, scores, level)

    def columns(self, some: IntArray | slice) -> ScoreSums:
        """In some of the unknowns, the others known."""
        A, B, C = (M[some][:, some] for M in (self.independent, self.side_frames, self.closed))
        return ScoreSums(A, B, C, self.sides, self.scores[:, some], self.level.columns(some))

    def transformed(self, T: FloatArray) -> ScoreSums:
        """In other unknowns, whose score is T (m, n) times that of these."""
        A, B, C = (T @ M @ T.T for M in (self.independent, self.side_frames, self.closed))
        return ScoreSums(A, B, C, self.sides, self.scores @ T.T, self.level.transformed(T))

    def scaled(self, weight: float) -> ScoreSums:
        """With the weights of all matches multiplied: the scores by as much, their variance by its square."""
        A, B, C = (weight**2 * M for M in (self.independent, self.side_frames, self.closed))
        return ScoreSums(A, B, C, self.sides, weight * self.scores, self.level.scaled(weight))

    def without_sides(self, gone: Collection[int]) -> ScoreSums:
        """With some sides closed: no frame will see them again."""
        if not gone:
            return self
        leaving = np.isin(self.sides, list(gone))
        rows, kept = self.scores[leaving], ~leaving
        closed, level = self.closed + rows.T @ rows, self.level.closing(leaving)
        sides, scores = self.sides[kept], self.scores[kept]
        return ScoreSums(self.independent, self.side_frames, closed, sides, scores, level)

    @property
    def rows(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """What is summed by side."""
        return self.scores, self.level.scores, self.level.moments

    def variance(self, model: ErrorModel) -> FloatArray:
        """(n, n) of the score of all matches, M above."""
        by_side = self.closed + self.scores.T @ self.scores
        whole = model.match * self.independent + model.side_frame * self.side_frames + model.side * by_side
        return np.asarray(whole + self.level.variance())

    def excess(self, model: ErrorModel) -> FloatArray:
        """(n, n) variance of the score beyond that of independent matches, M - A."""
        return self.variance(model) - self.independent


def total(n: int, parts: Sequence[ScoreSums], columns: Sequence[IntArray]) -> ScoreSums:
    """Sums over frames, each in its own columns (m,) of n unknowns."""
    independent, side_frames = scattered(
        n, columns, [part.independent for part in parts], [part.side_frames for part in parts]
    )
    closed, level = np.zeros((n, n)), LevelSums.none(n)
    for part, own in zip(parts, columns, strict=True):
        if part.closed.any():
            closed[np.ix_(own, own)] += part.closed
            level = level.with_closed(part.level, own)
    sides = [np.zeros(0, np.intp), *(part.sides for part in parts)]
    rows = np.zeros((sum(len(own) for own in sides), 2 * n + MOMENTS))
    start = 0
    for part, own in zip(parts, columns, strict=True):
        some = slice(start, start + len(part.sides))
        rows[some, own], rows[some, n + own], rows[some, 2 * n :] = part.rows
        start += len(part.sides)
    names, rows = summed_rows(rows, np.concatenate(sides))
    level = replace(level, scores=rows[:, n : 2 * n], moments=rows[:, 2 * n :])
    return ScoreSums(independent, side_frames, closed, names, rows[:, :n], level)


def _dense(rows: FloatArray | csr_array) -> FloatArray:
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

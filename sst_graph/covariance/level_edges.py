"""The error of level edges that stays in all frames: where between two rings they lie.

An upper or lower edge of an object lies anywhere between the last ring that hits the object and the next. A
level edge lies between the same two all along, so in one frame all its matches share the error. Over frames
it averages out where the edge passes from ring to ring, and stays where it does not: a roof as high as the
LiDAR, or a vehicle ahead at a constant distance. An edge keeps its height in the world, so the heights h_f at
which the frames put it differ by their errors alone. These are uniform with deviations s_f, and the share of
their variance that stays is

    1 - Var(h_f) / mean(s_f^2),    at least 0.

What is up is where all edges are level: the slope of the world's axes is fitted to how the edges' places vary
from frame to frame. A LiDAR's first pose, which the world has its axes from, may be tilted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from sst_graph.factors.alignment import Alignment
from sst_graph.types import BoolArray, FloatArray, IntArray

MOMENTS = 12
"""Sums over the frames of a side: of weights w, of w^2, of w s^2, of w p (3) and of the upper triangle of
w p p' (6), p the mean place of its matches."""
_UPPER = np.triu_indices(3)
"""Places of the upper triangle in p p'."""
_RIDGE_M2 = 1e-6
"""Added to how far the places of edges vary, where they hardly do: 1 mm of one edge."""


@dataclass(frozen=True)
class LevelEdges:
    """Which of some matches lie on level edges.

    Attributes:
        errors: (m,) what one deviation of the edge's place between the rings changes a residual by, in the
            residual's unit; 0 at other edges.
        places: (m, 3) of the points in the world [m]; of objects that move the height alone.
        sigmas_m: (m,) deviation of that place [m].
    """

    errors: FloatArray
    places: FloatArray
    sigmas_m: FloatArray

    @classmethod
    def none(cls, m: int) -> LevelEdges:
        """No match is on one."""
        return cls(np.zeros(m), np.zeros((m, 3)), np.zeros(m))

    @classmethod
    def of(cls, alignment: Alignment, level_px: FloatArray, wTl: gtsam.Pose3 | None) -> LevelEdges:
        """Of matches of one scan, the residuals whitened.

        Args:
            level_px: (m,) deviation of the place of a level edge between its rings; 0 at others.
            wTl: pose of the LiDAR. Without one, places count as equal: all of the error stays.
        """
        lPs, wRl_t = alignment.lPs, np.zeros((3, 4)) if wTl is None else wTl.matrix()[:3]
        sigmas_m = level_px * np.sqrt(np.vecdot(lPs, lPs)) / alignment.camera.fy
        places = lPs @ wRl_t[:, :3].T + wRl_t[:, 3]
        if alignment.l_velocities is not None:
            places[alignment.l_velocities.any(axis=1), :2] = 0.0
        return cls(level_px / alignment.sigmas_px, places, sigmas_m)

    @classmethod
    def joined(cls, parts: Sequence[LevelEdges]) -> LevelEdges:
        """One after the other."""
        columns = zip(*(vars(part).values() for part in (cls.none(0), *parts)), strict=True)
        return cls(*(np.concatenate(column) for column in columns))

    def take(self, index: IntArray) -> LevelEdges:
        """Some of the matches, by position."""
        return LevelEdges(self.errors[index], self.places[index], self.sigmas_m[index])

    def moments(self, weights: FloatArray, groups: IntArray, count: int) -> FloatArray:
        """(count, MOMENTS) of matches with weights (m,), in groups (m,): a side in a frame each."""
        weights = np.where(self.errors > 0.0, weights, 0.0)
        w, ws2, *wp = (
            np.bincount(groups, weights * each, count)
            for each in (np.ones(len(weights)), self.sigmas_m**2, *self.places.T)
        )
        place = np.stack(wp, axis=1) / np.maximum(w, 1e-12)[:, None]
        products = place[:, _UPPER[0]] * place[:, _UPPER[1]]
        return np.column_stack([w, w**2, ws2, w[:, None] * place, w[:, None] * products])


@dataclass(frozen=True)
class LevelSums:
    """Sums over matches on level edges, side by side, in n unknowns; 0 for sides that have none.

    Attributes:
        scores: (k, n) sum of sqrt(w) a e of each side, e the error.
        moments: (k, MOMENTS) of its places.
        closed: (n, n) variance of the score by sides that are closed.
        scatter: (3, 3) how far the places of these varied [m^2].
    """

    scores: FloatArray
    moments: FloatArray
    closed: FloatArray
    scatter: FloatArray

    @classmethod
    def of_open(cls, scores: FloatArray, moments: FloatArray) -> LevelSums:
        """Of sides none of which is closed."""
        n = scores.shape[1]
        return cls(scores, moments, np.zeros((n, n)), np.zeros((3, 3)))

    @classmethod
    def none(cls, n: int) -> LevelSums:
        """Of no side."""
        return cls.of_open(np.zeros((0, n)), np.zeros((0, MOMENTS)))

    def columns(self, some: IntArray | slice) -> LevelSums:
        """In some of the unknowns."""
        return LevelSums(self.scores[:, some], self.moments, self.closed[some][:, some], self.scatter)

    def transformed(self, T: FloatArray) -> LevelSums:
        """In other unknowns, whose score is T (m, n) times that of these."""
        return LevelSums(self.scores @ T.T, self.moments, T @ self.closed @ T.T, self.scatter)

    def scaled(self, weight: float) -> LevelSums:
        """With the weights of all matches multiplied."""
        return LevelSums(weight * self.scores, self.moments, weight**2 * self.closed, self.scatter)

    def without(self, other: LevelSums, places: IntArray) -> LevelSums:
        """Without other frames' sums, at some places of the sides."""
        scores, moments = self.scores.copy(), self.moments.copy()
        scores[places] -= other.scores
        moments[places] -= other.moments
        return replace(self, scores=scores, moments=moments)

    def closing(self, leaving: BoolArray) -> LevelSums:
        """With some sides closed."""
        rows, kept = self.steps[leaving], ~leaving
        scatter = self.scatter + scatter_of(self.moments[leaving]).sum(axis=0)
        return LevelSums(self.scores[kept], self.moments[kept], self.closed + rows.T @ rows, scatter)

    def with_closed(self, other: LevelSums, columns: IntArray) -> LevelSums:
        """With another's closed sides, in some of the columns."""
        closed = self.closed.copy()
        closed[np.ix_(columns, columns)] += other.closed
        return replace(self, closed=closed, scatter=self.scatter + other.scatter)

    @property
    def steps(self) -> FloatArray:
        """(k, n) score by one deviation of what stays of each side's error."""
        return np.asarray(np.sqrt(shares_that_stay(self.moments, self.scatter))[:, None] * self.scores)

    def variance(self) -> FloatArray:
        """(n, n) of the score by what stays of all these errors."""
        rows = self.steps
        return np.asarray(self.closed + rows.T @ rows)


def scatter_of(moments: FloatArray) -> FloatArray:
    """(k, 3, 3) sums of w (p - mean)(p - mean)' of each side's places, from moments (k, MOMENTS) [m^2]."""
    w = np.maximum(moments[:, 0], 1e-12)
    products = np.empty((len(w), 3, 3))
    products[:, _UPPER[0], _UPPER[1]] = products[:, _UPPER[1], _UPPER[0]] = moments[:, 6:]
    means = moments[:, 3:6] / w[:, None]
    return np.asarray(products - w[:, None, None] * means[:, :, None] * means[:, None, :])


def shares_that_stay(moments: FloatArray, others: FloatArray | float = 0.0) -> FloatArray:
    """(k,) of the variance of a level edge's error over the frames that see it.

    Args:
        moments: (k, MOMENTS) of the edges.
        others: (3, 3) sum of the :func:`scatter_of` of others, which tell what is up, too.
    """
    varied = scatter_of(moments)
    whole = varied.sum(axis=0) + others
    slope = np.linalg.solve(whole[:2, :2] + _RIDGE_M2 * np.eye(2), whole[:2, 2])
    up = np.append(-slope, 1.0) / np.sqrt(1.0 + slope @ slope)
    w = np.maximum(moments[:, 0], 1e-12)
    spread, s2 = np.maximum((varied @ up) @ up, 0.0) / w, moments[:, 2] / w
    # Frames of equal weight number w^2 / sum w^2; a single one tells no variance.
    freedom = 1.0 - moments[:, 1] / w**2
    known = (freedom > 1e-6) & (s2 > 0.0)
    averaged = np.divide(spread, freedom * s2, out=np.zeros(len(w)), where=known)
    return np.asarray(np.clip(1.0 - averaged, 0.0, 1.0))

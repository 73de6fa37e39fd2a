"""The error of level edges that stays in all frames: where between two rings they lie.

An upper or lower edge of an object lies anywhere between the last ring that hits the object and the next. A
level edge lies between the same two all along, so in one frame all its matches share the error. Over frames
it averages out where the edge passes from ring to ring, and stays where it does not: a roof as high as the
LiDAR, or a vehicle ahead at a constant distance. An edge keeps its height in the world, so the heights h_f at
which the frames put it differ by their errors alone. These are uniform with deviations s_f, and the share of
their variance that stays is

    1 - Var(h_f) / mean(s_f^2),    at least 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from sst_graph.factors.alignment import Alignment
from sst_graph.types import FloatArray, IntArray

MOMENTS = 5
"""Sums over the frames of a side: of weights w, of w^2, of w h, of w h^2 and of w s^2."""


@dataclass(frozen=True)
class LevelEdges:
    """Which of some matches lie on level edges.

    Attributes:
        errors: (m,) what one deviation of the edge's place between the rings changes a residual by, in the
            residual's unit; 0 at other edges.
        heights_m: (m,) of the points in the world [m].
        sigmas_m: (m,) deviation of that place [m].
    """

    errors: FloatArray
    heights_m: FloatArray
    sigmas_m: FloatArray

    @classmethod
    def none(cls, m: int) -> LevelEdges:
        """No match is on one."""
        return cls(np.zeros(m), np.zeros(m), np.zeros(m))

    @classmethod
    def of(cls, alignment: Alignment, level_px: FloatArray, wTl: gtsam.Pose3 | None) -> LevelEdges:
        """Of matches of one scan, the residuals whitened.

        Args:
            level_px: (m,) deviation of the place of a level edge between its rings; 0 at others.
            wTl: pose of the LiDAR. Without one, heights count as equal: all of the error stays.
        """
        lPs = alignment.lPs
        up = np.zeros(4) if wTl is None else wTl.matrix()[2]
        sigmas_m = level_px * np.sqrt(np.vecdot(lPs, lPs)) / alignment.camera.fy
        return cls(level_px / alignment.sigmas_px, lPs @ up[:3] + up[3], sigmas_m)

    @classmethod
    def joined(cls, parts: Sequence[LevelEdges]) -> LevelEdges:
        """One after the other."""
        columns = zip(*(vars(part).values() for part in (cls.none(0), *parts)), strict=True)
        return cls(*(np.concatenate(column) for column in columns))

    def take(self, index: IntArray) -> LevelEdges:
        """Some of the matches, by position."""
        return LevelEdges(self.errors[index], self.heights_m[index], self.sigmas_m[index])

    def moments(self, weights: FloatArray, groups: IntArray, count: int) -> FloatArray:
        """(count, MOMENTS) of matches with weights (m,), in groups (m,): a side in a frame each."""
        weights = np.where(self.errors > 0.0, weights, 0.0)
        w, wh, ws2 = (
            np.bincount(groups, weights * each, count) for each in (1.0, self.heights_m, self.sigmas_m**2)
        )
        return np.column_stack([w, w**2, wh, wh**2 / np.maximum(w, 1e-300), ws2])


def shares_that_stay(moments: FloatArray) -> FloatArray:
    """(k,) of the variance of a level edge's error over the frames that see it, from moments (k, MOMENTS)."""
    w = np.maximum(moments[:, 0], 1e-12)
    w2, h, h2, s2 = (moments[:, 1:] / np.stack([w**2, w, w, w], axis=1)).T
    # Frames of equal weight number 1 / w2; a single one tells no variance.
    freedom, spread = 1.0 - w2, np.maximum(h2 - h**2, 0.0)
    known = (freedom > 1e-6) & (s2 > 0.0)
    averaged = np.divide(spread, freedom * s2, out=np.zeros(len(w)), where=known)
    return np.asarray(np.clip(1.0 - averaged, 0.0, 1.0))

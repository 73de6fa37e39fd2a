"""Error model of the matches: variances of the errors that matches share, by the method of moments.

Each whitened residual is modelled as

    r_i = b_side + b_side,frame + e_i

for the side of an object that its match lies on: an error that the side keeps in all frames, one that it has
in a single frame, and one of the match alone. Only means of the residuals by side and frame enter the fit, so
that a frame can be forgotten once these are made.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sst_graph.association.edge_matching import SIDES
from sst_graph.types import FloatArray, IntArray

_SIDE, _SIDE_FRAME = 0.17, 0.17
"""Least variances as shares of a match's own: of a side over all frames, of a side in one frame.

The mask biases of the objects are fitted to the same residuals and absorb most of the error that a side
shares, so from the residuals alone the sigmas of a short drive would be far too small. Where a contour is
rough within a side, it is also rough as a whole: hence fractions of a match's variance."""
_LEAST_MATCH = 0.05
"""Least variance of a match's own error: only simulations have residuals of almost zero."""
_LEAST_FREEDOM = 0.25
"""Least share of the sides' spread that is taken to be left."""


@dataclass(frozen=True)
class ErrorModel:
    """Variances of whitened residuals: of a side over all frames, of a side in one frame, of a match."""

    side: float
    side_frame: float
    match: float


@dataclass(frozen=True)
class SideResiduals:
    """Whitened residuals, summed over the matches of one side of an object in one frame; k such sums.

    Attributes:
        sides: (k,) number of the side, the same in all frames; ``side // SIDES`` is its object.
        means: (k,) weighted mean.
        weights, weights2: (k,) sums of the weights and of their squares.
        within: (k,) weighted sum of squares around the mean.
    """

    sides: IntArray
    means: FloatArray
    weights: FloatArray
    weights2: FloatArray
    within: FloatArray

    @classmethod
    def of(
        cls, r: FloatArray, weights: FloatArray, sides: IntArray, frames: IntArray | None = None
    ) -> SideResiduals:
        """From residuals, weights, sides and numbers of the frames (None: one frame), all (m,)."""
        first, which = _by_side(sides) if frames is None else by_side_and_frame(sides, frames)
        total, squares, sums = (
            np.asarray(np.bincount(which, values, len(first)), np.float64)
            for values in (weights, weights**2, weights * r)
        )
        means = sums / np.maximum(total, 1e-12)
        within = np.bincount(which, weights * (r - means[which]) ** 2, len(first))
        return cls(sides[first], means, total, squares, np.asarray(within, np.float64))

    @classmethod
    def joined(cls, parts: Sequence[SideResiduals]) -> SideResiduals:
        """Residuals of the sides in several frames as one."""
        names = ("sides", "means", "weights", "weights2", "within")
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def _by_side(sides: IntArray) -> tuple[IntArray, IntArray]:
    """:func:`by_side_and_frame` of one frame."""
    _, first, which = np.unique(sides, return_index=True, return_inverse=True)
    return first, which.reshape(-1)


def by_side_and_frame(sides: IntArray, frames: IntArray) -> tuple[IntArray, IntArray]:
    """Sides in single frames: (k,) a match of each, (m,) the number of each match's."""
    names, number = np.unique(sides, return_inverse=True)
    frame = np.unique(frames, return_inverse=True)[1].reshape(-1)
    key = frame * len(names) + number.reshape(-1)
    _, first, which = np.unique(key, return_index=True, return_inverse=True)
    return first, which.reshape(-1)


def fit_error_model(residuals: SideResiduals) -> ErrorModel:
    """The three variances by moments of weighted means, each with a floor."""
    means, weights, weights2 = residuals.means, residuals.weights, residuals.weights2
    names, sides = np.unique(residuals.sides, return_inverse=True)
    sides = sides.reshape(-1)
    freedom = float((weights - weights2 / np.maximum(weights, 1e-12)).sum())
    match = max(_LEAST_MATCH, float(residuals.within.sum()) / max(freedom, 1e-9))
    # A frame's mean varies by match / effective count, plus side_frame, around its side's mean.
    count = weights**2 / np.maximum(weights2, 1e-12)
    side_frame = spread_beyond(means, match / count, sides)
    v = 1.0 / (match / count + side_frame)
    side_means, total, _ = _means(means, v, sides)
    side = spread_beyond(side_means, 1.0 / total, np.zeros(len(names), dtype=np.intp), centre=0.0)
    side /= freedom_of_sides(len(names), len(np.unique(names // SIDES)))
    return with_floors(side, side_frame, match)


def with_floors(side: float, side_frame: float, match: float) -> ErrorModel:
    """The error model with each variance at its least or above."""
    return ErrorModel(max(side, _SIDE * match), max(side_frame, _SIDE_FRAME * match), match)


def freedom_of_sides(sides: int, objects: int) -> float:
    """Share of the variance of sides that is left in their residuals.

    The pose and a mask bias of each object are fitted to the same sides and absorb the rest.
    """
    return max((sides - objects - 6) / max(sides, 1), _LEAST_FREEDOM)


def spread_beyond(
    means: FloatArray, variances: FloatArray, groups: IntArray, centre: float | None = None
) -> float:
    """Variance of ``means`` around their group's mean beyond what their own variances explain."""
    v = 1.0 / np.maximum(variances, 1e-9)
    group_mean, group_v, group_v2 = _means(means, v, groups)
    middle = group_mean[groups] if centre is None else np.full(len(means), centre)
    spread = float((v * (means - middle) ** 2).sum())
    lost = float(np.count_nonzero(group_v > 0)) if centre is None else 0.0
    c = float(v.sum() - (group_v2 / np.maximum(group_v, 1e-12)).sum()) if centre is None else float(v.sum())
    return max(0.0, (spread - (len(means) - lost)) / c) if c > 1e-9 else 0.0


def _means(values: FloatArray, w: FloatArray, groups: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Weighted mean, sum of weights and of squared weights of each group."""
    total = np.bincount(groups, w)
    mean = np.bincount(groups, w * values) / np.maximum(total, 1e-12)
    return mean, np.asarray(total, np.float64), np.asarray(np.bincount(groups, w * w), np.float64)

"""Jackknife over objects: the spread of the estimate over samples of objects.

Some objects have errors that the error model of all does not describe: two that were merged, one half hidden.
The estimate without each of them is computed. Where they are few, or few have most of the weight, the
jackknife's part grows by the correction of a sandwich for few clusters (Cameron and Miller, A practitioner's
guide to cluster-robust inference, 2015, sec. VI). Where objects disagree by more than the error model allows,
the model's part grows by as much.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sst_graph.graph.linear import unit_scale, with_ridge
from sst_graph.types import FloatArray


@dataclass(frozen=True)
class ObjectSpread:
    """The spread of the estimate over samples of objects.

    Attributes:
        jackknife: (n, n) covariance from leaving out one object after the other.
        number: how many objects of equal weight would weigh as unevenly as these: (sum w)^2 / sum w^2.
    """

    jackknife: FloatArray
    number: float

    @classmethod
    def of(cls, steps: FloatArray, weights: FloatArray) -> ObjectSpread:
        """From the steps (k, n) of the estimate without each of k objects, and their weights (k,)."""
        return cls.from_sums(steps.T @ steps, len(steps), float(weights.sum()), float(weights @ weights))

    @classmethod
    def from_sums(cls, squares: FloatArray, count: int, weight: float, weight2: float) -> ObjectSpread:
        """From sums over ``count`` objects: squared steps (n, n), weights and squared weights."""
        return cls((count - 1) / max(count, 1) * squares, max(weight**2 / max(weight2, 1e-12), 1.0))

    @property
    def correction(self) -> float:
        """G / (G - 1), the usual correction of a covariance by G clusters, and bounded."""
        return min(self.number / max(self.number - 1.0, 1e-9), _LARGEST_CORRECTION)

    def disagreement(self, covariance: FloatArray) -> float:
        """How much more the extrinsic's variances are over the objects than in a covariance, if they are.

        Birge's ratio (Physical Review 40, 1932): it is never below 1, for objects may agree by chance.
        """
        ratios = np.diag(self.jackknife)[:6] / np.diag(covariance)[:6]
        mean = float(np.exp(np.log(np.maximum(ratios, 1e-12)).mean()))
        return min(max(mean, 1.0), _LARGEST_DISAGREEMENT)

    def shares(self, covariance: FloatArray) -> tuple[float, float]:
        """Factors of a covariance (n, n) under the error model, and of the jackknife, in the estimate's."""
        # From less than two objects of like weight a jackknife cannot estimate how they vary.
        alone = self.correction / _OF_TWO
        model = _MODEL_SHARE * max(self.disagreement(covariance), alone)
        return model, _OBJECT_SHARE * self.correction


def composed(
    covariance: FloatArray, spread: ObjectSpread | None, weight_curvature_ratio: float
) -> FloatArray:
    """(n, n) covariance of an estimate.

    Args:
        covariance: under the error model.
        spread: over objects, where it is known.
        weight_curvature_ratio: mean robust weight over mean curvature.
    """
    if spread is not None:
        model, objects = spread.shares(covariance)
        covariance = model * covariance + objects * spread.jackknife
    return np.asarray(covariance * bounded_ratio(weight_curvature_ratio) ** 2)


def curvature_ratio(weight: float, curvature: float) -> float:
    """Sum of robust weights over that of the loss's second derivatives: 1 for least squares, inf where the
    second sum is not positive."""
    return weight / curvature if curvature > 0.0 else np.inf


def bounded_ratio(weight_curvature_ratio: float) -> float:
    """Mean robust weight over mean curvature, from 1 to the largest that is used."""
    return min(max(weight_curvature_ratio, 1.0), _LARGEST_RATIO)


_MODEL_SHARE, _OBJECT_SHARE = 0.33, 0.145
"""Parts of the covariance under the error model, and of the jackknife over objects, in the estimate's: set on
simulated drives so that the normalised error squared is neither too large on drives with few or moving
vehicles, where the model alone is too sure, nor too small on the others. That the correction for few objects
is applied to the jackknife alone was chosen by likelihood on the same drives."""
_OF_TWO = 2.0
"""The correction for two objects."""
_LARGEST_CORRECTION = 10.0
"""Largest correction for few objects."""
_LARGEST_DISAGREEMENT = 10.0
"""Largest disagreement among objects that is used."""
_LEFT_OUT = 0.98
"""Largest share of the information on a direction that is left out: at given twists an object's matches may
have more information on a direction than all matches together, whose twists are unknown."""
_LARGEST_RATIO = 3.0
"""Largest ratio of the mean robust weight to the mean curvature that is used."""


def steps_without(
    information: FloatArray, score: FloatArray, columns: NDArray[np.intp], covariance: FloatArray
) -> FloatArray:
    """(k, n) how far a linearized estimate moves without each of k objects.

    An object's matches have few columns c of the n. With p their information, s their score and P the
    covariance of the estimate if all matches are independent, P_cc = C C', the step is P_:c C^-T f(C'pC) C's
    with f(x) = 1 / (1 - x) on the eigenvalues (:func:`growth_without`): that of the normal equations without
    the object.

    Args:
        information, score: (k, m, m), (k, m) J^T J and J^T r of each object's matches.
        columns: (k, m) that these are in.
        covariance: (n, n) inverse of all information.
    """
    scale = unit_scale(covariance)
    unit = covariance * np.outer(scale, scale)
    C = np.linalg.cholesky(with_ridge(unit[columns[:, :, None], columns[:, None, :]]))
    Ct, own = np.swapaxes(C, 1, 2), scale[columns]
    shares, axes = np.linalg.eigh(Ct @ (information / (own[:, :, None] * own[:, None, :])) @ C)
    along = np.swapaxes(axes, 1, 2) @ (Ct @ (score / own)[:, :, None])
    moved = np.linalg.solve(Ct, axes @ (growth_without(shares)[:, :, None] * along))
    return np.asarray((np.swapaxes(moved, 1, 2) @ unit[columns])[:, 0, :] / scale)


def growth_without(shares: FloatArray) -> FloatArray:
    """How much variances grow along directions of which these shares of the information are left out."""
    return np.asarray(1.0 / (1.0 - np.minimum(shares, _LEFT_OUT)))

"""How an answer varies with the objects that happen to be there, and the covariance made of that.

Some objects err as no model of the others says. The answer without each of them is computed (a jackknife over
objects), and where they are few, or few of them weigh, this part grows by the correction of a sandwich
for few clusters (Cameron and Miller, A practitioner's guide to cluster-robust inference, 2015, sec. VI).
Where objects disagree by more than the error model allows, its part grows by as much.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class ObjectSpread:
    """How the answer varies with the objects that happen to be there.

    Attributes:
        jackknife: (n, n) covariance from leaving out one object after the other.
        number: how many objects of equal weight would weigh as unevenly as these: (sum w)^2 / sum w^2.
    """

    jackknife: FloatArray
    number: float

    @classmethod
    def of(cls, steps: FloatArray, weights: FloatArray) -> ObjectSpread:
        """From the steps (k, n) of the answer without each of k objects, and their weights (k,)."""
        return cls.from_sums(steps.T @ steps, len(steps), float(weights.sum()), float(weights @ weights))

    @classmethod
    def from_sums(cls, squares: FloatArray, count: int, weight: float, weight2: float) -> ObjectSpread:
        """From sums over ``count`` objects: squared steps (n, n), weights and squared weights."""
        return cls((count - 1) / max(count, 1) * squares, max(weight**2 / max(weight2, 1e-12), 1.0))

    @property
    def correction(self) -> float:
        """G / (G - 1), the usual correction of a covariance by G clusters; with one, nothing tells it."""
        return min(self.number / max(self.number - 1.0, 1e-9), _FEWEST)

    def disagreement(self, covariance: FloatArray) -> float:
        """How much more the extrinsic's variances are over the objects than in a covariance, if they are.

        Birge's ratio (Physical Review 40, 1932): it is never below 1, for objects may agree by chance.
        """
        ratios = np.diag(self.jackknife)[:6] / np.diag(covariance)[:6]
        mean = float(np.exp(np.log(np.maximum(ratios, 1e-12)).mean()))
        return min(max(mean, 1.0), _FARTHEST_APART)


def composed(covariance: FloatArray, spread: ObjectSpread | None, flatness: float) -> FloatArray:
    """(n, n) covariance of an answer.

    Args:
        covariance: under the error model.
        spread: over objects, where it is known.
        flatness: mean robust weight over mean curvature.
    """
    if spread is not None:
        # With less than two objects of like weight no jackknife tells how they vary.
        alone = spread.correction / _OF_TWO
        model = _MODEL_SHARE * max(spread.disagreement(covariance), alone) * covariance
        covariance = model + _OBJECT_SHARE * spread.correction * spread.jackknife
    return np.asarray(covariance * bounded_ratio(flatness) ** 2)


def bounded_ratio(flatness: float) -> float:
    """Mean robust weight over mean curvature, within what is believed of it."""
    return min(max(flatness, 1.0), _FLATTEST)


_MODEL_SHARE, _OBJECT_SHARE = 0.33, 0.145
"""Parts of the covariance under the error model, and of the jackknife over objects, in the answer's: set on
simulated drives so that the normalised error squared is neither too large on drives with few or moving
vehicles, where the model alone is too sure, nor too small on the others. That the correction for few objects
belongs to the jackknife alone is the likelihood's choice there, too."""
_OF_TWO = 2.0
"""The correction for two objects."""
_FEWEST = 10.0
"""Largest correction for few objects."""
_FARTHEST_APART = 10.0
"""Largest disagreement among objects that is believed."""
_LEFT_OUT = 0.98
"""Largest part of what is known of a direction that is left out. Matches whose twists are given may seem to
tell a direction better than all matches together do, whose twists are not."""
_FLATTEST = 3.0
"""Largest ratio of the mean robust weight to the mean curvature that is believed."""


def step_without(root: FloatArray, information: FloatArray, score: FloatArray) -> FloatArray:
    """(n,) how far an estimate moves without some matches.

    Args:
        root: (n, n) Cholesky factor of the inverse of all information.
        information, score: (n, n), (n,) J^T J and J^T r of these matches.
    """
    shares, axes = np.linalg.eigh(root.T @ information @ root)
    return np.asarray(root @ (axes @ (growth_without(shares) * (axes.T @ (root.T @ score)))))


def growth_without(shares: FloatArray) -> FloatArray:
    """How much variances grow along directions of which these shares of the information are left out."""
    return np.asarray(1.0 / (1.0 - np.minimum(shares, _LEFT_OUT)))

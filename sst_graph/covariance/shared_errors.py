"""Errors that several estimates have in common, such as those of cameras on one LiDAR, as steps of each."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sst_graph.types import FloatArray

FEWEST = 12
"""Fewest half-samples from which a spread is computed."""


@dataclass(frozen=True)
class SharedErrors:
    """How an estimate of extrinsic and time offset moves by errors that other cameras have, too.

    Attributes:
        samples: (k, 7) steps to the estimates of half-samples of the objects, which are the same for all
            cameras of a LiDAR; NaN where a half-sample has none [rad, m, s].
        common: (7,) step by one deviation of each error of the LiDAR, by its name.
    """

    samples: FloatArray
    common: Mapping[str, FloatArray]

    @property
    def estimated(self) -> int:
        """Half-samples that have an estimate."""
        return int(with_estimate(self.samples).sum())

    def cross_covariance(self, other: SharedErrors) -> FloatArray:
        """(7, 7) covariance with another camera's estimate."""
        return spread_covariance(self.samples, other.samples) + by_common_errors(self.common, other.common)


def by_common_errors(steps: Mapping[str, FloatArray], others: Mapping[str, FloatArray]) -> FloatArray:
    """(7, 7) covariance of two estimates by the errors that both have.

    Args:
        steps, others: (7,) of each estimate by one deviation of each error, by its name.
    """
    cross = np.zeros((7, 7))
    for name, step in steps.items():  # a set's order of texts would differ from run to run
        if name in others:
            cross += np.outer(step, others[name])
    return cross


def with_estimate(steps: FloatArray) -> NDArray[np.bool_]:
    """(k,) which half-samples have an estimate, from their steps (k, n)."""
    return np.asarray(np.isfinite(steps).all(axis=1))


def spread_covariance(steps: FloatArray, others: FloatArray | None = None) -> FloatArray:
    """(n, n) covariance by the steps (k, n) of half-samples; 0 of fewer than :data:`FEWEST`.

    Deviations are those from the estimate, not from the half-samples' mean (McCarthy, Pseudo-replication:
    half samples, 1969): where all of them lie to one side of it, they have met other edges, or it has not
    converged.

    The inverse of a sample covariance is too large on average: by k / (k - 1 - n), of k samples in n
    dimensions about a given mean (Hartlap, Simon and Schneider, Astronomy & Astrophysics 464, 2007). With
    that factor the mean of the NEES is right.

    Args:
        others: (k, n) steps of another camera's estimate by the same half-samples: the covariance of the two.
    """
    others = steps if others is None else others
    known = with_estimate(steps) & with_estimate(others)
    k, size = int(known.sum()), steps.shape[1]
    if k < FEWEST:
        return np.zeros((size, size))
    return np.asarray(steps[known].T @ others[known] / (k - 1 - size))

"""The covariance by static objects alone.

An oncoming vehicle whose velocity is known may separate the time offset from the translation where static
objects do not: on a straight road at one speed. Its velocity was itself estimated, so a direction that only
such matches determine does not count as observable.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sst_graph.covariance.cluster_robust import RobustCovariance, covariance_of
from sst_graph.covariance.sums import gram
from sst_graph.graph.matching import PairMatches
from sst_graph.types import FloatArray

_ALL = 1.0 - 1e-6
"""Largest share of the information on a direction that is taken away."""


def static_covariance(robust: RobustCovariance, pairs: Sequence[PairMatches]) -> FloatArray:
    """(n, n) covariance of the unknowns without the matches of dynamic objects with a known velocity.

    Args:
        robust: with all of them.
        pairs: its matches.
    """
    dynamic = np.concatenate([dynamic_matches(pair) for pair in pairs])
    if not dynamic.any():
        return robust.matrix
    if dynamic.all():
        return np.asarray(robust.matrix / (1.0 - _ALL))
    J = robust.table.J[np.flatnonzero(dynamic)]
    root = np.asarray(np.linalg.cholesky(robust.bread), np.float64)
    shares, axes = np.linalg.eigh(root.T @ gram(J) @ root)
    wider = root @ (axes / np.sqrt(1.0 - np.minimum(shares, _ALL)))
    table = robust.table.take(np.flatnonzero(~dynamic))
    return covariance_of(wider @ wider.T, table, robust.model, known=robust.known)


def dynamic_matches(pair: PairMatches) -> NDArray[np.bool_]:
    """(m,) whether the object of each match is dynamic with a known velocity, class by class."""
    found = []
    for matches in pair.matches.values():
        velocities = matches.alignment.l_velocities
        none = np.zeros(len(matches), np.bool_)
        found.append(none if velocities is None else np.asarray(velocities.any(axis=1), np.bool_))
    return np.concatenate(found)

"""Where edges lie between two beams, as parameters that are considered.

An edge lies anywhere between the last beam that hits an object and the next one. Matches take each of these
positions for independent of the others. What draws them the same way on all objects (a surface that curves
away, an edge inside of the outline) is left in the estimate, and no choice of objects shows it. So the whole
deviation of these positions is considered once more as common to all upper edges, and to all edges at the
sides: Schmidt's considered parameters, as those of :mod:`sst_graph.covariance.considered`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sst_graph.association.edge_matching import TOP, MatchConfig, sampling_sigmas
from sst_graph.batch.problem import JointEstimate
from sst_graph.covariance.considered import Considered, steps_by, weighted_columns
from sst_graph.types import FloatArray

POSITIONS = ("upward", "to_the_right", "outward")
"""All upper edges lie higher, all at the sides farther to the right, or farther out. One unit is the
deviation of a match by the spacing of its beams."""
_LEFT, _RIGHT = 0, 1
"""Sides, as matches number them."""


def considered_positions(estimate: JointEstimate, config: MatchConfig) -> Considered:
    """What common positions between the beams add to the covariance of an estimate by edges."""
    robust, pairs = estimate.robust, estimate.solution.pairs
    blocks = [
        position_columns(matches.sides, matches.alignment.sigmas_px, config)
        for pair in pairs
        for matches in pair.matches.values()
    ]
    columns = weighted_columns(robust.table, pairs, np.concatenate(blocks))
    steps = steps_by(POSITIONS, robust.bread, robust.table.J.T @ columns, 7)
    return Considered(steps, dict.fromkeys(POSITIONS, 1.0))


def position_columns(sides: NDArray[np.intp], sigmas_px: FloatArray, config: MatchConfig) -> FloatArray:
    """(n, 3) derivatives of the residuals of matches by :data:`POSITIONS` [px].

    Args:
        sides: (n,) of each match.
        sigmas_px: (n,) its deviation.
    """
    step = sampling_sigmas(sigmas_px, config)
    to_the_right = np.where(sides == _RIGHT, 1.0, np.where(sides == _LEFT, -1.0, 0.0))
    factors = np.stack([sides == TOP, to_the_right, np.abs(to_the_right)], axis=1)
    return np.asarray(step[:, None] * factors)

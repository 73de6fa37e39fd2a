"""Covariance of an estimate by edges: that of the matches, and what parts of the data disagree by.

Edges err together, where the matches do not show it: all top edges are seen a little low, all edges on one
side of the street face away from the sun. So the matches are split in two, in several ways, and the estimate
is linearized without each half in turn. Half of the difference between two halves is what the whole may be
wrong by; its square, summed over the ways, is added to the cluster-robust covariance.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sst_graph.association.edge_matching import SIDES
from sst_graph.batch.problem import JointEstimate
from sst_graph.covariance.jackknife import steps_without
from sst_graph.covariance.match_table import MatchTable
from sst_graph.graph.building import PairMatches

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

FLOOR = np.array([*np.radians([0.11] * 3), 0.025, 0.025, 0.025, 0.004])
"""(7,) sigmas that are added [rad, m, s]. The halves share what all edges have in common, and a soft match
follows the pose a little, so that their differences come out too small: on three simulated streets and two
real drives the errors were three to ten times the spread. These are about the root mean squares of those
errors."""


def edges_covariance(estimate: JointEstimate) -> tuple[FloatArray, dict[str, Any]]:
    """(7, 7) covariance of extrinsic and time offset, and the sigmas of its parts, JSON-able."""
    table = estimate.robust.table
    covariance = estimate.covariance[:7, :7] + np.diag(FLOOR**2)
    parts: dict[str, Any] = {"matches": _sigmas(estimate.covariance[:7, :7])}
    for name, half in _halves(estimate.solution.pairs, table).items():
        steps = [_step_without(table, estimate.robust.bread, side) for side in (half, ~half)]
        spread = 0.25 * np.outer(steps[0] - steps[1], steps[0] - steps[1])
        covariance = covariance + spread
        parts[name] = _sigmas(spread)
    return covariance, parts


def _halves(pairs: Sequence[PairMatches], table: MatchTable) -> dict[str, BoolArray]:
    """(m,) which half each match is in, by name of the split."""
    alignments = [matches.alignment for pair in pairs for matches in pair.matches.values()]
    column = np.concatenate([alignment.pixels[:, 0] for alignment in alignments])
    distance = np.concatenate([np.linalg.norm(alignment.lPs, axis=1) for alignment in alignments])
    weights = table.root_weights**2
    splits = {
        "time": table.frames < _middle(table.frames.astype(np.float64), weights),
        "left and right": column < _middle(column, weights),
        "near and far": distance < _middle(distance, weights),
        "sides and tops": table.sides % SIDES < _TOP,
    }
    return {name: half for name, half in splits.items() if half.any() and not half.all()}


_TOP = 2
"""Number of an object's top side; smaller ones are left and right."""


def _middle(values: FloatArray, weights: FloatArray) -> float:
    """Weighted median."""
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(total, 0.5 * total[-1])])


def _step_without(table: MatchTable, bread: FloatArray, left_out: BoolArray) -> FloatArray:
    """(7,) how far the linearized estimate moves without some of the matches."""
    J, r = table.J[left_out], (table.root_weights * table.r)[left_out]
    columns = np.unique(J.indices)
    own = J[:, columns].toarray()
    information, score = own.T @ own, own.T @ r
    return steps_without(information[None], score[None], columns[None], bread)[0, :7]


def _sigmas(covariance: FloatArray) -> list[float]:
    return [float(value) for value in np.sqrt(np.diag(covariance))]

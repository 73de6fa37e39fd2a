"""What the sums of the matches hold beside the unknowns: parameters of assumptions, and errors that all edges
share.

Edges err together in ways that no choice of them shows (:mod:`sst_graph.batch.by_edges.covariance`): where
they lie between the beams, in units of its deviation, and shifts of the calibration as they see it. Each is a
parameter held at 0. What it does to the estimate follows the share that edges have in it: none where labels
decide.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from sst_graph.association.edge_matching import MatchConfig, SilhouetteMatches
from sst_graph.assumptions import held_at_zero
from sst_graph.batch.by_edges.positions import POSITIONS, position_columns
from sst_graph.types import FloatArray, SemanticClass

SHIFTS = tuple(f"edges_shift_{axis}" for axis in range(7))
"""Shifts of extrinsic and time offset as all edges see them [rad, m, s]."""
EDGE_ERRORS = (*POSITIONS, *SHIFTS)
"""Errors that all edges share."""


def held_names(estimate: Sequence[str], classes: Collection[SemanticClass]) -> tuple[str, ...]:
    """What is held at 0: the assumptions that are not estimated; then, where edges are aligned, their errors.

    Args:
        estimate: assumptions whose parameters are variables.
    """
    return held_at_zero(estimate) + (EDGE_ERRORS if SemanticClass.OBJECT in classes else ())


def edge_error_columns(J: FloatArray, matches: SilhouetteMatches, config: MatchConfig) -> FloatArray:
    """(m, k) derivatives of weighted residuals of edges by :data:`EDGE_ERRORS`.

    Args:
        J: (m, 14) of the weighted residuals by [rot, trans, offset, twist, bias].
    """
    beams = position_columns(matches.sides, matches.alignment.sigmas_px, config)
    return np.column_stack([beams * J[:, 13:14], J[:, :7]])

"""Whether a start is inverted, LiDAR and camera exchanged: edges that agree around its inverse say so."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import gtsam

from sst_graph.batch.by_edges.optimum import candidate_steps
from sst_graph.batch.by_edges.problem import LabelEstimate, edges_problem
from sst_graph.batch.by_edges.reasons import contrast_reasons, edge_contrast_steps
from sst_graph.batch.config import CalibrationConfig
from sst_graph.batch.problem import CalibrationProblem
from sst_graph.diagnosis import INVERTED, Finding
from sst_graph.drive.preparation import Drive
from sst_graph.errors import EstimationError
from sst_graph.stepwise import run_to_end
from sst_graph.types import Guess

_UPRIGHT = 0.7
"""Cosine between the LiDAR's and the camera's up from which a rig is upright: an inverted one lies on its
side, and around the inverse of any other nothing is searched."""


def inverted_start(drives: Sequence[Drive], guess: Guess, config: CalibrationConfig) -> Finding | None:
    """The start, where edges of LiDAR and pictures agree around its inverse as around a right one.

    Args:
        drives: prepared with objects without a class.
        guess: under which they gave no result that is ok.
    """
    if guess.cTl is None or not drives:
        return None
    cTl = guess.cTl.inverse()
    if _upright(guess.cTl) or not _upright(cTl):
        return None
    inverse = replace(guess, cTl=cTl)
    try:
        problem = edges_problem(CalibrationProblem.of(drives, inverse, config), None, LabelEstimate())
        found = run_to_end(candidate_steps(problem))
    except EstimationError:
        return None
    best, *others = [solution.state for _, solution in found]
    contrast = run_to_end(edge_contrast_steps(problem.subset_edges, best, others, config.seed))
    if contrast_reasons(contrast):
        return None
    cause, check = INVERTED
    return Finding(
        cause,
        f"around its inverse edges of LiDAR and pictures agree better than at rotations 2 to 4 deg away, by "
        f"{contrast.sigmas:.1f} standard deviations",
        check,
    )


def _upright(cTl: gtsam.Pose3) -> bool:
    """Whether the LiDAR's z axis points up in the picture, against the camera's y axis."""
    return bool(-cTl.rotation().matrix()[1, 2] > _UPRIGHT)

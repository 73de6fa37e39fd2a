"""How an estimate by edges fits the pictures, point by point, and along each unknown: what a report draws."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sst_graph.batch.by_edges.reasons import turned_states
from sst_graph.batch.problem import CalibrationProblem
from sst_graph.fit import Fit, Profile
from sst_graph.graph.outer_loop import JointSolution
from sst_graph.quality.fit_of_solution import FitOfDrives
from sst_graph.quality.profiles import score_profiles

FloatArray = NDArray[np.float64]

_TURNED = 3
"""Random rotations under which the share of close points is measured: it differs by a percentage point among
them."""


def fit_of_edges(
    calibration: CalibrationProblem, solutions: Sequence[JointSolution], covariance: FloatArray
) -> Fit | None:
    """How the last of the solutions, each of which led to the next, fits the pictures.

    Args:
        covariance: (7, 7) of the result.
    """
    solution = solutions[-1]
    state, problem = solution.state, solution.problem
    iterations = [each for one in solutions for each in one.iterations]
    drives = FitOfDrives(problem.drives, problem.tracks, calibration.objects, problem.config.graph)
    profiles: Sequence[Profile] = ()
    if calibration.config.profiles:
        frozen = solution.frozen.linearized(solution.optimum).covariance()[:7, :7]
        profiles = score_profiles(drives.edges, state, frozen, np.sqrt(np.diag(covariance)))
    others = turned_states(state, calibration.config.seed)[:_TURNED]
    return drives.fit(state, calibration.at_guess(state), iterations, profiles, others)

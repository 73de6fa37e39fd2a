"""How an estimate fits the pictures, point by point, and along each unknown: what a report draws."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sst_graph.batch.problem import CalibrationProblem
from sst_graph.fit import Fit, Profile
from sst_graph.graph.outer_loop import JointSolution
from sst_graph.quality.profiles import score_profiles

FloatArray = NDArray[np.float64]


def fit_of_edges(
    calibration: CalibrationProblem, solutions: Sequence[JointSolution], covariance: FloatArray
) -> Fit | None:
    """How the last of the solutions, each of which led to the next, fits the pictures.

    Args:
        calibration: with the points that the last solution matched.
        covariance: (7, 7) of the result.
    """
    solution = solutions[-1]
    iterations = [each for one in solutions for each in one.iterations]
    profiles: Sequence[Profile] = ()
    if calibration.config.for_report:
        edges = calibration.fit_of_drives.edges
        frozen = solution.frozen.linearized(solution.optimum).covariance()[:7, :7]
        profiles = score_profiles(edges, solution.state, frozen, np.sqrt(np.diag(covariance)))
    return calibration.fit_at(solution.state, iterations, profiles)

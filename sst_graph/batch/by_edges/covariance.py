"""Covariance of an estimate by edges: that of the matches, of the choice of objects, and a floor.

A match with the picture's edge is soft: it follows the pose, and which edge is met is part of the estimate.
With the matches frozen a problem seems three to ten times stiffer than it is. So the problem is solved again,
and matched again, with half of the objects, in eight balanced ways (McCarthy, Pseudo-replication: half
samples, Review of the International Statistical Institute, 1969): the deviation of such an estimate has the
covariance of the whole one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import hadamard

from sst_graph.batch.by_edges.parts import thinned, with_objects
from sst_graph.batch.problem import JointEstimate
from sst_graph.errors import EstimationError
from sst_graph.graph.outer_loop import JointProblem, solve_joint
from sst_graph.hand_eye.solution import difference
from sst_graph.objects.tracks import ObjectId

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

FLOOR = np.array([*np.radians([0.06] * 3), 0.01, 0.01, 0.01, 0.004])
"""(7,) sigmas that are added [rad, m, s], for what all objects have in common and no choice of them shows:
edges inside an object draw its outline inwards, its top down, and pitch and height with it. That of the time
offset is for the 7 and 10 ms that two real drives are off, under a sigma of 2.6 and 4.5 ms with 2 ms here."""
SAMPLES = 8
"""Half-samples: the order of a Hadamard matrix."""
_PAIRS = SAMPLES - 1
"""Pairs of groups of objects, of which each half-sample has one group: each column but the constant one."""
_KERNELS_PX = (3.0, 2.0, 2.0, 1.5, 1.2)
"""Scales of the kernel from the estimate [px]: wide enough to meet other edges, too narrow to leave it."""
_POINTS_A_SCAN = 500
"""Most boundary points of a scan before half of the objects are taken: each edge keeps some."""
_STEP_SIGMAS = 0.5
"""A step shorter than this many standard deviations of the frozen problem ends a half-sample's outer loop:
they are a tenth of its own."""
FEWEST = 4
"""Fewest half-samples that a spread is believed of."""
FEW_OBJECTS = (
    "half of the objects has too few edges in view to calibrate with: how far the estimate may be off "
    "cannot be told; record a richer scene"
)


def edges_covariance(
    problem: JointProblem, estimate: JointEstimate, objects: Sequence[Mapping[ObjectId, int]]
) -> tuple[FloatArray, dict[str, Any], tuple[str, ...]]:
    """(7, 7) covariance of extrinsic and time offset; sigmas of its parts, JSON-able; reasons to doubt it.

    Args:
        problem: that was solved.
        objects: tracks of each drive's objects.
    """
    steps = _half_sample_steps(problem, estimate, objects)
    parts = {
        "matches": estimate.covariance[:7, :7],
        "objects": np.cov(steps.T) if len(steps) >= FEWEST else np.zeros((7, 7)),
        "floor": np.diag(FLOOR**2),
    }
    total = np.asarray(sum(parts.values()), np.float64)
    sigmas = {name: np.sqrt(np.diag(part)).tolist() for name, part in parts.items()}
    return total, sigmas | {"samples": len(steps)}, () if len(steps) >= FEWEST else (FEW_OBJECTS,)


def half_samples() -> BoolArray:
    """(SAMPLES, 2 _PAIRS) which groups of objects each half-sample has: one of each pair, all pairs of groups
    equally often together."""
    first = hadamard(SAMPLES)[:, 1:] > 0
    return np.stack([first, ~first], axis=2).reshape(SAMPLES, -1)


def _half_sample_steps(
    problem: JointProblem, estimate: JointEstimate, objects: Sequence[Mapping[ObjectId, int]]
) -> FloatArray:
    """(k, 7) steps from the estimate to those of the half-samples that have enough matches."""
    start, steps = estimate.solution.state, []
    some = [thinned(drive, _POINTS_A_SCAN) for drive in problem.drives]
    for kept in half_samples():
        drives = [with_objects(*each, kept) for each in zip(some, objects, strict=True)]
        try:
            part = solve_joint(replace(problem, drives=drives), start, _KERNELS_PX, None, _STEP_SIGMAS)
        except EstimationError:
            continue
        steps.append(difference(start, part.state))
    return np.array(steps).reshape(-1, 7)

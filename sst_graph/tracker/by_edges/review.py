"""Whether an estimate by edges may be wrong altogether, and by how much it may be off, from some scans.

These are the batch's own: the score of the estimate must stand out from those of random rotations around it
(:mod:`sst_graph.batch.by_edges.reasons`); the scans are solved again with half of their objects, with edges
farther away, and without upper edges that may be no outline (:mod:`sst_graph.batch.by_edges.covariance`).
The lens is not tested (:mod:`sst_graph.batch.by_edges.lens`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sst_graph.batch.by_edges.covariance import few_edges, half_sample_steps, outline_steps
from sst_graph.batch.by_edges.reasons import contrast_reasons, edge_contrast_steps, wider_kernel_reasons
from sst_graph.batch.by_edges.solution import WIDER_KERNEL_PX, solution_steps
from sst_graph.covariance.shared_errors import spread_covariance
from sst_graph.graph.matching import edges_of
from sst_graph.graph.outer_loop import JointProblem
from sst_graph.graph.state import State, difference
from sst_graph.objects.tracks import ObjectId
from sst_graph.sampling import evenly_spread
from sst_graph.stepwise import Stepwise

FloatArray = NDArray[np.float64]

_SCANS = 12
"""Scans that scores are compared on."""


@dataclass(frozen=True)
class EdgeReview:
    """What a review has found.

    Attributes:
        reasons: why the estimate may be wrong altogether; none where nothing says so.
        spread: (7, 7) covariance of an estimate from these scans by what differs from object to object.
        farther: (7, 7) covariance by edges farther away, and by upper edges that may be no outline.
    """

    reasons: tuple[str, ...] = ()
    spread: FloatArray = field(default_factory=lambda: np.zeros((7, 7)))
    farther: FloatArray = field(default_factory=lambda: np.zeros((7, 7)))


def review_steps(
    problem: JointProblem, state: State, objects: Mapping[ObjectId, int], seed: int
) -> Stepwise[EdgeReview]:
    """The review of an estimate, step by step.

    Args:
        problem: of one drive.
        objects: tracks of its objects.
        seed: of the random rotations.

    Raises:
        EstimationError: too few matches.
    """
    drive = problem.drives[0]
    few = evenly_spread(range(len(drive.scans)), _SCANS)
    edges = edges_of([drive.part(few)], problem.tracks.part(0, few), problem.config.graph)
    contrast = yield from edge_contrast_steps(edges, state, [], seed)
    wider = yield from solution_steps(problem, state, WIDER_KERNEL_PX)
    step = difference(state, wider.state)
    halves, _ = yield from half_sample_steps(problem, state, [dict(objects)])
    outlines = yield from outline_steps(problem, state)
    farther = np.outer(step, step) + (0.0 if outlines is None else np.outer(outlines, outlines))
    reasons = (*contrast_reasons(contrast), *wider_kernel_reasons(step), *few_edges(halves, outlines))
    return EdgeReview(reasons, spread_covariance(halves), np.asarray(farther))


def variance_ratio(review: EdgeReview, covariance: FloatArray) -> float:
    """How many times the variance of an estimate by edges is that by frozen matches, on average; 1 without
    edges.

    Args:
        covariance: (m, m) by frozen matches, extrinsic and time offset first.
    """
    if not review.spread.any():
        return 1.0
    return 1.0 + float(np.trace(np.linalg.solve(covariance[:7, :7], review.spread))) / 7.0

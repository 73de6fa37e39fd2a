"""Whether the two halves of a drive agree: each searched and solved by itself by edges, around the estimate.

The stretches of labels (:mod:`sst_graph.batch.contradictions`) are compared by covariances of frozen matches,
which say too little of soft ones; that of the whole estimate, by half-samples of its objects, is used here. A
half of the scans is known with twice that variance at most, for what all objects have in common does not
differ between halves.

What is known of the time offset beside the edges is of the whole drive. Where an image was lost or came late
in the middle, that holds for one half only, so each half is also solved with it moved by a period of the
images.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sst_graph.batch.by_edges.covariance import SAMPLES
from sst_graph.batch.by_edges.optimum import NEAR_KERNELS_PX, SCORE_PX, START_KERNELS_PX
from sst_graph.batch.by_edges.parts import thinned
from sst_graph.batch.by_edges.problem import POINTS_A_SCAN
from sst_graph.batch.by_edges.reasons import MIN_OVER_OTHER
from sst_graph.batch.contradictions import FALSE_ALARM, advice
from sst_graph.covariance.contradiction import Difference, PartEstimate, name_step
from sst_graph.edges.agreement import score
from sst_graph.edges.search import SearchRegion, edge_starts_steps
from sst_graph.errors import EstimationError
from sst_graph.graph.matching import edges_of
from sst_graph.graph.outer_loop import JointProblem, solve_joint
from sst_graph.graph.state import State, difference
from sst_graph.sampling import evenly_spread
from sst_graph.stepwise import run_to_end
from sst_graph.types import FloatArray

_LEAST_SCANS = 8
"""Fewest scans of a half."""
_SEARCHED_SCANS = 12
"""Scans of a half on which starts are compared."""
_HALF_DEG = 5.0
"""A half's own pose is searched within this of the estimate, about each of the camera's axes [deg]."""
_LATE_IMAGES = (-1, 1)
"""Periods of the images by which the time offset of a half may differ. Without them, images that are late by
one in half of a drive give a half that is turned by degrees, or no contradiction at all."""
_KERNELS_PX = (*START_KERNELS_PX, 2.0, 1.5, 1.2)
"""Scales of the kernel of a half's solution [px]: from a start that is a degree off."""


def halves_reasons(problem: JointProblem, state: State, covariance: FloatArray) -> tuple[str, ...]:
    """A sentence for every drive whose halves contradict each other.

    Args:
        problem: with all boundary points.
        state: estimate of all drives together.
        covariance: (7, 7) of it.
    """
    reasons = []
    for number, drive in enumerate(problem.drives):
        halves = [half.tolist() for half in np.array_split(np.arange(len(drive.scans)), 2)]
        parts = [_half(problem, number, half, state, covariance) for half in halves]
        first, second = parts
        if first is None or second is None:
            continue
        found = Difference.of(first, second)
        if found.p_value * len(problem.drives) < FALSE_ALARM:
            at = drive.scans[halves[1][0]].index
            named = name_step(found, state.cTl)
            reasons.append(
                f"{drive.name}: frames {drive.scans[0].index} to {drive.scans[halves[0][-1]].index} and "
                f"those from {at} on contradict each other: the later ones differ in {named.sentence}; "
                f"{advice(named.possible_kinds, by_labels=False)}"
            )
    return tuple(reasons)


def _half(
    problem: JointProblem, number: int, scans: list[int], state: State, covariance: FloatArray
) -> PartEstimate | None:
    """A half's own estimate, as a step from that of the whole; None where it has none."""
    if len(scans) < _LEAST_SCANS:
        return None
    drive = thinned(problem.drives[number].part(scans), POINTS_A_SCAN)
    motion = problem.motions[number].part(scans)
    few = evenly_spread(range(len(scans)), _SEARCHED_SCANS)
    some = replace(problem, drives=[drive.part(few)], motions=[motion.part(few)])
    edges = edges_of(some.drives, some.motions, problem.config.graph)
    if not edges:
        return None
    # 1. Every start on a few scans.
    region = SearchRegion(state.cTl, state.time_offsets_s[:1], (_HALF_DEG,) * 3)
    searched = run_to_end(edge_starts_steps(edges[0], region))
    trials = [(0.0, state), *((0.0, replace(state, cTl=start.cTl)) for start in searched)]
    late_s = [images * drive.image_period_s for images in _LATE_IMAGES]
    trials += [(shift_s, state.later(shift_s)) for shift_s in late_s]
    found: list[tuple[float, float, State]] = []
    for shift_s, start in trials:
        try:
            own = solve_joint(_with_later_offset(some, shift_s), start, _KERNELS_PX).state
        except EstimationError:
            continue
        # From another start a pose must agree clearly better, as between the optima of a whole drive.
        share = 1.0 if start is state else 1.0 / MIN_OVER_OTHER
        found.append((score(edges, own, SCORE_PX) * share, shift_s, own))
    if not found:
        return None
    # 2. The best of them on all.
    _, shift_s, best = max(found, key=lambda one: one[0])
    half = _with_later_offset(replace(problem, drives=[drive], motions=[motion]), shift_s)
    try:
        best = solve_joint(half, best, NEAR_KERNELS_PX).state
    except EstimationError:
        return None
    return PartEstimate(difference(state, best), 2.0 * covariance, float(SAMPLES))


def _with_later_offset(problem: JointProblem, shift_s: float) -> JointProblem:
    """The problem with all that is known of the time offset beside the edges moved."""
    centre, prior = problem.centre, problem.prior
    return replace(
        problem,
        centre=None if centre is None else centre.later(shift_s),
        prior=None if prior is None else replace(prior, state=prior.state.later(shift_s)),
    )

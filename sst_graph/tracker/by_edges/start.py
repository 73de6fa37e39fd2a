"""The tracker's first estimate without labels: the steps of the batch's method edges over some scans.

What the batch would not trust is no estimate: a later attempt has other scans.
"""

from __future__ import annotations

import numpy as np

from sst_graph.batch.by_edges.optimum import RESTARTS, best_optimum_steps, candidate_steps
from sst_graph.batch.by_edges.problem import LabelEstimate, checking_motion, edges_problem, motion_alone
from sst_graph.batch.by_edges.reasons import edge_contrast_steps, edges_reasons, pose_reasons
from sst_graph.batch.problem import CalibrationProblem
from sst_graph.errors import EstimationError
from sst_graph.stepwise import Stepwise
from sst_graph.tracker.by_edges.review import EdgeReview, review_steps
from sst_graph.tracker.config import TrackerConfig
from sst_graph.tracker.start.first_estimate import FirstEstimate, StartGuess
from sst_graph.tracker.window.gaussian import Point
from sst_graph.tracker.window.window import Stretch

_MOTION_WORK = 30
"""To find what motion says, in units of work."""
_START_SIGMAS = np.array([*np.radians([0.2] * 3), 0.03, 0.03, 0.03, 0.01])
"""(7,) deviations of a start from what motion says, beside motion's own [rad, m, s]."""


def first_edge_estimate_steps(
    stretch: Stretch, guess: StartGuess, config: TrackerConfig
) -> Stepwise[FirstEstimate]:
    """The batch solution of some scans by edges, step by step.

    Raises:
        EstimationError: no start: neither a guess nor motion, or nothing in view; or one that may be wrong.
    """
    calibration, drive = config.calibration, stretch.drive
    # 1. What motion says, before any edge is compared.
    motion = motion_alone([drive], guess, calibration, None)
    yield _MOTION_WORK
    # 2. Starts by a search, refined; the best optimum.
    whole = CalibrationProblem([drive], [stretch.motion(drive)], [dict(stretch.tracks)], guess, calibration)
    problem = edges_problem(whole, motion, LabelEstimate())
    candidates = yield from candidate_steps(problem)
    solution = yield from best_optimum_steps(problem, candidates[0][1].state, RESTARTS)
    # 3. Has it worked, and by how much may it be off?
    state = solution.state
    others = [one.state for _, one in candidates]
    contrast = yield from edge_contrast_steps(problem.subset_edges, state, others, calibration.seed)
    checking = checking_motion(motion, calibration)
    of_pose = pose_reasons(solution.state, contrast, checking, np.diag(_START_SIGMAS**2))
    reasons = edges_reasons(solution, of_pose, problem.centre)
    names = [name for name, _ in calibration.assumptions.estimated]
    point = Point.of_state(state, calibration.classes, names)
    if stretch.at_end:
        return FirstEstimate(point, problem.known, EdgeReview(reasons), reviewed=False)
    review = yield from review_steps(problem.whole, state, stretch.tracks, calibration.seed)
    if reasons := tuple(dict.fromkeys((*reasons, *review.reasons))):
        raise EstimationError("; ".join(reasons))
    return FirstEstimate(point, problem.known, review)

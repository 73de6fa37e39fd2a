"""The best optimum of edges: starts by a search, refined on a few scans, the best of them on all scans.

All of it in steps (:mod:`sst_graph.stepwise`): the tracker spreads them over frames."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np

from sst_graph.batch.by_edges.problem import EdgesProblem
from sst_graph.batch.by_edges.reasons import SCORE_WORK, unsettled_reasons
from sst_graph.drive.preparation import Progress
from sst_graph.drive.stages import begin, stage
from sst_graph.edges.agreement import score
from sst_graph.edges.search import edge_starts_steps, turned
from sst_graph.errors import EstimationError
from sst_graph.graph.matching import edges_of
from sst_graph.graph.outer_loop import JointProblem, JointSolution, solve_joint_steps
from sst_graph.graph.state import State, difference
from sst_graph.stepwise import Stepwise
from sst_graph.types import FloatArray

START_KERNELS_PX = (10.0, 8.0, 6.0, 5.0, 4.0, 3.0)
"""Scales of the kernel from a start that is a degree off [px]."""
KERNELS_PX = (*[5.0] * 6, *[4.0] * 3, *[3.0] * 3, *[2.0] * 2, 1.5, 1.2)
"""From the best of the starts, on all scans [px]. Pictures have edges beside the objects'; the last scale is
below most of their distances. Then :data:`NEAR_KERNELS_PX` until nothing moves."""
NEAR_KERNELS_PX = (3.0, 2.0, 2.0, 1.5, 1.2)
"""From the estimate [px]: wide enough to meet other edges, too narrow to leave it."""
WIDER_KERNEL_PX = (3.0,)
"""Scale of the kernel under which an estimate is solved once more [px]: where it moves, it hangs on which of
several edges nearby are met, and the step is a deviation of its covariance."""
SCORE_PX = 1.5
"""Blur under which solutions are compared [px]."""
_TURNS_DEG = np.array(
    [
        [0.0, 0.0, -0.8],
        [0.0, 0.0, 0.8],
        [0.0, -0.5, 0.0],
        [0.0, 0.5, 0.0],
        [-0.8, 0.0, 0.0],
        [0.8, 0.0, 0.0],
    ]
)
"""(n, 3) turns about the camera's axes from which an estimate is solved again: false optima lie close by in
roll, in yaw with a shift to the side, and in pitch with a shift in height [deg]."""
_APART_RAD = np.radians(1.0)
"""How far false optima lie apart in rotation: what motion knows less well says nothing about them [rad]."""
_SHORT_TURN_RAD = np.radians(0.2)
"""A turn shorter than this stays within one optimum [rad]."""
_KNOWN_TRANSLATION_M = 0.12
"""Where the translation is known as well as this, the edges lead to it [m]: as from a guess."""
RESTARTS = 4
"""Most times that a better optimum is followed."""
_BETTER = 1.005
"""Its score is higher by this factor: smaller differences are those of one optimum reached twice."""
_GAIN = 1.001
"""A round that raises the score by less than this factor is the last, where only scores are compared."""
_NEARBY = "solutions nearby"
"""Name of a stage of a calibration."""
_MAX_ROUNDS = 10
"""Most times that the near scales are gone through."""
CONVERGED_STEP = np.array([*np.radians([0.02] * 3), 0.005, 0.005, 0.005, 0.003])
"""(7,) a round that moves by no more is the last [rad, m, s]."""


def candidate_steps(problem: EdgesProblem) -> Stepwise[list[tuple[float, JointSolution]]]:
    """Solutions on a few scans from the starts of a search on the drive with most edges in view, by their
    score, best first.

    Raises:
        EstimationError: no start, or none leads anywhere.
    """
    if not problem.subset_edges:
        raise EstimationError("no LiDAR edge in any scan")
    richest = max(problem.subset_edges, key=len)
    starts = yield from edge_starts_steps(richest, problem.region)
    if not starts:
        raise EstimationError("no LiDAR edge in any picture")
    found, failures = [], []
    for start in starts:
        try:
            solution = yield from solve_joint_steps(problem.some, start, START_KERNELS_PX)
        except EstimationError as error:
            failures.append(error)
            continue
        found.append((score(problem.subset_edges, solution.state, SCORE_PX), solution))
        yield SCORE_WORK
    if not found:
        raise failures[0]
    return sorted(found, key=lambda pair: -pair[0])


def best_optimum_steps(
    problem: EdgesProblem, start: State, restarts: int, progress: Progress | None = None
) -> Stepwise[JointSolution]:
    """The solution on all scans that no turn leads away from to a better one.

    Raises:
        EstimationError: too few matches.
    """
    wide = yield from solve_joint_steps(problem.whole, start, KERNELS_PX, progress)
    best, best_score = yield from _newton_ascent(problem.whole, wide.state, progress)
    for _ in range(restarts):
        other = yield from _better_nearby(problem, best, progress)
        if other is None:
            break
        again, found_score = yield from _newton_ascent(problem.whole, other, progress)
        if found_score < _BETTER * best_score:
            break
        best, best_score = again, found_score
    return (yield from _converged(problem.whole, best, progress))


def _better_nearby(
    problem: EdgesProblem, state: State, progress: Progress | None = None
) -> Stepwise[State | None]:
    """An optimum on a few scans that agrees better than the one at a state; None where none is found."""
    t = state.cTl.translation()
    rotations = turned(state.cTl, np.radians(_TURNS_DEG))
    starts = [state, *(replace(state, cTl=gtsam.Pose3(gtsam.Rot3.ClosestTo(R), t)) for R in rotations)]
    starts += [*toward_motion(problem, state), *shifted(problem, state)]
    found = []
    with stage(progress, _NEARBY):
        for start in starts:
            try:
                found.append((yield from _newton_ascent(problem.some, start, None)))
            except EstimationError:
                if start is state:
                    return None
            begin(progress, _NEARBY)
    (_, own), *others = found
    other, found_score = max(others, key=lambda one: one[1], default=(state, 0.0))
    return other if found_score >= _BETTER * own else None


def toward_motion(problem: EdgesProblem, state: State) -> list[State]:
    """The state turned towards the rotation that motion knows, about the middle of what is seen, which stays
    where it is in the pictures; none where that is no long turn.

    A false optimum in pitch has another height with it, so that a turn about the camera leads out of the
    picture's edges and back.
    """
    known = problem.known
    prior = _APART_RAD**2 * np.eye(3)
    turn = difference(state, known.state)[:3]
    turn = prior @ np.linalg.solve(prior + known.covariance[:3, :3], turn)
    if np.linalg.norm(turn) < _SHORT_TURN_RAD:
        return []
    lPs = np.concatenate([edges.points.lPs for edges in problem.subset_edges])
    depths = state.cTl.transformFrom(lPs.T)[2]
    depths = depths[depths > 0.0]
    if len(depths) == 0:
        return []
    middle = state.cTl.transformTo(np.array([0.0, 0.0, np.median(depths)]))
    about = gtsam.Pose3(gtsam.Rot3(), middle)
    moved = gtsam.Pose3(gtsam.Rot3.Expmap(turn), np.zeros(3))
    return [replace(state, cTl=state.cTl * about * moved * about.inverse())]


def shifted(problem: EdgesProblem, state: State) -> list[State]:
    """The state with its translation moved by a standard deviation of what is known of it, either way along
    each axis of the LiDAR; none where a guess says where the camera is."""
    sigmas_m = np.sqrt(np.diag(problem.known.covariance))[3:6]
    steps = [
        sign * sigma_m * axis
        for sigma_m, axis in zip(sigmas_m, np.eye(3), strict=True)
        for sign in (-1.0, 1.0)
        if sigma_m > _KNOWN_TRANSLATION_M
    ]
    return [replace(state, cTl=state.cTl * gtsam.Pose3(gtsam.Rot3(), step)) for step in steps]


def _newton_ascent(
    problem: JointProblem, start: State, progress: Progress | None
) -> Stepwise[tuple[State, float]]:
    """A state near the optimum that a start leads to, and its score, by few long steps: each point is matched
    to the peak of its edge, which Newton's method says, until the score gains too little to count."""
    by_peaks = problem.at_peaks()
    edges = edges_of(problem.drives, problem.motions, by_peaks.config.graph)
    state, found_score = start, 0.0
    for _ in range(_MAX_ROUNDS):
        solution = yield from solve_joint_steps(by_peaks, state, NEAR_KERNELS_PX, progress)
        state = solution.state
        before, found_score = found_score, score(edges, state, SCORE_PX)
        yield SCORE_WORK
        if found_score < _GAIN * before:
            break
    return state, found_score


def _converged(problem: JointProblem, start: State, progress: Progress | None) -> Stepwise[JointSolution]:
    """The solution by near edges from a start that is nearly right.

    Soft matches follow the pose, so that steps are too short: the scales are gone through until nothing
    moves.
    """
    state = start
    for _ in range(_MAX_ROUNDS):
        solution = yield from solve_joint_steps(problem, state, NEAR_KERNELS_PX, progress)
        if (np.abs(difference(state, solution.state)) < CONVERGED_STEP).all():
            break
        state = solution.state
    return solution


def farther_edges_steps(
    problem: JointProblem, estimate: State
) -> Stepwise[tuple[FloatArray, tuple[str, ...]]]:
    """(7,) step of an estimate that is solved again with edges up to 3 px away; and, where it is a long one,
    why the estimate may be wrong: solved from there with near edges it does not come back.

    Raises:
        EstimationError: too few matches.
    """
    wider = yield from solve_joint_steps(problem, estimate, WIDER_KERNEL_PX)
    step = difference(estimate, wider.state)
    if not unsettled_reasons(step):
        return step, ()
    again = yield from _converged(problem, wider.state, None)
    return step, unsettled_reasons(difference(estimate, again.state))

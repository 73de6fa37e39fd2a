"""The tracker's first estimate: a short batch over the window."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sst_graph.association.time_pairing import pair_by_time
from sst_graph.assumptions import named_sigmas
from sst_graph.drive.preparation import Drive, boundary_count
from sst_graph.errors import EstimationError, count_of
from sst_graph.factors.robust import RobustKernel
from sst_graph.graph.building import (
    LOWER_EDGE_BIAS_SIGMA_PX,
    PRIOR_ROTATION_SIGMA_RAD,
    PRIOR_TRANSLATION_SIGMA_M,
)
from sst_graph.graph.drive_motion import DriveMotion
from sst_graph.graph.matching import GraphConfig, associate
from sst_graph.graph.outer_loop import (
    KERNELS_PX,
    MIN_EXPLAINED,
    NARROW_KERNELS_PX,
    JointConfig,
    JointProblem,
    explained,
    solve_joint_steps,
)
from sst_graph.graph.state import State
from sst_graph.initialization.candidates import StartProblem
from sst_graph.initialization.selection import far_apart, select_start_steps
from sst_graph.metrics import turn_rad
from sst_graph.stepwise import Stepwise
from sst_graph.tracker.config import TrackerConfig
from sst_graph.tracker.start.first_estimate import FirstEstimate, StartGuess
from sst_graph.tracker.window.gaussian import Gaussian, Point
from sst_graph.tracker.window.matcher import mean_cost
from sst_graph.types import SemanticClass

_OTHER_BASIN_RAD = float(np.radians(2.0))
"""Poses that are turned by more are in different basins of convergence."""
_LEAST_PAIRS_SHARE = 0.7
"""Share of the pairs that the first solution must still match: below it, its time offset has diverged."""
_LEAST_GAIN = 0.1
"""By which fraction of the cost a solution must be better than another one to be preferred to it, where their
costs hardly differ: one whose offset was searched, or one of another basin."""
_TRACKS_WORK, _COST_WORK = 12, 3
"""To find the objects' motion, and the cost of a solution, in units of work."""
_OFFSET_STEP_S = 0.005
"""Damping of the time offset in the first solution, as the prior deviation of a step [s]: a short stretch at
one speed does not determine it."""


@dataclass(frozen=True)
class _Solved:
    """A solution and the mean cost of all boundary points under it."""

    cost: float
    point: Point

    def in_other_basin_than(self, other: _Solved) -> bool:
        """Whether the two are in different basins of convergence."""
        return turn_rad(self.point.cTl, other.point.cTl) > _OTHER_BASIN_RAD


@dataclass(frozen=True)
class _Problem:
    """What all solutions of a start share.

    Attributes:
        drive: the scans and images.
        motion: of the LiDAR.
        joint: the joint method over them, its time offset damped.
        config: settings.
    """

    drive: Drive
    motion: DriveMotion
    joint: JointProblem
    config: TrackerConfig


class _NotConverged(EstimationError):
    """A solution that did not converge, and the point that it reached."""

    def __init__(self, message: str, reached: _Solved) -> None:
        super().__init__(message)
        self.reached = reached


def first_estimate_steps(drive: Drive, guess: StartGuess, config: TrackerConfig) -> Stepwise[Point]:
    """The batch solution of some scans of the window, step by step.

    A short stretch of driving at one speed does not determine the time offset. So the offset stays near the
    guess unless the labels clearly contradict it: a solution whose search left the offset free must explain
    them better by a tenth, and within a solution a step of the offset is damped.

    Raises:
        EstimationError: too few matches, an ambiguous start, no solution that converged, or one that
            explains the labels less well than another that did not converge.
    """
    searched = guess.search or guess.cTl is None
    reach = config.calibration.search.time_offset_s if guess.search else 0.0
    motion = DriveMotion.of(drive)
    # 1. Candidates, with time offsets around the guess's.
    starts = yield from _starts(drive, motion, guess, config, reach)
    # 2. Solutions from their poses with the guess's time offset, and from the candidates as they are.
    held = [State(start.cTl, (guess.time_offset_s,)) for start in far_apart(starts, _OTHER_BASIN_RAD)]
    # After a search the starts are near.
    kernels_px = NARROW_KERNELS_PX if searched else KERNELS_PX
    families = [held, starts] if reach > 0.0 else [starts]
    problem = _Problem(drive, motion, JointProblem.of([drive], _damped(config)), config)
    yield _TRACKS_WORK
    solved, failed = yield from _all_of([_best(problem, each, kernels_px) for each in families])
    if not solved:
        raise failed[-1]
    best, *others = solved
    for other in others:
        if other.cost < (1.0 - _LEAST_GAIN) * best.cost:
            best = other
    _check_not_converged(best, failed)
    return best.point


def _all_of(attempts: Sequence[Stepwise[_Solved]]) -> Stepwise[tuple[list[_Solved], list[EstimationError]]]:
    """The solutions, and the errors of those that failed."""
    solved, failed = [], []
    for attempt in attempts:
        try:
            solved.append((yield from attempt))
        except EstimationError as error:
            failed.append(error)
    return solved, failed


def _not_converged(failed: Sequence[EstimationError]) -> list[_Solved]:
    """The points that solutions without convergence reached."""
    return [error.reached for error in failed if isinstance(error, _NotConverged)]


def _check_not_converged(best: _Solved, failed: Sequence[EstimationError]) -> None:
    """Refuse a solution if one of another basin is clearly better, though it has not converged.

    At a steady speed the time offset may move along with the translation without end.
    """
    for other in _not_converged(failed):
        if best.in_other_basin_than(other) and other.cost < (1.0 - _LEAST_GAIN) * best.cost:
            raise EstimationError(
                f"another pose explains the labels better (cost {other.cost:.3f} against {best.cost:.3f} a "
                "point), but has not converged"
            )


def _best(problem: _Problem, starts: Sequence[State], kernels_px: Sequence[float]) -> Stepwise[_Solved]:
    """The best of the solutions from some starts.

    Raises:
        EstimationError: no solution, or two that differ and explain the labels alike.
    """
    solved, failed = yield from _all_of([_solution(problem, start, kernels_px) for start in starts])
    if not solved:
        if reached := _not_converged(failed):
            raise _NotConverged(str(failed[0]), min(reached, key=lambda one: one.cost))
        raise failed[0]
    best, *others = sorted(solved, key=lambda solution: solution.cost)
    _check_not_converged(best, failed)
    for other in others:
        if best.in_other_basin_than(other) and best.cost > (1.0 - _LEAST_GAIN) * other.cost:
            raise EstimationError(
                f"two poses explain the labels alike (cost {best.cost:.3f} and {other.cost:.3f} a point)"
            )
    return best


def _starts(
    drive: Drive, motion: DriveMotion, guess: StartGuess, config: TrackerConfig, reach_s: float
) -> Stepwise[list[State]]:
    """Where the solutions begin: the candidates that the batch's selection keeps, with offsets within
    ``reach_s`` of the guess's, or the guess itself.

    Raises:
        EstimationError: nothing to search for, or no guess and no search.
    """
    calibration = config.calibration
    enabled = guess.search or guess.cTl is None
    search = dataclasses.replace(calibration.search, time_offset_s=reach_s, enabled=enabled)
    joint = _damped(config) if reach_s == 0.0 else calibration.joint
    problem = StartProblem([drive], [motion], calibration.classes, guess)
    selection = yield from select_start_steps(problem, joint.graph, search)
    return [State(cTl, (time_offset_s,)) for cTl, time_offset_s in selection.starts]


def _damped(config: TrackerConfig) -> JointConfig:
    """The joint method with small steps of the time offset."""
    joint = config.calibration.joint
    graph = dataclasses.replace(joint.graph, time_offset_sigma_s=_OFFSET_STEP_S)
    return dataclasses.replace(joint, graph=graph)


def _solution(problem: _Problem, start: State, kernels_px: Sequence[float]) -> Stepwise[_Solved]:
    """The joint method from a start, its offset damped."""
    drive, config = problem.drive, problem.config
    calibration = config.calibration
    solution = yield from solve_joint_steps(problem.joint, start, kernels_px)
    yield _COST_WORK
    state = solution.state
    names = [name for name, _ in named_sigmas(calibration.noise.estimate)]
    point = Point.of_state(state, calibration.classes, names)
    if not solution.converged:
        message = f"the first solution still moved after {count_of(solution.outer_iterations, 'iteration')}"
        raise _NotConverged(message, _Solved(_cost(problem, point), point))
    if explained(solution) < MIN_EXPLAINED:
        share = f"{100.0 * explained(solution):.0f} %"
        raise EstimationError(f"only {share} of the boundary points in view meet a contour under it")
    _check_pairs(drive, start.time_offset_s(0), len(solution.pairs), state.time_offset_s(0), config)
    return _Solved(_cost(problem, point), point)


def _cost(problem: _Problem, point: Point) -> float:
    """Mean cost of all boundary points of the window."""
    graph, classes = problem.config.calibration.noise, problem.config.calibration.classes
    kernel = RobustKernel("geman_mcclure", KERNELS_PX[-1])
    pairs = associate([problem.drive], [problem.motion], point.state(classes), kernel, graph)
    scans, below = problem.drive.scans, graph.lower_edges
    counted = [(pair, boundary_count(scans[pair.pair.scan], below)) for pair in pairs]
    cost = mean_cost(counted, point, classes, kernel)
    if cost is None:
        raise EstimationError("no boundary point meets an image")
    return cost


def _check_pairs(
    drive: Drive, start_s: float, pairs: int, time_offset_s: float, config: TrackerConfig
) -> None:
    """Refuse a solution whose time offset has diverged: it loses pairs, or leaves the searched range."""
    seen = [
        pair
        for pair in pair_by_time(drive.scan_stamps_ns, drive.image_stamps_ns, start_s, drive.image_period_s)
        if drive.scans[pair.scan].boundaries and drive.images[pair.image].contours
    ]
    if pairs < _LEAST_PAIRS_SHARE * len(seen):
        raise EstimationError(
            f"the first solution keeps {pairs} of {count_of(len(seen), 'pair')} of scan and image"
        )
    reach = config.calibration.search.time_offset_s
    if abs(time_offset_s - start_s) > reach:
        raise EstimationError(f"the time offset ran from {start_s:.3f} s to {time_offset_s:.3f} s")


def prior_gaussian(
    first: FirstEstimate, guess: StartGuess, classes: tuple[SemanticClass, ...], config: GraphConfig
) -> Gaussian:
    """The batch's own weak priors around the guess, and what else is known, linearized at a first estimate.

    A class's mask bias is around 0, that of its lower edges around the class's; an estimated parameter of an
    assumption is around 0.
    """
    point, estimated = first.point, dict(named_sigmas(config.estimate))
    sigmas = [PRIOR_ROTATION_SIGMA_RAD] * 3 + [PRIOR_TRANSLATION_SIGMA_M] * 3 + [config.time_offset_sigma_s]
    k = len(classes)
    sigmas += [config.mask_bias_sigma_px] * k + [np.inf] * k + [estimated[name] for name in point.names]
    information = np.diag(1.0 / np.square(sigmas))
    tie, biases = LOWER_EDGE_BIAS_SIGMA_PX**-2.0 * np.eye(k), slice(7, 7 + 2 * k)
    information[biases, biases] += np.block([[tie, -tie], [-tie, tie]])
    centre = Point.unbiased(guess.cTl or point.cTl, guess.time_offset_s, classes, point.names)
    vector = information @ point.local(centre)
    if first.known is not None:
        known, nothing = first.known, np.zeros(len(point.names))
        mean = dataclasses.replace(
            point,
            cTl=known.state.cTl,
            time_offset_s=known.state.time_offset_s(0),
            parameters=nothing,
        )
        jacobian = np.eye(7, len(vector))
        jacobian[:, list(point.parameter_columns)] = known.columns(point.names)
        information += jacobian.T @ known.information @ jacobian
        vector += jacobian.T @ (known.information @ (jacobian @ point.local(mean)))
    return Gaussian(point, information, vector)

"""``--method edges``: LiDAR edges against gradients of the pictures, in the joint method's graph; no
labels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.association.time_pairing import pair_by_time
from sst_graph.batch.by_edges.covariance import NEAR_KERNELS_PX, edges_covariance
from sst_graph.batch.by_edges.halves import halves_reasons
from sst_graph.batch.by_edges.parts import thinned
from sst_graph.batch.by_edges.reasons import EdgeContrast, edge_contrast, edges_reasons, wider_kernel_reasons
from sst_graph.batch.config import CalibrationConfig
from sst_graph.batch.method_estimate import Guess, MethodEstimate, frames_used
from sst_graph.batch.motion_factor import gaussian_factor
from sst_graph.batch.problem import CalibrationProblem, JointEstimate
from sst_graph.batch.total_covariance import sweep_effects
from sst_graph.drive.preparation import Drive, Progress
from sst_graph.edges.agreement import score
from sst_graph.edges.search import (
    KnownRotation,
    SearchRegion,
    angle_deg,
    edge_starts,
    turned,
)
from sst_graph.errors import EstimationError
from sst_graph.graph.building import Tracks
from sst_graph.graph.matching import DriveEdges, edges_of
from sst_graph.graph.outer_loop import JointProblem, JointSolution, solve_joint
from sst_graph.graph.state import State
from sst_graph.hand_eye.solution import MotionSolution, alternative, difference, solve_motion
from sst_graph.sampling import evenly_spread

FloatArray = NDArray[np.float64]

SEARCH_SCANS = 12
"""Scans of each drive that starts are compared on."""
POINTS_A_SCAN = 1000
"""Most boundary points of a scan that are matched: neighbours on one edge tell the same."""
START_KERNELS_PX = (10.0, 8.0, 6.0, 5.0, 4.0, 3.0)
"""Scales of the kernel from a start that is a degree off [px]."""
KERNELS_PX = (*[5.0] * 6, *[4.0] * 3, *[3.0] * 3, *[2.0] * 2, 1.5, 1.2)
"""From the best of the starts, on all scans [px]. Pictures have edges beside the objects'; the last scale is
below most of their distances. Then :data:`NEAR_KERNELS_PX` until nothing moves."""
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
_RESTARTS = 4
"""Most times that a better optimum is followed."""
_BETTER = 1.005
"""Its score is higher by this factor: smaller differences are those of one optimum reached twice."""
_GAIN = 1.001
"""A round that raises the score by less than this factor is the last, where only scores are compared."""
_GUESS_SIGMA_DEG = 3.5
"""Sigma, by axis, of the rotation of a guess that starts are searched around [deg]."""
_REACH_SIGMAS, _MOST_DEG = 2.2, 25.0
"""The search covers so many sigmas to either side, and this at most [deg]."""
_KNOWN_OFFSET_S = 0.03
"""Motion tells the time offset where its sigma is smaller than this [s]."""
_OFFSETS_S = np.arange(-3, 4) * 0.1
"""Time offsets around the guess that are tried where motion does not tell and the vehicle moves [s]."""
_MOVING_MPS = 0.2
"""Mean speed from which it counts as moving [m/s]: 100 ms are then 2 cm."""
_MOTION_FLOOR = np.array([*np.radians([0.5] * 3), 0.1, 0.1, 0.1, 0.004])
"""(7,) sigmas added to motion's as a factor: odometry errs by this much in ways that its covariance leaves
out [rad, m, s]."""
_TRANSLATION_SIGMA_M, _FREE_TRANSLATION_SIGMA_M = 0.1, 0.3
"""Prior sigma of the translation around the guess, or around 0 without one: unbounded, weak scenes run away
along the road [m]."""


@dataclass(frozen=True)
class _Problem:
    """Drives to be calibrated by edges.

    Attributes:
        whole: all scans, with no more points than are needed.
        some: a few scans of each drive.
        region: where starts are searched.
        centre: what the weak priors are centred on.
        motion: what motion alone says, or None.
    """

    whole: JointProblem
    some: JointProblem
    region: SearchRegion
    centre: State
    motion: MotionSolution | None

    @cached_property
    def subset_edges(self) -> list[DriveEdges]:
        """Boundary points of the few scans."""
        return edges_of(self.some.drives, self.some.tracks, self.some.config.graph)


@dataclass(frozen=True)
class LabelEstimate:
    """What labels of other frames estimate.

    Attributes:
        state: their estimate; edges begin there, without a search. None where it is not known well enough.
        has_motion: motion is in their estimate, and must not count twice.
    """

    state: State | None = None
    has_motion: bool = False


def edges_method(
    drives: Sequence[Drive],
    guess: Guess,
    config: CalibrationConfig,
    progress: Progress | None,
    labels: LabelEstimate | None = None,
) -> MethodEstimate:
    """Extrinsic and time offset from edges; drives are prepared with objects without a class.

    Args:
        labels: where other frames have some.

    Raises:
        EstimationError: no start: neither a guess nor motion, or nothing in view.
    """
    labels = labels or LabelEstimate()
    # 1. What motion says, before any edge is compared.
    motion = _motion_alone(drives, guess, config, progress)
    calibration = CalibrationProblem.of(drives, guess, config, progress)
    problem = _problem(calibration, motion, labels)
    if labels.state is None:
        # 2. Starts by a search over rotations; the best of them after refinement on a few scans.
        candidates = _refined(problem, _starts(problem))
        begin, restarts = candidates[0][1].state, _RESTARTS
    else:
        candidates, begin, restarts = [], labels.state, 0
    # 3. All frames, from the best, and from small turns while one agrees better.
    solution = _best_optimum(problem, begin, restarts, progress)
    # 4. Covariance, with what halves of the objects disagree by, and edges that are farther away.
    estimate = JointEstimate.of(solution, calibration.objects)
    wider = solve_joint(problem.whole, solution.state, _WIDER_KERNEL_PX)
    wider_step = difference(solution.state, wider.state)
    own = edges_covariance(problem.whole, estimate, calibration.objects, calibration.config.assumptions)
    covariance = own.matrix + np.outer(wider_step, wider_step)
    sweeps = sweep_effects(calibration, solution, covariance)
    covariance = covariance + sweeps.covariance
    # 5. Has it worked?
    contrast = edge_contrast(
        problem.subset_edges, solution.state, [one.state for _, one in candidates], config.seed
    )
    reasons = edges_reasons(solution, contrast, motion, covariance, problem.centre)
    reasons += wider_kernel_reasons(wider_step)
    if config.check_contradictions:
        reasons += halves_reasons(problem.whole, solution.state, covariance)
    return MethodEstimate(
        solution.state.cTl,
        solution.state.time_offsets_s[0],
        covariance,
        frames_used(drives, solution),
        (*reasons, *own.reasons, *sweeps.reasons),
        by_static_objects=covariance,
        diagnostics=_diagnostics(solution, contrast, motion)
        | {"spread": {**own.sigmas, "farther_edges": np.abs(wider_step).tolist()}},
        by_sweeps=sweeps.covariance,
        sweep_reasons=sweeps.reasons,
        shared=own.shared,
    )


def _motion_alone(
    drives: Sequence[Drive], guess: Guess, config: CalibrationConfig, progress: Progress | None
) -> MotionSolution | None:
    """What motion says; None where it says nothing, two things, or what the guess rules out."""
    reach_s = config.search.time_offset_s
    try:
        solutions = solve_motion(drives, guess.cTl, guess.time_offset_s, reach_s, progress)
    except EstimationError:
        return None
    possible = [
        one
        for one in solutions
        if abs(one.state.time_offsets_s[0] - guess.time_offset_s) <= reach_s
        and (guess.cTl is None or angle_deg(one.state.cTl, guess.cTl) < _MOST_DEG)
    ]
    if not possible or not possible[0].converged or alternative(possible) is not None:
        return None
    return possible[0]


def _problem(
    calibration: CalibrationProblem, motion: MotionSolution | None, labels: LabelEstimate
) -> _Problem:
    """The problem, with the search around what guess and motion say together.

    Raises:
        EstimationError: neither says anything.
    """
    guess = calibration.guess
    if labels.state is not None:
        guess = Guess(labels.state.cTl, labels.state.time_offsets_s[0])
    if guess.cTl is None and motion is None:
        raise EstimationError(
            "without labels, a start is needed: a guess within 5 deg (--init), or a drive whose motion "
            "tells the rotation (turns and changes of speed)"
        )
    drives = [thinned(drive, POINTS_A_SCAN) for drive in calibration.drives]
    joint = replace(calibration.joint(), drives=drives)
    region = _region(guess, motion, _time_offsets(calibration, motion))
    if labels.state is not None:
        region = replace(region, cTl=labels.state.cTl, time_offsets_s=labels.state.time_offsets_s)
    translation = np.zeros(3) if guess.cTl is None else np.asarray(guess.cTl.translation())
    pose = gtsam.Pose3(region.cTl.rotation(), translation)
    known = labels.state is None and motion is not None and _tells_offset(motion)
    centre = State(pose, (region.time_offsets_s[0] if known else guess.time_offset_s,))
    guessed = labels.state is None and guess.cTl is not None
    prior = _prior(centre, None if labels.has_motion else motion, guessed)
    whole = replace(joint, centre=centre, prior=prior)
    scans = [_some_scans(drive, guess.time_offset_s) for drive in drives]
    parts = [drive.part(own) for drive, own in zip(drives, scans, strict=True)]
    tracks = [joint.tracks.part(number, own) for number, own in enumerate(scans)]
    some = replace(whole, drives=parts, tracks=Tracks.joined(tracks))
    return _Problem(whole, some, replace(region, cTl=pose), centre, motion)


def _some_scans(drive: Drive, time_offset_s: float) -> list[int]:
    """Scans that starts are compared on, of those without labels beside their images."""
    found = pair_by_time(drive.scan_stamps_ns, drive.image_stamps_ns, time_offset_s, drive.image_period_s)
    scans = sorted({pair.scan for pair in found if not drive.have_labels(pair.scan, pair.image)})
    scans = scans or list(range(len(drive.scans)))
    return evenly_spread(scans, SEARCH_SCANS)


def _tells_offset(motion: MotionSolution) -> bool:
    return bool(np.sqrt(motion.covariance[6, 6]) < _KNOWN_OFFSET_S)


def _time_offsets(calibration: CalibrationProblem, motion: MotionSolution | None) -> tuple[float, ...]:
    """Time offsets at which starts are searched."""
    guess = calibration.guess.time_offset_s
    if motion is not None and _tells_offset(motion):
        return (motion.state.time_offsets_s[0],)
    speeds = [
        float(np.linalg.norm(each.mean_twist[3:]))
        for drive in calibration.drives
        for each in drive.lidar_motions
        if each.ok
    ]
    moving = bool(speeds) and float(np.mean(speeds)) > _MOVING_MPS
    return tuple((guess + _OFFSETS_S).tolist()) if moving else (guess,)


def _region(guess: Guess, motion: MotionSolution | None, time_offsets_s: tuple[float, ...]) -> SearchRegion:
    """Guess and motion together; where one says nothing, what the other says."""
    if motion is None:
        assert guess.cTl is not None
        half = (_REACH_SIGMAS * _GUESS_SIGMA_DEG,) * 3
        return SearchRegion(guess.cTl, time_offsets_s, half)
    known = KnownRotation(motion.state.cTl.rotation(), motion.covariance[:3, :3])
    # Both as Gaussians in the tangent space of the guess, or of motion alone.
    information = np.linalg.inv(known.covariance + np.radians(0.7) ** 2 * np.eye(3))
    middle = motion.state.cTl
    covariance = np.linalg.inv(information)
    if guess.cTl is not None:
        step = gtsam.Rot3.Logmap(guess.cTl.rotation().between(known.cRl))
        total = information + np.eye(3) / np.radians(_GUESS_SIGMA_DEG) ** 2
        covariance = np.linalg.inv(total)
        middle = gtsam.Pose3(
            guess.cTl.rotation().retract(covariance @ information @ step), guess.cTl.translation()
        )
    R = middle.rotation().matrix()
    sigmas_deg = np.degrees(np.sqrt(np.diag(R @ covariance @ R.T)))
    half = tuple(np.minimum(_REACH_SIGMAS * sigmas_deg, _MOST_DEG).tolist())
    return SearchRegion(middle, time_offsets_s, (half[0], half[1], half[2]), known)


def _prior(centre: State, motion: MotionSolution | None, guessed: bool) -> gtsam.NonlinearFactor:
    """Motion as a factor, and the translation's prior."""
    sigma_m = _TRANSLATION_SIGMA_M if guessed else _FREE_TRANSLATION_SIGMA_M
    sigmas = np.array([10.0] * 3 + [sigma_m] * 3 + [1.0])
    information, state = np.diag(sigmas**-2.0), centre
    if motion is not None:
        own = np.linalg.inv(motion.covariance + np.diag(_MOTION_FLOOR**2))
        step = np.append(
            gtsam.Pose3.Logmap(motion.state.cTl.between(centre.cTl)),
            centre.time_offsets_s[0] - motion.state.time_offsets_s[0],
        )
        total = information + own
        # Both Gaussians in the tangent space of motion's estimate.
        mean = np.linalg.solve(total, information @ step)
        state = State(motion.state.cTl.retract(mean[:6]), (motion.state.time_offsets_s[0] + float(mean[6]),))
        information = total
    return gaussian_factor(state, np.asarray(np.linalg.inv(information), np.float64))


def _starts(problem: _Problem) -> list[State]:
    """Starts by the search, on the drive with most edges in view.

    Raises:
        EstimationError: none.
    """
    if not problem.subset_edges:
        raise EstimationError("no LiDAR edge in any scan")
    richest = max(problem.subset_edges, key=len)
    found = edge_starts(richest, problem.region)
    if not found:
        raise EstimationError("no LiDAR edge in any picture")
    return [State(start.cTl, (start.time_offset_s,)) for start in found]


def _refined(problem: _Problem, starts: Sequence[State]) -> list[tuple[float, JointSolution]]:
    """Solutions on a few scans, by their score, best first.

    Raises:
        EstimationError: none leads anywhere.
    """
    found, failures = [], []
    for start in starts:
        try:
            solution = solve_joint(problem.some, start, START_KERNELS_PX)
        except EstimationError as error:
            failures.append(error)
            continue
        found.append((score(problem.subset_edges, solution.state, SCORE_PX), solution))
    if not found:
        raise failures[0]
    return sorted(found, key=lambda pair: -pair[0])


def _best_optimum(problem: _Problem, start: State, restarts: int, progress: Progress | None) -> JointSolution:
    """The solution on all scans that no turn leads away from to a better one."""
    wide = solve_joint(problem.whole, start, KERNELS_PX, progress)
    best, best_score = _newton_ascent(problem.whole, wide.state, progress)
    for _ in range(restarts):
        other = _better_nearby(problem, best)
        if other is None:
            break
        again, found_score = _newton_ascent(problem.whole, other, progress)
        if found_score < _BETTER * best_score:
            break
        best, best_score = again, found_score
    return _converged(problem.whole, best, progress)


def _better_nearby(problem: _Problem, state: State) -> State | None:
    """An optimum on a few scans that agrees better than the one at a state; None where none is found."""
    t = state.cTl.translation()
    rotations = turned(state.cTl, np.radians(_TURNS_DEG))
    starts = [state, *(replace(state, cTl=gtsam.Pose3(gtsam.Rot3.ClosestTo(R), t)) for R in rotations)]
    found = []
    for start in starts:
        try:
            found.append(_newton_ascent(problem.some, start, None))
        except EstimationError:
            if start is state:
                return None
    (_, own), *others = found
    other, found_score = max(others, key=lambda one: one[1], default=(state, 0.0))
    return other if found_score >= _BETTER * own else None


def _newton_ascent(problem: JointProblem, start: State, progress: Progress | None) -> tuple[State, float]:
    """A state near the optimum that a start leads to, and its score, by few long steps: each point is matched
    to the peak of its edge, which Newton's method says, until the score gains too little to count."""
    graph = replace(problem.config.graph, edge_peaks=True)
    by_peaks = replace(problem, config=replace(problem.config, graph=graph))
    edges = edges_of(problem.drives, problem.tracks, graph)
    state, found_score = start, 0.0
    for _ in range(_MAX_ROUNDS):
        state = solve_joint(by_peaks, state, NEAR_KERNELS_PX, progress).state
        before, found_score = found_score, score(edges, state, SCORE_PX)
        if found_score < _GAIN * before:
            break
    return state, found_score


def _converged(problem: JointProblem, start: State, progress: Progress | None) -> JointSolution:
    """The solution by near edges from a start that is nearly right.

    Soft matches follow the pose, so that steps are too short: the scales are gone through until nothing
    moves.
    """
    state = start
    for _ in range(_MAX_ROUNDS):
        solution = solve_joint(problem, state, NEAR_KERNELS_PX, progress)
        if (np.abs(difference(state, solution.state)) < _CONVERGED_STEP).all():
            break
        state = solution.state
    return solution


_MAX_ROUNDS = 10
"""Most times that the near scales are gone through."""
_CONVERGED_STEP = np.array([*np.radians([0.02] * 3), 0.005, 0.005, 0.005, 0.003])
"""(7,) a round that moves by no more is the last [rad, m, s]."""
_WIDER_KERNEL_PX = (3.0,)
"""Scale of the kernel under which an estimate is solved once more [px]: where it moves, it hangs on which of
several edges nearby are met, and the step is a deviation of its covariance."""


def _diagnostics(
    solution: JointSolution, contrast: EdgeContrast, motion: MotionSolution | None
) -> dict[str, Any]:
    """JSON-able numbers about the run."""
    facts: dict[str, Any] = {
        "outer_iterations": solution.outer_iterations,
        "matches": sum(len(pair) for pair in solution.pairs),
        "pairs": len(solution.pairs),
        "contrast": contrast.to_dict(),
    }
    if motion is not None:
        sigmas = np.sqrt(np.diag(motion.covariance))
        facts["motion"] = {
            "time_offset_s": motion.state.time_offsets_s[0],
            "sigmas": sigmas.tolist(),
        }
    return facts

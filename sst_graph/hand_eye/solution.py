"""Calibration from motion alone: LiDAR odometry against visual odometry in a hand-eye factor graph.

Neither labels nor common sight are needed. Sources: Taylor & Nieto, Motion-based calibration of multimodal
sensor extrinsics and timing offset estimation, T-RO 2016; Park et al., Spatiotemporal camera-LiDAR
calibration: a targetless and structureless approach, RA-L 2020.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from sst_graph.drive.path import SensorPath
from sst_graph.drive.preparation import Drive, Progress
from sst_graph.errors import EstimationError, count_of
from sst_graph.fit import OuterIteration
from sst_graph.graph.linear import ordering_of
from sst_graph.graph.outer_loop import STEP_SIGMAS, step_share
from sst_graph.graph.state import EXTRINSIC, State, difference, time_offset_key
from sst_graph.hand_eye.covariance import hand_eye_covariance
from sst_graph.hand_eye.graph import (
    CameraStep,
    HandEyeTerms,
    NoiseScales,
    camera_steps,
    hand_eye_graph,
    hand_eye_terms,
    lidar_paths,
    pair_motions,
    state_values,
)
from sst_graph.hand_eye.initialization import LEAST_SHARE, MAX_OFFSET_S, motion_starts
from sst_graph.types import FloatArray, Guess

_LOG = logging.getLogger(__name__)

VAGUE_DEG, VAGUE_S = 5.0, 0.03
"""A rotation or a time offset with a larger sigma than this is as good as unknown [deg], [s]."""
MIN_PAIRS = 5
"""Fewest pairs of camera and LiDAR motions of a solution: fewer tell nothing of the noise."""
MAX_NOISE_SCALE = 4.0
"""Odometry that fits worse than this many times its stated noise errs in ways that its covariance, which is
scaled to fit, does not describe. On KITTI and on simulated streets the scales are 0.5 to 1.8. Where few
features are in view and half of them move they are 5 to 9: a time offset was 20 ms off at a sigma of 4 ms."""
_MAX_OUTER = 20
"""Most outer iterations: a bound on the time; what has not converged by then is reported."""
_FIRST_OUTER = 4
"""Outer iterations from every start, before the best of them go on."""
_INNER_ITERATIONS = 10
"""Most Levenberg-Marquardt iterations on frozen motions: the next outer iteration goes on from there."""
ALTERNATIVE_CHI2 = 9.0
"""A different solution that costs at most this much more makes the estimate ambiguous: three sigmas of one
unknown. Solutions farther apart than this (chi-squared of 7) are different."""


@dataclass(frozen=True)
class MotionSolution:
    """Result of the outer loop.

    Attributes:
        state: the estimate.
        centre: of the priors.
        terms: its pairs, under the noise that the residuals have.
        scales: that noise, in multiples of what odometry states.
        covariance: (7, 7).
        cost: log of the noise that the residuals have, over all of the camera's motions, as if those without
            a pair had the same: a negative log-likelihood.
        outer_iterations: done since the outer loop last began.
        converged: the last step was short.
        iterations: all of them, from the start on.
    """

    state: State
    centre: State
    terms: HandEyeTerms
    scales: NoiseScales
    covariance: FloatArray
    cost: float
    outer_iterations: int
    converged: bool
    iterations: tuple[OuterIteration, ...] = ()

    @property
    def misfit(self) -> str | None:
        """Why the covariance may be wrong; None where the odometry fits."""
        worst = max(self.scales.rotation, self.scales.direction)
        if worst <= MAX_NOISE_SCALE:
            return None
        return (
            f"the camera's motion fits the LiDAR's {worst:.0f} times worse than their noise allows: check "
            "the stamps, and whether frames are missing; record a scene with more texture that does not move"
        )


def solve_motion(
    drives: Sequence[Drive],
    guess: Guess,
    max_offset_s: float = MAX_OFFSET_S,
    progress: Progress | None = None,
) -> list[MotionSolution]:
    """Solutions from the best starts, the likeliest first.

    Args:
        max_offset_s: half width of the time offsets that are tried around the guess [s].

    Raises:
        EstimationError: too few pairs of motions.
    """
    # 1. The motions, which depend on no calibration.
    steps, paths = camera_steps(drives), lidar_paths(drives)
    if len(steps) < MIN_PAIRS:
        raise EstimationError(_too_few(len(steps)))
    # 2. Rotation and time offset on a grid of offsets.
    starts = motion_starts(steps, paths, guess, max_offset_s)
    if not starts:
        raise EstimationError(
            f"no time offset within {max_offset_s:g} s of {guess.time_offset_s:g} s at which the LiDAR's "
            f"motion is known over the time of the camera's ({count_of(len(steps), 'motion')}): "
            "compare the stamps of scans and images"
        )
    # 3. The graph from each of them, a few steps; from those that differ and fit alike to the end.
    translation = np.zeros(3) if guess.cTl is None else guess.cTl.translation()
    solutions: list[MotionSolution] = []
    for number, start in enumerate(starts):
        cTl = gtsam.Pose3(start.cRl, translation)
        centre = State(guess.cTl or cTl, (guess.time_offset_s,))
        first = State(cTl, (start.time_offset_s,))
        solution = _solve(steps, paths, first, centre, _FIRST_OUTER)
        if solution is not None:
            solutions.append(solution)
        if progress is not None:
            progress("motion", number + 1, len(starts))
    if not solutions:
        raise EstimationError("from every start the time offset left the time that the LiDAR's motion covers")
    finished = [_finished(steps, paths, s) for s in _different(solutions)]
    _LOG.info("motion: %d pairs, costs %s", len(steps), [round(s.cost, 1) for s in finished])
    return sorted(finished, key=lambda s: s.cost)


def _different(solutions: Sequence[MotionSolution]) -> list[MotionSolution]:
    """The cheapest, and those that cost little more and lie elsewhere; all before they were finished."""
    first, *others = sorted(solutions, key=lambda s: s.cost)
    kept = [first]
    for other in others:
        near = 2.0 * (other.cost - first.cost) < 3.0 * ALTERNATIVE_CHI2
        if near and all(_apart(one, other) > ALTERNATIVE_CHI2 for one in kept):
            kept.append(other)
    return kept


def _finished(
    steps: Sequence[CameraStep], paths: Sequence[SensorPath], solution: MotionSolution
) -> MotionSolution:
    """A solution with its outer loop run to the end."""
    if solution.converged:
        return solution
    again = _solve(steps, paths, solution.state, solution.centre)
    return solution if again is None else replace(again, iterations=solution.iterations + again.iterations)


def _apart(a: MotionSolution, b: MotionSolution) -> float:
    """Chi-squared of 7 of the step between two solutions under the covariance of both."""
    step = difference(a.state, b.state)
    return float(step @ np.linalg.solve(a.covariance + b.covariance, step))


def _solve(
    steps: Sequence[CameraStep],
    paths: Sequence[SensorPath],
    state: State,
    centre: State,
    max_outer: int = _MAX_OUTER,
) -> MotionSolution | None:
    """Interpolate the LiDAR's motion at the time offset and optimise, until the step is small.

    None where the offset runs away to where too few pairs are left.
    """
    converged, outer = False, 0
    iterations = []
    while outer < max_outer and not converged:
        outer += 1
        # 1. The LiDAR's motion at the current offset, under the noise that the residuals have.
        pairs = pair_motions(steps, paths, state.time_offsets_s[0])
        if len(pairs) < max(MIN_PAIRS, LEAST_SHARE * len(steps)):
            return None
        terms, scales = hand_eye_terms(pairs, state)
        # 2. Inner optimisation.
        graph = hand_eye_graph(terms, centre)
        values = _optimise(graph, state_values(state))
        moved = State(values.atPose3(EXTRINSIC), (float(values.atVector(time_offset_key())[0]),))
        covariance = hand_eye_covariance(terms, moved, _information(graph, values))
        # 3. Move, by less and less of the step where robust weights and the LiDAR's motion at the new offset
        # alternate; stop when the step is small.
        step = step_share(outer) * difference(state, moved)
        state = state.moved(step)
        iterations.append(OuterIteration(**vars(state.calibration()), kernel_px=None, matches=len(pairs)))
        converged = float(step @ np.linalg.solve(covariance, step)) < STEP_SIGMAS**2
    # Offsets leave different numbers of pairs: a sum over those that there are would reward few.
    cost = float(len(steps) * (3.0 * np.log(scales.rotation) + 2.0 * np.log(scales.direction)))
    return MotionSolution(state, centre, terms, scales, covariance, cost, outer, converged, tuple(iterations))


def _optimise(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.Values:
    params = gtsam.LevenbergMarquardtParams()
    params.setMaxIterations(_INNER_ITERATIONS)
    params.setlambdaInitial(1e-6)
    return gtsam.LevenbergMarquardtOptimizer(graph, values, params).optimize()


def _information(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> FloatArray:
    """(7, 7) of [E, D]."""
    ordering = ordering_of((EXTRINSIC, time_offset_key()))
    return np.asarray(graph.linearize(values).hessian(ordering)[0])


def _too_few(pairs: int) -> str:
    return (
        f"{count_of(pairs, 'pair')} of camera and LiDAR motion over the same time, expected {MIN_PAIRS} "
        "or more: "
        "motion alone needs consecutive frames of a moving vehicle"
    )


def alternative(solutions: Sequence[MotionSolution]) -> MotionSolution | None:
    """A solution that fits almost as well as the first and is another one by the covariance of both.

    None where the first is so uncertain that no other can contradict it.
    """
    best, *others = solutions
    sigmas = np.sqrt(np.diag(best.covariance))
    if np.degrees(sigmas[:3].max()) > VAGUE_DEG or sigmas[6] > VAGUE_S:
        return None
    for other in others:
        if 2.0 * (other.cost - best.cost) < ALTERNATIVE_CHI2 and _apart(best, other) > ALTERNATIVE_CHI2:
            return other
    return None

"""Calibration from motion alone: LiDAR odometry against visual odometry in a hand-eye factor graph.

Neither labels nor common sight are needed. Sources: Taylor & Nieto, Motion-based calibration of multimodal
sensor extrinsics and timing offset estimation, T-RO 2016; Park et al., Spatiotemporal camera-LiDAR
calibration: a targetless and structureless approach, RA-L 2020.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.config import Settings, setting
from sst_graph.drive.path import SensorPath
from sst_graph.drive.preparation import Drive, Progress
from sst_graph.errors import EstimationError
from sst_graph.factors.robust import RobustKernel
from sst_graph.graph.state import EXTRINSIC, State, time_offset_key
from sst_graph.hand_eye.covariance import HandEyeErrors, hand_eye_covariance
from sst_graph.hand_eye.graph import (
    CameraStep,
    HandEyePriors,
    HandEyeTerm,
    NoiseScales,
    camera_steps,
    hand_eye_graph,
    hand_eye_terms,
    lidar_paths,
    pair_motions,
    state_values,
)
from sst_graph.hand_eye.initialization import MotionStartConfig, motion_starts

_LOG = logging.getLogger(__name__)
FloatArray = NDArray[np.float64]

VAGUE_DEG, VAGUE_S = 5.0, 0.03
"""A rotation or a time offset with a larger sigma than this is as good as unknown [deg], [s]."""


@dataclass(frozen=True)
class MotionConfig(Settings):
    """Hand-eye calibration.

    Attributes:
        start: the closed-form start.
        priors: around the guess, or around the start without a guess.
        errors: what all pairs share.
        kernel: of whitened rotations and directions, scales in sigmas.
        max_rotation_sigma_rad: camera motions whose rotation is known worse are left out [rad].
        min_pairs: fewest pairs for an answer.
        max_outer: most times that the LiDAR's motion is looked up anew.
        heat_outer: outer steps from every start, before the best go on.
        full_steps: outer steps after which ever smaller parts of each are made: robust weights and look-ups
            may go to and fro for ever.
        settled: an outer step shorter than this many standard deviations ends the outer loop.
        inner_iterations: most Levenberg-Marquardt iterations in between.
        least_scale: the odometry's sigmas are never made smaller by more than this factor.
        max_disagreement: chi-squared of 7 up to which the joint method takes the motion in.
        rival_chi2: a different solution that costs at most this much more makes the answer doubtful.
    """

    start: MotionStartConfig = field(default_factory=MotionStartConfig)
    priors: HandEyePriors = field(default_factory=HandEyePriors)
    errors: HandEyeErrors = field(default_factory=HandEyeErrors)
    kernel: RobustKernel = field(default_factory=lambda: RobustKernel("cauchy", 3.0))
    max_rotation_sigma_rad: float = setting(0.02, at_least=1e-6, at_most=10.0)
    min_pairs: int = setting(5, at_least=2, at_most=1_000_000)
    max_outer: int = setting(20, at_least=1, at_most=1000)
    heat_outer: int = setting(4, at_least=1, at_most=1000)
    full_steps: int = setting(6, at_least=0, at_most=1000)
    settled: float = setting(0.1, at_least=0.0, at_most=10.0)
    inner_iterations: int = setting(10, at_least=1, at_most=1000)
    least_scale: float = setting(0.3, at_least=0.001, at_most=10.0)
    max_disagreement: float = setting(40.0, at_least=0.0, at_most=1e6)
    rival_chi2: float = setting(9.0, at_least=0.0, at_most=1e6)


@dataclass(frozen=True)
class MotionSolution:
    """Where the outer loop ended.

    Attributes:
        state: the estimate.
        centre: of the priors.
        terms: its factors, under the noise that the residuals have.
        scales: that noise, in multiples of what odometry claims.
        covariance: (7, 7).
        cost: log of the noise that the residuals have, over all pairs: a negative log-likelihood.
        outer_iterations: done.
        converged: the last step was short.
    """

    state: State
    centre: State
    terms: list[HandEyeTerm]
    scales: NoiseScales
    covariance: FloatArray
    cost: float
    outer_iterations: int
    converged: bool


def solve_motion(
    drives: Sequence[Drive],
    guess_cTl: gtsam.Pose3 | None,
    guess_offset_s: float,
    config: MotionConfig,
    progress: Progress | None = None,
) -> list[MotionSolution]:
    """Solutions from the best starts, the likeliest first.

    Raises:
        EstimationError: too few pairs of motions.
    """
    # 1. The motions, which depend on no calibration.
    steps, paths = camera_steps(drives, config.max_rotation_sigma_rad), lidar_paths(drives)
    if len(steps) < config.min_pairs:
        raise EstimationError(_too_few(len(steps), config))
    # 2. Rotation and time offset by trying all offsets.
    guess = None if guess_cTl is None else guess_cTl.rotation()
    starts = motion_starts(steps, paths, guess, guess_offset_s, config.start)
    if not starts:
        raise EstimationError(_too_few(len(steps), config))
    # 3. The graph from each of them, a few steps; from those that differ and fit alike to the end.
    translation = np.zeros(3) if guess_cTl is None else guess_cTl.translation()
    solutions: list[MotionSolution] = []
    for number, start in enumerate(starts):
        cTl = gtsam.Pose3(start.cRl, translation)
        centre = State(guess_cTl or cTl, (guess_offset_s,))
        heat = replace(config, max_outer=config.heat_outer)
        solution = _solve(steps, paths, State(cTl, (start.offset_s,)), centre, heat)
        if solution is not None:
            solutions.append(solution)
        if progress is not None:
            progress("motion", number + 1, len(starts))
    if not solutions:
        raise EstimationError("the time offset ran to where the drive has no LiDAR motion, from every start")
    finished = [_finished(steps, paths, s, config) for s in _different(solutions, config)]
    _LOG.info("motion: %d pairs, costs %s", len(steps), [round(s.cost, 1) for s in finished])
    return sorted(finished, key=lambda s: s.cost)


def _different(solutions: Sequence[MotionSolution], config: MotionConfig) -> list[MotionSolution]:
    """The cheapest, and those that cost little more and lie elsewhere; all before they were finished."""
    first, *others = sorted(solutions, key=lambda s: s.cost)
    kept = [first]
    for other in others:
        near = 2.0 * (other.cost - first.cost) < 3.0 * config.rival_chi2
        if near and all(_apart(one, other) > config.rival_chi2 for one in kept):
            kept.append(other)
    return kept


def _finished(
    steps: Sequence[CameraStep], paths: Sequence[SensorPath], solution: MotionSolution, config: MotionConfig
) -> MotionSolution:
    """A solution with its outer loop run to the end."""
    if solution.converged:
        return solution
    return _solve(steps, paths, solution.state, solution.centre, config) or solution


def _apart(a: MotionSolution, b: MotionSolution) -> float:
    """Chi-squared of 7 of the step between two solutions under the covariance of both."""
    step = difference(a.state, b.state)
    return float(step @ np.linalg.solve(a.covariance + b.covariance, step))


def _solve(
    steps: Sequence[CameraStep],
    paths: Sequence[SensorPath],
    state: State,
    centre: State,
    config: MotionConfig,
) -> MotionSolution | None:
    """Look the LiDAR's motion up at the time offset, optimise, until nothing moves.

    None where the offset runs away to where too few pairs are left.
    """
    converged, outer = False, 0
    while outer < config.max_outer and not converged:
        outer += 1
        # 1. The LiDAR's motion at the current offset, under the noise that the residuals have.
        pairs = pair_motions(steps, paths, state.offsets_s[0])
        if len(pairs) < max(config.min_pairs, config.start.least_share * len(steps)):
            return None
        terms, scales = hand_eye_terms(pairs, state, config.kernel, config.least_scale)
        # 2. Inner optimisation.
        graph = hand_eye_graph(terms, centre, config.priors)
        values = _optimise(graph, state_values(state), config.inner_iterations)
        covariance = hand_eye_covariance(graph, values, terms, config.errors, config.priors)
        # 3. Move; stop when the step is small.
        moved = State(values.atPose3(EXTRINSIC), (float(values.atVector(time_offset_key())[0]),))
        step = difference(state, moved)
        step /= 1 + max(0, outer - config.full_steps)
        state = State(state.cTl.retract(step[:6]), (state.offsets_s[0] + float(step[6]),))
        converged = float(step @ np.linalg.solve(covariance, step)) < config.settled**2
    misfit = len(terms) * (3.0 * np.log(scales.rotation) + 2.0 * np.log(scales.direction))
    return MotionSolution(state, centre, terms, scales, covariance, float(misfit), outer, converged)


def difference(a: State, b: State) -> FloatArray:
    """(7,) step from one state to another, in the tangent space of the covariance."""
    return np.append(gtsam.Pose3.Logmap(a.cTl.between(b.cTl)), b.offsets_s[0] - a.offsets_s[0])


def _optimise(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, iterations: int) -> gtsam.Values:
    params = gtsam.LevenbergMarquardtParams()
    params.setMaxIterations(iterations)
    params.setlambdaInitial(1e-6)
    return gtsam.LevenbergMarquardtOptimizer(graph, values, params).optimize()


def _too_few(pairs: int, config: MotionConfig) -> str:
    return (
        f"{pairs} pairs of camera and LiDAR motion over the same time, expected {config.min_pairs} or more: "
        "motion alone needs consecutive frames of a moving vehicle"
    )


def rival(solutions: Sequence[MotionSolution], config: MotionConfig) -> MotionSolution | None:
    """A solution that fits almost as well as the first and is another one by the covariance of both.

    None where the first is so vague that it claims nothing that another could contradict.
    """
    best, *others = solutions
    sigmas = np.sqrt(np.diag(best.covariance))
    if np.degrees(sigmas[:3].max()) > VAGUE_DEG or sigmas[6] > VAGUE_S:
        return None
    for other in others:
        if 2.0 * (other.cost - best.cost) < config.rival_chi2 and _apart(best, other) > config.rival_chi2:
            return other
    return None

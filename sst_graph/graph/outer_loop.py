"""The default method: a global start, then silhouettes over the whole drive in one factor graph."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.config import Settings, setting
from sst_graph.drive.preparation import Drive, Progress
from sst_graph.errors import EstimationError
from sst_graph.factors import residuals
from sst_graph.factors.robust import RobustKernel
from sst_graph.graph.building import GraphConfig, PairMatches, Tracks, joint_graph
from sst_graph.graph.frozen_problem import FrozenProblem
from sst_graph.graph.matching import DriveMatches, match_all, outlines_of
from sst_graph.graph.state import State
from sst_graph.objects.tracks import object_tracks
from sst_graph.stepwise import Stepwise, whole
from sst_graph.types import SemanticClass

FloatArray = NDArray[np.float64]
_LOG = logging.getLogger(__name__)

CONCENTRATION_SCALES = (1.0, 5.0)
"""Kernels, in units of the last one, whose supports are compared to see how close matches are."""


@dataclass(frozen=True)
class JointConfig(Settings):
    """Outer and inner loop of the joint method.

    Attributes:
        graph: matches, priors.
        kernel_px: scales of the robust kernel, outer iteration by outer iteration; the last one stays [px].
        max_outer: most outer iterations.
        step_sigmas: an outer step, at the last kernel scale, shorter than this many standard deviations of
            the frozen problem ends the outer loop.
        full_steps: outer steps at the last kernel scale before they are shortened: matches that come and
            go in turn would lead round in a circle, and the middle of it is the answer ...
        circle_sigmas: ... if a full step there is shorter than this many standard deviations.
        inner_iterations: most Levenberg-Marquardt iterations on frozen matches.
        min_matches: fewest matches in all for an answer.
    """

    graph: GraphConfig = field(default_factory=GraphConfig)
    kernel_px: tuple[float, ...] = setting(
        (20.0, 20.0, 15.0, 15.0, 10.0, 10.0, 7.0, 7.0, 5.0, 5.0, 4.0, 3.0),
        at_least=0.1,
        at_most=1000.0,
        length=(1, 100),
    )
    max_outer: int = setting(40, at_least=1, at_most=1000)
    step_sigmas: float = setting(0.1, at_least=0.0, at_most=10.0)
    full_steps: int = setting(6, at_least=0, at_most=1000)
    circle_sigmas: float = setting(1.5, at_least=0.0, at_most=100.0)
    inner_iterations: int = setting(2, at_least=1, at_most=100)
    min_matches: int = setting(30, at_least=1, at_most=1_000_000)


@dataclass(frozen=True)
class JointSolution:
    """Where the outer loop ended.

    Attributes:
        state: the estimate.
        matches: its matches, drive by drive, and
        pairs: pair by pair.
        graph, values: the last frozen graph and its optimum.
        outer_iterations: outer iterations done.
        converged: the last step was short beside the frozen problem's own uncertainty.
        matched_at: the state that the matches were made at.
    """

    state: State
    matches: Sequence[DriveMatches]
    pairs: list[PairMatches]
    graph: gtsam.NonlinearFactorGraph
    values: gtsam.Values
    outer_iterations: int
    converged: bool
    matched_at: State


def solve_joint(
    drives: Sequence[Drive],
    start: State,
    config: JointConfig,
    progress: Progress | None = None,
    guess: State | None = None,
    tracks: Tracks | None = None,
    belief: gtsam.NonlinearFactor | None = None,
) -> JointSolution:
    """All steps of :func:`solving_joint`."""
    return whole(solving_joint(drives, start, config, progress, guess, tracks, belief))


def solving_joint(
    drives: Sequence[Drive],
    start: State,
    config: JointConfig,
    progress: Progress | None = None,
    guess: State | None = None,
    tracks: Tracks | None = None,
    belief: gtsam.NonlinearFactor | None = None,
) -> Stepwise[JointSolution]:
    """Re-pair, re-match, optimise, until nothing moves: an outer iteration a step.

    Args:
        guess: what the weak priors are centred on; the start where it is None.
        tracks: twist and object tracks of the drives; made here where it is None.
        belief: what else is known of the extrinsic and the first clock's offset.

    Raises:
        EstimationError: too few matches at any step.
    """
    if tracks is None:
        by_object = config.graph.object_bias_sigma_px > 0.0
        tracks = Tracks(drives, [object_tracks(drive) for drive in drives] if by_object else None)
    state, converged, outer = start, False, 0
    guess = start if guess is None else guess
    outlines = outlines_of(drives, tracks, config.graph)
    for outer in range(config.max_outer):
        # 1. Matches at the current estimate, under a kernel that narrows.
        scale = config.kernel_px[min(outer, len(config.kernel_px) - 1)]
        matches = match_all(outlines, state, RobustKernel("geman_mcclure", scale))
        pairs = sum(len(own.paired) for own in matches)
        _check_matches(sum(map(len, matches)), pairs, config)
        # 2. Inner optimisation with the matches frozen.
        problem = FrozenProblem(matches, state, config.graph, guess, belief)
        optimum, system = problem.optimum(config.inner_iterations)
        # 3. Move, by less and less of the step when matches come and go in turn.
        rested = outer + 1 - len(config.kernel_px)
        share = 1.0 / (1.0 + max(0, rested - config.full_steps))
        state = state.towards(problem.state_at(optimum), share)
        if progress is not None:
            progress("joint", outer + 1, config.max_outer)
        yield pairs
        # 4. Stop when the step is small at the last scale.
        if rested >= 0:
            step = problem.step_sigmas(optimum, system)
            if share * step < config.step_sigmas:
                converged = step < config.circle_sigmas
                break
    # 5. The last frozen problem as a graph.
    found = [pair for own in matches for pair in own.by_pair()]
    graph, _ = joint_graph(found, problem.state, config.graph, guess)
    if belief is not None:
        graph.add(belief)
    _LOG.info("joint: %d outer iterations, %d pairs", outer + 1, pairs)
    values = problem.values_at(optimum)
    return JointSolution(state, matches, found, graph, values, outer + 1, converged, problem.state)


def support(solution: JointSolution) -> float:
    """How much agrees with a solution: its matches, each counted by its robust weight."""
    return _support(solution.matches, solution.state)


def _support(matches: Sequence[DriveMatches], state: State) -> float:
    return sum(float(robust_weights(own, state).sum()) for own in matches)


def robust_weights(matches: DriveMatches, state: State) -> FloatArray:
    """(m,) robust weight of each match of a drive at a state, with the mask bias of its class."""
    alignment, number = matches.alignment, matches.number
    biases = [state.biases_px.get((number, c), 0.0) for c in matches.group_classes]
    twists = matches.c_twists[matches.pair_of].T
    bias_px = np.repeat(biases, matches.counts)
    r, _ = residuals(alignment, state.cTl, state.offset_s(number), twists, bias_px, jacobians=False)
    return alignment.kernel.weight(r / alignment.sigmas_px)


def support_of(
    matches: Sequence[DriveMatches], state: State, side: int | None = None
) -> dict[SemanticClass, float]:
    """How much agrees with a state, by class: matches, of all sides or one, counted by robust weight."""
    total: dict[SemanticClass, float] = {}
    for own in matches:
        weights = robust_weights(own, state)
        if side is not None:
            weights = np.where(own.found.sides == side, weights, 0.0)
        for c, (a, b) in zip(own.group_classes, pairwise(own.found.bounds.tolist()), strict=True):
            if b > a:
                total[c] = total.get(c, 0.0) + float(weights[a:b].sum())
    return total


def concentration(
    solution: JointSolution, drives: Sequence[Drive], tracks: Tracks, config: JointConfig
) -> float:
    """Support under the last kernel as a share of that under one five times as wide.

    A true pose leaves the masks' own errors, whatever share of the points has a mask; a wrong pose that
    was fitted to some contours leaves all distances.
    """
    kernel = RobustKernel("geman_mcclure", CONCENTRATION_SCALES[1] * config.kernel_px[-1])
    matches = match_all(outlines_of(drives, tracks, config.graph), solution.state, kernel)
    return support(solution) / max(_support(matches, solution.state), 1e-9)


def explained(solution: JointSolution) -> float:
    """Share of the boundary points in the images that a solution's :func:`support` stands for."""
    return support(solution) / _seen(solution)


def agreement(solution: JointSolution) -> float:
    """How well a solution explains what it sees: :func:`support` times :func:`explained`.

    The support alone prefers poses that bring many objects into view.
    """
    return support(solution) ** 2 / _seen(solution)


def _seen(solution: JointSolution) -> int:
    return max(1, sum(int(own.found.seen[own.counts > 0].sum()) for own in solution.matches))


def _check_matches(matches: int, pairs: int, config: JointConfig) -> None:
    if matches < config.min_matches:
        raise EstimationError(
            f"{matches} silhouette matches in {pairs} pairs of scan and image, "
            f"expected {config.min_matches} or more"
        )

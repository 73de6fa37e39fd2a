"""The outer loop of the joint method: pair, match, optimise with the matches frozen, and again.

:mod:`~sst_graph.graph.matching` matches, :mod:`~sst_graph.graph.frozen_problem` optimises. The robust kernel
narrows from one outer iteration to the next. The functions at the end measure how well a solution explains
the labels, which its covariance does not show.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import gtsam
import numpy as np

from sst_graph.config import Settings, internal
from sst_graph.drive.preparation import Drive, Progress
from sst_graph.errors import EstimationError, count_of
from sst_graph.factors import residuals
from sst_graph.factors.robust import RobustKernel
from sst_graph.fit import OuterIteration
from sst_graph.graph.building import joint_graph
from sst_graph.graph.drive_motion import DriveMotion, motions_of
from sst_graph.graph.elimination import NormalEquations
from sst_graph.graph.frozen_problem import FrozenPoint, FrozenProblem
from sst_graph.graph.known import KnownCalibration
from sst_graph.graph.matching import (
    DriveEdges,
    DriveMatches,
    GraphConfig,
    PairMatches,
    edges_of,
    match_all,
)
from sst_graph.graph.state import State
from sst_graph.objects.tracks import object_tracks
from sst_graph.stepwise import Stepwise, run_to_end
from sst_graph.types import FloatArray, SemanticClass

_LOG = logging.getLogger(__name__)

STEP_SIGMAS = 0.1
"""A step shorter than this many standard deviations of the frozen problem ends the loop: what is left is
small beside the uncertainty."""
OSCILLATION_SIGMAS = 1.5
"""The loop has converged if its last full step is shorter than this many standard deviations: an oscillation
of that width is covered by the uncertainty."""
FULL_STEPS = 6
"""Full steps at the last kernel scale before steps are shortened; a solution that does not oscillate
converges with fewer."""
KERNELS_PX = (20.0, 20.0, 15.0, 15.0, 10.0, 10.0, 7.0, 7.0, 5.0, 5.0, 4.0, 3.0)
"""Schedule of the robust kernel: its scale in each outer iteration; the last one stays [px].

20 px are 1.6 degrees with KITTI's camera, the error that a start may have; 3 px are more than most errors of
masks. The other schedules end at the same 3 px: :data:`NARROW_KERNELS_PX` (the batch and the tracker after a
search, the tracker's whole window), ``_KERNELS_PX`` of :mod:`sst_graph.batch.part_solver`,
``_ALL_FREE_KERNELS_PX`` and ``_NEAR_KERNELS_PX`` of :mod:`sst_graph.batch.assumption_tests`,
``_KERNELS_PX`` of :mod:`sst_graph.batch.lower_edges`. New frames in the tracker are matched at the last
scale."""
NARROW_KERNELS_PX = KERNELS_PX[6:]
"""Schedule from a start that is nearly right, which wide kernels would lead away from [px]."""
INNER_ITERATIONS = 2
"""Most Levenberg-Marquardt iterations on frozen matches: the next matches are worth more than a third."""
_CONCENTRATION_SCALES = (1.0, 5.0)
"""Kernel scales, in units of the last one, whose supports :func:`concentration` compares."""
MIN_EXPLAINED = 0.2
"""Least :func:`explained`, the share of the boundary points in view that meet a contour, of a result."""
MIN_EXPLAINED_VAGUE = 0.45
"""Least :func:`explained` where the rotation is not observable: with so little in view, a lower share is also
reached by wrong poses."""
MAX_OUTER = 40
"""Most outer iterations: a bound on the time; what has not converged by then is reported."""
MIN_MATCHES = 30
"""Fewest matches of a solution: single frames with few objects have more, and seven unknowns need them."""
_MOSTLY, _UNKNOWN_MPS = 0.5, 1.0
"""Too few matches are said to be due to moving vehicles where more than this share of the outlines moves, at
velocities that are off by more than this [m/s]."""
_PAIRS_A_UNIT, _EDGES_WORK = 6, 2
"""Pairs of scan and image whose outer iteration costs one unit of work (:mod:`sst_graph.stepwise`), and how
many times the work of one with contours one with edges of pictures is."""
MIN_CONCENTRATION = 0.6
"""Least :func:`concentration` of a result: wrong poses stay below it."""


@dataclass(frozen=True)
class JointConfig(Settings):
    """The joint method.

    Attributes:
        graph: noise of matches and priors.
        max_outer: most outer iterations.
        min_matches: fewest matches of a solution.
    """

    graph: GraphConfig = field(default_factory=GraphConfig)
    max_outer: int = internal(MAX_OUTER)
    min_matches: int = internal(MIN_MATCHES)


@dataclass(frozen=True)
class JointProblem:
    """What is solved.

    Attributes:
        drives: all of them.
        motions: of each: its LiDAR's, and its objects' where those have mask biases.
        config: matches, priors, limits.
        centre: what the weak priors are centred on; the start where it is None.
        prior: what is known beside the matches.
    """

    drives: Sequence[Drive]
    motions: Sequence[DriveMotion]
    config: JointConfig
    centre: State | None = None
    prior: KnownCalibration | None = None

    @classmethod
    def of(cls, drives: Sequence[Drive], config: JointConfig) -> JointProblem:
        """With the objects tracked where the configuration has biases of theirs."""
        by_object = config.graph.object_bias_sigma_px > 0.0
        objects = [object_tracks(drive) for drive in drives] if by_object else None
        return cls(drives, motions_of(drives, objects), config)

    def estimating(self, names: Sequence[str]) -> JointProblem:
        """The problem with the parameters of further assumptions as variables, their spans as priors."""
        return self._with_graph(estimate=(*self.config.graph.estimate, *names))

    def at_peaks(self) -> JointProblem:
        """The problem with points matched to the peaks of the picture's edges, to which few steps lead."""
        return self._with_graph(edge_place="peak")

    def _with_graph(self, **settings: Any) -> JointProblem:
        graph = replace(self.config.graph, **settings)
        return replace(self, config=replace(self.config, graph=graph))


@dataclass(frozen=True)
class JointSolution:
    """Result of the outer loop.

    Attributes:
        state: the estimate.
        matches: its matches, drive by drive.
        outer_iterations: outer iterations done.
        converged: the last step was short compared with the sigmas of the frozen problem.
        frozen, optimum: the last frozen problem, at the state that the matches were made at, and its optimum.
        iterations: how the estimate was reached.
        problem: that was solved.
        centre: what its weak priors were centred on.
    """

    state: State
    matches: Sequence[DriveMatches]
    outer_iterations: int
    converged: bool
    frozen: FrozenProblem
    optimum: FrozenPoint
    iterations: tuple[OuterIteration, ...]
    problem: JointProblem
    centre: State

    @cached_property
    def pairs(self) -> list[PairMatches]:
        """The matches pair by pair."""
        return [pair for own in self.matches for pair in own.by_pair()]

    @cached_property
    def graph(self) -> gtsam.NonlinearFactorGraph:
        """The last frozen problem as a graph. Many solutions are compared by their states alone: it is made
        where it is asked for."""
        graph, _ = joint_graph(self.pairs, self.frozen.state, self.problem.config.graph, self.centre)
        if self.problem.prior is not None:
            graph.add(self.problem.prior.factor([*self.state.nuisances]))
        return graph

    def frozen_with(self, matches: Sequence[DriveMatches]) -> FrozenProblem:
        """The last frozen problem with other matches."""
        prior = self.problem.prior
        return FrozenProblem(matches, self.frozen.state, self.problem.config.graph, self.centre, prior)

    @cached_property
    def values(self) -> gtsam.Values:
        """The unknowns at the optimum of the last frozen problem."""
        return self.frozen.values_at(self.optimum)

    @cached_property
    def system(self) -> NormalEquations:
        """The last frozen problem, linear at its optimum."""
        return self.frozen.linearized(self.optimum)


def step_share(steps: int) -> float:
    """Share of the next step that is made, after so many at the last kernel scale: 1, ..., 1, 1/2, 1/3, ...

    Each outer iteration matches again. Where some matches appear and disappear in turn, the estimate
    oscillates about a point, which is the estimate that is wanted. So after some full steps the steps are
    shortened, and a short step ends the loop.
    """
    return 1.0 / (1.0 + max(0, steps - FULL_STEPS))


def solve_joint(
    problem: JointProblem,
    start: State,
    kernels_px: Sequence[float] = KERNELS_PX,
    progress: Progress | None = None,
    step_sigmas: float = STEP_SIGMAS,
) -> JointSolution:
    """All steps of :func:`solve_joint_steps`."""
    return run_to_end(solve_joint_steps(problem, start, kernels_px, progress, step_sigmas))


def solve_joint_steps(
    problem: JointProblem,
    start: State,
    kernels_px: Sequence[float],
    progress: Progress | None = None,
    step_sigmas: float = STEP_SIGMAS,
) -> Stepwise[JointSolution]:
    """Pair, match and optimise until the step is small; each outer iteration is one step of the generator.

    Args:
        kernels_px: scales of the robust kernel, outer iteration by outer iteration; the last one stays [px].
        step_sigmas: a step, at the last scale, shorter than this many standard deviations is the last one.

    Raises:
        EstimationError: too few matches at any step.
    """
    config, state, converged, outer = problem.config, start, False, 0
    centre = start if problem.centre is None else problem.centre
    edges = edges_of(problem.drives, problem.motions, config.graph)
    unit = _EDGES_WORK if _by_edges(edges) else 1
    iterations = []
    for outer in range(config.max_outer):
        # 1. Matches at the current estimate, under a kernel that narrows.
        scale = kernels_px[min(outer, len(kernels_px) - 1)]
        matches = match_all(edges, state, RobustKernel("geman_mcclure", scale))
        pairs = sum(len(own.paired) for own in matches)
        _check_matches(sum(map(len, matches)), pairs, config, edges)
        # 2. Inner optimisation with the matches frozen.
        frozen = FrozenProblem(matches, state, config.graph, centre, problem.prior)
        optimum, system = frozen.optimum(INNER_ITERATIONS)
        # 3. Move; after some full steps by a part of the step, so that oscillations end.
        at_last = outer + 1 - len(kernels_px)
        share = step_share(at_last)
        state = state.towards(frozen.state_at(optimum), share)
        count = sum(map(len, matches))
        iterations.append(OuterIteration(**vars(state.calibration()), kernel_px=scale, matches=count))
        if progress is not None:
            progress("solve", outer + 1, config.max_outer)
        yield unit * (1 + pairs // _PAIRS_A_UNIT)
        # 4. Stop when the step is small at the last scale.
        if at_last >= 0:
            step = frozen.step_sigmas(optimum, system)
            if share * step < step_sigmas:
                converged = step < OSCILLATION_SIGMAS
                break
    if progress is not None and outer + 1 < config.max_outer:
        progress("solve", config.max_outer, config.max_outer)
    _LOG.info("joint: %d outer iterations, %d pairs", outer + 1, pairs)
    return JointSolution(
        state, matches, outer + 1, converged, frozen, optimum, tuple(iterations), problem, centre
    )


def solve_all(
    problem: JointProblem,
    starts: Sequence[tuple[State, State]],
    kernels_px: Sequence[float],
    progress: Progress | None,
) -> list[JointSolution]:
    """Solutions from (start, what the weak priors are centred on), the one that agrees best first.

    Raises:
        EstimationError: none leads anywhere.
    """
    solutions, failures = [], []
    for start, centre in starts:
        try:
            solutions.append(solve_joint(replace(problem, centre=centre), start, kernels_px, progress))
        except EstimationError as error:
            failures.append(error)
    if not solutions:
        raise failures[0]
    return sorted(solutions, key=agreement, reverse=True)


def support(solution: JointSolution) -> float:
    """Sum of the robust weights of a solution's matches."""
    return _support(solution.matches, solution.state)


def _support(matches: Sequence[DriveMatches], state: State) -> float:
    return sum(float(robust_weights(own, state).sum()) for own in matches)


def robust_weights(matches: DriveMatches, state: State) -> FloatArray:
    """(m,) robust weight of each match of a drive at a state, with the mask bias of its class."""
    alignment, number = matches.alignment, matches.number
    biases = [state.biases_px.get((number, c), 0.0) for c in matches.group_classes]
    twists = matches.c_twists[matches.pair_of].T
    bias_px = np.repeat(biases, matches.counts)
    r, _ = residuals(alignment, state.cTl, state.time_offset_s(number), twists, bias_px, jacobians=False)
    return alignment.kernel.weight(r / alignment.sigmas_px)


def support_of(
    matches: Sequence[DriveMatches], state: State, side: int | None = None
) -> dict[SemanticClass, float]:
    """Sum of the robust weights of matches at a state, by class; of all sides of the objects or of one."""
    total: dict[SemanticClass, float] = {}
    for own in matches:
        weights = robust_weights(own, state)
        if side is not None:
            weights = np.where(own.found.sides == side, weights, 0.0)
        for c, (a, b) in zip(own.group_classes, pairwise(own.found.bounds.tolist()), strict=True):
            if b > a:
                total[c] = total.get(c, 0.0) + float(weights[a:b].sum())
    return total


def concentration(solution: JointSolution, problem: JointProblem) -> float:
    """Support under the last kernel as a share of that under one five times as wide.

    The residuals of a true pose are the masks' errors, so most are below the last scale; those of a wrong
    pose that was fitted to some contours are spread over all distances.
    """
    edges = edges_of(problem.drives, problem.motions, problem.config.graph)
    state = solution.state
    close, wide = (_support(matches, state) for matches in close_and_wide_matches(edges, state))
    return close / max(wide, 1e-9)


def close_and_wide_matches(edges: Sequence[DriveEdges], state: State) -> Iterator[list[DriveMatches]]:
    """The matches at a state under the last kernel, and under one five times as wide."""
    for scale in _CONCENTRATION_SCALES:
        yield match_all(edges, state, RobustKernel("geman_mcclure", scale * KERNELS_PX[-1]))


def explained(solution: JointSolution) -> float:
    """:func:`support` of a solution as a share of the boundary points in the images."""
    return support(solution) / _seen(solution)


def agreement(solution: JointSolution) -> float:
    """Score of a solution: :func:`support` times :func:`explained`.

    The support alone would prefer poses that bring many objects into view.
    """
    return support(solution) ** 2 / _seen(solution)


def still_moved(outer_iterations: int) -> str:
    """Why a solution that did not converge may be wrong."""
    return f"the outer loop still moved after {count_of(outer_iterations, 'iteration')}"


def poor_fit(explained: float, concentration: float, rotation_observable: bool) -> list[str]:
    """Reasons why a solution may be wrong altogether; none for one that explains the labels.

    Args:
        explained, concentration: as the functions of these names give them.
    """
    least_explained = MIN_EXPLAINED if rotation_observable else MIN_EXPLAINED_VAGUE
    return [
        f"only {math.floor(100.0 * share)} % {what} (expected {100.0 * least:.0f} % or more): "
        "the pose may be wrong altogether"
        for share, least, what in (
            (explained, least_explained, "of the boundary points in view meet a contour"),
            (concentration, MIN_CONCENTRATION, "of the matches are close ones"),
        )
        if share < least
    ]


def _seen(solution: JointSolution) -> int:
    return max(1, sum(int(own.found.seen.sum()) for own in solution.matches))


def _check_matches(matches: int, pairs: int, config: JointConfig, edges: Sequence[DriveEdges]) -> None:
    if matches >= config.min_matches:
        return
    expected = f"expected {config.min_matches} or more"
    by_edges, moving = _by_edges(edges), _moving_share(edges)
    if moving > _MOSTLY:
        cause = (
            f"; {100.0 * moving:.0f} % of the outlines are those of vehicles that move, at velocities which "
            "the scans do not tell: record parked or slow vehicles, too"
        )
    elif not matches:
        cause = (
            ": no boundary point of a scan is near an edge of the picture of its time"
            if by_edges
            else ": no boundary point of a scan is near a contour of its class in the image of its time"
        )
    else:
        cause = ""
    kind = "edge match" if by_edges else "silhouette match"
    where = f"{count_of(matches, kind, f'{kind}es')} in {count_of(pairs, 'pair')} of scan and image"
    where = where if matches else f"no {kind}es"
    raise EstimationError(f"{where}, {expected}{cause}")


def _by_edges(edges: Sequence[DriveEdges]) -> bool:
    """Whether edges of pictures are aligned, and no labels."""
    return {c for own in edges for c in own.classes} <= {SemanticClass.OBJECT}


def _moving_share(edges: Sequence[DriveEdges]) -> float:
    """Share of the boundary points on objects that move at velocities which are not known."""
    unknown = [own.unknown_mps for own in edges if own.unknown_mps is not None]
    moving = sum(int(np.count_nonzero(speeds_mps > _UNKNOWN_MPS)) for speeds_mps in unknown)
    return moving / max(sum(map(len, edges)), 1)

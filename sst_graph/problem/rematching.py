"""Matching again and again while a graph is solved: Levenberg-Marquardt, and what all solvers share.

Frozen matches lead to a point that the next matches confirm or not. The loop solves, matches again at what
was found, and narrows the robust kernel wherever a round has moved the matched points little beside it
(deterministic annealing, as in robust ICP). While the kernel is wide, what the matches hardly tell is held
by a *proximal* prior on extrinsic and offset about the present estimate, whose sigmas are a kernel's width
in the image: matches say nothing farther than they reach. It follows the estimate, so that it pulls towards
nothing, and it is gone at the end.

Matches of one side of one object err together in all images that show it. The covariance of extrinsic and
offset is therefore the cluster-robust one, P + o^2 P (sum over sides of s s') P, with P the graph's marginal
and s a side's score for an error of 1 px; and the factors are scaled down by the mean ratio of the two, so
that the marginals of the graph itself tell the same size.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import gtsam
import numpy as np
from numpy.typing import NDArray

from factors.delay import delay_prior
from sst_graph.config import Settings, setting
from sst_graph.errors import EstimationError
from sst_graph.problem.alignment_keys import AlignmentKeys
from sst_graph.problem.alignment_term import AlignmentTerm, TermMatches
from sst_graph.problem.object_sides import ObjectSides

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class RematchConfig(Settings):
    """When to match again, under which kernel, and how sure to be.

    Attributes:
        first_px: scale of the robust kernel at the start [px].
        last_px: its scale at the end [px].
        narrowing: from one scale to the next, below 1.
        settled: the kernel is narrowed when a round has moved the matched points by less than this share of
            it (RMS).
        step_px: at the last scale, a round that moves them by less ends the loop (RMS) [px]; matches that
            come and go in turn move them by a few hundredths for ever.
        most_rounds: rounds of matching, at most.
        inner_iterations: Levenberg-Marquardt iterations on frozen matches, at most.
        side_sigma_px: error that a side of an object keeps over all images that show it [px].
    """

    first_px: float = setting(40.0, at_least=0.1, at_most=1000.0)
    last_px: float = setting(4.0, at_least=0.1, at_most=1000.0)
    narrowing: float = setting(0.7, at_least=0.01, at_most=0.99)
    settled: float = setting(0.1, at_least=0.0, at_most=10.0)
    step_px: float = setting(0.1, at_least=0.0, at_most=100.0)
    most_rounds: int = setting(60, at_least=1, at_most=10_000)
    inner_iterations: int = setting(4, at_least=1, at_most=1000)
    side_sigma_px: float = setting(1.0, at_least=0.0, at_most=100.0)

    def __post_init__(self) -> None:
        self.expect_at_most("last_px", self.first_px, "first_px")

    def narrower(self, kernel_px: float) -> float:
        return max(self.last_px, self.narrowing * kernel_px)


class WarningKind(Enum):
    """What may be wrong with a solution."""

    WIDE_UNCERTAINTY = "the calibration is less certain than the matches reach"
    LEFT_INTERVAL = "stamp + offset has left the interval between its two poses"
    NO_MATCHES = "terms without a factor"
    NOT_SETTLED = "matching again still moves the matched points"


@dataclass(frozen=True)
class TermWarning:
    """One thing that may be wrong, with the figure behind it.

    Attributes:
        kind: what.
        value, limit: the figure and what it should not exceed, in ``unit``.
        unit: px, ms or terms.
    """

    kind: WarningKind
    value: float
    limit: float
    unit: str

    def __str__(self) -> str:
        return f"{self.kind.value}: {self.value:.3g} {self.unit}, at most {self.limit:.3g} {self.unit}"


@dataclass(frozen=True)
class RematchSolution:
    """Where the loop ended.

    Attributes:
        values: the estimate.
        graph: the user's factors and those of the terms, with the last matches.
        matches: of each term, in their order.
        covariance: (7, 7) of extrinsic and time offset, robust to sides of objects that err in all images;
            order and perturbation as :mod:`factors` has them; zeros for what is constant.
        rounds: rounds of matching.
        settled: the last round moved the matched points by less than ``step_px``.
        warnings: what may be wrong.
    """

    values: gtsam.Values
    graph: gtsam.NonlinearFactorGraph
    matches: tuple[TermMatches, ...]
    covariance: FloatArray
    rounds: int
    settled: bool
    warnings: tuple[TermWarning, ...]


def solve_with_terms(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    terms: Sequence[AlignmentTerm],
    config: RematchConfig | None = None,
) -> RematchSolution:
    """Levenberg-Marquardt on a graph and the terms' factors, matched again until that changes nothing.

    Args:
        graph: all other factors, priors on extrinsic and offset among them.
        values: start, of all variables.
        terms: of one camera.
        config: the schedule.

    Raises:
        EstimationError: no term, no match at the start, or a system that is indeterminate at the end.
    """
    config = config or RematchConfig()
    if not terms:
        raise EstimationError("solve_with_terms: found no term, expected one or more")
    keys, kernel_px, held = terms[0].keys, config.first_px, True
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(config.inner_iterations)
    matches = match_all(terms, values, kernel_px, 1.0)
    warnings = wide_uncertainty(matches, values, marginal(graph, values, keys), config)
    settled, rounds = False, 0
    while not settled and rounds < config.most_rounds:
        whole = with_factors(graph, matches)
        if held:
            whole.push_back(proximal(matches, values, kernel_px, keys))
        values = gtsam.LevenbergMarquardtOptimizer(whole, values, parameters).optimize()
        moved, rounds = moved_px(matches, values), rounds + 1
        if kernel_px > config.last_px:
            if moved < config.settled * kernel_px:
                kernel_px = config.narrower(kernel_px)
        elif held:
            held = moved >= config.settled * kernel_px
        else:
            settled = moved < config.step_px
        matches = match_all(terms, values, kernel_px, 1.0)
    P = marginal(with_factors(graph, matches), values, keys)
    C = robust_covariance(P, P, side_totals(matches, ObjectSides(), values), config.side_sigma_px)
    matches = match_all(terms, values, kernel_px, 1.0 / inflation(P, C))
    if not settled:
        warnings.append(TermWarning(WarningKind.NOT_SETTLED, moved, config.step_px, "px"))
    warnings += last_warnings(matches, values, C, config)
    return RematchSolution(
        values, with_factors(graph, matches), tuple(matches), C, rounds, settled, tuple(warnings)
    )


def match_all(
    terms: Sequence[AlignmentTerm], values: gtsam.Values, kernel_px: float, information: float
) -> list[TermMatches]:
    """Every term at the values.

    Raises:
        EstimationError: none of them has a factor.
    """
    matches = [term.matched(values, kernel_px, information) for term in terms]
    if all(each.factor is None for each in matches):
        states = ", ".join(sorted({each.state.value for each in matches}))
        found = f"no factor in {len(terms)} terms ({states})"
        raise EstimationError(f"alignment: found {found}, expected one or more")
    return matches


def with_factors(
    graph: gtsam.NonlinearFactorGraph, matches: Sequence[TermMatches]
) -> gtsam.NonlinearFactorGraph:
    """A copy of the graph with the terms' factors."""
    whole = gtsam.NonlinearFactorGraph(graph)
    for each in matches:
        if each.factor is not None:
            whole.add(each.factor)
    return whole


def moved_px(matches: Sequence[TermMatches], values: gtsam.Values) -> float:
    """How far the values have moved the matched points since matching, RMS over the terms [px]."""
    moved = [each.moved_px(values) for each in matches if each.factor is not None]
    return float(np.sqrt(np.mean(np.square(moved)))) if moved else 0.0


def proximal(
    matches: Sequence[TermMatches], values: gtsam.Values, kernel_px: float, keys: AlignmentKeys
) -> gtsam.NonlinearFactorGraph:
    """Priors on extrinsic and offset about the values; along each axis a kernel's width in the image."""
    J = [J for each in matches if each.term is not None for _, J in each.term.residuals_of(each, values)]
    reach = np.sqrt(np.mean(np.square(np.concatenate(J)), axis=0)) if J else np.zeros(7)
    sigmas = kernel_px / np.maximum(reach, 1e-3 * kernel_px)  # at most 1,000 of what moves nothing
    graph = gtsam.NonlinearFactorGraph()
    if isinstance(keys.cTl, int):
        noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas[:6])
        graph.add(gtsam.PriorFactorPose3(keys.cTl, values.atPose3(keys.cTl), noise))
    if isinstance(keys.offset_s, int):
        double = keys.keeps_double(values)
        graph.add(delay_prior(keys.offset_s, keys.offset(values), float(sigmas[6]), double=double))
    return graph


def marginal(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, keys: AlignmentKeys) -> FloatArray:
    """(7, 7) marginal covariance of extrinsic and offset in a graph; zeros for what is constant.

    Infinite where the graph does not determine them.
    """
    variables = list(keys.variables)
    if not variables:
        return np.zeros((7, 7))
    try:
        joint = gtsam.Marginals(graph, values).jointMarginalCovariance(variables)
        return keys.placed(np.asarray(joint.fullMatrix()))
    except (RuntimeError, IndexError):  # indeterminate, or nothing in the graph tells of them
        return keys.placed(np.diag(np.full(keys.size, np.inf)))


def side_totals(matches: Sequence[TermMatches], sides: ObjectSides, values: gtsam.Values) -> FloatArray:
    """(len(sides), 7) score of each side of an object, over all images, for an error of 1 px that it keeps.

    Args:
        matches: of all terms.
        sides: numbers of the sides.
        values: the estimate.
    """
    parts = [
        part
        for each in matches
        if each.term is not None
        for part in each.term.side_scores(each, sides, values)
    ]
    total = np.zeros((len(sides), 7))
    for numbers, scores in parts:
        np.add.at(total, numbers, scores)
    return total


def robust_covariance(own: FloatArray, P: FloatArray, totals: FloatArray, sigma_px: float) -> FloatArray:
    """own + o^2 P (sum s s') P: (7, 7), with what each side of an object errs by in all images.

    Args:
        own: (7, 7) covariance by errors that no two images share.
        P: (7, 7) marginal covariance of extrinsic and offset in the graph.
        totals: (sides, 7) scores as they stand in that graph.
        sigma_px: o.
    """
    spread = sigma_px * totals @ P
    C = own + spread.T @ spread
    return np.asarray(0.5 * (C + C.T))


def inflation(P: FloatArray, C: FloatArray) -> float:
    """Mean ratio of two covariances over the directions that P knows, 1 or more."""
    known = np.diag(P) > 0.0
    if not known.any() or not np.isfinite(P).all():
        return 1.0
    block = np.ix_(known, known)
    return max(1.0, float(np.trace(np.linalg.solve(P[block], C[block]))) / np.count_nonzero(known))


def wide_uncertainty(
    matches: Sequence[TermMatches],
    values: gtsam.Values,
    covariance: FloatArray,
    config: RematchConfig,
    reach_px: float | None = None,
) -> list[TermWarning]:
    """A warning where the calibration may err by more than matches reach.

    Args:
        matches: of all terms.
        values: the estimate.
        covariance: (7, 7) of extrinsic and offset: at the start by all but these matches, at the end by all.
        config: the schedule.
        reach_px: limit; by default the search range of the matches [px].
    """
    found = [(each, each.term) for each in matches if each.factor is not None and each.term is not None]
    if not found:
        return []
    gate = found[0][1].config.match.gate
    limit = gate * found[0][0].kernel_px if reach_px is None else reach_px
    if not np.isfinite(covariance).all():
        return [TermWarning(WarningKind.WIDE_UNCERTAINTY, float("inf"), limit, "px")]
    sigmas = [each.predicted_sigma_px(values, covariance) for each, _ in found]
    sigma_px = float(np.sqrt(np.mean(np.square(sigmas))))
    return [TermWarning(WarningKind.WIDE_UNCERTAINTY, sigma_px, limit, "px")] if sigma_px > limit else []


def last_warnings(
    matches: Sequence[TermMatches], values: gtsam.Values, covariance: FloatArray, config: RematchConfig
) -> list[TermWarning]:
    """What may be wrong with the last matches at the estimate."""
    warnings = wide_uncertainty(matches, values, covariance, config, config.last_px)
    left_ms = 1e3 * max(each.left_interval_s(values) for each in matches)
    if left_ms > 0.0:
        warnings.append(TermWarning(WarningKind.LEFT_INTERVAL, left_ms, 0.0, "ms"))
    without = sum(each.factor is None for each in matches)
    if without > 0.5 * len(matches):
        warnings.append(TermWarning(WarningKind.NO_MATCHES, without, 0.5 * len(matches), "terms"))
    return warnings

"""Matching again while a graph is solved: Levenberg-Marquardt, and what all solvers share.

The loop solves with frozen matches, matches again at the solution, and narrows the robust kernel
wherever a round has moved the matched points by much less than its scale (deterministic annealing, as in
robust ICP). While the kernel is wide, what the matches hardly determine is held by a *proximal* prior on
extrinsic and offset about the present estimate, whose sigmas are a kernel's width in the image: matches
inform no farther than they reach. It follows the estimate, so it adds no bias, and it is removed at the end.

The covariance of extrinsic and offset is cluster-robust (:mod:`sst_graph.slam.covariance`), and the factors
are scaled down by its mean ratio to what they claim, so that the marginals of the graph itself have the same
size.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from sst_graph.config import expect_settings
from sst_graph.errors import EstimationError, count_of
from sst_graph.factors.custom.variables import checked_problem
from sst_graph.factors.priors import time_offset_prior
from sst_graph.slam.alignment_keys import AlignmentKeys
from sst_graph.slam.alignment_term import AlignmentTerm, TermMatches, TermState
from sst_graph.slam.checked_terms import checked_terms, expect_factors_of
from sst_graph.slam.config import CALM, RematchConfig
from sst_graph.slam.covariance import (
    TermSums,
    covariance_warnings,
    fit_errors,
    inflation,
    marginal,
    robust_covariance,
    rows_of,
    total,
)
from sst_graph.slam.object_sides import ObjectSides
from sst_graph.slam.term_warnings import (
    TermWarning,
    WarningKind,
    far_from_start,
    last_warnings,
    wide_uncertainty,
)
from sst_graph.types import FloatArray

_STEP_PX = 0.1
"""At the last scale, a round that moves the matched points by less (RMS) ends the loop [px]: matches
that come and go in turn move them by a few hundredths for ever."""
_INNER_ITERATIONS = 4
"""Most Levenberg-Marquardt iterations on frozen matches: more would only be undone by the next matches."""


@dataclass(frozen=True)
class RematchSolution:
    """Where the loop ended.

    Attributes:
        values: the estimate.
        graph: the user's factors and those of the terms, with the last matches.
        matches: of each term, in their order.
        covariance: (7, 7) cluster-robust, of extrinsic and time offset; order and perturbation as
            :mod:`factors` has them; zeros for what is constant.
        rounds: rounds of matching.
        converged: the last round moved the matched points by less than 0.1 px.
        warnings: what may be wrong.
    """

    values: gtsam.Values
    graph: gtsam.NonlinearFactorGraph
    matches: tuple[TermMatches, ...]
    covariance: FloatArray
    rounds: int
    converged: bool
    warnings: tuple[TermWarning, ...]


def solve_with_terms(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    terms: Sequence[AlignmentTerm],
    config: RematchConfig | None = None,
) -> RematchSolution:
    """Levenberg-Marquardt on a graph and the terms' factors, matched again until that changes nothing.

    Args:
        graph: all other factors, priors on extrinsic and offset among them; none of an earlier solution's.
        values: start, of all variables.
        terms: of one camera.
        config: the schedule.

    Raises:
        EstimationError: no term, no match at the start, or a system that is indeterminate at the end.
        FactorError: no graph, no terms, terms of several cameras, a term given twice, no value for a key of
            either, or one of another kind.
        ConfigError: no settings.
    """
    config = expect_settings(config, RematchConfig)
    checked_terms("solve_with_terms", terms)
    lasting = [key for term in terms for key in term.keys.lasting]
    checked_problem("solve_with_terms", graph, values, lasting)
    if not terms:
        raise EstimationError("solve_with_terms: found no term, expected one or more")
    keys, kernel_px, with_proximal = terms[0].keys, config.first_px, True
    keys.check_kinds(values)
    expect_factors_of("solve_with_terms", graph, keys, ())
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(_INNER_ITERATIONS)
    matches = match_all(terms, values, kernel_px, 1.0)
    rest, alone = values, marginal(graph, values, keys)[:7, :7]
    warnings = wide_uncertainty(matches, values, alone)
    if np.isfinite(alone).all():
        # What the other factors know, wherever the given values are.
        rest = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
        alone = marginal(graph, rest, keys)[:7, :7]
    converged, rounds = False, 0
    while not converged and rounds < config.most_rounds:
        whole = with_factors(graph, matches)
        if with_proximal:
            whole.push_back(proximal(matches, values, widest_px(matches, kernel_px), keys))
        values = gtsam.LevenbergMarquardtOptimizer(whole, values, parameters).optimize()
        moved, rounds = moved_px(matches, values), rounds + 1
        calm = moved < CALM * widest_px(matches, kernel_px)
        if kernel_px > config.last_px:
            if calm:
                kernel_px = config.narrower(kernel_px)
        elif with_proximal:
            with_proximal = not calm
        else:
            converged = moved < _STEP_PX
        matches = match_all(terms, values, kernel_px, 1.0)
    # The covariance by matches that count in full; then the factors are scaled down to it.
    P, sides = marginal(with_factors(graph, matches), values, keys), ObjectSides()
    if not np.isfinite(P).all():
        found = "a graph that does not determine extrinsic and time offset"
        raise EstimationError(f"solve_with_terms: found {found}, expected priors on them")
    rows = [rows_of(each, sides, values) for each in matches]
    sums = total(TermSums.of(each, 1.0) for each in rows)
    robust = robust_covariance(P, sums, fit_errors(rows, config), keys)
    C = robust.covariance
    matches = match_all(terms, values, kernel_px, 1.0 / inflation(robust.independent, robust.clustered))
    whole = with_factors(graph, matches)
    if not converged:
        warnings.append(TermWarning(WarningKind.NOT_CONVERGED, moved, _STEP_PX, "px"))
    warnings += last_warnings(matches, values, C, config)
    warnings += far_from_start(keys, rest, values, alone)
    warnings += covariance_warnings(
        marginal(whole, values, keys)[:7, :7], robust, keys.extrinsic(values), config
    )
    return RematchSolution(values, whole, tuple(matches), C, rounds, converged, tuple(warnings))


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
        away_s = [each.pose_away_s for each in matches if each.state is TermState.NO_SCAN_POSE]
        if away_s:
            states += f": the nearest pose is {1e3 * min(away_s):.3g} ms from a scan"
        found = f"no factor in {count_of(len(terms), 'term')} ({states})"
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


def widest_px(matches: Sequence[TermMatches], kernel_px: float) -> float:
    """Widest kernel of any of the matches [px]; ``kernel_px`` where there is none."""
    return max((each.scale_px for each in matches if each.factor is not None), default=kernel_px)


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
    if isinstance(keys.time_offset_s, int):
        double = keys.keeps_double(values)
        graph.add(time_offset_prior(keys.time_offset_s, keys.offset(values), float(sigmas[6]), double=double))
    return graph

"""Do the data contradict what is assumed? The parameter of each assumption is estimated and tested.

The problem is solved again with the parameters of all assumptions as variables, from matches far away to
near ones: a wrong assumption moves matches beyond the last kernel, and they are found again where its
parameter is free. Where few objects are seen, so many parameters and wide kernels may lead to another
optimum; then it is solved from nearer matches. With those matches frozen one
linear step leads to the estimate of one parameter while all others hold, with its cluster-robust covariance.
The estimate over its deviation decides (Wald). What is contradicted most is solved for once more, alone and
from where that step leads: that solution must confirm it. One that explains less of what is in view than the
estimate does is another optimum and contradicts nothing: wide kernels lead there where few objects are seen.
A solution from the estimate itself then tells how far the parameter is open. What is not confirmed leaves the
next one to be tried.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, stdtrit

from sst_graph.assumptions import ASSUMPTIONS, Assumption
from sst_graph.batch.problem import CalibrationProblem, JointEstimate, robust_of
from sst_graph.covariance.broken_assumptions import Evidence, considered_sigmas
from sst_graph.covariance.cluster_robust import RobustCovariance, covariance_of
from sst_graph.covariance.considered import AssumptionConfig, Considered
from sst_graph.covariance.error_model import fit_error_model
from sst_graph.covariance.image_shifts import columns_by_image, shifts_of
from sst_graph.covariance.match_table import MatchTable
from sst_graph.covariance.observability import weak_directions
from sst_graph.drive.stages import stage, under
from sst_graph.errors import EstimationError
from sst_graph.graph.linear import scaled_inverse
from sst_graph.graph.outer_loop import JointSolution, explained, solve_joint
from sst_graph.graph.state import State, nuisance_key
from sst_graph.objects.tracks import ObjectId
from sst_graph.types import FloatArray, IntArray

_LOG = logging.getLogger(__name__)

_LEAST_FREEDOM = 8
"""Least degrees of freedom of Student's t: each object has several sides, and the error model has a floor."""
_FARTHEST_TAIL = 20.0
"""Threshold of which Student's t is compared with the normal distribution at most: a tail of 3e-89."""
_ALL_FREE_KERNELS_PX = (20.0, 10.0, 5.0, 3.0, 3.0, 3.0)
"""Kernel scales of the solution with all parameters free, outer iteration by outer iteration [px]. It need
not converge: the linear step to one parameter's estimate covers the rest.
"""
_NEAR_KERNELS_PX = (10.0, 7.0, 5.0, 4.0, 3.0)
"""Kernel scales of a solution that starts near its optimum [px]: with one parameter free, or with all where
the wider kernels lead to another optimum."""
_ANOTHER_OPTIMUM = 0.6
"""Share of the boundary points that the estimate explains below which a solution with more parameters free is
at another optimum. On thirteen streets it was 0.86 to 1.02 at the same one, and below 0.3 at another on two.
"""
_STAGE = "assumptions"
"""Name of this stage of a calibration."""
_MOST_AT_LAST_SCALE = 4
"""Most outer iterations at the last scale of :data:`_NEAR_KERNELS_PX` after it, with one parameter free."""


@dataclass(frozen=True)
class ParameterTest:
    """The estimate of one assumption's parameter while all other assumptions hold.

    Attributes:
        assumption: which.
        value, sigma: estimate and its deviation, in the parameter's unit.
        contradicted: whether the assumption is contradicted.
    """

    assumption: Assumption
    value: float
    sigma: float
    contradicted: bool

    @classmethod
    def of(cls, assumption: Assumption, value: float, sigma: float, threshold: float) -> ParameterTest:
        """The test of an estimate and its deviation."""
        return cls(assumption, value, sigma, assumption.contradicted_by(value, sigma, threshold))

    def __getstate__(self) -> dict[str, Any]:
        """The assumption by its name: its effect is a function, which cannot be stored."""
        return {**vars(self), "assumption": self.assumption.name}

    def __setstate__(self, state: Mapping[str, Any]) -> None:
        for name, value in {**state, "assumption": ASSUMPTIONS[state["assumption"]]}.items():
            object.__setattr__(self, name, value)

    @property
    def score(self) -> float:
        """Distance of the estimate from zero in deviations."""
        return abs(self.value) / self.sigma

    @property
    def sentence(self) -> str:
        """What it means, and what to do about it."""
        figure = self.assumption.figure(self.value, self.sigma)
        return f"{self.assumption.violation}: {figure}; {self.assumption.remedy}"


@dataclass(frozen=True)
class SolvedProblem:
    """A solved problem whose assumptions are to be tested."""

    problem: CalibrationProblem
    solution: JointSolution

    @property
    def objects(self) -> Sequence[dict[ObjectId, int]]:
        return self.problem.objects

    def solve_with(
        self, names: Sequence[str], start: State, kernels_px: tuple[float, ...], most_outer: int
    ) -> JointSolution:
        """The problem with the parameters of some assumptions as variables, their spans as priors.

        Raises:
            EstimationError: too few matches at any step.
        """
        free, centre = self.problem.joint().estimating(names), self.problem.prior_centre(self.solution.state)
        config = replace(free.config, max_outer=most_outer)
        return solve_joint(
            replace(free, config=config, centre=centre),
            start,
            kernels_px,
            under(self.problem.progress, _STAGE),
        )


FurtherTests = Callable[[CalibrationProblem, State, Sequence[ParameterTest]], tuple[ParameterTest, ...]]


def examine_assumptions(
    problem: CalibrationProblem, estimate: JointEstimate, further: FurtherTests
) -> tuple[tuple[ParameterTest, ...], Considered]:
    """Test the assumptions against the data, and consider in the covariance what the data leave open.

    Args:
        further: tests by other data than the matches, beside the tests by these, asked where these contradict
            nothing and leave no direction open: else the result is not ok by itself. What they contradict
            counts; what they leave open is considered as the matches have it.

    Returns:
        The tests, the most contradicted first, and what the assumptions add to the covariance.
    """
    config, state = problem.config.assumptions, estimate.solution.state
    with stage(problem.progress, _STAGE):
        findings = check_assumptions(SolvedProblem(problem, estimate.solution), config)
    if config.test and not (
        any(finding.contradicted for finding in findings)
        or weak_directions(estimate.covariance[:7, :7], state.cTl, problem.config.observability)
    ):
        findings = with_further_tests(findings, further(problem, state, findings), config.threshold)
    considered = estimate.considered(config)
    return findings, with_test_results(considered, findings, untested(findings, config))


def check_assumptions(problem: SolvedProblem, config: AssumptionConfig) -> tuple[ParameterTest, ...]:
    """Test every assumption that the matches can test; the most contradicted first."""
    names = _to_be_tested(config)
    if not names:
        return ()
    try:
        linear = LinearProblem.of(problem, names)
        findings = sorted((linear.alone(name, config) for name in names), key=lambda f: -f.score)
        for finding in [each for each in findings if each.contradicted]:
            findings.remove(finding)
            alone = _solved_alone(problem, finding, linear.start_of(finding), config)
            if alone is not None and alone.contradicted:
                return (alone, *findings)
            alone = alone or _left_open(problem, finding, config)
            findings += [] if alone is None else [alone]
        return tuple(sorted(findings, key=lambda f: -f.score))
    except (EstimationError, np.linalg.LinAlgError) as error:
        _LOG.info("assumptions not tested: %s", error)
        return ()


def _to_be_tested(config: AssumptionConfig) -> list[str]:
    """Assumptions that matches can test and whose parameters are not estimated anyway."""
    estimated = dict(config.estimated)
    can_be = [name for name, each in ASSUMPTIONS.items() if each.by_matches and name not in estimated]
    return can_be if config.test else []


def untested(findings: Sequence[ParameterTest], config: AssumptionConfig) -> tuple[str, ...]:
    """Assumptions that were to be tested and could not be: with their parameters free there are too few
    matches, or another optimum."""
    tested = {each.assumption.name for each in findings}
    return tuple(name for name in _to_be_tested(config) if name not in tested)


def untested_remark(names: Sequence[str]) -> tuple[str, ...]:
    """The remark about assumptions that could not be tested; none where all were."""
    if not names:
        return ()
    which = ", ".join(names)
    return (f"no test of {which} by these matches: considered as where nobody has checked the set-up",)


@dataclass(frozen=True)
class LinearProblem:
    """The problem with many parameters free, linear about its optimum.

    Attributes:
        robust: its matches and their information, priors included.
        values: of the free parameters at the optimum, by name.
        state: the optimum.
        by_image: derivatives of the residuals by shifts of their image, and its number.
    """

    robust: RobustCovariance
    values: dict[str, float]
    state: State
    by_image: tuple[FloatArray, IntArray]

    @classmethod
    def of(cls, problem: SolvedProblem, names: Sequence[str]) -> LinearProblem:
        """The problem with these parameters free.

        Raises:
            EstimationError: too few matches, or another optimum from near matches, too.
        """
        solution = _solved_with_all(problem, names)
        robust, state = robust_of(solution, problem.objects), solution.frozen.state_at(solution.optimum)
        by_image = columns_by_image(robust.table, solution.pairs, solution.values, state)
        return cls(robust, {name: state.nuisances[name] for name in names}, state, by_image)

    @cached_property
    def information(self) -> FloatArray:
        """(n, n) of the unknowns, motion marginalised out."""
        return scaled_inverse(self.robust.bread)

    def alone(self, name: str, config: AssumptionConfig) -> ParameterTest:
        """Estimate of one parameter while the others of them are zero."""
        step, kept, bread = self._step_to(name)
        moved = self.robust.table.after(step)
        table = _centred(replace(moved, J=moved.J[:, kept]), bread)
        known = self.robust.known[np.ix_(kept, kept)]
        covariance = covariance_of(bread, table, fit_error_model(table.residuals), known=known)
        column = self.robust.unknowns.column(nuisance_key(name))
        place = int(np.searchsorted(kept, column))
        variance = float(covariance[place, place])
        sigma = _deviation(variance, bread[place], table, self.by_image, config.threshold)
        value = self.values[name] + float(step[column])
        return ParameterTest.of(ASSUMPTIONS[name], value, sigma, config.threshold)

    def start_of(self, finding: ParameterTest) -> State:
        """Predicted state of a solution with a finding's parameter alone."""
        step, _, _ = self._step_to(finding.assumption.name)
        offsets = step[6 : 6 + len(self.state.time_offsets_s)]
        return replace(
            self.state,
            cTl=self.state.cTl.compose(gtsam.Pose3.Expmap(step[:6])),
            time_offsets_s=tuple(
                float(a + b) for a, b in zip(self.state.time_offsets_s, offsets, strict=True)
            ),
            nuisances={name: value for name, value in self.state.nuisances.items() if name not in self.values}
            | {finding.assumption.name: finding.value},
        )

    def _step_to(self, name: str) -> tuple[FloatArray, NDArray[np.intp], FloatArray]:
        """Step (n,) of all unknowns to where the other parameters are zero, columns of those that stay
        unknown, and the inverse of their information.

        With the steps d_o of the others given, the rest moves by d = -Λ_dd^-1 Λ_do d_o.
        """
        unknowns = self.robust.unknowns
        columns = {each: unknowns.column(nuisance_key(each)) for each in self.values}
        fixed = np.array([column for each, column in columns.items() if each != name], dtype=np.intp)
        kept = np.setdiff1d(np.arange(unknowns.size), fixed)
        step = np.zeros(unknowns.size)
        step[fixed] = [-value for each, value in self.values.items() if each != name]
        bread = scaled_inverse(self.information[np.ix_(kept, kept)])
        step[kept] = -bread @ (self.information[np.ix_(kept, fixed)] @ step[fixed])
        return step, kept, bread


def _solved_with_all(problem: SolvedProblem, names: Sequence[str]) -> JointSolution:
    """The problem with these parameters free, at the estimate's optimum.

    Raises:
        EstimationError: too few matches, or another optimum from near matches, too.
    """
    start = problem.solution.state.with_parameters(names)
    least = _ANOTHER_OPTIMUM * explained(problem.solution)
    for kernels_px in (_ALL_FREE_KERNELS_PX, _NEAR_KERNELS_PX):
        solution = problem.solve_with(names, start, kernels_px, len(kernels_px))
        if explained(solution) >= least:
            return solution
    raise EstimationError(
        f"parameters of assumptions: found {explained(solution):.3f} of the boundary points explained with "
        f"all of them free, expected {least:.3f} or more"
    )


def _centred(table: MatchTable, bread: FloatArray) -> MatchTable:
    """Matches with the residuals of a linear fit. After a long step the sum of the scores is not zero, and
    the jackknife over objects would count that as disagreement among the objects."""
    return table.after(-bread @ (table.J.T @ (table.root_weights * table.r)))


def _solved_alone(
    problem: SolvedProblem,
    finding: ParameterTest,
    start: State,
    config: AssumptionConfig,
    least: float = 1.0,
) -> ParameterTest | None:
    """The finding from a solution with its parameter alone; None where that solution is another optimum.

    Args:
        least: share of what the estimate explains that the solution is to explain.
    """
    name = finding.assumption.name
    try:
        solution = problem.solve_with(
            (name,), start, _NEAR_KERNELS_PX, len(_NEAR_KERNELS_PX) + _MOST_AT_LAST_SCALE
        )
    except EstimationError as error:
        _LOG.info("assumption %s: %s", name, error)
        return finding
    if explained(solution) < least * explained(problem.solution):
        return None
    robust = robust_of(solution, problem.objects)
    column = robust.unknowns.column(nuisance_key(name))
    by_image = columns_by_image(robust.table, solution.pairs, solution.values, solution.state)
    value, variance = solution.state.nuisances[name], float(robust.matrix[column, column])
    sigma = _deviation(variance, robust.bread[column], robust.table, by_image, config.threshold)
    return ParameterTest.of(finding.assumption, value, sigma, config.threshold)


def _left_open(
    problem: SolvedProblem, finding: ParameterTest, config: AssumptionConfig
) -> ParameterTest | None:
    """A finding that its own solution has not confirmed, from the estimate's optimum: how far the parameter
    may be off, which contradicts nothing; None where the solution leads to another one."""
    found = _solved_alone(problem, finding, problem.solution.state, config, _ANOTHER_OPTIMUM)
    return None if found is None else replace(found, contradicted=False)


def _deviation(
    variance: float,
    bread: FloatArray,
    table: MatchTable,
    by_image: tuple[FloatArray, IntArray],
    threshold: float,
) -> float:
    """Deviation of a parameter: by the matches, by what shifts from image to image, and for few objects.

    Args:
        variance: by the matches.
        bread: (n,) the parameter's row of the inverse of the information.
        by_image: of :func:`~sst_graph.covariance.image_shifts.columns_by_image`.
    """
    by_shifts = shifts_of(table, bread[None], *by_image).covariance[0, 0]
    objects = int(table.objects.max()) + 1
    return float(np.sqrt(variance + by_shifts)) * few_objects_factor(objects, threshold)


def with_further_tests(
    tests: Sequence[ParameterTest], others: Sequence[ParameterTest], threshold: float
) -> tuple[ParameterTest, ...]:
    """Tests by matches, with those parameters that other data contradict together with them; the most
    contradicted first.

    Args:
        others: tests of the same parameters by data that do not share an error: the two are weighted by their
            variances.
    """
    found = {each.assumption.name: each for each in tests}
    for other in others:
        name = other.assumption.name
        both = [found[name], other] if name in found else [other]
        weights = np.array([each.sigma**-2.0 for each in both])
        value = float(weights @ [each.value for each in both] / weights.sum())
        sigma = float(weights.sum() ** -0.5)
        if other.assumption.contradicted_by(value, sigma, threshold):
            found[name] = ParameterTest(other.assumption, value, sigma, True)
    return tuple(sorted(found.values(), key=lambda each: -each.score))


def few_objects_factor(objects: int, threshold: float) -> float:
    """Factor on a standard deviation from few objects that keeps the rate of false alarms at a threshold.

    The errors of one object are correlated over a whole drive, so there are as many independent errors as
    objects, and the estimate over its deviation follows Student's t rather than the normal distribution
    (Cameron and Miller, A practitioner's guide to cluster-robust inference, 2015).
    """
    # The tail of a higher threshold is no number any more; its rate of false alarms is nothing.
    threshold = min(threshold, _FARTHEST_TAIL)
    tail = float(ndtr(-threshold))
    return -float(stdtrit(max(objects - 1, _LEAST_FREEDOM), tail)) / threshold


def with_test_results(
    considered: Considered, findings: Sequence[ParameterTest], untestable: Sequence[str] = ()
) -> Considered:
    """The considered assumptions, with larger deviations for parameters that the tests leave open, or that
    could not be tested."""
    evidence = {
        f.assumption.name: Evidence(
            f.value,
            f.sigma,
            considered.sigmas[f.assumption.name],
            f.assumption.span,
            f.assumption.prevalence,
        )
        for f in findings
        if f.assumption.name in considered.sigmas
    }
    for name in untestable:
        each = ASSUMPTIONS[name]
        evidence[name] = Evidence.none(considered.sigmas[name], each.span, each.prevalence)
    return replace(considered, sigmas={**considered.sigmas, **considered_sigmas(evidence)})


def contradiction_sentence(findings: Sequence[ParameterTest]) -> tuple[str, ...]:
    """The sentence about contradicted assumptions: the most likely one, then the others.

    Args:
        findings: the most contradicted first.
    """
    against = [finding for finding in findings if finding.contradicted]
    if not against:
        return ()
    others = ", ".join(f.assumption.figure(f.value, f.sigma) for f in against[1:])
    return (against[0].sentence + (f" (or, less likely: {others})" if others else ""),)


def assumption_report(considered: Considered, findings: Sequence[ParameterTest]) -> dict[str, Any]:
    """JSON-able: what each assumption adds to the covariance, and the test of it.

    By name: ``sigma``, the deviation of its parameter that is considered, ``sensitivity`` (7) of the estimate
    [rad, m, s per unit], and, where it was tested, ``estimate``, ``estimate_sigma``, ``contradicted``.
    """
    said = {finding.assumption.name: finding for finding in findings}
    report: dict[str, Any] = {}
    for name, sigma in considered.sigmas.items():
        sensitivity = considered.sensitivities[name][:7]
        report[name] = {"sigma": sigma, "sensitivity": [float(f"{value:.6g}") for value in sensitivity]}
        if name in said:
            finding = said[name]
            report[name]["estimate"] = float(f"{finding.value:.6g}")
            report[name]["estimate_sigma"] = float(f"{finding.sigma:.6g}")
            report[name]["contradicted"] = finding.contradicted
    return report


def estimated_report(robust: RobustCovariance, state: State) -> dict[str, Any]:
    """JSON-able: value and deviation of the parameters that are unknowns of an estimate, by name."""
    report = {}
    for name, value in state.nuisances.items():
        column = robust.unknowns.column(nuisance_key(name))
        report[name] = {"value": value, "sigma": float(np.sqrt(robust.matrix[column, column]))}
    return report

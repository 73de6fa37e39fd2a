"""Do the data contradict what is taken for granted? Each assumption's parameter is let free and looked at.

A score test of all of them comes first: from matches made anew under a kernel wide enough to keep those
that a wrong assumption has pushed away, one Gauss-Newton step of each parameter with all unknowns free.
Where it hints at something the whole problem is solved again with that parameter as a variable, from matches
far away to near ones, and the estimate over its cluster-robust deviation decides (Wald).
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm
from scipy.stats import t as student_t

from factors.robust import RobustKernel
from sst_graph.assumptions import ASSUMPTIONS, Assumption, named_sigmas
from sst_graph.errors import EstimationError
from sst_graph.estimators.joint import JointConfig, JointSolution, solve_joint
from sst_graph.problem.drive import Drive
from sst_graph.problem.graph import Tracks, associate, joint_graph
from sst_graph.problem.objects import ObjectId
from sst_graph.problem.state import State, nuisance_key
from sst_graph.uncertainty.assumptions import AssumptionConfig, Considered, columns_of, weighted_columns
from sst_graph.uncertainty.covariance import RobustCovariance, match_table, robust_covariance
from sst_graph.uncertainty.marginal import Unknowns, marginal_covariance

FloatArray = NDArray[np.float64]
_LOG = logging.getLogger(__name__)

_HINT_KERNEL = 5.0 / 3.0
"""Scale of the score test's kernel, in units of the last one: scales of 5, 10 and 20 px put the parameter of
a lens at two thirds of its true size alike, and the widest lets neighbouring objects in."""
_HINT_SIGMAS = 1.5
"""Score in deviations, if all matches were independent, from which the problem is solved again. They are not,
so that hints come too often rather than too seldom."""
_LEAST_FREEDOM = 8
"""Degrees of freedom that few objects have: each has several sides, and the error model a floor."""
_WIDE_PX = (20.0, 10.0, 7.0)
"""Kernel scales with which a new solve begins [px]."""


@dataclass(frozen=True)
class Finding:
    """What the data say of one assumption's parameter.

    Attributes:
        assumption: which.
        value, sigma: estimate and its deviation, in the parameter's unit.
        step: (7,) how far the answer moves when the parameter is estimated with it [rad, m, s].
        contradicted: whether the assumption is.
    """

    assumption: Assumption
    value: float
    sigma: float
    step: FloatArray
    contradicted: bool

    def __getstate__(self) -> dict[str, Any]:
        """The assumption by its name: what it does to a match is a function, which no file holds."""
        return {**vars(self), "assumption": self.assumption.name}

    def __setstate__(self, state: Mapping[str, Any]) -> None:
        for name, value in {**state, "assumption": ASSUMPTIONS[state["assumption"]]}.items():
            object.__setattr__(self, name, value)

    @property
    def sentence(self) -> str:
        """What it means, and what to do about it."""
        figure = self.assumption.figure(self.value, self.sigma)
        return f"{self.assumption.finding}: {figure}; {self.assumption.remedy}"


@dataclass(frozen=True)
class TestedProblem:
    """A solved problem whose assumptions are to be tested.

    Attributes:
        drives, tracks, objects: its data: twists and moving objects, and object tracks by drive.
        solution: its answer.
        config: what it was solved with.
        guess: what its weak priors are centred on.
    """

    drives: Sequence[Drive]
    tracks: Tracks
    objects: Sequence[dict[ObjectId, int]]
    solution: JointSolution
    config: JointConfig
    guess: State


def check_assumptions(problem: TestedProblem, config: AssumptionConfig) -> tuple[Finding, ...]:
    """What the data say of the assumptions that the score test hints at, the most contradicted first."""
    if not config.test:
        return ()
    free = dict(named_sigmas(problem.config.graph.estimate))
    names = [name for name, each in ASSUMPTIONS.items() if each.by_matches and name not in free]
    found = []
    for name, score in zip(names, scores(problem, names), strict=True):
        if abs(score) > _HINT_SIGMAS and (finding := _estimated(problem, name, config)) is not None:
            found.append(finding)
    return tuple(sorted(found, key=lambda finding: -abs(finding.value) / finding.sigma))


def scores(problem: TestedProblem, names: Sequence[str]) -> FloatArray:
    """(k,) one step of each parameter, let free alone, over its deviation if all matches were independent."""
    state = problem.solution.state
    graph_config = problem.config.graph
    kernel = RobustKernel("geman_mcclure", _HINT_KERNEL * problem.config.kernel_px[-1])
    pairs = associate(problem.drives, problem.tracks, state, kernel, graph_config)
    graph, values = joint_graph(pairs, state, graph_config, problem.guess)
    unknowns = Unknowns.of(state, pairs)
    P = marginal_covariance(graph, values, unknowns)
    table = match_table(graph, values, pairs, state, problem.objects, unknowns)
    C = weighted_columns(table, pairs, columns_of(pairs, values, state, names))
    r = table.root_weights * table.r
    # The answer moves to its optimum under this kernel, and the parameter by what is left beside it.
    JC = table.J.T @ C
    gradient = -(C.T @ r) + JC.T @ (P @ (table.J.T @ r))
    information = np.einsum("mk,mk->k", C, C) - np.einsum("nk,nk->k", JC, P @ JC)
    spans = np.array([ASSUMPTIONS[name].span for name in names])
    return np.asarray(gradient / np.sqrt(np.maximum(information, 0.0) + spans**-2.0))


def _estimated(problem: TestedProblem, name: str, config: AssumptionConfig) -> Finding | None:
    """The problem solved with one parameter as a variable; None where it cannot be."""
    assumption, before = ASSUMPTIONS[name], problem.solution.state
    narrow = tuple(scale for scale in problem.config.kernel_px if scale < _WIDE_PX[-1])
    free = replace(
        problem.config,
        kernel_px=(*_WIDE_PX, *(narrow or problem.config.kernel_px[-1:])),
        graph=replace(
            problem.config.graph, estimate=(*problem.config.graph.estimate, name)
        ),
    )
    start = replace(before, nuisances={**before.nuisances, name: 0.0})
    try:
        solution = solve_joint(problem.drives, start, free, None, problem.guess, problem.tracks)
    except EstimationError as error:
        _LOG.info("assumption %s: %s", name, error)
        return None
    robust = robust_covariance(
        solution.graph, solution.values, solution.pairs, solution.state, problem.objects
    )
    column = robust.unknowns.column(nuisance_key(name))
    value, sigma = solution.state.nuisances[name], float(np.sqrt(robust.matrix[column, column]))
    sigma *= few_objects(int(robust.table.objects.max()) + 1, config.threshold)
    step = np.append(
        np.asarray(before.cTl.logmap(solution.state.cTl)),
        solution.state.offsets_s[0] - before.offsets_s[0],
    )
    contradicted = solution.converged and abs(value) > config.threshold * sigma
    return Finding(assumption, value, sigma, step, contradicted)


def few_objects(objects: int, threshold: float) -> float:
    """By how much a deviation from few objects is to be larger for the same false alarms at a threshold.

    Errors of one object go together for a whole drive, so that there are as many of them as objects, and the
    estimate over its deviation follows Student's t rather than the normal distribution (Cameron and Miller, A
    practitioner's guide to cluster-robust inference, 2015).
    """
    tail = float(norm.sf(threshold))
    return float(student_t.isf(tail, max(objects - 1, _LEAST_FREEDOM))) / threshold


def contradiction_of(findings: Sequence[Finding]) -> tuple[str, ...]:
    """The reason that the data contradict assumptions: the most likely one, and which others would do.

    Args:
        findings: the most contradicted first.
    """
    against = [finding for finding in findings if finding.contradicted]
    if not against:
        return ()
    others = ", ".join(f.assumption.figure(f.value, f.sigma) for f in against[1:])
    return (against[0].sentence + (f" (or, less likely: {others})" if others else ""),)


def assumption_report(considered: Considered, findings: Sequence[Finding]) -> dict[str, Any]:
    """JSON-able: what each assumption adds to the covariance, and what the data say of it.

    By name: ``sigma`` of its parameter, ``sensitivity`` (7) of the answer [rad, m, s per unit], and where the
    parameter was estimated ``estimate`` and ``estimate_sigma``.
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
    """JSON-able: value and deviation of the parameters that are unknowns of an answer, by name."""
    report = {}
    for name, value in state.nuisances.items():
        column = robust.unknowns.column(nuisance_key(name))
        report[name] = {"value": value, "sigma": float(np.sqrt(robust.matrix[column, column]))}
    return report

"""Covariance of an estimate by edges.

A match with the picture's edge is soft: it follows the pose, and which edge is met is part of the estimate.
With the matches frozen a problem seems three to ten times stiffer than it is. So the problem is solved again,
and matched again, with half of the objects, in sixteen balanced ways (McCarthy, Pseudo-replication: half
samples, Review of the International Statistical Institute, 1969): the deviation of such an estimate has the
covariance of the whole one.

What all objects have in common, no choice of them shows. Of it, three parts are known: the assumptions of the
set-up, where edges lie between the beams, and upper edges that may be no outline.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import hadamard

from sst_graph.assumptions import OF_LIDAR
from sst_graph.batch.assumption_tests import (
    ParameterTest,
    assumption_report,
    estimated_report,
    with_test_results,
)
from sst_graph.batch.by_edges.optimum import NEAR_KERNELS_PX
from sst_graph.batch.by_edges.parts import thinned, with_objects, without_kind
from sst_graph.batch.by_edges.positions import considered_positions
from sst_graph.batch.problem import JointEstimate
from sst_graph.covariance.considered import AssumptionConfig
from sst_graph.covariance.shared_errors import FEWEST, SharedErrors, spread_covariance, with_estimate
from sst_graph.errors import EstimationError
from sst_graph.features.lidar_edges import Edge
from sst_graph.graph.outer_loop import JointProblem, solve_joint_steps
from sst_graph.graph.state import State, difference
from sst_graph.objects.tracks import ObjectId
from sst_graph.stepwise import Stepwise, run_to_end
from sst_graph.types import BoolArray, FloatArray

FLOOR = np.array([0.0, 0.0, 0.0, 0.01, 0.01, 0.01, 0.004])
"""(7,) sigmas that are added [rad, m, s]. That of the translation is for the 2 cm by which two real drives of
one rig differ to the left; that of the time offset for the 7 and 10 ms that they are off, under a sigma of
2.6 and 4.5 ms with 2 ms here. No part of the model explains either."""
SAMPLES = 16
"""Half-samples: the order of a Hadamard matrix."""
_POINTS_A_SCAN = 500
"""Most boundary points of a scan before half of the objects are taken: each edge keeps some."""
_STEP_SIGMAS = 0.5
"""A step shorter than this many standard deviations of the frozen problem ends a half-sample's outer loop:
they are a tenth of its own."""
FEW_OBJECTS = (
    "half of the objects has too few edges in view to calibrate with: how far the estimate may be off "
    "cannot be told; record a richer scene"
)
FEW_OUTLINES = (
    "without upper edges that may lie within an object, too few edges are in view to calibrate with: how far "
    "the estimate may be off cannot be told; record a richer scene"
)


@dataclass(frozen=True)
class EdgesCovariance:
    """The covariance of an estimate by edges.

    Attributes:
        matrix: (7, 7) of extrinsic and time offset.
        sigmas: of its parts, JSON-able.
        assumptions: what each adds, and the tests of it, as
            :func:`~sst_graph.batch.assumption_tests.assumption_report`.
        estimated: value and deviation of the parameters that are unknowns of the estimate, by name,
            JSON-able.
        reasons: why it may be too small.
        shared: what of it the other cameras on this LiDAR have, too.
        assumption_steps: (7,) step by one deviation of each assumption, by name.
    """

    matrix: FloatArray
    sigmas: Mapping[str, Any]
    assumptions: Mapping[str, Any]
    estimated: Mapping[str, Any]
    reasons: tuple[str, ...]
    shared: SharedErrors
    assumption_steps: Mapping[str, FloatArray]


def edges_covariance(
    problem: JointProblem,
    estimate: JointEstimate,
    objects: Sequence[Mapping[ObjectId, int]],
    assumptions: AssumptionConfig,
    tests: Sequence[ParameterTest] = (),
) -> EdgesCovariance:
    """The covariance of extrinsic and time offset.

    Args:
        problem: that was solved.
        objects: tracks of each drive's objects.
        tests: of assumptions; those that the data leave open widen what is considered.
    """
    solution = estimate.solution
    # 1. What differs from object to object.
    steps, parameter_steps = run_to_end(half_sample_steps(problem, solution.state, objects))
    # 2. What all of them have in common.
    open_ = [each for each in tests if not each.contradicted]
    considered = with_test_results(estimate.considered(assumptions), open_)
    positions = considered_positions(estimate, problem.config.graph)
    outlines = run_to_end(outline_steps(problem, solution.state))
    parts = {
        "matches": estimate.covariance[:7, :7],
        "objects": spread_covariance(steps),
        "assumptions": considered.covariance(7),
        "positions": positions.covariance(7),
        "shallow": np.zeros((7, 7)) if outlines is None else np.outer(outlines, outlines),
        "floor": np.diag(FLOOR**2),
    }
    total = np.asarray(sum(parts.values()), np.float64)
    sigmas = {name: np.sqrt(np.diag(part)).tolist() for name, part in parts.items()}
    by_assumption = considered.steps()
    common = {name: step for name, step in by_assumption.items() if name in OF_LIDAR}
    common |= {name: positions.step(name) for name in positions.sigmas}
    # What no part of the model explains may be the LiDAR's.
    common |= {f"floor_{axis}": step for axis, step in enumerate(np.diag(FLOOR)) if step.any()}
    if outlines is not None:
        common["shallow"] = outlines
    shared = SharedErrors(steps, common)
    sigmas |= {"samples": shared.estimated}
    report, estimated = assumption_report(considered, tests), _estimated(estimate, parameter_steps)
    reasons = few_edges(steps, outlines)
    return EdgesCovariance(total, sigmas, report, estimated, reasons, shared, by_assumption)


def _estimated(estimate: JointEstimate, steps: Mapping[str, FloatArray]) -> dict[str, Any]:
    """The parameters of an estimate, their deviations being those of frozen matches and of the steps
    (SAMPLES,) of the half-samples."""
    report = estimated_report(estimate.robust, estimate.solution.state)
    for name, entry in report.items():
        variance = float(spread_covariance(steps[name][:, None])[0, 0])
        entry["sigma"] = float(np.hypot(entry["sigma"], np.sqrt(variance)))
    return report


def few_edges(steps: FloatArray, outlines: FloatArray | None) -> tuple[str, ...]:
    """Why a covariance cannot be told.

    Args:
        steps: of the half-samples.
        outlines: step without upper edges that may be no outline, or None.
    """
    holding = {FEW_OBJECTS: with_estimate(steps).sum() < FEWEST, FEW_OUTLINES: outlines is None}
    return tuple(reason for reason, holds in holding.items() if holds)


def half_samples() -> BoolArray:
    """(SAMPLES, 2 (SAMPLES - 1)) which groups of objects each half-sample has: one of each pair, all pairs of
    groups equally often together."""
    first = hadamard(SAMPLES)[:, 1:] > 0
    return np.stack([first, ~first], axis=2).reshape(SAMPLES, -1)


def half_sample_steps(
    problem: JointProblem,
    start: State,
    objects: Sequence[Mapping[ObjectId, int]],
    enough: Callable[[Mapping[str, FloatArray]], bool] = lambda _: False,
) -> Stepwise[tuple[FloatArray, dict[str, FloatArray]]]:
    """Steps (SAMPLES, 7) from the estimate to those of the half-samples, and (SAMPLES,) of each parameter of
    an assumption; NaN where matches are too few.

    Args:
        enough: asked after each half-sample, with the parameters' steps so far: whether the others are left
            out, whose steps are NaN, too.
    """
    steps = np.full((SAMPLES, 7), np.nan)
    parameter_steps = {name: np.full(SAMPLES, np.nan) for name in start.nuisances}
    some = [thinned(drive, _POINTS_A_SCAN) for drive in problem.drives]
    for number, kept in enumerate(half_samples()):
        drives = [with_objects(*each, kept) for each in zip(some, objects, strict=True)]
        try:
            half = replace(problem, drives=drives)
            part = yield from solve_joint_steps(half, start, NEAR_KERNELS_PX, None, _STEP_SIGMAS)
        except EstimationError:
            continue
        steps[number] = difference(start, part.state)
        for name, values in parameter_steps.items():
            values[number] = part.state.nuisances[name] - start.nuisances[name]
        if enough(parameter_steps):
            break
    return steps, parameter_steps


def outline_steps(problem: JointProblem, start: State) -> Stepwise[FloatArray | None]:
    """(7,) step of the estimate where upper edges that may be no outline are left out.

    A surface that goes on in the ring above ends somewhere else than its edge is taken to be, on all objects
    the same way; whether it does, the scan does not tell. None where too few edges are left.
    """
    drives = [without_kind(drive, Edge.SHALLOW_TOP) for drive in problem.drives]
    try:
        others = replace(problem, drives=drives)
        part = yield from solve_joint_steps(others, start, NEAR_KERNELS_PX, None, _STEP_SIGMAS)
    except EstimationError:
        return None
    return difference(start, part.state)

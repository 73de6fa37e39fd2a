"""The marginal of a calibration on extrinsic and time offset, as one factor on (E, D).

The cost of a calibration (cTl, offset), in the tangent space of the linearization point:

    0.5 d' information d - vector' d + 0.5 constant,   d = [Log(cTl_0^-1 cTl), offset - time_offset_0_s]

with d (7,) = [rotation xyz rad, translation xyz m, offset s]: gtsam's ``HessianFactor`` on E (6) and D (1).
docs/reference/marginal.md describes how a C++ program rebuilds it from the JSON.
"""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np

from sst_graph.errors import EstimationError, count_of, first_line
from sst_graph.export.agreement import SIGNIFICANCE, check_agreement, check_apart
from sst_graph.factors.arguments import checked_several, checked_type, described
from sst_graph.factors.errors import FactorError
from sst_graph.graph.linear import ordering_of
from sst_graph.inspect.considered import considered_errors
from sst_graph.marginal import (
    EXTRINSIC,
    FORMAT,
    SCAN_HASHES,
    TIME_OFFSET,
    VERSION,
    CalibrationMarginal,
    Common,
    Separated,
    marginal_keys,
    own_covariance,
    read_marginal,
    separated,
    weighted_steps,
)
from sst_graph.marginal import carried as _carried
from sst_graph.marginal import inverse as _inverse
from sst_graph.result import CalibrationResult
from sst_graph.types import Calibration, FloatArray
from sst_graph.validation import checked_guess

__all__ = [
    "EXTRINSIC",
    "FORMAT",
    "TIME_OFFSET",
    "VERSION",
    "CalibrationMarginal",
    "Common",
    "common_errors",
    "fuse_graphs",
    "fuse_marginals",
    "marginal_of_graph",
    "marginal_of_result",
    "read_marginal",
]

_CONVERGED_SIGMAS, _MOST_ROUNDS = 1e-4, 20
"""The estimate fused of graphs has converged when a round moves it by less [sigma]; most rounds."""


def marginal_of_result(result: CalibrationResult) -> CalibrationMarginal:
    """The marginal of a calibration: its estimate, with the inverse of its cluster-robust covariance.

    Not the frozen graph's Hessian, which takes neighbouring matches for independent and is far too sure.
    What the result's assumptions may be wrong by is known to be common to all results of these sensors.
    A direction that the data do not determine has a large, finite sigma in the result and so next to no
    information here.

    Raises:
        EstimationError: the covariance has no inverse.
        FactorError: no result.
    """
    checked_type("result", result, CalibrationResult, "a CalibrationResult")
    information = _inverse(result.covariance, "covariance of the result")
    common = Common(common_errors(result), result.diagnostics.get(SCAN_HASHES, ()))
    return CalibrationMarginal(
        result.T_camera_lidar, result.time_offset_s, information, np.zeros(7), common=common
    )


def common_errors(result: CalibrationResult) -> dict[str, FloatArray]:
    """(7,) step of a result by one deviation of each assumption that its covariance holds, by name.

    All results of the same two sensors err by these together. Empty where the covariance does not hold them,
    such as one that a program has put in its place.

    Raises:
        FactorError: no result.
    """
    checked_type("result", result, CalibrationResult, "a CalibrationResult")
    errors = {name: sigma * sensitivity for name, (sigma, sensitivity) in considered_errors(result).items()}
    steps = {name: step for name, step in errors.items() if step.any()}
    return {} if own_covariance(result.covariance, steps) is None else steps


def marginal_of_graph(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    E_key: int = EXTRINSIC,
    D_key: int = TIME_OFFSET,
    *,
    at: Calibration | tuple[gtsam.Pose3, float] | None = None,
) -> CalibrationMarginal:
    """A graph's cost on (E, D), everything else eliminated.

    Exact to second order about its point; as sure as the graph's noise models say. Of one of the two that no
    factor is on it says nothing: its rows are zero.

    Args:
        graph, values: the problem, and where it is linearized: its optimum, as a rule.
        E_key, D_key: keys of extrinsic and time offset in it.
        at: another point to expand about, such as the fused estimate of several drives. Extrinsic and
            offset are held there, and the other variables optimised.

    Raises:
        EstimationError: the other variables are not determined even when E and D are given, or a factor
            cannot be linearized or eliminated, such as one of a constrained noise model.
        FactorError: no graph, no values, or none of E, D or another variable of the graph.
    """
    E_key, D_key = _checked_keys(graph, values, E_key, D_key)
    if at is not None:
        values = _others_at(graph, values, E_key, D_key, _point(at))
    calibration, _ = _calibration_in(values, E_key, D_key)
    try:
        linear = graph.linearize(values)
        keys = list(linear.keyVector())
        first = sorted(keys, key=lambda key: (key != E_key, key != D_key, key))
        augmented = linear.augmentedHessian(ordering_of(first))
    except (RuntimeError, ValueError) as error:
        raise EstimationError(f"graph: cannot be linearized and eliminated ({first_line(error)})") from error
    known = [*(range(6) if E_key in keys else ()), *((6,) if D_key in keys else ())]
    n = len(known)
    G, g, f = augmented[:-1, :-1], augmented[:-1, -1], float(augmented[-1, -1])
    inner = _inverse(G[n:, n:], "information of the variables to eliminate")
    coupling = G[:n, n:] @ inner
    information, vector = np.zeros((7, 7)), np.zeros(7)
    information[np.ix_(known, known)] = G[:n, :n] - coupling @ G[n:, :n]
    vector[known] = g[:n] - coupling @ g[n:]
    return CalibrationMarginal(
        calibration.cTl,
        calibration.time_offset_s,
        0.5 * (information + information.T),
        vector,
        f - float(g[n:] @ inner @ g[n:]),
    )


def _checked_keys(graph: object, values: object, E_key: int, D_key: int) -> tuple[int, int]:
    """The keys of extrinsic and time offset, if these are a graph and its values, and have them."""
    checked_type("graph", graph, gtsam.NonlinearFactorGraph, "a NonlinearFactorGraph")
    checked_type("values", values, gtsam.Values, "Values")
    assert isinstance(graph, gtsam.NonlinearFactorGraph) and isinstance(values, gtsam.Values)
    E, D = marginal_keys(E_key, D_key)
    for key in (E, D):
        if not values.exists(key):
            expected = f"one of the key {gtsam.DefaultKeyFormatter(key)}"
            raise FactorError("values", "none of extrinsic or time offset", expected)
    for key in graph.keyVector():
        if not values.exists(key):
            found = f"none of the key {gtsam.DefaultKeyFormatter(key)}"
            raise FactorError("values", found, "one of each variable of the graph")
    return E, D


def _calibration_in(values: gtsam.Values, E_key: int, D_key: int) -> tuple[Calibration, bool]:
    """Extrinsic and time offset, and whether the offset is kept as a ``double``.

    Raises:
        FactorError: variables of another kind.
    """
    E, D = (gtsam.DefaultKeyFormatter(key) for key in (E_key, D_key))
    try:
        cTl = values.atPose3(E_key)
    except RuntimeError:
        raise FactorError("values", f"a variable {E} of another kind", "a Pose3, the extrinsic") from None
    try:
        return Calibration(cTl, values.atDouble(D_key)), True
    except RuntimeError:
        pass
    try:
        (offset_s,) = values.atVector(D_key)
    except (RuntimeError, ValueError):
        expected = "a vector of one number or a double, the time offset"
        raise FactorError("values", f"a variable {D} of another kind", expected) from None
    return Calibration(cTl, float(offset_s)), False


def _point(at: Calibration | tuple[gtsam.Pose3, float]) -> Calibration:
    """An extrinsic and a time offset that are both."""
    expected = "a Calibration, or a pair of extrinsic and time offset"
    checked_type("at", at, (Calibration, tuple, list), expected)
    parts = list(at)
    if len(parts) != 2 or not isinstance(parts[0], gtsam.Pose3):
        raise FactorError("at", "no such pair", expected)
    cTl, offset_s = checked_guess(*parts)
    assert cTl is not None
    return Calibration(cTl, offset_s)


def _others_at(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    E_key: int,
    D_key: int,
    at: Calibration,
) -> gtsam.Values:
    """Values with (E, D) at a point and the others at their optimum given that."""
    cTl, time_offset_s = at
    _, double = _calibration_in(values, E_key, D_key)
    prior = gtsam.PriorFactorDouble if double else gtsam.PriorFactorVector
    offset = time_offset_s if double else np.array([time_offset_s])
    there = gtsam.Values(values)
    there.update(E_key, cTl)
    there.update(D_key, offset)
    if there.size() == 2:
        return there
    held = gtsam.NonlinearFactorGraph(graph)
    held.add(gtsam.NonlinearEqualityPose3(E_key, cTl))
    held.add(prior(D_key, offset, gtsam.noiseModel.Constrained.All(1)))
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(1e-12)
    params.setAbsoluteErrorTol(0.0)
    try:
        return gtsam.LevenbergMarquardtOptimizer(held, there, params).optimize()
    except (RuntimeError, ValueError) as error:
        raise EstimationError(f"variables to eliminate: not determined ({first_line(error)})") from error


def fuse_graphs(
    graphs: Sequence[tuple[gtsam.NonlinearFactorGraph, gtsam.Values]],
    E_key: int = EXTRINSIC,
    D_key: int = TIME_OFFSET,
    *,
    significance: float = SIGNIFICANCE,
) -> tuple[CalibrationMarginal, list[CalibrationMarginal]]:
    """Drives fused through their marginals until that equals one graph of all of them.

    Marginals taken each at its own drive's optimum miss that by some thousandths to hundredths of a sigma,
    for no drive's cost is quadratic. So every drive's marginal is taken again at the fused estimate
    (:func:`marginal_of_graph` with ``at``), and fused again, until the estimate converges. Only
    seven-vectors travel between the drives' machines.

    Args:
        graphs: each drive's own graph and its values; they share nothing but E and D.
        E_key, D_key: keys of extrinsic and time offset, the same in all.
        significance: as in :func:`fuse_marginals`. It holds for graphs whose noise models hold: one that
            takes matches which err together for independent contradicts others too easily.

    Returns:
        The fused marginal, and those of the drives about the fused estimate.

    Raises:
        ContradictionError: the drives contradict one another.
        EstimationError: a direction that no drive determines, no convergence, or two equal graphs.
        FactorError: no pairs of a graph and its values.
    """
    expected = "pairs of a NonlinearFactorGraph and its Values"
    checked_type("graphs", graphs, (list, tuple), expected)
    for pair in graphs:
        checked_type("graphs", pair, (list, tuple), expected)
        if len(pair) != 2:
            raise FactorError("graphs", count_of(len(pair), "object"), expected)
    parts = [marginal_of_graph(graph, values, E_key, D_key) for graph, values in graphs]
    fused = fuse_marginals(parts, significance=significance)
    for _ in range(_MOST_ROUNDS):
        point = fused.at
        parts = [marginal_of_graph(graph, values, E_key, D_key, at=point) for graph, values in graphs]
        fused = fuse_marginals(parts, significance=significance)
        step = fused.at.local_coordinates(point)
        if np.sqrt(step @ fused.information @ step) < _CONVERGED_SIGMAS:
            return fused, parts
    raise EstimationError(
        f"fusion of {count_of(len(graphs), 'drive')}: still moving after {_MOST_ROUNDS} rounds"
    )


def fuse_marginals(
    marginals: Sequence[CalibrationMarginal],
    *,
    names: Sequence[str] = (),
    significance: float = SIGNIFICANCE,
) -> CalibrationMarginal:
    """Several calibrations of the same pair of sensors, fused; linearized at the optimum.

    Exact where all marginals share their linearization point. Otherwise each is expanded about the common
    point by its first derivative, which holds while the points differ by little (a degree, a decimetre). By
    how much the sum of the costs at their common optimum exceeds the sum of their own minima is a
    chi-squared, and so is what each differs from the others by: both are tested. Errors that the marginals
    have in common (:class:`Common`) do not average out, and hide no contradiction.

    Args:
        names: of the marginals, for the error; numbers from 0 where none are given.
        significance: probability of an error where the marginals agree and their covariances hold; 0 fuses
            whatever is given.

    Raises:
        ContradictionError: they contradict one another; the message names the worst and its step.
        EstimationError: none given, a direction that none of them determines, one that takes information away
            (to be added with ``significance=0``), no optimum, or two of the same scans.
        FactorError: no marginals, no names, or no probability.
    """
    _check_probability(significance)
    checked_several("names", names, str, "a text", "a list of texts")
    several = "a list of CalibrationMarginal"
    checked_several("marginals", marginals, CalibrationMarginal, "a CalibrationMarginal", several)
    if not marginals:
        raise EstimationError("no marginal to fuse")
    if names and len(names) != len(marginals):
        raise EstimationError(
            f"found {count_of(len(names), 'name')}, expected {len(marginals)}, one a marginal"
        )
    if significance > 0.0:
        check_apart(marginals, names)
    fused = marginals[0]
    separate = [separated(marginal) for marginal in marginals]
    for _ in range(_MAX_ROUNDS):
        parts = [one.carried(fused.at) for one in separate]
        owns = [part.own for part in parts]
        total = CalibrationMarginal(
            fused.cTl,
            fused.time_offset_s,
            sum((own.information for own in owns), np.zeros((7, 7))),
            sum((own.vector for own in owns), np.zeros(7)),
            sum(own.constant for own in owns),
            Common({}, tuple(sorted({one for own in owns for one in own.common.scan_hashes}))),
        )
        step = total.covariance() @ total.vector
        fused = _carried(total, total.best())
        if np.sqrt(max(float(step @ total.vector), 0.0)) < _STANDSTILL_SIGMAS:
            break
    else:
        raise EstimationError(
            f"fusion of {count_of(len(marginals), 'marginal')}: still moving after {_MAX_ROUNDS} rounds"
        )
    check_agreement(parts, fused.cTl, names, significance)
    errors = weighted_steps([one.carried(fused.at) for one in separate])
    return Separated(fused, errors).together()


def _check_probability(significance: object) -> None:
    number = isinstance(significance, int | float) and not isinstance(significance, bool)
    if not (number and 0.0 <= float(significance) <= 1.0):  # type: ignore[arg-type]
        raise FactorError("significance", described(significance), "a probability from 0 to 1")


_MAX_ROUNDS, _STANDSTILL_SIGMAS = 50, 1e-6
"""Most rounds of a fusion, which ends when its optimum moves by less than so many sigmas."""

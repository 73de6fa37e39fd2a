"""What a calibration knows about extrinsic and time offset, as one factor on (E, D).

The cost of a calibration (cTl, offset), in the tangent space of the linearization point:

    0.5 d' information d - vector' d + 0.5 constant,   d = [Log(cTl_0^-1 cTl), offset - offset_0]

with d (7,) = [rotation xyz rad, translation xyz m, offset s]: gtsam's ``HessianFactor`` on E (6) and D (1).
docs/export.md tells how a C++ program rebuilds it from the JSON.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.errors import DataError, EstimationError
from sst_graph.export.agreement import SIGNIFICANCE, check_agreement
from sst_graph.input_files import MARGINAL, parse_json, read_text
from sst_graph.json_table import JsonTable, json_table
from sst_graph.result import CalibrationResult
from sst_graph.types import ByValue

FloatArray = NDArray[np.float64]

FORMAT = "sst-graph/marginal"
VERSION = 1

MAX_INFORMATION = 1e24
"""Of a sigma of 1e-12 rad, m or s."""

EXTRINSIC = int(gtsam.symbol("E", 0))
"""Default key of the extrinsic cTl (Pose3)."""
DELAY = int(gtsam.symbol("D", 0))
"""Default key of the time offset (``Vector(1)``)."""

_ORDER = ["rot_x_rad", "rot_y_rad", "rot_z_rad", "trans_x_m", "trans_y_m", "trans_z_m", "offset_s"]


@dataclass(frozen=True, eq=False)
class CalibrationMarginal(ByValue):
    """A quadratic cost on extrinsic and time offset; the equation is the module's.

    Attributes:
        cTl, offset_s: linearization point.
        information: (7, 7) symmetric, positive semi-definite.
        vector: (7,) information times the optimum's d; zero where the point is the optimum.
        constant: twice the cost at d = 0.
    """

    cTl: gtsam.Pose3
    offset_s: float
    information: FloatArray
    vector: FloatArray
    constant: float = 0.0

    def factor(self, E_key: int = EXTRINSIC, D_key: int = DELAY) -> gtsam.LinearContainerFactor:
        """The cost as a factor on the given keys; it pickles and serializes, and needs gtsam only."""
        L, g = self.information, self.vector
        hessian = gtsam.HessianFactor(
            E_key, D_key, L[:6, :6], L[:6, 6:], g[:6], L[6:, 6:], g[6:], self.constant
        )
        return gtsam.LinearContainerFactor(hessian, self.point(E_key, D_key))

    def point(self, E_key: int = EXTRINSIC, D_key: int = DELAY) -> gtsam.Values:
        """The linearization point as values."""
        values = gtsam.Values()
        values.insert(E_key, self.cTl)
        values.insert(D_key, np.array([self.offset_s]))
        return values

    def covariance(self) -> FloatArray:
        """(7, 7) inverse of the information.

        Raises:
            EstimationError: a direction that the information does not tell.
        """
        return _inverse(self.information, "information of a marginal")

    def best(self) -> tuple[gtsam.Pose3, float]:
        """cTl and offset [s] of the least cost.

        Raises:
            EstimationError: a direction that the information does not tell.
        """
        d = self.covariance() @ self.vector
        return self.cTl.retract(d[:6]), self.offset_s + float(d[6])

    def to_json(self, E_key: int = EXTRINSIC, D_key: int = DELAY) -> str:
        """The marginal as documented in docs/export.md."""
        document = {
            "format": FORMAT,
            "version": VERSION,
            "variables": [_variable("extrinsic", E_key, "Pose3", 6), _variable("offset", D_key, "Vector", 1)],
            "error": "0.5 d'*information*d - vector'*d + 0.5*constant, "
            "d = [Logmap(T0^-1 * T_camera_lidar), time_offset_s - offset0]",
            "order": _ORDER,
            "perturbation": "right, as gtsam has it: T_camera_lidar = T0 * Pose3::Expmap(d[0:6])",
            "conventions": "p_camera = T_camera_lidar * p_lidar; t_lidar = t_camera_stamp + time_offset_s",
            "linearization_point": {
                "T_camera_lidar": self.cTl.matrix().tolist(),
                "time_offset_s": self.offset_s,
            },
            "information": self.information.tolist(),
            "vector": self.vector.tolist(),
            "constant": self.constant,
            "gtsam_serialized": self.factor(E_key, D_key).serialize(),
        }
        return _dump(document)

    @staticmethod
    def from_json(text: str, place: str | Path = "marginal.json") -> CalibrationMarginal:
        """The marginal in the text of such a file; the numbers count, not the serialized factor.

        Raises:
            DataError: no such file's text.
        """
        table = json_table(parse_json(text, place, MARGINAL.name), place, FORMAT, VERSION)
        point = table.table("linearization_point")
        return CalibrationMarginal(
            point.pose("T_camera_lidar"),
            point.offset_s("time_offset_s"),
            _information(table),
            _bounded(table, "vector", table.matrix("vector", (7,))),
            float(_bounded(table, "constant", np.array(table.number("constant")))),
        )


def read_marginal(path: str | Path) -> CalibrationMarginal:
    """The marginal in a file.

    Raises:
        DataError: missing, unreadable or no such file.
    """
    return CalibrationMarginal.from_json(read_text(path, MARGINAL), path)


def _bounded(table: JsonTable, key: str, values: FloatArray) -> FloatArray:
    """Numbers that can be squared and added up."""
    if np.abs(values).max() > MAX_INFORMATION:
        place = f"{table.place}: {key}"
        raise DataError(place, f"{np.abs(values).max():.3g}", f"at most {MAX_INFORMATION:g}")
    return values


def _information(table: JsonTable) -> FloatArray:
    """(7, 7) symmetric, positive semi-definite but for rounding."""
    place = f"{table.place}: information"
    L = table.matrix("information", (7, 7))
    if np.abs(L).max() > MAX_INFORMATION:
        raise DataError(place, f"{np.abs(L).max():.3g}", f"entries of at most {MAX_INFORMATION:g}")
    diagonal = np.diag(L)
    if (diagonal < 0.0).any():
        raise DataError(place, f"{diagonal.min():.3g} on the diagonal", "at least 0")
    # Of a direction that nothing tells there is no information: rounding is measured by the largest entry.
    scale = np.sqrt(np.maximum(diagonal, 1e-12 * diagonal.max(initial=0.0) + 1e-300))
    unit = L / scale[:, None] / scale
    if (np.abs(unit - unit.T) > 1e-6).any():
        raise DataError(place, "a matrix that is not symmetric", "an information matrix")
    least = float(np.linalg.eigvalsh(unit)[0])
    if least < -1e-6:
        raise DataError(place, f"the eigenvalue {least:.3g} (scaled)", "a positive semi-definite matrix")
    return L


def marginal_of_result(result: CalibrationResult) -> CalibrationMarginal:
    """The marginal of a calibration: its estimate, with the inverse of its cluster-robust covariance.

    Not the frozen graph's Hessian, which takes neighbouring matches for independent and is far too sure.
    A direction that the data do not tell has a large, finite sigma in the result and so next to no
    information here.

    Raises:
        EstimationError: the covariance has no inverse.
    """
    information = _inverse(result.covariance, "covariance of the result")
    return CalibrationMarginal(result.T_camera_lidar, result.time_offset_s, information, np.zeros(7))


def marginal_of_graph(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    E_key: int = EXTRINSIC,
    D_key: int = DELAY,
    *,
    at: tuple[gtsam.Pose3, float] | None = None,
) -> CalibrationMarginal:
    """A graph's cost on (E, D), everything else eliminated.

    Exact to second order about its point; as sure as the graph's noise models say.

    Args:
        graph, values: the problem, and where it is linearized: its optimum, as a rule.
        E_key, D_key: keys of extrinsic and time offset in it.
        at: another point of (cTl, offset [s]) to expand about, such as the fused estimate of several
            drives. Extrinsic and offset are held there, and the other variables optimised.

    Raises:
        EstimationError: the other variables are not determined even when E and D are given.
    """
    if at is not None:
        values = _others_at(graph, values, E_key, D_key, at)
    others = [key for key in values.keys() if key not in (E_key, D_key)]  # noqa: SIM118  (gtsam, no dict)
    ordering = gtsam.Ordering()
    for key in (E_key, D_key, *others):
        ordering.push_back(key)
    linear = graph.linearize(values)
    augmented = linear.augmentedHessian(ordering)
    G, g, f = augmented[:-1, :-1], augmented[:-1, -1], float(augmented[-1, -1])
    inner = _inverse(G[7:, 7:], "information of the variables to eliminate")
    coupling = G[:7, 7:] @ inner
    information = G[:7, :7] - coupling @ G[7:, :7]
    return CalibrationMarginal(
        values.atPose3(E_key),
        float(values.atVector(D_key)[0]),
        0.5 * (information + information.T),
        g[:7] - coupling @ g[7:],
        f - float(g[7:] @ inner @ g[7:]),
    )


def _others_at(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    E_key: int,
    D_key: int,
    at: tuple[gtsam.Pose3, float],
) -> gtsam.Values:
    """Values with (E, D) at a point and the others at their optimum given that."""
    there = gtsam.Values(values)
    there.update(E_key, at[0])
    there.update(D_key, np.array([at[1]]))
    if there.size() == 2:
        return there
    held = gtsam.NonlinearFactorGraph(graph)
    held.add(gtsam.NonlinearEqualityPose3(E_key, at[0]))
    held.add(gtsam.PriorFactorVector(D_key, np.array([at[1]]), gtsam.noiseModel.Constrained.All(1)))
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(1e-12)
    params.setAbsoluteErrorTol(0.0)
    try:
        return gtsam.LevenbergMarquardtOptimizer(held, there, params).optimize()
    except RuntimeError as error:
        raise EstimationError(f"variables to eliminate: not determined ({error})") from error


def fuse_graphs(
    graphs: Sequence[tuple[gtsam.NonlinearFactorGraph, gtsam.Values]],
    E_key: int = EXTRINSIC,
    D_key: int = DELAY,
    *,
    tolerance_sigmas: float = 1e-4,
    max_rounds: int = 20,
    significance: float = SIGNIFICANCE,
) -> tuple[CalibrationMarginal, list[CalibrationMarginal]]:
    """Drives fused through their marginals until that equals one graph of all of them.

    Marginals taken each at its own drive's optimum miss that by some thousandths to hundredths of a sigma,
    for no drive's cost is quadratic. So every drive's marginal is taken anew at the fused estimate
    (:func:`marginal_of_graph` with ``at``), and fused again, until the estimate stands still. Only
    seven-vectors travel between the drives' machines.

    Args:
        graphs: each drive's own graph and its values; they share nothing but E and D.
        E_key, D_key: keys of extrinsic and time offset, the same in all.
        tolerance_sigmas: the fused estimate stands still when it moves by less [sigma].
        max_rounds: most rounds.
        significance: as in :func:`fuse_marginals`. It holds for graphs whose noise models hold: one that
            takes matches which err together for independent contradicts others too easily.

    Returns:
        The fused marginal, and those of the drives about the fused estimate.

    Raises:
        ContradictionError: the drives contradict one another.
        EstimationError: a direction that no drive tells, or no standstill.
    """
    parts = [marginal_of_graph(graph, values, E_key, D_key) for graph, values in graphs]
    fused = fuse_marginals(parts, significance=significance)
    for _ in range(max_rounds):
        point = fused.cTl, fused.offset_s
        parts = [marginal_of_graph(graph, values, E_key, D_key, at=point) for graph, values in graphs]
        fused = fuse_marginals(parts, significance=significance)
        step = np.append(fused.cTl.localCoordinates(point[0]), fused.offset_s - point[1])
        if np.sqrt(step @ fused.information @ step) < tolerance_sigmas:
            return fused, parts
    raise EstimationError(f"fusion of {len(graphs)} drives: still moving after {max_rounds} rounds")


def fuse_marginals(
    marginals: Sequence[CalibrationMarginal],
    *,
    names: Sequence[str] = (),
    significance: float = SIGNIFICANCE,
) -> CalibrationMarginal:
    """What several calibrations of the same pair of sensors know together; linearized at the optimum.

    Exact where all marginals share their linearization point. Otherwise each is carried to the common
    point by its first derivative, which holds while the points differ by little (a degree, a decimetre).
    By how much the sum of the costs at their common optimum exceeds the sum of their own minima is a
    chi-squared, and so is what each differs from the others by: both are tested.

    Args:
        names: of the marginals, for the error; numbers from 0 where none are given.
        significance: probability of an error where the marginals agree and their covariances hold; 0 fuses
            whatever is given.

    Raises:
        ContradictionError: they contradict one another; the message names the worst and its step.
        EstimationError: none given, a direction that none of them tells, or no optimum.
    """
    if not marginals:
        raise EstimationError("no marginal to fuse")
    if names and len(names) != len(marginals):
        raise EstimationError(f"found {len(names)} names, expected {len(marginals)}, one a marginal")
    fused = marginals[0]
    for _ in range(_MAX_ROUNDS):
        parts = [_carried(marginal, fused.cTl, fused.offset_s) for marginal in marginals]
        total = CalibrationMarginal(
            fused.cTl,
            fused.offset_s,
            sum((part.information for part in parts), np.zeros((7, 7))),
            sum((part.vector for part in parts), np.zeros(7)),
            sum(part.constant for part in parts),
        )
        step = total.covariance() @ total.vector
        fused = _carried(total, *total.best())
        if np.sqrt(max(float(step @ total.vector), 0.0)) < _STANDSTILL_SIGMAS:
            break
    else:
        raise EstimationError(
            f"fusion of {len(marginals)} marginals: still moving after {_MAX_ROUNDS} rounds"
        )
    check_agreement([(part.information, part.vector) for part in parts], fused.cTl, names, significance)
    return fused


_MAX_ROUNDS, _STANDSTILL_SIGMAS = 50, 1e-6
"""Most rounds of a fusion, which ends when its optimum moves by less than so many sigmas."""


def _carried(marginal: CalibrationMarginal, cTl: gtsam.Pose3, offset_s: float) -> CalibrationMarginal:
    """The same cost about another point: d_0 = shift + J d, J the derivative of Log(T0^-1 T Exp(d))."""
    J = np.eye(7)
    step, J[:6, :6] = _log(marginal.cTl.between(cTl))
    shift = np.append(step, offset_s - marginal.offset_s)
    L, g = marginal.information, marginal.vector
    constant = marginal.constant - 2.0 * float(g @ shift) + float(shift @ L @ shift)
    return CalibrationMarginal(cTl, offset_s, J.T @ L @ J, J.T @ (g - L @ shift), constant)


def _log(pose: gtsam.Pose3) -> tuple[FloatArray, FloatArray]:
    """Log of a pose and its derivative (6, 6) by a right perturbation."""
    xi = np.asarray(gtsam.Pose3.Logmap(pose))
    return xi, np.asarray(gtsam.Pose3.LogmapDerivative(xi))


def _inverse(matrix: FloatArray, what: str) -> FloatArray:
    """Inverse of a symmetric positive-definite matrix, scaled to a unit diagonal first."""
    if not len(matrix):
        return matrix
    variances = np.diag(matrix)
    if not (variances > 0.0).all():
        raise EstimationError(f"{what}: found {variances.min():.3g} on the diagonal, expected above 0")
    scale = 1.0 / np.sqrt(variances)
    values, vectors = np.linalg.eigh(matrix * np.outer(scale, scale))
    if values[0] < 1e-13:
        raise EstimationError(f"{what}: found a singular matrix ({values[0]:.1e}), expected an inverse")
    return np.asarray(((vectors / values) @ vectors.T) * np.outer(scale, scale))


def _variable(name: str, key: int, kind: str, dim: int) -> dict[str, Any]:
    """A variable's entry; the key as text, for it is past the whole numbers that a JSON double holds."""
    symbol = gtsam.Symbol(key)
    return {
        "name": name,
        "key": str(key),
        "symbol": {"character": chr(symbol.chr()), "index": symbol.index()},
        "type": kind,
        "dim": dim,
    }


def _dump(document: dict[str, Any]) -> str:
    """Strict JSON, one key a line, the rows of lists one a line."""
    lines = []
    for key, value in document.items():
        text = json.dumps(value, allow_nan=False)
        if isinstance(value, list) and isinstance(value[0], list | dict):
            rows = ",\n  ".join(json.dumps(row, allow_nan=False) for row in value)
            text = f"[\n  {rows}\n ]"
        lines.append(f" {json.dumps(key)}: {text}")
    return "{\n" + ",\n".join(lines) + "\n}\n"

"""The marginal of a calibration on extrinsic and time offset, as one quadratic cost on (E, D).

The cost of a calibration (cTl, offset), in the tangent space of the linearization point:

    0.5 d' information d - vector' d + 0.5 constant,   d = [Log(cTl_0^-1 cTl), offset - time_offset_0_s]

with d (7,) = [rotation xyz rad, translation xyz m, offset s]: gtsam's ``HessianFactor`` on E (6) and D (1).
docs/reference/marginal.md shows how a C++ program rebuilds it from the JSON.

A result errs by its own data, and by what it assumes of the sensors (a principal point, a range): with s_i
the step of its estimate by one deviation of an assumption, its covariance is C = C_own + sum s_i s_i'.
Another drive's result errs by the same assumptions. So two marginals are added by their own parts, and their
steps with the same weights: s_i = (L_1 + L_2)^-1 (L_1 s_i1 + L_2 s_i2) with L = C_own^-1. The assumptions are
considered, not estimated (Schmidt, Application of state-space methods to navigation problems, 1966).
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from sst_graph.errors import DataError, EstimationError, count_of
from sst_graph.factors.arguments import checked_array, checked_gtsam, checked_number, checked_type, described
from sst_graph.factors.custom.variables import checked_keys
from sst_graph.factors.errors import FactorError
from sst_graph.files.checked_values import checked_pose, checked_text
from sst_graph.files.json_table import JsonTable, json_table
from sst_graph.files.reading import MARGINAL, parse_json, read_text
from sst_graph.types import ByValue, Calibration, FloatArray

FORMAT = "sst-graph/marginal"
VERSION = 1

MAX_INFORMATION = 1e24
"""Of a sigma of 1e-12 rad, m or s."""

EXTRINSIC = int(gtsam.symbol("E", 0))
"""Default key of the extrinsic cTl (Pose3)."""
TIME_OFFSET = int(gtsam.symbol("D", 0))
"""Default key of the time offset (``Vector(1)``)."""

SCAN_HASHES = "scan_hashes"
"""Key of the hashes of scans in a marginal's file, and in the diagnostics of a result."""
MOST_SCAN_HASHES = 32
"""Hashes that a result keeps of its scans."""
COMMON_ERRORS = "common_errors"
"""Key of the steps by errors that a marginal has in common with others, in its file."""
_MOST_COMMON = 100
_MOST_FUSED = 1_000_000
_HASH, _HASHES = re.compile("[0-9a-f]{16}"), "texts of 16 hexadecimal digits"

_ORDER = ["rot_x_rad", "rot_y_rad", "rot_z_rad", "trans_x_m", "trans_y_m", "trans_z_m", "time_offset_s"]


@dataclass(frozen=True, eq=False)
class Common(ByValue):
    """What a marginal may have in common with others.

    Attributes:
        errors: (7,) step of its optimum by one deviation of each error that marginals of the same sensors
            have, too, by name; the information holds them.
        scan_hashes: of some of the scans behind it, by which data that are counted twice are found; empty
            where they are not known.

    Raises:
        FactorError: other types or shapes, or values NaN or inf.
    """

    errors: Mapping[str, FloatArray] = field(default_factory=dict)
    scan_hashes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        of = "of what marginals have in common"
        object.__setattr__(self, "errors", _checked_steps(f"errors {of}", self.errors))
        object.__setattr__(self, "scan_hashes", _checked_hashes(f"scan_hashes {of}", self.scan_hashes))


@dataclass(frozen=True, eq=False)
class CalibrationMarginal(ByValue):
    """A quadratic cost on extrinsic and time offset; the equation is the module's.

    Attributes:
        cTl, time_offset_s: linearization point.
        information: (7, 7) symmetric; positive semi-definite but for a part of a tracker's frames.
        vector: (7,) information times the optimum's d; zero where the point is the optimum.
        constant: twice the cost at d = 0.
        common: with others.

    Raises:
        FactorError: other types or shapes, values NaN or inf, an information that is not symmetric, or common
            errors that are larger than its covariance.
        DataError: a pose whose rotation is none.
    """

    cTl: gtsam.Pose3
    time_offset_s: float
    information: FloatArray
    vector: FloatArray
    constant: float = 0.0
    common: Common = field(default_factory=Common)

    def __post_init__(self) -> None:
        of = "of CalibrationMarginal"
        checked_gtsam(f"cTl {of}", self.cTl, gtsam.Pose3)
        checked_pose(np.asarray(self.cTl.matrix()), f"cTl {of}")
        information = checked_array(f"information {of}", self.information, (7, 7))
        if not _symmetric(_unit(information)):
            raise FactorError(f"information {of}", "a matrix that is not symmetric", "an information matrix")
        plain = {
            "time_offset_s": checked_number(f"time_offset_s {of}", self.time_offset_s),
            "information": information,
            "vector": checked_array(f"vector {of}", self.vector, (7,)),
            "constant": checked_number(f"constant {of}", self.constant),
        }
        for name, value in plain.items():
            object.__setattr__(self, name, value)
        checked_type(f"common {of}", self.common, Common, "what it has in common with others (Common)")
        errors = self.common.errors
        if errors and own_covariance(self.covariance(), errors) is None:
            raise FactorError(f"common errors {of}", "more than its covariance", "a part of it")

    def factor(self, E_key: int = EXTRINSIC, D_key: int = TIME_OFFSET) -> gtsam.LinearContainerFactor:
        """The cost as a factor on the given keys; it pickles and serializes, and needs gtsam only.

        Raises:
            FactorError: no keys, or one for both.
        """
        E_key, D_key = marginal_keys(E_key, D_key)
        L, g = self.information, self.vector
        hessian = gtsam.HessianFactor(
            E_key, D_key, L[:6, :6], L[:6, 6:], g[:6], L[6:, 6:], g[6:], self.constant
        )
        return gtsam.LinearContainerFactor(hessian, self.point(E_key, D_key))

    def point(self, E_key: int = EXTRINSIC, D_key: int = TIME_OFFSET) -> gtsam.Values:
        """The linearization point as values.

        Raises:
            FactorError: no keys, or one for both.
        """
        E_key, D_key = marginal_keys(E_key, D_key)
        values = gtsam.Values()
        values.insert(E_key, self.cTl)
        values.insert(D_key, np.array([self.time_offset_s]))
        return values

    @property
    def at(self) -> Calibration:
        """The linearization point."""
        return Calibration(self.cTl, self.time_offset_s)

    def covariance(self) -> FloatArray:
        """(7, 7) inverse of the information.

        Raises:
            EstimationError: a direction without information.
        """
        return inverse(self.information, "information of a marginal")

    def best(self) -> Calibration:
        """The extrinsic and the offset of the least cost.

        Raises:
            EstimationError: a direction without information.
        """
        return self.at.retract(self.covariance() @ self.vector)

    def plus(self, other: CalibrationMarginal) -> CalibrationMarginal:
        """Both costs together, at this one's linearization point; exact where the two share it.

        Raises:
            EstimationError: the two have errors in common, and leave a direction without information.
            FactorError: something else than a marginal.
        """
        checked_type("a marginal plus another", other, CalibrationMarginal, "a CalibrationMarginal")
        if self.common.errors or other.common.errors:
            return replace(self, **vars(separated(self).plus(separated(other)).together()))
        there = other if self.shares_point(other) else carried(other, self.at)
        return replace(
            self,
            information=self.information + there.information,
            vector=self.vector + there.vector,
            constant=self.constant + there.constant,
            common=Common({}, tuple(sorted({*self.common.scan_hashes, *other.common.scan_hashes}))),
        )

    def shares_point(self, other: CalibrationMarginal) -> bool:
        """Whether both are linearized at the very same point.

        Raises:
            FactorError: something else than a marginal.
        """
        checked_type("the other marginal", other, CalibrationMarginal, "a CalibrationMarginal")
        return self.time_offset_s == other.time_offset_s and self.cTl.equals(other.cTl, 0.0)

    def to_json(self, E_key: int = EXTRINSIC, D_key: int = TIME_OFFSET) -> str:
        """The marginal as documented in docs/reference/marginal.md.

        Raises:
            FactorError: no keys, or one for both.
        """
        E_key, D_key = marginal_keys(E_key, D_key)
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
                "time_offset_s": self.time_offset_s,
            },
            "information": self.information.tolist(),
            "vector": self.vector.tolist(),
            "constant": self.constant,
            "gtsam_serialized": self.factor(E_key, D_key).serialize(),
        }
        if self.common.scan_hashes:
            document[SCAN_HASHES] = list(self.common.scan_hashes)
        if self.common.errors:
            document[COMMON_ERRORS] = {name: step.tolist() for name, step in self.common.errors.items()}
        return _dump(document)

    @staticmethod
    def from_json(text: str, place: str | Path = "marginal.json") -> CalibrationMarginal:
        """The marginal in the text of such a file; the numbers count, not the serialized factor.

        Raises:
            DataError: no such file's text.
        """
        table = json_table(parse_json(text, place, MARGINAL.name), place, FORMAT, VERSION)
        point = table.table("linearization_point")
        without = CalibrationMarginal(
            point.pose("T_camera_lidar"),
            point.time_offset_s("time_offset_s"),
            _information(table),
            _bounded(table, "vector", table.matrix("vector", (7,))),
            float(_bounded(table, "constant", np.array(table.number("constant")))),
        )
        try:
            return replace(without, common=Common(steps_in(table), hashes_in(table)))
        except (EstimationError, FactorError) as error:
            place = f"{table.place}: {COMMON_ERRORS}"
            raise DataError(place, str(error), "steps that the information holds") from None


@dataclass(frozen=True, eq=False)
class Separated:
    """A marginal by its own data alone, and what it has in common with others apart from it.

    Attributes:
        own: the marginal without the common errors.
        errors: (7,) step of its optimum by one deviation of each of these, by name.
    """

    own: CalibrationMarginal
    errors: Mapping[str, FloatArray]

    def carried(self, to: Calibration) -> Separated:
        """Marginal and steps about another point."""
        _, J = _moved(self.own, to)
        return Separated(carried(self.own, to), _steps_there(self.errors, J))

    def plus(self, other: Separated) -> Separated:
        """Both together, at this one's point.

        Raises:
            EstimationError: errors in common, and a direction without information.
        """
        if not self.own.shares_point(other.own):
            other = other.carried(self.own.at)
        return Separated(self.own.plus(other.own), weighted_steps([self, other]))

    def covariance(self) -> FloatArray:
        """(7, 7) with the common errors.

        Raises:
            EstimationError: a direction without information.
        """
        return self.own.covariance() + self.common_covariance()

    def common_covariance(self) -> FloatArray:
        """(7, 7) of the optimum by the common errors alone."""
        return _covariance_by(self.errors)

    def together(self) -> CalibrationMarginal:
        """As one marginal, with the same optimum and the same least cost.

        Raises:
            EstimationError: errors in common, and a direction without information.
        """
        if not self.errors:
            return self.own
        information = inverse(self.covariance(), "covariance of a marginal")
        whole = _with_information(self.own, information)
        return replace(whole, common=replace(whole.common, errors=self.errors))


def separated(marginal: CalibrationMarginal) -> Separated:
    """A marginal by its own data, and its common errors apart.

    Raises:
        EstimationError: errors in common, and a direction without information.
    """
    errors = marginal.common.errors
    if not errors:
        return Separated(marginal, {})
    own = own_covariance(marginal.covariance(), errors)
    assert own is not None  # the marginal has seen to it
    information = inverse(own, "own covariance of a marginal")
    return Separated(_with_information(marginal, information), errors)


def weighted_steps(parts: Sequence[Separated]) -> dict[str, FloatArray]:
    """(7,) step of the optimum of several marginals about one point together, by each error of theirs.

    Raises:
        EstimationError: errors in common, and a direction without information.
    """
    names = dict.fromkeys(name for part in parts for name in part.errors)
    if not names:
        return {}
    covariance = inverse(sum((part.own.information for part in parts), np.zeros((7, 7))), "information")
    return {
        name: covariance
        @ sum((part.own.information @ part.errors.get(name, np.zeros(7)) for part in parts), np.zeros(7))
        for name in names
    }


def own_covariance(covariance: FloatArray, errors: Mapping[str, FloatArray]) -> FloatArray | None:
    """(7, 7) part of a covariance without common errors, or None where that is none."""
    with np.errstate(over="ignore", invalid="ignore"):
        own = covariance - _covariance_by(errors)
        unit = _scaled(own, np.diag(covariance))
    if not np.isfinite(unit).all() or np.linalg.eigvalsh(unit)[0] <= _LEAST_OWN:
        return None
    return own


_LEAST_OWN = 1e-9
"""Least share of a variance that is a marginal's own: rounding takes less."""


def _covariance_by(errors: Mapping[str, FloatArray]) -> FloatArray:
    steps = np.reshape([*errors.values()], (-1, 7))
    return np.asarray(steps.T @ steps)


def _with_information(marginal: CalibrationMarginal, information: FloatArray) -> CalibrationMarginal:
    """The cost with the same optimum and least cost, and another information; without common errors."""
    d = marginal.covariance() @ marginal.vector
    vector = information @ d
    constant = marginal.constant - float(marginal.vector @ d) + float(vector @ d)
    point = marginal.cTl, marginal.time_offset_s
    return CalibrationMarginal(*point, information, vector, constant, replace(marginal.common, errors={}))


def marginal_keys(E_key: Any, D_key: Any) -> tuple[int, int]:
    """The keys of extrinsic and time offset, if they are two.

    Raises:
        FactorError: no keys, or one for both.
    """
    E, D = checked_keys("a marginal", {"E_key": E_key, "D_key": D_key})
    return E, D


def read_marginal(path: str | Path) -> CalibrationMarginal:
    """The marginal in a file.

    Raises:
        DataError: missing, unreadable or no such file.
    """
    return CalibrationMarginal.from_json(read_text(path, MARGINAL), path)


def hashes_in(table: JsonTable) -> tuple[str, ...]:
    """The hashes of scans in a file; none in one that does not have them.

    Raises:
        DataError: something else.
    """
    found = table.sequence(SCAN_HASHES) if SCAN_HASHES in table.data else []
    if len(found) > _MOST_FUSED or not all(map(_is_hash, found)):
        raise DataError(f"{table.place}: {SCAN_HASHES}", "something else", _HASHES)
    return tuple(found)


def steps_in(table: JsonTable) -> dict[str, FloatArray]:
    """The steps by common errors in a file; none in one that does not have them.

    Raises:
        DataError: something else.
    """
    found = table.mapping(COMMON_ERRORS) if COMMON_ERRORS in table.data else {}
    if len(found) > _MOST_COMMON:
        raise DataError(
            f"{table.place}: {COMMON_ERRORS}", count_of(len(found), "step"), f"at most {_MOST_COMMON}"
        )
    inner = JsonTable(found, f"{table.place}: {COMMON_ERRORS}")
    return {checked_text(name, inner.place): inner.matrix(name, (7,)) for name in found}


def _checked_steps(what: str, value: Any) -> dict[str, FloatArray]:
    checked_type(what, value, Mapping, "steps (7,) by name")
    for name in value:
        checked_type(what, name, str, "steps (7,) by name")
    return {name: checked_array(f"{name} of {what}", step, (7,)) for name, step in value.items()}


def _checked_hashes(what: str, value: Any) -> tuple[str, ...]:
    checked_type(what, value, (tuple, list), _HASHES)
    for one in value:
        if not _is_hash(one):
            raise FactorError(what, described(one), _HASHES)
    return tuple(value)


def _is_hash(value: object) -> bool:
    return isinstance(value, str) and _HASH.fullmatch(value) is not None


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
    unit = _unit(L)
    if not _symmetric(unit):
        raise DataError(place, "a matrix that is not symmetric", "an information matrix")
    least = float(np.linalg.eigvalsh(unit)[0])
    if least < -1e-6:
        raise DataError(place, f"the eigenvalue {least:.3g} (scaled)", "a positive semi-definite matrix")
    return L


def _unit(information: FloatArray) -> FloatArray:
    """An information with a diagonal of ones, so that its entries can be compared.

    A direction may have no information: rounding is measured by the largest entry.
    """
    diagonal = np.abs(np.diag(information))
    scale = np.sqrt(np.maximum(diagonal, 1e-12 * diagonal.max(initial=0.0) + 1e-300))
    return np.asarray(information / scale[:, None] / scale)


def _symmetric(unit: FloatArray) -> bool:
    """Whether it is, but for rounding; of a difference of two informations entries beside the diagonal may
    be far above one."""
    return bool((np.abs(unit - unit.T) <= 1e-6 * np.maximum(1.0, np.abs(unit))).all())


def carried(marginal: CalibrationMarginal, to: Calibration) -> CalibrationMarginal:
    """The same cost, expanded about another point: d_0 = shift + J d, J the derivative of Log(T0^-1 T
    Exp(d)).

    The information may be of any sign, such as what a tracker adds to an earlier marginal: its entries may
    be rounding, which need not be symmetric.
    """
    shift, J = _moved(marginal, to)
    L, g = marginal.information, marginal.vector
    information = J.T @ L @ J
    information = 0.5 * (information + information.T)
    constant = marginal.constant - 2.0 * float(g @ shift) + float(shift @ L @ shift)
    common = replace(marginal.common, errors=_steps_there(marginal.common.errors, J))
    vector = J.T @ (g - L @ shift)
    return CalibrationMarginal(to.cTl, to.time_offset_s, information, vector, constant, common)


def _steps_there(errors: Mapping[str, FloatArray], J: FloatArray) -> dict[str, FloatArray]:
    """Steps about the point from which J leads."""
    if not errors:
        return {}
    there = np.linalg.solve(J, np.transpose([*errors.values()])).T
    return dict(zip(errors, np.asarray(there), strict=True))


def _moved(marginal: CalibrationMarginal, to: Calibration) -> tuple[FloatArray, FloatArray]:
    """Shift (7,) and J (7, 7) of d_0 = shift + J d, from a marginal's point to another."""
    step, J = marginal.at.local_coordinates(to), np.eye(7)
    J[:6, :6] = gtsam.Pose3.LogmapDerivative(step[:6])
    return step, J


def inverse(matrix: FloatArray, what: str) -> FloatArray:
    """Inverse of a symmetric positive-definite matrix, scaled to a unit diagonal first."""
    if not len(matrix):
        return matrix
    variances = np.diag(matrix)
    if not (variances > 0.0).all():
        raise EstimationError(f"{what}: found {variances.min():.3g} on the diagonal, expected above 0")
    with np.errstate(over="ignore", invalid="ignore"):
        unit = _scaled(matrix, variances)
    if not np.isfinite(unit).all():
        raise EstimationError(f"{what}: found entries far above those on the diagonal, expected an inverse")
    values, vectors = np.linalg.eigh(unit)
    if values[0] < 1e-13:
        raise EstimationError(f"{what}: found a singular matrix ({values[0]:.1e}), expected an inverse")
    return _scaled((vectors / values) @ vectors.T, variances)


def _scaled(matrix: FloatArray, variances: FloatArray) -> FloatArray:
    """A matrix divided by the roots of variances on both sides."""
    scale = 1.0 / np.sqrt(variances)
    return np.asarray(matrix * np.outer(scale, scale))


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

"""Information of each frame of a calibration, as stored in ``calibration.json``.

Under ``diagnostics.frame_information``, one list a quantity, one entry a frame. Ratios are relative to
the calibration with all its frames, so that they hold whatever scale its covariance has.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sst_graph.errors import DataError, printable
from sst_graph.result import CalibrationResult, FrameId
from sst_graph.types import ByValue, FloatArray

KEY = "frame_information"
"""Key in the diagnostics of a result."""

DIGITS = 4
"""Significant digits that are kept."""

MAX_NUMBER = 1e18
"""Of any quantity that is kept: information of a sigma of 1e-9 [rad, m, s], and far beyond all others."""

_ROUNDING = 6.0 * 10.0 ** (1 - DIGITS)
"""How far :data:`DIGITS` may move an eigenvalue of a (6, 6) matrix scaled to a unit diagonal: six entries of
a row, each off by half a unit of its last digit, and by as much again through the diagonal."""

_UPPER = np.triu_indices(6)
_PLACE = f"diagnostics.{KEY}"


@dataclass(frozen=True, eq=False)
class FrameInformation(ByValue):
    """What one frame adds. Order of seven: the covariance's; see :mod:`factors`.

    Attributes:
        frame: which frame.
        bits: information on extrinsic and time offset that it adds to all the other frames [bit].
        without: (7,) sigmas without this frame, over those with all.
        so_far: (7,) sigmas of the frames up to this one, over those of all.
        view: (6, 6) information of the frame by itself on the extrinsic, the offset known
            [1/rad^2, 1/(rad m), 1/m^2]; motion and the frame's own mask biases are marginalised out.
        l_twist: (6,) the LiDAR's twist at its image [rad/s, m/s].
        matches, objects: matched boundary points, and objects that they lie on.
        nearest_m: range of the nearest of them [m].
        left: share of them in the left half of the image.
    """

    frame: FrameId
    bits: float
    without: FloatArray
    so_far: FloatArray
    view: FloatArray
    l_twist: FloatArray
    matches: int
    objects: int
    nearest_m: float
    left: float

    @property
    def speed(self) -> float:
        """Speed of the LiDAR [m/s]."""
        return float(np.linalg.norm(self.l_twist[3:]))

    @property
    def turn_rate(self) -> float:
        """Rate of turn [rad/s]."""
        return float(np.linalg.norm(self.l_twist[:3]))

    @property
    def information(self) -> FloatArray:
        """(7, 7) information of the frame by itself on extrinsic and time offset."""
        return with_offset(self.view, self.l_twist)


def with_offset(view: FloatArray, l_twist: FloatArray) -> FloatArray:
    """(7, 7) information on [extrinsic, offset] of a view (6, 6) that is taken at a twist (6,).

    A static point is seen at Exp(-V tau) cTl p with V = Ad(cTl) l_twist: a later image is a pose moved
    by -l_twist a second, so that J_offset = -J_extrinsic l_twist.
    """
    H = np.hstack([np.eye(6), -np.asarray(l_twist, dtype=np.float64)[:, None]])
    return np.asarray(H.T @ view @ H)


def to_document(frames: Sequence[FrameInformation]) -> dict[str, Any]:
    """JSON-able columns, rounded to :data:`DIGITS`; a view is its upper triangle, row by row."""
    document: dict[str, Any] = {
        "drive": [frame.frame.drive for frame in frames],
        "frame": [frame.frame.frame for frame in frames],
    }
    for name in _COLUMNS:
        values = (getattr(frame, name) for frame in frames)
        document[name] = [rounded(value[_UPPER] if name == "view" else value) for value in values]
    return document


def frames_of(result: CalibrationResult) -> tuple[FrameInformation, ...]:
    """What each frame of a result added; empty where the result does not have it.

    Raises:
        DataError: the entry is there, and is not such columns.
    """
    document = result.diagnostics.get(KEY)
    return () if document is None else from_document(document)


def from_document(document: Any) -> tuple[FrameInformation, ...]:
    """The inverse of :func:`to_document`.

    Raises:
        DataError: no such columns.
    """
    if not isinstance(document, Mapping):
        raise DataError(_PLACE, type(document).__name__, "an object of columns")
    names, numbers = document.get("drive"), document.get("frame")
    if not isinstance(names, list) or not isinstance(numbers, list) or len(names) != len(numbers):
        raise DataError(_PLACE, "no matching lists 'drive' and 'frame'", "one entry a frame in each")
    n = len(names)
    columns = [_column(document, "frame", (n,))]
    for name, (shape, read) in _COLUMNS.items():
        columns.append([read(value) for value in _column(document, name, (n, *shape))])
    return tuple(
        FrameInformation(FrameId(printable(drive), int(number)), *values)
        for drive, number, *values in zip(names, *columns, strict=True)
    )


def _column(document: Mapping[str, Any], name: str, shape: tuple[int, ...]) -> Any:
    try:
        array = np.array(document[name], dtype=np.float64).reshape(shape)
    except (KeyError, TypeError, ValueError):
        raise DataError(f"{_PLACE}.{name}", "no such numbers", f"shape {shape}") from None
    if not (np.abs(array) <= MAX_NUMBER).all():
        expected = f"finite numbers of at most {MAX_NUMBER:g}"
        raise DataError(f"{_PLACE}.{name}", "a value that is not finite, or huge", expected)
    return array


def _symmetric(upper: FloatArray) -> FloatArray:
    """(6, 6) from its upper triangle; rounding may leave it a little indefinite, which is cut off.

    Raises:
        DataError: more indefinite than rounding makes it.
    """
    A = np.zeros((6, 6))
    A[_UPPER] = upper
    A = A + np.triu(A, 1).T
    place, expected = f"{_PLACE}.view", "information (positive semi-definite)"
    sigmas = np.sqrt(np.maximum(np.diag(A), 0.0))
    if (np.abs(A) > (1.0 + _ROUNDING) * np.outer(sigmas, sigmas)).any():
        raise DataError(place, "entries that their diagonal does not allow", expected)
    least = float(np.linalg.eigvalsh(unit_diagonal(A)[0])[0])
    if least < -_ROUNDING:
        raise DataError(place, f"the eigenvalue {least:.3g} (scaled to a unit diagonal)", expected)
    return positive_part(A)


def positive_part(A: FloatArray) -> FloatArray:
    """A symmetric matrix (n, n) without correlations beyond 1 and without negative eigenvalues.

    They are cut off at a unit diagonal. A direction whose diagonal is not above 0 has zeros.
    """
    unit, scale = unit_diagonal(0.5 * (A + A.T))
    values, vectors = np.linalg.eigh(unit)
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T * np.outer(scale, scale))


def unit_diagonal(A: FloatArray) -> tuple[FloatArray, FloatArray]:
    """A symmetric matrix scaled to a unit diagonal (n, n), and its scale (n,): unit * scale_i scale_j.

    Entries are bounded as those of a semi-definite matrix are: to -1 and 1, and to 0 in the row and column
    of a diagonal that is not above 0. There the scale is 0. So neither a zero nor what rounding leaves
    in its place is divided by.
    """
    diagonal = np.diag(A)
    known = diagonal > 0.0
    scale = np.sqrt(np.where(known, diagonal, 1.0))
    with np.errstate(over="ignore"):
        unit = np.clip(A / scale[:, None] / scale, -1.0, 1.0)
    return unit * np.outer(known, known), scale * known


def rounded(value: Any) -> Any:
    """A number or an array, to :data:`DIGITS`; None and whole numbers as they are."""
    if value is None or isinstance(value, int):
        return value
    return (
        float(f"{value:.{DIGITS}g}") if isinstance(value, float) else [rounded(float(one)) for one in value]
    )


_COLUMNS: Mapping[str, tuple[tuple[int, ...], Callable[[Any], Any]]] = {
    "bits": ((), float),
    "without": ((7,), np.asarray),
    "so_far": ((7,), np.asarray),
    "view": ((len(_UPPER[0]),), _symmetric),
    "l_twist": ((6,), np.asarray),
    "matches": ((), int),
    "objects": ((), int),
    "nearest_m": ((), float),
    "left": ((), float),
}
"""Attributes of a frame in the order of the class, with the shape of an entry and how it is read."""

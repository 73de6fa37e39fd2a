"""Keys of alignment terms in a graph: the trajectory's poses, extrinsic, time offset and mask biases."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import gtsam
import numpy as np

from sst_graph.errors import DataError, count_of
from sst_graph.factors import FactorError, Vector
from sst_graph.factors.arguments import (
    checked_finite,
    checked_gtsam,
    checked_number,
    checked_type,
    described,
    is_several,
    is_whole,
)
from sst_graph.factors.custom.variables import (
    Kind,
    Reader,
    body_in_lidar,
    checked_key,
    key_name,
    number_or_key,
    pose_or_key,
)
from sst_graph.types import Calibration, FloatArray, SemanticClass
from sst_graph.validation import checked_stamp

_CLASSES = tuple(SemanticClass)
POSITIONS = slice(7 + len(_CLASSES), 7 + len(_CLASSES) + 2)
"""Columns of what all edges of objects without a class may have in common: upper edges lie higher, those at
the sides farther to the right, each by one sigma of the beams' spacing."""
COLUMNS = POSITIONS.stop
"""What all terms share, in order: extrinsic (6), time offset, the mask bias of each class,
:data:`POSITIONS`."""


SAME_STAMP_NS = 2_000
"""Stamps of a scan and of its pose may differ by this [ns]: seconds as a ``double`` are good to 0.4 us in our
century, a text with six decimals to 1 us. At 30 m/s a body moves by 0.06 mm in that time."""


def bias_column(semantic_class: SemanticClass) -> int:
    """Place of a class's mask bias among :data:`COLUMNS`."""
    return 7 + _CLASSES.index(semantic_class)


class Trajectory:
    """Keys and stamps of a body's poses wTb, in the order of time; poses may be added at the end."""

    def __init__(self, keys: Iterable[int] = (), stamps_ns: Iterable[int] = ()) -> None:
        """keys: of Pose3 variables; stamps_ns: in the LiDAR's clock, rising [ns].

        Raises:
            DataError: not one rising stamp for each key.
            FactorError: no keys, no stamps.
        """
        expected = "one for each pose, in the order of time"
        for name, given in (("keys of Trajectory", keys), ("stamps_ns of Trajectory", stamps_ns)):
            if not is_several(given):
                raise FactorError(name, described(given), expected)
        self._keys: list[int] = []
        self._stamps: list[int] = []
        self._known: set[int] = set()
        keys, stamps = list(keys), list(stamps_ns)
        if len(keys) != len(stamps):
            raise DataError(
                "Trajectory",
                f"{count_of(len(keys), 'key')}, {count_of(len(stamps), 'stamp')}",
                "one stamp a key",
            )
        for key, stamp_ns in zip(keys, stamps, strict=True):
            self.append(key, stamp_ns)

    def __len__(self) -> int:
        return len(self._keys)

    def __contains__(self, key: object) -> bool:
        return key in self._known

    def append(self, key: int, stamp_ns: int) -> None:
        """Add the pose after all others.

        Raises:
            DataError: no stamp, or one that is no later than the last.
            FactorError: no key, or that of an earlier pose.
        """
        key = checked_key("Trajectory", "key", key)
        if key in self._known:
            raise FactorError("keys of Trajectory", f"{key_name(key)} twice", "distinct keys")
        stamp_ns = checked_stamp(stamp_ns, "a pose")
        if self._stamps and stamp_ns <= self._stamps[-1]:
            raise DataError("stamp of a pose", f"{stamp_ns} ns", f"a stamp after {self._stamps[-1]} ns")
        self._keys.append(key)
        self._known.add(key)
        self._stamps.append(stamp_ns)

    @property
    def keys(self) -> tuple[int, ...]:
        return tuple(self._keys)

    @property
    def stamps_ns(self) -> tuple[int, ...]:
        return tuple(self._stamps)

    def at(self, position: int) -> tuple[int, int]:
        """Key and stamp [ns] of the pose at a position, from the end where it is negative.

        Raises:
            FactorError: there is no such position.
        """
        if not (is_whole(position) and -len(self) <= position < len(self)):
            expected = f"a position among {count_of(len(self), 'pose')}"
            raise FactorError("position in the Trajectory", described(position), expected)
        return self._keys[position], self._stamps[position]

    def position(self, stamp_ns: int) -> int | None:
        """Position of the pose with this stamp, to :data:`SAME_STAMP_NS`; None where there is none.

        Raises:
            DataError: no stamp.
        """
        at = self._nearest(stamp_ns)
        return None if at is None or abs(self._stamps[at] - stamp_ns) > SAME_STAMP_NS else at

    def nearest_s(self, stamp_ns: int) -> float:
        """How far the pose nearest to a stamp lies from it [s]; inf where there is no pose.

        Raises:
            DataError: no stamp.
        """
        at = self._nearest(stamp_ns)
        return float("inf") if at is None else 1e-9 * abs(self._stamps[at] - stamp_ns)

    def _nearest(self, stamp_ns: int) -> int | None:
        stamp_ns = checked_stamp(stamp_ns, "a pose")
        after = bisect_left(self._stamps, stamp_ns)
        beside = range(max(after - 1, 0), min(after + 1, len(self)))
        return min(beside, key=lambda at: abs(self._stamps[at] - stamp_ns), default=None)

    def interval(self, true_ns: float) -> int | None:
        """Position of the pose before a time that lies between two poses; None outside of all.

        Raises:
            FactorError: no number.
        """
        true_ns = _checked_time(true_ns)
        if len(self) < 2 or not self._stamps[0] <= true_ns <= self._stamps[-1]:
            return None
        return min(bisect_right(self._stamps, true_ns) - 1, len(self) - 2)

    def outside_s(self, true_ns: float) -> float:
        """How far a time lies after the last pose (positive) or before the first (negative) [s].

        Raises:
            FactorError: no number.
        """
        true_ns = _checked_time(true_ns)
        if not self._stamps:
            return float("nan")
        late, early = true_ns - self._stamps[-1], true_ns - self._stamps[0]
        return 1e-9 * (late if late > 0.0 else min(early, 0.0))

    def twist(self, values: gtsam.Values, position: int) -> FloatArray | None:
        """(6,) mean body twist from a pose to the next [rad/s, m/s]; None where one is not in the values."""
        if not 0 <= position < len(self) - 1:
            return None
        a, b = self._keys[position : position + 2]
        if not (values.exists(a) and values.exists(b)):
            return None
        seconds = 1e-9 * (self._stamps[position + 1] - self._stamps[position])
        return np.asarray(gtsam.Pose3.Logmap(body_pose(values, a).between(body_pose(values, b)))) / seconds

    def acceleration(self, values: gtsam.Values, position: int) -> FloatArray:
        """(6,) rate of change of the body's twist at the middle of an interval, from its neighbours."""
        found = [(k, self.twist(values, k)) for k in (position - 1, position, position + 1)]
        known = [(self._middle_s(k), twist) for k, twist in found if twist is not None]
        (t_1, first), (t_2, last) = known[0], known[-1]
        return np.zeros(6) if t_2 == t_1 else (last - first) / (t_2 - t_1)

    def _middle_s(self, position: int) -> float:
        return 5e-10 * float(self._stamps[position] + self._stamps[position + 1] - 2 * self._stamps[0])


def _checked_time(true_ns: float) -> float:
    """A time [ns]: whole where it is given so, for a float has not the digits of a stamp."""
    number = checked_number("true_ns", true_ns)
    return true_ns if type(true_ns) is int else number


@dataclass(frozen=True)
class AlignmentKeys:
    """Keys of the terms of one camera in a graph.

    Attributes:
        trajectory: poses wTb of the body, one at each scan's stamp (to :data:`SAME_STAMP_NS`).
        cTl: key of the extrinsic, or a fixed pose.
        time_offset_s: key of the time offset (``Vector(1)`` or ``double``), or a fixed offset [s].
        biases_px: by class, key of its mask bias or a fixed bias [px]; none where a class is missing.
        bTl: pose of the LiDAR in the body; None where the poses are the LiDAR's own.

    Raises:
        FactorError: no trajectory, no keys, one key for two variables (classes may share a bias), or
            constants that are none.
    """

    trajectory: Trajectory
    cTl: int | gtsam.Pose3
    time_offset_s: int | float
    biases_px: Mapping[SemanticClass, int | float] = field(default_factory=dict)
    bTl: gtsam.Pose3 | None = None

    def __post_init__(self) -> None:
        place = "AlignmentKeys"
        object.__setattr__(self, "cTl", pose_or_key(place, "cTl", self.cTl))
        object.__setattr__(self, "time_offset_s", number_or_key(place, "time_offset_s", self.time_offset_s))
        checked_type("trajectory of AlignmentKeys", self.trajectory, Trajectory, "a Trajectory")
        body_in_lidar(place, self.bTl)
        expected = "a dict from SemanticClass to a key or a number"
        checked_type("biases_px of AlignmentKeys", self.biases_px, Mapping, expected)
        for c in self.biases_px:
            checked_type("biases_px of AlignmentKeys", c, SemanticClass, expected)
        biases = {c: number_or_key(place, "biases_px", bias) for c, bias in self.biases_px.items()}
        object.__setattr__(self, "biases_px", biases)
        used: dict[int, str] = {}
        given = [("cTl", self.cTl), ("time_offset_s", self.time_offset_s)]
        given += [("biases_px", key) for key in dict.fromkeys(biases.values())]
        for name, key in given:
            if not isinstance(key, int):
                continue
            other = used.get(key) or ("a pose of the trajectory" if key in self.trajectory else None)
            if other is not None:
                raise FactorError(
                    f"keys of {place}", f"{key_name(key)} for {other} and {name}", "distinct keys"
                )
            used[key] = name

    def is_same_camera(self, other: AlignmentKeys) -> bool:
        """Whether both name one extrinsic, one time offset and the same mask biases."""
        if isinstance(self.cTl, gtsam.Pose3) and isinstance(other.cTl, gtsam.Pose3):
            same_pose = self.cTl.equals(other.cTl, 0.0)
        else:
            same_pose = self.cTl == other.cTl
        offsets = self.time_offset_s, other.time_offset_s
        return (
            same_pose
            and offsets[0] == offsets[1]
            and type(offsets[0]) is type(offsets[1])
            and self.biases_px == other.biases_px
        )

    def extrinsic(self, values: gtsam.Values) -> gtsam.Pose3:
        if isinstance(self.cTl, gtsam.Pose3):
            return self.cTl
        return _pose(values, self.cTl, "cTl")

    def offset(self, values: gtsam.Values) -> float:
        return number(values, self.time_offset_s, "time_offset_s")

    def calibration(self, values: gtsam.Values) -> Calibration:
        """Extrinsic and time offset in the values."""
        return Calibration(self.extrinsic(values), self.offset(values))

    def bias(self, values: gtsam.Values, semantic_class: SemanticClass) -> float:
        return number(values, self.biases_px.get(semantic_class, 0.0), "biases_px")

    def check_kinds(self, values: gtsam.Values) -> None:
        """Nothing, where extrinsic, offset and biases are among the values, of their kinds and finite.

        Raises:
            FactorError: one is not.
        """
        self.extrinsic(values)
        self.offset(values)
        for c in self.biases_px:
            self.bias(values, c)

    @property
    def variables(self) -> tuple[int, ...]:
        """Keys of extrinsic and time offset, those of the two that are variables."""
        return tuple(key for key in (self.cTl, self.time_offset_s) if isinstance(key, int))

    @property
    def lasting(self) -> tuple[int, ...]:
        """Keys of all that no pose marginalizes: extrinsic, time offset and mask biases."""
        biases = (key for key in self.biases_px.values() if isinstance(key, int))
        return tuple(dict.fromkeys((*self.variables, *biases)))

    def placed(self, covariance: FloatArray) -> FloatArray:
        """(n, n) over :data:`COLUMNS` from the covariance of :attr:`lasting`; zeros for what is constant."""
        A = np.zeros((len(covariance), COLUMNS))
        rows = dict(zip(self.lasting, self._first_rows(), strict=True))
        if isinstance(self.cTl, int):
            A[rows[self.cTl] : rows[self.cTl] + 6, :6] = np.eye(6)
        if isinstance(self.time_offset_s, int):
            A[rows[self.time_offset_s], 6] = 1.0
        for c, key in self.biases_px.items():
            if isinstance(key, int):
                A[rows[key], bias_column(c)] = 1.0
        return np.asarray(A.T @ covariance @ A)

    def _first_rows(self) -> list[int]:
        sizes = [6 if key == self.cTl else 1 for key in self.lasting]
        return [sum(sizes[:k]) for k in range(len(sizes))]

    def keeps_double(self, values: gtsam.Values) -> bool:
        """Whether the time offset is kept as a ``double``."""
        try:
            values.atDouble(int(self.time_offset_s))
        except RuntimeError:
            return False
        return True


def number(values: gtsam.Values, key_or_value: int | float, argument: str) -> float:
    """A scalar variable, ``Vector(1)`` or ``double``, or the constant itself.

    Raises:
        FactorError: no such variable, one of another kind, NaN or inf.
    """
    if not isinstance(key_or_value, int):
        return key_or_value
    value = _read(values, key_or_value, Vector(1), argument)
    checked_finite(f"variable {key_name(key_or_value)} ({argument})", value)
    return float(value[0])


def body_pose(values: gtsam.Values, key: int) -> gtsam.Pose3:
    """A pose wTb of the trajectory.

    Raises:
        FactorError: no such variable, one of another kind, NaN or inf.
    """
    return _pose(values, key, "pose of the trajectory")


def _pose(values: gtsam.Values, key: int, argument: str) -> gtsam.Pose3:
    pose: gtsam.Pose3 = _read(values, key, gtsam.Pose3, argument)
    checked_gtsam(f"variable {key_name(key)} ({argument})", pose, gtsam.Pose3)
    return pose


def _read(values: gtsam.Values, key: int, kind: Kind, argument: str) -> Any:
    checked_type("values", values, gtsam.Values, "a gtsam.Values")
    return Reader(key, kind, "AlignmentKeys", argument).read(values)

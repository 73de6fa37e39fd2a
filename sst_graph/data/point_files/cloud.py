"""A point cloud by named fields, whatever file it came from."""

from __future__ import annotations

import io
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sst_graph.data.arrays import MAX_POINTS, check_metres
from sst_graph.data.point_times import FARTHEST_S, WITHOUT_TIMES, PointClock, seconds_after_stamp
from sst_graph.errors import DataError, count_of
from sst_graph.files.reading import FileKind

CLOUD_FILE = FileKind("a point cloud", 512 * 1024 * 1024)
MAX_POINT_BYTES = 1024
"""Of one point with all its fields."""

RINGS = ("ring", "rings", "channel", "laser_id")
"""Fields, in lower case, with the number of the laser."""
TIMES = ("time", "times", "t", "timestamp", "time_stamp", "offset_time", "time_offset", "time_offset_ns")
"""Fields with the time of a point: of Velodyne, Ouster, Hesai and RoboSense, Livox, Aeva."""
LABELS = ("label", "labels")
INTENSITIES = ("intensity", "reflectivity", "reflectance", "remission", "i")


@dataclass(frozen=True, eq=False)
class PointFields:
    """Fields of a cloud, each (n,): those that are used, others are left out.

    Attributes:
        path: the file, named in errors.
        fields: by lower-case name; x, y, z [m] always.
    """

    path: Path
    fields: Mapping[str, NDArray[Any]]

    def points(self) -> NDArray[np.float32]:
        """(n, 3) float32 [m]; those of beams without a return may be NaN.

        Raises:
            DataError: a coordinate that is no length.
        """
        with np.errstate(over="ignore"):
            points = np.stack([self.fields[name].astype(np.float32) for name in "xyz"], axis=1)
        check_metres(points, self.path)
        return points

    def rings(self) -> NDArray[np.uint16] | None:
        """Laser numbers (n,), or None where there are none, or only one.

        Raises:
            DataError: one that is no whole number of 0 to 65535.
        """
        values = self._first(RINGS)
        if values is None:
            return None
        rings = self._whole(values, 0xFFFF, "rings").astype(np.uint16)
        return None if is_constant(rings) else rings

    def intensities(self) -> NDArray[np.float32] | None:
        """Strengths of the returns (n,), or None."""
        values = self._first(INTENSITIES)
        return None if values is None else values.astype(np.float32)

    def labels(self) -> NDArray[np.uint32] | None:
        """SemanticKITTI labels (n,): class in the low, instance in the high 16 bits; or None.

        Raises:
            DataError: one that is no whole number of 32 bits.
        """
        values = self._first(LABELS)
        return None if values is None else self._whole(values, 0xFFFFFFFF, "labels").astype(np.uint32)

    def times(self) -> NDArray[Any] | None:
        """Times (n,) of the points as they are stored, in whichever unit, or None."""
        return self._first(TIMES)

    def offsets_s(
        self, stamp_ns: int, used: NDArray[np.bool_], clock: PointClock | None = None
    ) -> NDArray[np.float32] | None:
        """Times (n,) of the points after the scan's stamp [s], or None where the cloud has none.

        How they are counted: :func:`~sst_graph.data.point_times.seconds_after_stamp`.

        Args:
            used: (n,) False for points that are left out, whose times may be anything.
            clock: by which the times count; None: that of the stamp.

        Raises:
            DataError: a time more than a second from the stamp.
        """
        values = self.times()
        kept = np.flatnonzero(used)
        seconds = None if values is None else seconds_after_stamp(values[kept], stamp_ns, clock)
        if seconds is None:
            return None
        bad = kept[~(np.abs(seconds) <= FARTHEST_S)]
        if len(bad):
            times = count_of(len(bad), "time that is", "times that are")
            found = f"{times} NaN or beyond {FARTHEST_S:g} s, first at index {bad[0]}"
            expected = f"times within {FARTHEST_S:g} s of the scan's stamp {WITHOUT_TIMES}"
            raise DataError(self.path, found, expected)
        offsets_s = np.zeros(len(used), np.float32)
        offsets_s[kept] = seconds
        return offsets_s

    def _first(self, names: tuple[str, ...]) -> NDArray[Any] | None:
        return next((self.fields[name] for name in names if name in self.fields), None)

    def _whole(self, values: NDArray[Any], most: int, what: str) -> NDArray[Any]:
        """Values that are whole numbers of 0 to ``most``; floats are taken where they hold such."""
        with np.errstate(invalid="ignore"):
            good = (values >= 0) & (values <= most)
            if values.dtype.kind == "f":
                good &= values == np.floor(values)
        if not good.all():
            k = int(np.argmin(good))
            raise DataError(self.path, f"{what} {values[k]} at index {k}", f"whole numbers, 0 to {most}")
        return values


def cloud_of(path: Path, fields: Mapping[str, NDArray[Any]]) -> PointFields:
    """A cloud of the fields that are used.

    Raises:
        DataError: no x, y, z, a field of other than numbers, or fields of other lengths.
    """
    # CloudCompare puts "scalar_" before all but coordinates and colours.
    lower = {name.lower().removeprefix("scalar_"): values for name, values in fields.items()}
    missing = [name for name in "xyz" if name not in lower]
    if missing:
        named = ", ".join(sorted(fields)) or "none"
        raise DataError(path, f"no field {missing[0]} (fields: {named})", "fields x, y, z [m]")
    used = {name: lower[name] for name in ("x", "y", "z", *RINGS, *TIMES, *LABELS) if name in lower}
    count = len(lower["x"]) if lower["x"].ndim else -1
    for name in INTENSITIES:
        if name in lower and lower[name].dtype.kind in "fiu" and lower[name].shape == (count,):
            used[name] = lower[name]
    for name, values in used.items():
        if values.dtype.kind not in "fiu" or values.shape != (count,):
            found = f"{name} of {values.dtype}, shape {values.shape}"
            raise DataError(path, found, f"numbers, one a point ({count_of(count, 'point')})")
    check_count(path, count)
    return PointFields(path, used)


def is_constant(rings: NDArray[np.uint16]) -> bool:
    """Whether laser numbers (n,) of several points are all the same: drivers leave the field at 0."""
    return len(rings) > 1 and bool((rings == rings[0]).all())


def check_count(path: Path, count: int) -> None:
    """Require a number of points that a scan may have, before memory is taken.

    Raises:
        DataError: more than MAX_POINTS.
    """
    if not 0 <= count <= MAX_POINTS:
        raise DataError(path, count_of(count, "point"), f"0 to {MAX_POINTS}")


def structured_fields(records: NDArray[Any]) -> dict[str, NDArray[Any]]:
    """Fields (n,) of structured records (n,), in the machine's byte order."""
    return {
        name: np.ascontiguousarray(records[name]).astype(records.dtype[name].newbyteorder("="), copy=False)
        for name in records.dtype.names or ()
        if records.dtype[name].shape == ()
    }


def text_records(body: bytes, dtype: np.dtype[Any], count: int, path: Path) -> NDArray[Any]:
    """``count`` records of ``dtype`` in as many lines; NaN and inf are numbers.

    Raises:
        DataError: other lines, or fewer.
    """
    if count == 0:
        return np.zeros(0, dtype)
    found = body.count(b"\n") + (not body.endswith(b"\n"))
    if found < count:
        raise DataError(path, f"{count_of(found, 'line')} of points", f"{count}")
    lines = body.split(b"\n", count)[:count]
    flat = np.dtype(
        [(f"{k}", part) for k, part in enumerate(_parts(dtype))]
    )  # loadtxt counts a field of several values as one
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of a body without lines
            text = io.StringIO(b"\n".join(lines).decode("ascii"))
            records = np.loadtxt(text, flat, comments=None, ndmin=1)
    except (ValueError, OverflowError) as error:
        line = (str(error).splitlines() or ["?"])[0]
        raise DataError(
            path,
            f"points that are no numbers ({line})",
            f"{count_of(len(flat.names or ()), 'number')} a line",
        ) from None
    if len(records) != count:
        raise DataError(path, f"{count_of(len(records), 'line')} of points", f"{count}")
    return np.frombuffer(np.ascontiguousarray(records).tobytes(), dtype, count)


def _parts(dtype: np.dtype[Any]) -> list[np.dtype[Any]]:
    """Types of the values of a record, in turn."""
    parts: list[np.dtype[Any]] = []
    for name in dtype.names or ():
        field = dtype[name]
        parts += [field.base] * (field.itemsize // field.base.itemsize)
    return parts

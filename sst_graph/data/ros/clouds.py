"""Points, laser numbers, times and labels of sensor_msgs/PointCloud2, and of Livox's CustomMsg."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sst_graph.data.arrays import MAX_POINTS, are_returns
from sst_graph.data.point_files.cloud import INTENSITIES, RINGS, TIMES, is_constant
from sst_graph.data.point_times import FARTHEST_S, WITHOUT_TIMES, PointClock, seconds_after_stamp
from sst_graph.errors import DataError, count_of
from sst_graph.validation import FARTHEST_M

POINT_FIELD_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""NumPy's names of sensor_msgs/PointField datatypes."""


@dataclass(frozen=True)
class MessagePoints:
    """Points of a message; those that are NaN, inf or at the origin are left out.

    Attributes:
        points: (n, 3) float32, frame of the LiDAR [m].
        rings: (n,) uint16 laser number, or None.
        offsets_s: (n,) float32 time after the header's stamp [s], or None.
        labels: (n,) uint32 as SemanticKITTI has them, instance in the high 16 bits, or None.
        left_out: number of points left out.
        intensities: (n,) float32 strength of the return, in the driver's unit, or None.
    """

    points: NDArray[np.float32]
    rings: NDArray[np.uint16] | None
    offsets_s: NDArray[np.float32] | None
    labels: NDArray[np.uint32] | None
    left_out: int
    intensities: NDArray[np.float32] | None = None


def cloud_of(
    message: Any,
    stamp_ns: int,
    place: str,
    times: bool = True,
    labels: bool = False,
    clock: PointClock | None = None,
) -> MessagePoints:
    """The cloud of a message.

    Args:
        message: a PointCloud2, or the points of a CustomMsg (n,) by field.
        stamp_ns: the header's stamp.
        times: read the times of the points, where the message has them.
        labels: read the fields ``label`` and ``instance``, where the message has them.
        clock: by which the times count; None: that of the stamp.

    Raises:
        DataError: no x, y, z; fewer bytes than points; times that are no times of this scan.
    """
    # What has no value as a float of 32 bits becomes inf, and is left out.
    with np.errstate(over="ignore", invalid="ignore"):
        table, points, left_out = _used(message, place)
        if len(points) and float(np.abs(points).max()) > FARTHEST_M:
            found = f"a coordinate of {float(np.abs(points).max()):.3g} m"
            raise DataError(place, found, f"at most {FARTHEST_M:g} m")
        return MessagePoints(
            points,
            _rings(table),
            _offsets(table, stamp_ns, place, clock) if times else None,
            _labels(table) if labels else None,
            left_out,
            _intensities(table),
        )


def times_of(message: Any, place: str) -> NDArray[Any] | None:
    """Times (n,) of the points as they are stored, in whichever unit; None where the message has none.

    Raises:
        DataError: as :func:`cloud_of`.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        table, _, _ = _used(message, place)
    name = _field_of_times(table)
    return None if name is None else np.asarray(table[name])


def field_names(message: Any) -> tuple[str, ...]:
    """Names of all fields of a message, whether they are understood or not."""
    if isinstance(message, np.ndarray):
        return message.dtype.names or ()
    return tuple(str(field.name) for field in message.fields)


def _used(message: Any, place: str) -> tuple[NDArray[Any], NDArray[np.float32], int]:
    """Rows and coordinates (n, 3) of the points that are used, and how many are left out."""
    table = message if isinstance(message, np.ndarray) else _table(message, place)
    points = np.stack([np.asarray(table[axis], np.float64) for axis in "xyz"], axis=1).astype(np.float32)
    used = are_returns(points)
    return table[used], np.ascontiguousarray(points[used]), int(len(used) - used.sum())


def _table(message: Any, place: str) -> NDArray[Any]:
    """The points as a table (n,) of columns, named in lower case."""
    fields: dict[str, Any] = {}
    for field in message.fields:
        if int(field.datatype) in POINT_FIELD_TYPES and field.name:
            fields.setdefault(field.name.lower(), field)
    if missing := [axis for axis in "xyz" if axis not in fields]:
        found = f"fields {', '.join(fields) or 'none'} without {', '.join(missing)}"
        raise DataError(place, found, "a cloud with x, y, z")
    order, step = ">" if message.is_bigendian else "<", int(message.point_step)
    width, height, row = int(message.width), int(message.height), int(message.row_step)
    ends = [
        field.offset + np.dtype(POINT_FIELD_TYPES[int(field.datatype)]).itemsize for field in fields.values()
    ]
    if step < max(ends) or not 0 <= width * height <= MAX_POINTS:
        found = f"{width}x{height} points of {step} bytes"
        raise DataError(place, found, f"at least {max(ends)} bytes a point, at most {MAX_POINTS} points")
    row = max(row, width * step) if height > 1 else width * step
    data = np.asarray(message.data, np.uint8)
    if len(data) < row * (height - 1) + width * step:
        raise DataError(
            place, count_of(len(data), "byte"), f"{width}x{height} points of {count_of(step, 'byte')}"
        )
    if row == width * step:
        packed = np.ascontiguousarray(data[: height * row])
    else:
        padded = np.zeros(row * height, np.uint8)
        padded[: min(len(data), len(padded))] = data[: len(padded)]
        packed = np.ascontiguousarray(padded.reshape(height, row)[:, : width * step])
    table = np.dtype(
        {
            "names": list(fields),
            "formats": [order + POINT_FIELD_TYPES[int(field.datatype)] for field in fields.values()],
            "offsets": [int(field.offset) for field in fields.values()],
            "itemsize": step,
        }
    )
    return np.asarray(packed.reshape(-1).view(table))


def _names(table: NDArray[Any]) -> tuple[str, ...]:
    return table.dtype.names or ()


def _rings(table: NDArray[Any]) -> NDArray[np.uint16] | None:
    """Laser numbers, if there are several; floats are taken where they hold such."""
    for name in RINGS:
        values = table[name] if name in _names(table) else None
        if values is not None and (values == values.astype(np.uint16)).all():
            rings = values.astype(np.uint16)
            return None if is_constant(rings) else rings
    return None


def _intensities(table: NDArray[Any]) -> NDArray[np.float32] | None:
    name = next((name for name in INTENSITIES if name in _names(table)), None)
    return None if name is None else np.asarray(table[name]).astype(np.float32)


def _field_of_times(table: NDArray[Any]) -> str | None:
    return next((name for name in TIMES if name in _names(table)), None)


def _offsets(
    table: NDArray[Any], stamp_ns: int, place: str, clock: PointClock | None
) -> NDArray[np.float32] | None:
    """Times after the stamp [s]."""
    name = _field_of_times(table)
    seconds = None if name is None else seconds_after_stamp(table[name], stamp_ns, clock)
    if seconds is None:
        return None
    worst = float(np.abs(seconds).max())
    if not worst <= FARTHEST_S:
        found = f"field {name!r} with times up to {worst:.6g} s from the header's stamp"
        expected = f"times within {FARTHEST_S:g} s of it {WITHOUT_TIMES}"
        raise DataError(place, found, expected)
    return seconds.astype(np.float32)


def _labels(table: NDArray[Any]) -> NDArray[np.uint32] | None:
    if "label" not in _names(table) or table["label"].dtype.kind not in "iu":
        return None
    labels = table["label"].astype(np.uint32)
    if "instance" in _names(table) and table["instance"].dtype.kind in "iu":
        labels = (labels & np.uint32(0xFFFF)) | (table["instance"].astype(np.uint32) << np.uint32(16))
    return labels

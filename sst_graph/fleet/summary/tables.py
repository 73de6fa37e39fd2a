"""The summary of a batch as tables: CSV always, Parquet where pyarrow is installed (extra ``fleet``)."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Mapping, Sequence
from typing import Any

import gtsam
import numpy as np

from sst_graph.fleet.drives import ListedDrive
from sst_graph.fleet.record import Record
from sst_graph.fleet.vehicles.fused import COUNTED, Vehicle
from sst_graph.inspect.inspection import HUMAN

Row = dict[str, str | int | float | None]

_SIGMAS = (
    "sigma_rot_x_deg",
    "sigma_rot_y_deg",
    "sigma_rot_z_deg",
    "sigma_trans_x_cm",
    "sigma_trans_y_cm",
    "sigma_trans_z_cm",
    "sigma_time_offset_ms",
)
_POSE = ("trans_x_m", "trans_y_m", "trans_z_m", "quat_x", "quat_y", "quat_z", "quat_w")


def drive_rows(
    drives: Sequence[ListedDrive], records: Mapping[str, Record], vehicles: Sequence[Vehicle], report: str
) -> list[Row]:
    """A row a drive, what needs attention first.

    Args:
        report: name of the report in a result's folder.
    """
    contradicting = {
        name: (one.name, finding) for one in vehicles for name, finding in one.contradicting.items()
    }
    left_out = {name: (one.name, why) for one in vehicles for name, why in one.without.items()}
    rows: list[tuple[tuple[int, float, str], Row]] = []
    for drive in drives:
        record = records.get(drive.name) or Record(drive.name, drive.place.url, "not_run", "not run")
        reason, rank = record.reason, float(record.attention)
        if drive.name in contradicting:
            vehicle, finding = contradicting[drive.name]
            against = f"contradicts the other drives of {vehicle}: {finding.words}"
            reason, rank = f"{against}; {reason}" if reason else against, min(rank, 6.5)
        elif drive.name in left_out and record.status in COUNTED:
            vehicle, why = left_out[drive.name]
            against = f"not counted for {vehicle}: {why}"
            reason, rank = f"{against}; {reason}" if reason else against, min(rank, 6.5)
        numbers = record.numbers
        sigmas = None if numbers is None else numbers.sigmas * HUMAN
        row: Row = {
            "drive": drive.name,
            "vehicle": drive.vehicle,
            "date": drive.date,
            "status": record.status,
            "reason": reason,
            "contradicts": drive.name in contradicting,
            "report": f"drives/{drive.name}/{report}" if record.has_result else "",
            **_pose(None if numbers is None else np.array(numbers.T_camera_lidar)),
            "time_offset_s": None if numbers is None else numbers.time_offset_s,
            **dict(zip(_SIGMAS, [None] * 7 if sigmas is None else map(float, sigmas), strict=True)),
            "frames": None if numbers is None else numbers.frames,
            "place": drive.place.url,
            "attempts": record.cost.attempts,
            "wall_s": round(record.cost.wall_s, 3),
            "cpu_s": round(record.cost.cpu_s, 3),
            "peak_mb": round(record.cost.peak_bytes / 1e6, 1),
            "input_mb": round(record.cost.input_bytes / 1e6, 3),
        }
        size = 0.0 if sigmas is None else float(np.max(sigmas / np.array([0.1] * 3 + [1.0] * 3 + [1.0])))
        rows.append(((rank, -size, drive.name), row))  # type: ignore[arg-type]
    return [row for _, row in sorted(rows, key=lambda one: one[0])]


def own_reason(row: Row) -> str:
    """The reason of a drive's own result, without what it is beside others of its vehicle."""
    vehicle = re.escape(str(row["vehicle"]))
    beside = rf"^(?:contradicts the other drives of|not counted for) {vehicle}: [^;]*(?:; |$)"
    return re.sub(beside, "", str(row["reason"]))


def vehicle_rows(vehicles: Sequence[Vehicle]) -> list[Row]:
    """A row a vehicle, what needs attention first."""
    order = ("changed", "contradicted", "no_result", "unobservable", "ok")
    rows: list[Row] = []
    for one in sorted(vehicles, key=lambda each: (order.index(each.status), each.name)):
        now = one.calibration
        sigmas = [None] * 7 if now is None else map(float, np.sqrt(np.diag(now.covariance)) * HUMAN)
        rows.append(
            {
                "vehicle": one.name,
                "status": one.status,
                "reason": one.reason,
                "drives": len(one.drives),
                "changes": len(one.changes),
                "contradicting": len(one.contradicting),
                "without": len(one.without),
                **_pose(None if now is None else np.asarray(now.cTl.matrix())),
                "time_offset_s": None if now is None else now.time_offset_s,
                **dict(zip(_SIGMAS, sigmas, strict=True)),
            }
        )
    return rows


def _pose(T: Any) -> Row:
    if T is None:
        return dict.fromkeys(_POSE)
    q: Any = gtsam.Pose3(T).rotation().toQuaternion()
    return dict(zip(_POSE, map(float, (*T[:3, 3], q.x(), q.y(), q.z(), q.w())), strict=True))


def csv_bytes(rows: Sequence[Row]) -> bytes:
    """Rows as CSV in UTF-8; empty where there is no row."""
    stream = io.StringIO()
    if rows:
        writer = csv.DictWriter(stream, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows({name: _cell(value) for name, value in row.items()} for row in rows)
    return stream.getvalue().encode("utf-8", "backslashreplace")


def _cell(value: str | int | float | None) -> str | int | float | None:
    """A cell that a spreadsheet takes for text where it is text: no formula."""
    if isinstance(value, str) and value[:1] in ("=", "+", "-", "@", "\t", "\r"):
        return "'" + value
    return value


def parquet_bytes(rows: Sequence[Row]) -> bytes | None:
    """Rows as Parquet, or None where pyarrow is not installed or there is no row.

    A column without any value counts as one of numbers.
    """
    if not rows:
        return None
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        return None
    columns = {}
    for name in rows[0]:
        cells = [row[name] for row in rows]
        kinds = {type(cell) for cell in cells if cell is not None}
        if kinds <= {float} or (kinds <= {float, int} and float in kinds):
            columns[name] = pyarrow.array(cells, pyarrow.float64())
        else:
            columns[name] = pyarrow.array(cells)
    sink = pyarrow.BufferOutputStream()
    pyarrow.parquet.write_table(pyarrow.table(columns), sink)
    return bytes(sink.getvalue().to_pybytes())

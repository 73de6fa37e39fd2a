"""Records of camera and LiDAR: calibration.json, marginals, OpenCV's matrices, nuScenes' sensors."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from sst_graph.data.nuscenes.tables import pose_of
from sst_graph.errors import DataError, count_of
from sst_graph.files.checked_values import checked_pose, checked_time_offset_s
from sst_graph.files.json_table import JsonTable
from sst_graph.files.yaml_file import number, numbers
from sst_graph.imports.document import Document
from sst_graph.imports.frames import Found, ImportOptions, is_of_camera
from sst_graph.marginal import CalibrationMarginal
from sst_graph.result import FORMAT as RESULT_FORMAT
from sst_graph.result import UNNAMED_CAMERA, CalibrationResult

Table = Mapping[str, Any]
VEHICLE_FORMAT = "sst-graph/vehicle"
"""Of the file that a batch writes of a vehicle."""
_MOST_RADIANS = 100.0
"""Length of a rotation vector; what is longer is of another unit."""


def read_own(document: Document, options: ImportOptions) -> Found:
    """A JSON object with ``T_camera_lidar``, and where it is known ``time_offset_s`` and ``camera``; or a
    vehicle's, which has these at its last drive. One that says that it is a result is checked as a whole.

    Raises:
        DataError: another camera than the one asked for, no pose, no time offset; a damaged result.
    """
    table, taken = JsonTable(document.json, str(document.path)), "as it is"
    _check_camera(table.data.get("camera"), options.camera, document.path)
    if table.data.get("format") == RESULT_FORMAT:
        result = CalibrationResult.from_json(document.text, document.path)
        return Found(result.T_camera_lidar, result.time_offset_s, taken)
    if table.data.get("format") == VEHICLE_FORMAT:
        if table.data.get("calibration") is None:
            raise DataError(document.path, "a vehicle without a calibration", "one with a drive that counts")
        table = table.table("calibration")
        taken = f"the vehicle's, at its drive {table.text('drive')}"
    known = table.data.get("time_offset_s") is not None
    time_offset_s = table.time_offset_s("time_offset_s") if known else None
    return Found(table.pose("T_camera_lidar"), time_offset_s, taken)


def _check_camera(found: object, camera: str | None, path: Path) -> None:
    """Refuse a file that says it is of another camera; a file that names none is taken as it is."""
    name = found.get("name") if isinstance(found, dict) else found
    if camera is None or not isinstance(name, str):
        return
    if name != camera and UNNAMED_CAMERA not in (name, camera):
        raise DataError(path, f"a calibration of camera {name:.60}", f"one of {camera}")


def read_gtsam(document: Document, options: ImportOptions) -> Found:
    """The optimum of a marginal on (E, D).

    Raises:
        DataError: no marginal.
        EstimationError: a marginal that leaves a direction open.
    """
    best = CalibrationMarginal.from_json(document.text, document.path).best()
    place = f"{document.path} (optimum)"
    cTl = checked_pose(best.cTl.matrix(), place)
    return Found(cTl, checked_time_offset_s(best.time_offset_s, place), "the optimum")


def is_opencv(table: Table) -> bool:
    """Whether a table, or those of cameras in it, have OpenCV's rvec and tvec, or T_camera_lidar."""
    return bool(_opencv_cameras(table))


def read_opencv(document: Document, options: ImportOptions) -> Found:
    """``T_camera_lidar``, or ``rvec`` and ``tvec`` for points of the LiDAR, and ``time_offset_s``.

    Raises:
        DataError: several cameras and none named, or no such matrices.
    """
    cameras = _opencv_cameras(document.yaml)
    matching = [name for name in cameras if options.camera is not None and is_of_camera(name, options.camera)]
    name = next(iter(cameras)) if len(cameras) == 1 else (matching[0] if len(matching) == 1 else None)
    if name is None:
        raise DataError(document.path, f"the cameras {', '.join(cameras)}", "one of them by --camera NAME")
    entry, place = cameras[name], f"{document.path}: {name}" if name else str(document.path)
    if "T_camera_lidar" in entry:
        matrix, said = np.array(numbers(entry["T_camera_lidar"], place, 16)).reshape(4, 4), "T_camera_lidar"
    else:
        matrix, said = np.eye(4), "rvec and tvec"
        rvec, tvec = (numbers(entry[key], f"{place}: {key}", 3) for key in ("rvec", "tvec"))
        angle = float(np.linalg.norm(rvec))
        if angle > _MOST_RADIANS:
            raise DataError(f"{place}: rvec", f"a length of {angle:.3g}", "an angle in radians")
        matrix[:3, :3], matrix[:3, 3] = gtsam.Rot3.Expmap(np.array(rvec)).matrix(), tvec
    stated = entry.get("time_offset_s")
    at = f"{place}: time_offset_s"
    time_offset_s = None if stated is None else checked_time_offset_s(number(stated, at), at)
    return Found(checked_pose(matrix, f"{place}: {said}"), time_offset_s, said)


def _opencv_cameras(table: Table) -> dict[str, Table]:
    """Tables of cameras by name; the name of the only one of a file is empty."""
    if _is_opencv_camera(table):
        return {"": table}
    return {
        str(name): entry
        for name, entry in table.items()
        if isinstance(entry, dict) and _is_opencv_camera(entry)
    }


def _is_opencv_camera(table: Table) -> bool:
    return "T_camera_lidar" in table or {"rvec", "tvec"} <= set(table)


def is_nuscenes(value: Any) -> bool:
    """Whether a JSON value is a list of records with a translation and a rotation."""
    return (
        isinstance(value, list)
        and bool(value)
        and all(isinstance(one, dict) and {"translation", "rotation"} <= set(one) for one in value)
    )


def read_nuscenes(document: Document, options: ImportOptions) -> Found:
    """Records of ``calibrated_sensor``: poses of camera and LiDAR in the ego frame, rotation w x y z.

    Raises:
        DataError: several cameras or LiDARs and none named, none of the name, or no pose.
    """
    records = document.json
    cameras = [record for record in records if record.get("camera_intrinsic")]
    lidars = [record for record in records if not record.get("camera_intrinsic")]
    camera = _record(cameras, options.camera, document, "camera")
    lidar = _record(_named_lidar(lidars, options.lidar_frame, document), None, document, "LiDAR")
    cTl = pose_of(camera, document.path).inverse() * pose_of(lidar, document.path)
    table = JsonTable(camera, str(document.path))
    known = camera.get("time_offset_s") is not None
    time_offset_s = table.time_offset_s("time_offset_s") if known else None
    return Found(cTl, time_offset_s, f"{_channel(camera)} and {_channel(lidar)} in the ego frame")


def _named_lidar(records: list[Any], channel: str | None, document: Document) -> list[Any]:
    """Records of a channel; all without one."""
    named = [record for record in records if channel in (None, _channel(record))]
    if records and not named:
        listed = ", ".join(map(_channel, records[:12]))
        raise DataError(document.path, f"the LiDARs {listed}", f"one named {channel:.60} (--lidar-frame)")
    return named


def _record(records: list[Any], name: str | None, document: Document, what: str) -> Any:
    """The only record; of several that of a channel, or of those of a LiDAR the one that says so."""
    if len(records) > 1 and name is not None:
        records = [record for record in records if _channel(record) == name] or records
    if len(records) > 1 and what == "LiDAR":
        records = [record for record in records if re.search("lidar", _channel(record), re.I)]
    if len(records) != 1:
        channels = ", ".join(map(_channel, records[:12]))
        option = "--camera NAME" if what == "camera" else "--lidar-frame NAME"
        raise DataError(
            document.path, f"{count_of(len(records), 'record')} of a {what} ({channels})", f"one: {option}"
        )
    return records[0]


def _channel(record: Table) -> str:
    return f"{record.get('channel', 'a sensor')!s:.60}"

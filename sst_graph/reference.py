"""A calibration read from a file, as a start or as the truth: KITTI, calibration.json, groundtruth.json."""

from __future__ import annotations

from pathlib import Path

import gtsam

from sst_graph.data.kitti.calib import read_calibration
from sst_graph.errors import DataError
from sst_graph.files.json_table import JsonTable
from sst_graph.files.reading import CALIBRATION, read_json
from sst_graph.result import UNNAMED_CAMERA
from sst_graph.types import GroundTruth


def read_reference(path: Path, camera: str = "image_2") -> GroundTruth:
    """The calibration in a KITTI ``calib.txt`` (of ``camera``), or in a JSON file with ``T_camera_lidar``.

    The offset is the file's ``time_offset_s`` [s]; a ``calib.txt`` has none, and so may a JSON file.

    Raises:
        DataError: a missing or unreadable file, or one without a usable pose.
        ConfigError: ``camera`` is no KITTI camera.
    """
    if path.suffix != ".json":
        return GroundTruth(read_calibration(path).cTl(camera), None)
    document = read_json(path, CALIBRATION)
    if not isinstance(document, dict) or "T_camera_lidar" not in document:
        raise DataError(path, "no 'T_camera_lidar'", "a 4x4 matrix 'T_camera_lidar'")
    _check_camera(document.get("camera"), camera, path)
    table = JsonTable(document, str(path))
    known = document.get("time_offset_s") is not None
    return GroundTruth(table.pose("T_camera_lidar"), table.time_offset_s("time_offset_s") if known else None)


def _check_camera(found: object, camera: str, path: Path) -> None:
    """Refuse a file that says it is of another camera; a file that names none is taken as it is."""
    name = found.get("name") if isinstance(found, dict) else found
    if isinstance(name, str) and name != camera and UNNAMED_CAMERA not in (name, camera):
        raise DataError(path, f"a calibration of camera {name:.60}", f"one of {camera}")


def load_initial(path: Path, camera: str = "image_2") -> tuple[gtsam.Pose3, float]:
    """Start of a calibration from a file: cTl and time offset [s], 0 where the file has none.

    Raises:
        DataError, ConfigError: as :func:`read_reference`.
    """
    reference = read_reference(path, camera)
    return reference.cTl, reference.time_offset_s or 0.0

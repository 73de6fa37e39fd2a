"""A calibration read from a file, as a start or as the truth: KITTI, calibration.json, groundtruth.json."""

from __future__ import annotations

import json
from pathlib import Path

import gtsam
import numpy as np

from sst_graph.data.calib import read_calibration
from sst_graph.errors import DataError
from sst_graph.result import UNNAMED_CAMERA, checked_pose
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
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise DataError(path, "no such file", "a calibration.json, groundtruth.json or calib.txt") from None
    except (OSError, ValueError) as error:
        raise DataError(path, f"no readable JSON ({error})", "JSON with T_camera_lidar") from error
    if not isinstance(document, dict) or "T_camera_lidar" not in document:
        raise DataError(path, "no 'T_camera_lidar'", "a 4x4 matrix 'T_camera_lidar'")
    _check_camera(document.get("camera"), camera, path)
    try:
        matrix = np.array(document["T_camera_lidar"], dtype=np.float64)
    except (ValueError, TypeError):
        raise DataError(f"{path}: T_camera_lidar", "no numeric array", "a 4x4 matrix") from None
    offset_s = document.get("time_offset_s")
    if offset_s is not None:
        numeric = isinstance(offset_s, (int, float)) and not isinstance(offset_s, bool)
        if not numeric or not np.isfinite(offset_s):
            raise DataError(f"{path}: time_offset_s", repr(offset_s), "a finite number of seconds or null")
        offset_s = float(offset_s)
    return GroundTruth(checked_pose(matrix, f"{path}: T_camera_lidar"), offset_s)


def _check_camera(found: object, camera: str, path: Path) -> None:
    """Refuse a file that says it is of another camera; a file that names none is taken as it is."""
    name = found.get("name") if isinstance(found, dict) else found
    if isinstance(name, str) and name != camera and UNNAMED_CAMERA not in (name, camera):
        raise DataError(path, f"a calibration of camera {name}", f"one of {camera}")


def load_initial(path: Path, camera: str = "image_2") -> tuple[gtsam.Pose3, float]:
    """Start of a calibration from a file: cTl and time offset [s], 0 where the file has none.

    Raises:
        DataError, ConfigError: as :func:`read_reference`.
    """
    reference = read_reference(path, camera)
    return reference.cTl, reference.time_offset_s or 0.0

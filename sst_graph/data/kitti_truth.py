"""What a KITTI drive brings as its truth: ``groundtruth.json``, or the published calibration."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from sst_graph.data.arrays import read_bytes
from sst_graph.data.calib import KittiCalibration, pose_from
from sst_graph.errors import DataError
from sst_graph.types import GroundTruth

_FILE = "groundtruth.json"
_EXPECTED = '{"T_camera_lidar": 4x4, "time_offset_s": number or null, "camera": "image_2"}'


def drive_truth(folder: Path, calibration: KittiCalibration, camera: str) -> tuple[GroundTruth, bool]:
    """Truth of a drive for ``camera``, and whether it is a reference only.

    ``groundtruth.json`` holds ``T_camera_lidar`` of its ``camera`` (default image_2); for another one the
    shift between the rectified cameras is applied. Without that file the published
    calibration and equal stamps stand in, as a reference.

    Raises:
        DataError: a file that is no such JSON.
    """
    path = folder / _FILE
    if not path.is_file():
        return GroundTruth(calibration.cTl(camera), 0.0), True
    values = _parse(path)
    offset_s = values.get("time_offset_s")
    if offset_s is not None and not (isinstance(offset_s, int | float) and math.isfinite(offset_s)):
        raise DataError(path, f"time_offset_s {offset_s!r}", "seconds, or null")
    try:
        matrix = np.array(values["T_camera_lidar"], dtype=np.float64)
    except (KeyError, TypeError, ValueError):
        raise DataError(path, "no numeric T_camera_lidar", _EXPECTED) from None
    truth_cTl = pose_from(matrix, f"{path} (T_camera_lidar)")
    own = values.get("camera", "image_2")
    if isinstance(own, str) and own != camera:
        truth_cTl = calibration.cTc0(camera) * calibration.cTc0(own).inverse() * truth_cTl
    return GroundTruth(truth_cTl, None if offset_s is None else float(offset_s)), False


def _parse(path: Path) -> dict[str, Any]:
    try:
        values = json.loads(read_bytes(path))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise DataError(path, f"no JSON ({error})", _EXPECTED) from None
    if not isinstance(values, dict):
        raise DataError(path, f"a JSON {type(values).__name__}", _EXPECTED)
    return values

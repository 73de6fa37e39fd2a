"""What a KITTI drive brings as its truth: ``groundtruth.json``, or the published calibration."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path

from sst_graph.data.kitti.calib import KittiCalibration, pose_from
from sst_graph.errors import DataError
from sst_graph.files.json_table import JsonTable
from sst_graph.files.reading import GROUND_TRUTH, read_json
from sst_graph.types import GroundTruth

_FILE = "groundtruth.json"
_EXPECTED = '{"T_camera_lidar": 4x4, "time_offset_s": number or null, "camera": "image_2"}'


def drive_truth(folder: Path, calibration: KittiCalibration, camera: str) -> tuple[GroundTruth | None, bool]:
    """Truth of a drive for ``camera``, and whether it is a reference only.

    ``groundtruth.json`` holds ``T_camera_lidar`` of its ``camera`` (default image_2); for another one the
    shift between the rectified cameras is applied. Without that file the published
    calibration and equal stamps stand in, as a reference; None where there is none.

    Raises:
        DataError: a file that is no such JSON.
    """
    stored = read_truth(folder / _FILE)
    if stored is None and calibration.c0Tl is None:
        return None, True
    if stored is None:
        return GroundTruth(calibration.cTl(camera), 0.0), True
    truth = stored.truth
    if stored.camera != camera:
        shift = calibration.cTc0(camera) * calibration.cTc0(stored.camera).inverse()
        truth = replace(truth, cTl=shift * truth.cTl)
    return truth, False


@dataclass(frozen=True)
class StoredTruth:
    """Contents of a ``groundtruth.json``: the truth of a camera."""

    truth: GroundTruth
    camera: str


def read_truth(path: Path) -> StoredTruth | None:
    """The truth in a ``groundtruth.json``, or None where there is no such file.

    Raises:
        DataError: a file that is no such JSON.
    """
    if not os.path.lexists(path):
        return None
    values = read_json(path, GROUND_TRUTH)
    if not isinstance(values, dict):
        raise DataError(path, f"a JSON {type(values).__name__}", _EXPECTED)
    table = JsonTable(values, str(path))
    time_offset_s = None if values.get("time_offset_s") is None else table.time_offset_s("time_offset_s")
    rows = values.get("T_camera_lidar")
    matrix = table.matrix("T_camera_lidar", (len(rows) if isinstance(rows, list) else 4, 4))
    camera = values.get("camera")
    truth = GroundTruth(pose_from(matrix, f"{path} (T_camera_lidar)"), time_offset_s)
    return StoredTruth(truth, camera if isinstance(camera, str) else "image_2")

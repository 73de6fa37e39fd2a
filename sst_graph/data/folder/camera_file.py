"""``camera.yaml`` and ``extrinsic.yaml`` of a folder.

A camera is written in one of three ways:

- plainly: fx, fy, cx, cy [px], width, height, and where the pictures are not rectified distortion_model and
  distortion;
- as Kalibr's camchain: cam0 with camera_model, intrinsics, distortion_model, distortion_coeffs, resolution;
- as OpenCV's or ROS's calibration: camera_matrix, image_width, image_height, distortion_coefficients.

An extrinsic is ``T_camera_lidar`` (4x4), or ``translation`` [m] and ``quaternion`` in the order w x y z.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from sst_graph.cameras.model import CameraModel
from sst_graph.cameras.readers import camera_from_opencv, camera_of, cameras_from_kalibr
from sst_graph.errors import DataError
from sst_graph.files.checked_values import checked_pose, pinhole_camera
from sst_graph.files.yaml_file import number, numbers, read_yaml

_EXPECTED = "fx, fy, cx, cy, width, height; or Kalibr's cam0; or OpenCV's camera_matrix"
_PLAIN = ("fx", "fy", "cx", "cy", "width", "height", "distortion_model", "distortion")
_ROUNDED = 1e-3
"""A quaternion's length differs from 1 by no more than its digits were rounded."""


def read_camera(path: Path) -> CameraModel:
    """Intrinsics and distortion of a camera.

    Raises:
        DataError: a file that holds none, an unknown distortion, intrinsics that are none.
        MissingDependencyError: PyYAML is not installed.
    """
    table = read_yaml(path)
    if "fx" in table:
        if unknown := [key for key in table if key not in _PLAIN]:
            raise DataError(path, f"the key {unknown[0]!r:.60}", f"none but {', '.join(_PLAIN)}")
        names = _PLAIN[:6]
        fx, fy, cx, cy, *size = (number(_entry(table, name, path), f"{path} ({name})") for name in names)
        width, height = (_whole(side, path) for side in size)
        intrinsics = pinhole_camera((fx, fy, cx, cy), (width, height), path)
        coefficients = numbers(table.get("distortion") or [], f"{path} (distortion)")
        return camera_of(intrinsics, str(table.get("distortion_model", "none")), coefficients, path)
    if isinstance(table.get("cam0"), dict):
        return cameras_from_kalibr({"cam0": {"camera_model": "pinhole", **table["cam0"]}}, path)["cam0"].model
    if "camera_matrix" in table or "K" in table:
        if "D" not in table:
            table.setdefault("distortion_coefficients", [])
        return camera_from_opencv(table, path)
    raise DataError(path, f"keys {', '.join(map(str, table))}"[:200], _EXPECTED)


def read_extrinsic(path: Path) -> gtsam.Pose3:
    """cTl of a file.

    Raises:
        DataError: a file that holds none, or no rigid transform.
        MissingDependencyError: PyYAML is not installed.
    """
    table = read_yaml(path)
    if "T_camera_lidar" in table and ("translation" in table or "quaternion" in table):
        raise DataError(path, "two poses, T_camera_lidar and translation or quaternion", "one of them")
    if "T_camera_lidar" in table:
        place = f"{path} (T_camera_lidar)"
        return checked_pose(np.array(numbers(table["T_camera_lidar"], place, 16)).reshape(4, 4), place)
    t = numbers(_entry(table, "translation", path), f"{path} (translation)", 3)
    q = numbers(_entry(table, "quaternion", path), f"{path} (quaternion)", 4)
    length = float(np.linalg.norm(q))
    if abs(length - 1.0) > _ROUNDED:
        raise DataError(f"{path} (quaternion)", f"length {length:.6g}", "1, in the order w x y z")
    matrix = np.eye(4)
    matrix[:3, :3] = gtsam.Rot3.Quaternion(*(value / length for value in q)).matrix()
    matrix[:3, 3] = t
    return checked_pose(matrix, str(path))


_POSE = "T_camera_lidar, or translation and quaternion"


def _entry(table: Mapping[Any, Any], name: str, path: Path) -> Any:
    if name not in table:
        expected = _POSE if name in ("translation", "quaternion") else _EXPECTED
        raise DataError(path, f"no {name}", expected)
    return table[name]


def _whole(side: float, path: Path) -> int:
    if side != round(side):
        raise DataError(path, f"an image side of {side} px", "a whole number")
    return int(side)

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
from sst_graph.cameras.readers import camera_of
from sst_graph.data.folder.yaml_file import number, numbers, read_yaml
from sst_graph.errors import DataError
from sst_graph.factors.camera import PinholeCamera
from sst_graph.files.checked_values import checked_camera, checked_pose

_EXPECTED = "fx, fy, cx, cy, width, height; or Kalibr's cam0; or OpenCV's camera_matrix"
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
        values = [number(_entry(table, name, path), f"{path} ({name})") for name in ("fx", "fy", "cx", "cy")]
        size = [number(_entry(table, name, path), f"{path} ({name})") for name in ("width", "height")]
        model, coefficients = table.get("distortion_model", "none"), table.get("distortion", [])
    elif isinstance(table.get("cam0"), dict):
        values, size, model, coefficients = _kalibr(table["cam0"], path)
    elif "camera_matrix" in table or "K" in table:
        name = "camera_matrix" if "camera_matrix" in table else "K"
        K = numbers(table[name], f"{path} ({name})", 9)
        values = [K[0], K[4], K[2], K[5]]
        size = [
            number(_entry(table, f"image_{side}", path), f"{path} ({side})") for side in ("width", "height")
        ]
        model = table.get("distortion_model", "plumb_bob")
        coefficients = table.get("distortion_coefficients", table.get("D", []))
    else:
        raise DataError(path, f"keys {', '.join(map(str, table))}"[:200], _EXPECTED)
    distortion = numbers(coefficients or [], f"{path} (distortion)")
    width, height = (_whole(side, path) for side in size)
    fx, fy, cx, cy = values
    intrinsics = checked_camera(PinholeCamera(fx, fy, cx, cy, width, height), path)
    return camera_of(intrinsics, str(model), distortion, path)


def read_extrinsic(path: Path) -> gtsam.Pose3:
    """cTl of a file.

    Raises:
        DataError: a file that holds none, or no rigid transform.
        MissingDependencyError: PyYAML is not installed.
    """
    table = read_yaml(path)
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


def _kalibr(cam: Mapping[Any, Any], path: Path) -> tuple[list[float], list[float], Any, Any]:
    model = cam.get("camera_model", "pinhole")
    if model != "pinhole":
        raise DataError(f"{path} (cam0)", f"camera_model {model!r:.40}", "pinhole")
    values = numbers(_entry(cam, "intrinsics", path), f"{path} (intrinsics)", 4)
    size = numbers(_entry(cam, "resolution", path), f"{path} (resolution)", 2)
    return values, size, cam.get("distortion_model", "none"), cam.get("distortion_coeffs", [])


def _entry(table: Mapping[Any, Any], name: str, path: Path) -> Any:
    if name not in table:
        raise DataError(
            path, f"no {name}", _EXPECTED if name != "quaternion" else "translation and quaternion"
        )
    return table[name]


def _whole(side: float, path: Path) -> int:
    if side != round(side):
        raise DataError(path, f"an image side of {side} px", "a whole number")
    return int(side)

"""``camera.yaml`` and ``extrinsic.yaml`` of a folder.

A camera is written in one of four ways:

- plainly: fx, fy, cx, cy [px], width, height, and where the pictures are not rectified distortion_model and
  distortion;
- as Kalibr's camchain: cam0 with camera_model, intrinsics, distortion_model, distortion_coeffs, resolution;
  or one camera alone as EuRoC's sensor.yaml has it;
- as OpenCV's or ROS's calibration: camera_matrix, image_width, image_height, distortion_coefficients; or
  the names that scripts and CameraInfo have for these, such as K, D, dist_coeffs, width, height, image_size;
- as the settings of ORB-SLAM, VINS or FAST-LIVO have it (:mod:`sst_graph.data.folder.slam_camera`).

An extrinsic is ``T_camera_lidar`` (4x4), or ``translation`` [m] and ``quaternion`` in the order w x y z.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from sst_graph.cameras.model import CameraModel
from sst_graph.cameras.readers import (
    camera_from_opencv,
    camera_of,
    cameras_from_kalibr,
    check_full_sensor,
)
from sst_graph.data.folder.camera_entries import pinhole_by_names, plain_key, refuse_of_lens
from sst_graph.data.folder.slam_camera import slam_camera
from sst_graph.errors import DataError
from sst_graph.files.checked_values import checked_pose
from sst_graph.files.yaml_file import numbers, read_yaml

_EXPECTED = (
    "fx, fy, cx, cy, width, height; or Kalibr's cam0; or OpenCV's camera_matrix; or ORB-SLAM's Camera.fx, "
    "camodocal's projection_parameters, vikit's cam_fx"
)
_IN_CHAIN = re.compile(r"cam\d+", re.ASCII)
_PLAIN = ("fx", "fy", "cx", "cy", "width", "height", "distortion_model", "distortion")
_OPENCV = {
    "camera_matrix": ("cameramatrix", "k", "mtx"),
    "distortion_coefficients": (
        *("distortioncoefficients", "distortioncoeffs", "distortioncoeff", "distcoeffs", "distcoeff"),
        *("distcoefs", "distortion", "dist", "d"),
    ),
    "image_width": ("imagewidth", "width"),
    "image_height": ("imageheight", "height"),
    "image_size": ("imagesize", "resolution"),
    "fisheye_model": ("fisheyemodel", "fisheye"),
}
"""OpenCV's names, and others for the same in small letters without underscores."""
_EUROC = {"distortion_coefficients": "distortion_coeffs", "radial-tangential": "radtan"}
"""EuRoC's names, and Kalibr's for the same."""
_ROUNDED = 1e-3
"""A quaternion's length differs from 1 by no more than its digits were rounded."""


def read_camera(path: Path, name: str = "") -> CameraModel:
    """Intrinsics and distortion of a camera.

    Args:
        name: of the camera, or the topic of its images, by which it is found in a chain of several; without
            it cam0.

    Raises:
        DataError: a file that holds none, an unknown distortion, intrinsics that are none.
        MissingDependencyError: PyYAML is not installed.
    """
    table = read_yaml(path)
    if "fx" in table:
        if unknown := [key for key in table if key not in _PLAIN]:
            raise DataError(path, f"the key {unknown[0]!r:.60}", f"none but {', '.join(_PLAIN)}")
        intrinsics = pinhole_by_names(table, _PLAIN[:6], path, _EXPECTED)
        coefficients = numbers(table.get("distortion") or [], f"{path} (distortion)")
        return camera_of(intrinsics, str(table.get("distortion_model", "none")), coefficients, path)
    if "intrinsics" in table and "resolution" in table:
        table = {"cam0": table}
    chain = {str(key): value for key, value in table.items() if _IN_CHAIN.fullmatch(str(key))}
    if any(isinstance(value, dict) for value in chain.values()):
        key = _of_chain(chain, name, path)
        own = _of_kalibr(chain[key])
        refuse_of_lens(own, ("distortion_coeffs", "distortion_model"), path)
        return cameras_from_kalibr({key: {"camera_model": "pinhole", **own}}, path)[key].model
    if any(plain_key(key) in _OPENCV["camera_matrix"] for key in table):
        calibration = _by_opencv_names(table, path)
        camera = camera_from_opencv({"distortion_coefficients": [], **calibration}, path)
        check_full_sensor({**calibration, "width": camera.width, "height": camera.height}, path)
        return camera
    if (of_slam := slam_camera(table, path)) is not None:
        return of_slam
    raise DataError(path, f"keys {', '.join(map(str, table))}"[:200], _EXPECTED)


def _of_kalibr(table: Mapping[str, Any]) -> dict[str, Any]:
    """EuRoC's entries of a camera by Kalibr's names."""
    named = {_EUROC.get(str(key), str(key)): value for key, value in table.items()}
    model = named.get("distortion_model")
    if isinstance(model, str):
        named["distortion_model"] = _EUROC.get(model, model)
    return named


def _by_opencv_names(table: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """The table with OpenCV's names in the place of others for the same.

    Raises:
        DataError: two entries for the same, or one of the lens that is not understood.
    """
    named: dict[str, Any] = {}
    for key, value in table.items():
        plain = plain_key(key)
        name = next((name for name, others in _OPENCV.items() if plain in others), None)
        if name in named:
            raise DataError(path, f"{key!r:.60} beside another entry for {name}", "one of them")
        named[str(key) if name is None else name] = value
    refuse_of_lens(named, ("distortion_coefficients", "distortion_model"), path)
    if "image_size" in named:
        width, height = numbers(named.pop("image_size"), f"{path} (image size)", 2)
        named = {"image_width": width, "image_height": height} | named
    return named


def _of_chain(chain: Mapping[str, Any], name: str, path: Path) -> str:
    """The camera of a chain: the only one, or that of a name, a topic or its namespace."""
    topics = {key: str(table.get("rostopic", "")) for key, table in chain.items() if isinstance(table, dict)}
    if len(topics) == 1 or (not name and "cam0" in topics):
        return min(topics)
    topic = name.removesuffix("/compressed")
    for same in filter(None, (topic, topic.rpartition("/")[0])):
        found = [key for key, own in topics.items() if same.strip("/") in (key, _plain(own), _space(own))]
        if len(found) == 1:
            return found[0]
    listed = ", ".join(f"{key} ({own})" if own else key for key, own in topics.items())
    raise DataError(path, f"cameras {listed}", f"one of the name or rostopic {name or 'cam0'}")


def _plain(topic: str) -> str:
    return topic.removesuffix("/compressed").strip("/")


def _space(topic: str) -> str:
    return _plain(topic).rpartition("/")[0]


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

"""Formats with one record a camera: KITTI's calib.txt, OpenCV, nuScenes, gtsam."""

from __future__ import annotations

import hashlib
import json
import logging
import re
from collections.abc import Mapping
from typing import Any

import cv2
import gtsam
import numpy as np

from sst_graph.cameras.estimated_camera import EstimatedCamera
from sst_graph.errors import ConfigError
from sst_graph.export.frames import OPTICAL_AXES, Rig
from sst_graph.export.marginal import marginal_of_result
from sst_graph.export.text import heading, row
from sst_graph.imports.rotations import quaternion_xyzw
from sst_graph.result import CalibrationResult

_LOG = logging.getLogger(__name__)


def kitti(rig: Rig) -> str:
    """KITTI odometry ``calib.txt``: P lines, and Tr: the LiDAR in the rectified camera **0**.

    uv1 ~ PN [Tr; 0 0 0 1] lP1, so that for camera N Tr = [I | K^-1 PN[:, 3]]^-1 T_camera_lidar. Readers
    take every line for numbers, so the file has no comments and no time offset.
    """
    result = _only(rig, "kitti", "its one Tr goes with one camera")
    calibration, lens = rig.options.kitti, EstimatedCamera.of(result)
    if lens.estimated and (lens.distorts or calibration is not None):
        _LOG.warning("--to kitti: the file does not hold this: %s", "; ".join(lens.sentences))
    if calibration is not None:
        projections = dict(calibration.projections)
        c0Tl = calibration.cTc0(result.camera_name).inverse() * result.T_camera_lidar
    else:
        camera = result.camera_name.removeprefix("image_").lstrip("0") or "0"
        own = int(camera) if re.fullmatch(r"\d", camera) else 0
        # pykitti expects P0 to P3; all get the one camera that is known.
        P = np.hstack([lens.matrix, np.zeros((3, 1))])
        projections = dict.fromkeys(sorted({0, 1, 2, 3, own}), P)
        c0Tl = result.T_camera_lidar
    lines = [f"P{number}: {row(matrix)}" for number, matrix in sorted(projections.items())]
    return "\n".join([*lines, f"Tr: {row(c0Tl.matrix()[:3])}"]) + "\n"


def opencv(rig: Rig) -> str:
    """OpenCV FileStorage (YAML): rvec, tvec as projectPoints takes them for points of the LiDAR.

    The cameras of a rig stand each in a map of its name.
    """
    storage = cv2.FileStorage(".yml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    storage.writeComment("LiDAR-camera calibration by sst-graph")
    lidar = rig.options.lidar_frame
    storage.writeComment("p_camera = T_camera_lidar * p_lidar, the pose of the LiDAR in the camera")
    for name, result in rig.cameras.items():
        camera = rig.frames[name].optical
        storage.writeComment(
            f"parent {camera} (camera, optical frame: {OPTICAL_AXES}), child {lidar} (LiDAR)"
        )
        for line in heading(result, camera):
            storage.writeComment(line)
        if rig.several:
            storage.startWriteStruct(_node_name(name), cv2.FileNode_MAP)
        _write_camera(storage, result)
        if rig.several:
            storage.endWriteStruct()
    return str(storage.releaseAndGetString())


def _write_camera(storage: cv2.FileStorage, result: CalibrationResult) -> None:
    T, camera = result.T_camera_lidar, EstimatedCamera.of(result)
    storage.write("image_width", camera.width)
    storage.write("image_height", camera.height)
    storage.write("camera_matrix", camera.matrix)
    storage.write("distortion_coefficients", np.array([[camera.k1, camera.k2, 0.0, 0.0, 0.0]]))
    storage.write("rvec", np.asarray(gtsam.Rot3.Logmap(T.rotation())).reshape(3, 1))
    storage.write("tvec", np.asarray(T.translation()).reshape(3, 1))
    storage.write("T_camera_lidar", np.ascontiguousarray(T.matrix()))
    storage.write("time_offset_s", result.time_offset_s)
    storage.write("covariance", np.ascontiguousarray(result.covariance))


def nuscenes(rig: Rig) -> str:
    """Records of nuScenes' calibrated_sensor: the pose of each sensor in the ego frame, rotation w x y z.

    Without a tree the LiDAR stands at the origin of the ego frame. ``channel``, ``time_offset_s`` and
    ``comment`` are none of nuScenes' keys; its tools pass over them.
    """
    options = rig.options
    parent = options.parent
    if parent is None and options.tree is not None:
        rig.check_tree()
        parent = options.tree.root(options.lidar_frame)
    egoTl = rig.lidar_in(parent, "the ego frame")
    ego = parent or options.lidar_frame
    records = [_record(options.lidar_frame, egoTl, {"camera_intrinsic": []}, f"p_{ego} = T * p_sensor")]
    for name, result in rig.cameras.items():
        direction = f"camera, optical frame: {OPTICAL_AXES}; p_{ego} = T * p_sensor"
        own = {
            "camera_intrinsic": EstimatedCamera.of(result).matrix.tolist(),
            "time_offset_s": result.time_offset_s,
        }
        said = "; ".join([direction, *heading(result, name)])
        records.append(_record(name, egoTl * result.T_camera_lidar.inverse(), own, said))
    return "[\n" + ",\n".join(json.dumps(record, indent=1, allow_nan=False) for record in records) + "\n]\n"


def _record(channel: str, pose: gtsam.Pose3, own: Mapping[str, Any], comment: str) -> dict[str, Any]:
    x, y, z, w = quaternion_xyzw(pose.rotation()).tolist()
    token, sensor = (hashlib.md5(f"{kind} {channel}".encode()).hexdigest() for kind in ("pose", "sensor"))
    return {
        "token": token,
        "sensor_token": sensor,
        "channel": channel,
        "translation": pose.translation().tolist(),
        "rotation": [w, x, y, z],
        **own,
        "comment": comment,
    }


def gtsam_marginal(rig: Rig) -> str:
    """The marginal on (E, D) as JSON; see :mod:`sst_graph.export.marginal`."""
    return marginal_of_result(_only(rig, "gtsam", "a marginal is that of one camera")).to_json()


def _only(rig: Rig, target: str, why: str) -> CalibrationResult:
    if rig.several:
        raise ConfigError(f"--to {target}: found a rig, expected the folder of one of its cameras ({why})")
    return next(iter(rig.cameras.values()))


def _node_name(name: str) -> str:
    """A key that OpenCV takes: it begins with a letter or _, and holds letters, digits, - and _."""
    plain = re.sub(r"[^A-Za-z0-9_-]+", "_", name).strip("_") or "camera"
    return plain if plain[0].isalpha() else f"_{plain}"

"""Made-up calibrations for tests of exports and imports, and a vehicle to put them on."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sst_graph.factors.camera import PinholeCamera
from sst_graph.result import CalibrationResult

FORWARD = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""Rotation of a LiDAR (x forward) in an optical frame (z forward), not turned."""
OPTICAL_FROM_LINK = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
CAMERA = PinholeCamera(700.0, 710.0, 600.0, 180.0, 1242, 375)
SIGMAS = np.array([0.002, 0.002, 0.002, 0.01, 0.02, 0.03, 0.004])
TIME_OFFSET_S = -0.0375


def result_of(R: NDArray[np.float64], t: list[float], **changes: Any) -> CalibrationResult:
    """A calibration of ``image_2``, its image 37.5 ms older than its stamp says."""
    pose = gtsam.Pose3(gtsam.Rot3(R), np.array(t))
    result = CalibrationResult(pose, TIME_OFFSET_S, np.diag(SIGMAS**2), "ok", CAMERA, "image_2")
    return dataclasses.replace(result, **changes)


def turned(seed: int) -> CalibrationResult:
    """By hand, near the gimbal lock that a LiDAR in an optical frame has, and anywhere."""
    rng = np.random.default_rng(seed)
    size = [0.0, 1e-9, 1e-5, 0.02, 0.02, 1.0, 1.0, 3.0][seed]
    R = FORWARD @ Rotation.from_rotvec(size * rng.normal(size=3)).as_matrix()
    return result_of(R, [0.06, -0.08, -1e-5])


VEHICLE = """<robot name="vehicle">
  <link name="base_link"/><link name="roof"/><link name="lidar"/><link name="imu_link"/>
  <link name="camera_link"/>
  <joint name="roof_joint" type="fixed">
    <parent link="base_link"/><child link="roof"/><origin xyz="1.0 0.0 1.5" rpy="0 0 1.5707963267948966"/>
  </joint>
  <joint name="lidar_joint" type="fixed">
    <parent link="roof"/><child link="lidar"/><origin xyz="0.2 0.0 0.1"/>
  </joint>
  <joint name="imu_joint" type="fixed">
    <parent link="base_link"/><child link="imu_link"/><origin xyz="0.0 0.0 0.4"/>
  </joint>
  <joint name="camera_joint" type="fixed">
    <parent link="roof"/><child link="camera_link"/><origin xyz="0.5 0.0 0.0"/>
  </joint>
</robot>
"""
"""base_link holds the IMU and the roof, turned by 90 deg to the left; the LiDAR is 0.2 m in front of that."""

BASE_FROM_LIDAR = np.array(
    [[0.0, -1.0, 0.0, 1.0], [1.0, 0.0, 0.0, 0.2], [0.0, 0.0, 1.0, 1.6], [0.0, 0.0, 0.0, 1.0]]
)
"""Worked by hand: 0.2 m along the roof's x is 0.2 m along the vehicle's y."""


def vehicle(folder: Path) -> Path:
    """The file of :data:`VEHICLE`."""
    path = folder / "vehicle.urdf"
    path.write_text(VEHICLE)
    return path


def matrix_of(xyz: Any, rotation: Rotation) -> NDArray[np.float64]:
    """(4, 4) of a translation and scipy's rotation."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation.as_matrix(), np.asarray(xyz, float)
    return T

"""Poses in the forms that files have: fixed-axis angles and quaternions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gtsam
import numpy as np

from sst_graph.files.checked_values import checked_pose
from sst_graph.types import FloatArray


def quaternion_xyzw(rotation: gtsam.Rot3) -> FloatArray:
    """(4,) unit quaternion x y z w with w >= 0."""
    q: Any = rotation.toQuaternion()
    xyzw = np.array([q.x(), q.y(), q.z(), q.w()])
    return xyzw if xyzw[3] >= 0.0 else -xyzw


def fixed_axis_rpy(rotation: gtsam.Rot3) -> FloatArray:
    """(3,) roll, pitch, yaw [rad] with R = Rz(yaw) Ry(pitch) Rx(roll), exact at a pitch of 90 deg too.

    A LiDAR (x forward) in an optical frame (z forward) stands at just that pitch; roll is therefore
    taken from what is left of R when yaw is undone.
    """
    R = np.asarray(rotation.matrix())
    yaw = np.arctan2(R[1, 0], R[0, 0])
    s, c = np.sin(yaw), np.cos(yaw)
    pitch = np.arctan2(-R[2, 0], c * R[0, 0] + s * R[1, 0])
    roll = np.arctan2(s * R[0, 2] - c * R[1, 2], c * R[1, 1] - s * R[0, 1])
    return np.array([roll, pitch, yaw])


def pose_by_rpy(xyz: Sequence[float], rpy: Sequence[float], place: str) -> gtsam.Pose3:
    """Pose of a translation [m] and roll, pitch, yaw [rad] about fixed axes: R = Rz(yaw) Ry(pitch) Rx(roll).

    Raises:
        DataError: naming ``place``: a translation that is none between two sensors.
    """
    matrix = np.eye(4)
    matrix[:3, :3] = gtsam.Rot3.RzRyRx(np.array(rpy)).matrix()
    matrix[:3, 3] = xyz
    return checked_pose(matrix, place)

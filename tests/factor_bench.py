"""Every factor on one scene, for tests that try them all."""

from __future__ import annotations

import gtsam
import numpy as np

from sst_graph.factors import (
    Between,
    CameraMotion,
    LidarMotion,
    LidarTwist,
    camera_motion_factor,
    frame_factor,
    hand_eye_factor,
    pixel_to_point_factor,
    point_to_pixel_factor,
    pose_alignment_factor,
    rotation_hand_eye,
    silhouette_factor,
    stacked,
    twist_transfer_factor,
)

E, D, B = (gtsam.symbol(letter, 0) for letter in "EDB")
V = [gtsam.symbol("V", k) for k in range(3)]
X = [gtsam.symbol("X", k) for k in range(3)]
POSE, NEAR = gtsam.Pose3(), gtsam.Pose3.Expmap(np.array([0.1, -0.05, 0.08, 0.3, 0.2, -0.1]))
TWIST = np.array([0.1, 0.2, 0.3, 1.0, -2.0, 5.0])
COVARIANCE = np.diag(np.repeat([1e-4, 1e-2], 3))


class Bench:
    """One scene, and every factor on given keys."""

    def __init__(self, make_scene):
        self.points, self.cTl, self.time_offset_s, self.twist = make_scene(3)
        self.contour, *_ = make_scene(3, normals=True)

    def values(self, offset=None):
        """All variables; the offset as a Vector(1), or as it is given."""
        values = gtsam.Values()
        values.insert(E, self.cTl)
        values.insert(D, np.array([self.time_offset_s]) if offset is None else offset)
        values.insert(B, np.array([0.5]))
        for k in range(3):
            values.insert(V[k], self.twist + 0.01 * k)
            values.insert(X[k], gtsam.Pose3.Expmap(0.1 * k * TWIST))
        return values

    def makers(self):
        """By name, of (extrinsic, offset) to the factor on them."""
        first, second = Between(X[0], X[1], 0.1, 0.02), Between(X[1], X[2], 0.1, 0.02)
        later = Between(X[0], X[1], 0.1, 0.02, X_scan=X[2])
        seen, turned = CameraMotion(NEAR, COVARIANCE), NEAR.rotation()
        driven = LidarMotion(NEAR, TWIST, 1.1 * TWIST, 0.0)
        turn = LidarMotion.of_turn(turned, TWIST[:3], TWIST[:3], 0.0)
        points, contour = self.points, self.contour
        return {
            "frame_factor": lambda E, D: frame_factor([points, contour], E, D, V[0], [None, B]),
            "stacked frame_factor": lambda E, D: stacked(frame_factor([points], E, D, V[0])),
            "point_to_pixel_factor": lambda E, D: point_to_pixel_factor(points, E, D, V[0]),
            "pixel_to_point_factor": lambda E, D: pixel_to_point_factor(points, E, D, V[0]),
            "silhouette_factor": lambda E, D: silhouette_factor(contour, E, D, V[0], B),
            "pose_alignment_factor": lambda E, D: pose_alignment_factor([points], first, E, D),
            "with a scan of another time": lambda E, D: pose_alignment_factor([points], later, E, D),
            "camera_motion_factor": lambda E, D: camera_motion_factor(first, second, E, D, seen),
            "hand_eye_factor": lambda E, D: hand_eye_factor(E, D, seen, driven),
            "rotation_hand_eye": lambda E, D: rotation_hand_eye(E, D, turned, turn, COVARIANCE[:3, :3]),
            "twist_transfer_factor": lambda E, D: twist_transfer_factor(
                V[0], E, D, LidarTwist(TWIST, 0.1 * TWIST, 0.0), COVARIANCE
            ),
        }


NAMES = [
    "frame_factor",
    "stacked frame_factor",
    "point_to_pixel_factor",
    "pixel_to_point_factor",
    "silhouette_factor",
    "pose_alignment_factor",
    "with a scan of another time",
    "camera_motion_factor",
    "hand_eye_factor",
    "rotation_hand_eye",
    "twist_transfer_factor",
]

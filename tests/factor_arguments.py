"""Arguments that fit, of every public constructor and function of ``sst_graph.factors``."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, D, E, T, V, X
from wrong_objects import POSE, PRIOR, PRIORS, UNIT

from sst_graph import factors

CAMERA = factors.PinholeCamera(700.0, 700.0, 600.0, 180.0, 1242, 375)
TWIST = np.array([0.1, 0.2, 0.1, 1.0, 0.5, 8.0])
LPS, PIXELS = np.array([[1.0, 2.0, 8.0 + k] for k in range(5)]), np.array([[600.0, 180.0]] * 5)
POINTS = factors.Alignment(CAMERA, LPS, 0.1, PIXELS, 1.0)  # type: ignore[arg-type]  # one number for all
OUTLINE = replace(POINTS, normals=np.array([[1.0, 0.0]] * 5))
COVARIANCE = 0.01 * np.eye(6)
BETWEEN = factors.Between(X(0), X(1), 0.1, 0.02)
CAMERA_MOTION = factors.CameraMotion(POSE, COVARIANCE)
LIDAR_MOTION = factors.LidarMotion(POSE, TWIST, TWIST, 0.0)
FRAME = factors.frame_factor([POINTS], E(0), D(0), V(0))
VALUES = gtsam.Values()
for _key, _value in ((E(0), POSE), (D(0), np.array([0.1])), (V(0), TWIST)):
    VALUES.insert(_key, _value)


def _identity(vector: np.ndarray, *, jacobians: bool) -> tuple[np.ndarray, list[np.ndarray] | None]:
    return vector, [np.eye(6)] if jacobians else None


RIGHT: dict[str, dict[str, Any]] = {
    "Alignment": {
        "camera": CAMERA,
        "lPs": OUTLINE.lPs,
        "base_taus_s": 0.1,
        "pixels": OUTLINE.pixels,
        "sigmas_px": 1.0,
        "normals": OUTLINE.normals,
        "kernel": factors.RobustKernel(),
        "c_acceleration": TWIST,
        "motion_model": "se3",
        "weights": np.ones(5),
        "l_velocities": np.zeros((5, 3)),
        "stretches": np.ones(5),
    },
    "Between": {
        "X_a": X(0),
        "X_b": X(1),
        "seconds": 0.1,
        "image_after_a_s": 0.02,
        "X_scan": X(2),
        "bTl": POSE,
    },
    "CameraMotion": {"c1Tc2": POSE, "covariance": COVARIANCE},
    "CameraTwist": {"c_twist": TWIST, "c_acceleration": TWIST},
    "DirectionSigmas": {"omega": 0.1, "direction_rad": 0.1, "speed_mps": 0.1},
    "FactorRecipe": {
        "noise": UNIT,
        "keys": {V(0): ""},
        "function": _identity,
        "dims": (6,),
        "rows": 6,
        "name": "mine",
    },
    "GncParams": {"inlier_cost": 5.0, "mu_step": 1.4, "max_iterations": 60, "weights_tolerance": 1e-3},
    "GroupedBias": {"biases": (B(0), B(1)), "groups": np.array([0, 1, 1, 0, 0])},
    "LidarMotion": {"l1Tl2": POSE, "l_twist_1": TWIST, "l_twist_2": TWIST, "time_offset_0_s": 0.1},
    "LidarTwist": {"l_twist": TWIST, "l_acceleration": TWIST, "time_offset_0_s": 0.1},
    "LinearTerm": {"key": T(0), "coefficients": np.ones(5), "at": 0.1},
    "PackedGraph": {"factors": (PRIOR, None)},
    "PinholeCamera": {"fx": 700.0, "fy": 700.0, "cx": 600.0, "cy": 180.0, "width": 1242, "height": 375},
    "RobustKernel": {"kind": "huber", "scale": 3.0},
    "Vector": {"size": 6},
    "beta_regularizer": {"key": E(0), "cTl_static": POSE, "lambda_t": 1e6, "lambda_r": 1e9},
    "camera_motion_factor": {
        "first": BETWEEN,
        "second": factors.Between(X(1), X(2), 0.1, 0.02),
        "cTl": E(0),
        "time_offset_s": D(0),
        "camera_motion": CAMERA_MOTION,
    },
    "camera_pose_factor": {"E_b": E(0), "E_c": E(1), "cTb": POSE, "covariance": COVARIANCE},
    "check_gradient": {"factor": FRAME, "values": VALUES, "tolerance": 1e-4, "step": 1e-3},
    "check_jacobians": {"factor": PRIOR, "values": VALUES, "tolerance": 1e-4, "step": 1e-3},
    "clone_factor": {"factor": FRAME},
    "clone_graph": {"graph": PRIORS},
    "condense": {"G": np.eye(4), "constant": 1.0},
    "custom_factor": {
        "noise": UNIT,
        "keys": {"V": V(0)},
        "function": _identity,
        "dims": [6],
        "rows": 6,
        "name": "mine",
    },
    "extrinsic_drift": {"E_a": E(0), "E_b": E(1), "seconds": 1.0, "sigma_rot": 0.1, "sigma_trans": 0.1},
    "frame_factor": {
        "alignments": [OUTLINE],
        "cTl": E(0),
        "time_offset_s": D(0),
        "c_twist": V(0),
        "biases_px": [B(0)],
        "terms": [[factors.LinearTerm(T(0), np.ones(5))]],
    },
    "gnc": {
        "graph": PRIORS,
        "values": VALUES,
        "config": factors.GncParams(5.0),
        "known_inliers": [0],
    },
    "hand_eye_factor": {
        "E": E(0),
        "D": D(0),
        "camera_motion": CAMERA_MOTION,
        "lidar_motion": LIDAR_MOTION,
    },
    "mean_velocity_factor": {"V_a": V(0), "V_b": V(1), "mean_twist": TWIST, "covariance": COVARIANCE},
    "move_points": {
        "cTl": POSE,
        "lPs": OUTLINE.lPs.T,
        "taus_s": 0.1,
        "motion": factors.CameraTwist(TWIST, TWIST),
        "model": "se3",
        "l_velocities": np.zeros((3, 5)),
    },
    "pose_alignment_factor": {
        "alignments": [OUTLINE],
        "between": BETWEEN,
        "cTl": E(0),
        "time_offset_s": D(0),
        "biases_px": [B(0)],
        "noise": gtsam.noiseModel.Isotropic.Sigma(1, 2.0),
    },
    "recipe_of": {"factor": FRAME},
    "rekeyed": {"factor": FRAME, "new_keys": {E(0): E(1)}},
    "rotation_hand_eye": {
        "E": E(0),
        "D": D(0),
        "c1Rc2": POSE.rotation(),
        "lidar_motion": LIDAR_MOTION,
        "covariance": 0.01 * np.eye(3),
    },
    "stacked": {"factor": FRAME},
    "time_offset_drift": {"D_a": D(0), "D_b": D(1), "seconds": 1.0, "sigma_s_per_sqrt_s": 0.1},
    "time_offset_prior": {"D_key": D(0), "time_offset_s": 0.1, "sigma_s": 0.1},
    "twist_jerk_factor": {
        "V_a": V(0),
        "V_b": V(1),
        "V_c": V(2),
        "seconds": (0.1, 0.1),
        "sigma_rot_jerk": 1.0,
        "sigma_lin_jerk": 1.0,
    },
    "twist_smoothness_factor": {
        "V_a": V(0),
        "V_b": V(1),
        "seconds": 0.1,
        "sigma_rot_acc": 1.0,
        "sigma_lin_acc": 1.0,
    },
    "twist_transfer_factor": {
        "V_key": V(0),
        "E_key": E(0),
        "D_key": D(0),
        "lidar_twist": factors.LidarTwist(TWIST, TWIST, 0.0),
        "covariance": COVARIANCE,
    },
    "velocity_direction_factor": {
        "V_key": V(0),
        "omega": TWIST[:3],
        "direction": TWIST[3:],
        "speed_mps": 5.0,
        "sigmas": factors.DirectionSigmas(0.1, 0.1, 0.1),
        "low_speed_mps": 0.5,
    },
    "velocity_factor": {"V_key": V(0), "c_twist": TWIST, "covariance": COVARIANCE},
    **{
        name: {"alignment": OUTLINE, "cTl": POSE, "time_offset_s": 0.1, "c_twist": TWIST, "bias_px": 0.5}
        for name in ("residuals", "weighted_residuals", "alignment_cost")
    },
    **{
        name: {"alignment": POINTS, "cTl": E(0), "time_offset_s": D(0), "c_twist": V(0)}
        for name in ("point_to_pixel_factor", "pixel_to_point_factor")
    },
    "silhouette_factor": {
        "alignment": OUTLINE,
        "cTl": E(0),
        "time_offset_s": D(0),
        "c_twist": V(0),
        "bias_px": B(0),
    },
}
"""Arguments that fit, of each public name; flags apart."""

"""Every public constructor and function refuses what is no argument of it, in one sentence.

Each is called once with arguments that fit, then with each of them replaced by each of the wrong objects that
a new user of gtsam might give. What does not fit is answered with a FactorError; what fits is listed.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, D, E, T, V, X
from wrong_objects import POSE, PRIOR, PRIORS, UNIT, WRONG

from sst_graph import factors
from sst_graph.factors import FactorError

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

MADE_HERE = {"RigidlyMoved", "PointwiseMoved", "JacobianBlock", "JacobianReport", "GncSolution"}
"""Results: the package makes them, a caller reads them."""
NO_CALLABLES = {"Kind", "KernelKind", "MotionModel", "MIN_DEPTH_M", "FactorError"}

KEY, NUMBER, POSITIVE = {"int"}, {"int", "negative", "float"}, {"int", "float"}
KEY_OR_NUMBER, KEY_OR_POSE = {"int", "float"}, {"int", "Pose3"}
BY_NAME: list[tuple[str, set[str]]] = [
    ("X_a X_b key E E_a E_b E_c V_a V_b V_c V_key E_key D_key D_a D_b", KEY),
    ("at base_taus_s cx cy image_after_a_s speed_mps taus_s time_offset_0_s", NUMBER),
    ("fx fy omega direction_rad lambda_t lambda_r low_speed_mps constant inlier_cost tolerance", POSITIVE),
    ("scale seconds sigma_rot sigma_trans sigma_s sigmas_px sigma_s_per_sqrt_s weights", POSITIVE),
    ("sigma_rot_acc sigma_lin_acc sigma_rot_jerk sigma_lin_jerk", POSITIVE),
    ("width height size max_iterations mu_step", {"int"}),
    ("c1Tc2 cTb cTl_static l1Tl2", {"Pose3"}),
    ("X_scan D c_twist", KEY | {"None"}),
    ("l_velocities stretches terms", {"None"}),
]
FITS: dict[str, set[str]] = {
    **{name: fits for names, fits in BY_NAME for name in names.split()},
    "G": {"matrix"},
    "bTl": {"Pose3", "None"},
    "bias_px": NUMBER | {"None"},
    "biases": {"array", "list"},
    "biases_px": KEY_OR_NUMBER | {"None"},
    "c1Rc2": {"Rot3"},
    "cTl": KEY_OR_POSE,
    "coefficients": {"array", "list", "empty"},
    "factor": {"factor"},
    "function": {"function", "class"},
    "custom_factor.function": {"class"},
    "graph": {"graph"},
    "groups": {"array", "empty"},
    "known_inliers": {"empty"},
    "name": {"text"},
    "new_keys": {"dict"},
    "noise": {"noise model"},
    "pixels": {"points of two"},
    "time_offset_s": KEY_OR_NUMBER,
    "CameraTwist.c_twist": set(),
    "DirectionSigmas.speed_mps": POSITIVE,
    "GncParams.inlier_cost": POSITIVE | {"function", "class"},
    "LidarTwist.l_twist": set(),
    "check_gradient.factor": {"factor", "other's factor"},
    "check_jacobians.factor": {"factor", "other's factor"},
    "check_jacobians.step": {"float"},  # a step that is right for the linear factor
    "mean_velocity_factor.mean_twist": set(),
    "move_points.cTl": {"Pose3"},
    "pose_alignment_factor.noise": {"None"},
    "recipe_of.factor": {"factor", "other's factor"},
    "stacked.factor": set(),
    "time_offset_prior.time_offset_s": NUMBER,
    "twist_jerk_factor.seconds": set(),
    "velocity_direction_factor.direction": {"list"},
    "velocity_direction_factor.omega": {"array", "list"},
    "silhouette_factor.bias_px": KEY_OR_NUMBER | {"None"},
    "velocity_factor.c_twist": set(),
}
"""Which of these are right after all: by name of the argument, or by name of the function and argument."""
for _name in ("residuals", "weighted_residuals", "alignment_cost"):
    FITS |= {f"{_name}.cTl": {"Pose3"}, f"{_name}.time_offset_s": NUMBER, f"{_name}.c_twist": set()}


def fitting(name: str, argument: str) -> set[str]:
    """Which of the wrong objects are right for this argument."""
    return FITS.get(f"{name}.{argument}", FITS.get(argument, set()))


def test_all_public_names_are_called_here() -> None:
    assert set(RIGHT) | MADE_HERE | NO_CALLABLES == set(factors.__all__)
    for name, right in RIGHT.items():
        flags = {"double", "scale_known", "jacobians"}
        assert set(inspect.signature(getattr(factors, name)).parameters) - flags == set(right), name


@pytest.mark.parametrize("name", RIGHT)
def test_what_is_no_argument_is_refused_in_one_sentence(name: str) -> None:
    call: Callable[..., Any] = getattr(factors, name)
    call(**RIGHT[name])
    for argument in RIGHT[name]:
        fits = fitting(name, argument)
        for kind, wrong in WRONG.items():
            try:
                call(**{**RIGHT[name], argument: wrong})
            except FactorError as error:
                said = str(error)
                assert kind not in fits, f"{name}({argument}={kind}): {said}"
                assert ": found " in said and ", expected " in said and "\n" not in said, said
                assert len(said) < 300 or argument == "step", said  # which are reports on a Jacobian
            except Exception as error:
                pytest.fail(f"{name}({argument}={kind}): {type(error).__name__}: {error}")
            else:
                assert kind in fits, f"{name}({argument}={kind}) was taken"

"""GTSAM factors for target-less LiDAR-camera calibration in space and time.

The package needs gtsam and NumPy only. Every convention of the project is stated here, once.

Frames
    ``w`` world, ``b`` body, ``l`` LiDAR, ``c`` camera (optical: x right, y down, z forward).
Transforms
    ``cTl`` maps LiDAR coordinates into the camera: ``cP = cTl.transformFrom(lP)``. In files and
    prose it is ``T_camera_lidar``, always "p_camera = T_camera_lidar . p_lidar". Inner letters
    meet: ``wTc * cTl``.
Time offset
    ``t_lidar = t_camera_stamp + time_offset_s``: an image stamped ``t`` shows the world at
    LiDAR-clock time ``t + offset`` (the sign of Kalibr's ``timeshift``, of OpenVINS and of VINS ``td``).
Interval of a pair
    ``tau = (t_image_stamp + offset) - t_point`` [s]; ``t_point`` is the scan's stamp or, where the
    data has it, the point's own time.
Twist
    ``c_twist = [omega, v]`` of the camera in its own frame, gtsam order, rad/s and m/s. A static
    world point moves as ``cP(tau) = Exp(-c_twist * tau) . cP``. (The v_k of SST-Calib is the
    *apparent* velocity of the points, -v.)
Covariance
    7x7 over [rotation xyz rad, translation xyz m, offset s]; right perturbation
    ``cTl * Exp(xi)``, as gtsam has it. A sigma is never called a covariance.
Residual
    predicted - measured, in pixels, unwhitened; sigmas in pixels belong to the noise model.
Pixels
    The centre of the top-left pixel is (0, 0), as in OpenCV.
Variables
    extrinsic E ``Pose3``, offset D ``Vector(1)``, twist V ``Vector(6)``, mask bias B ``Vector(1)``
    or ``double`` for D and B (which gtsam's Values cannot serialize). A factor takes their keys, ints or
    ``gtsam.Symbol``; a float or an array in place of a key fixes the quantity.
Units
    SI inside; a suffix at boundaries (``_s _ns _px _deg``). Degrees are for people only.
Arrays
    A batch of points is ``(n, 3)``, of pixels ``(n, 2)``. Jacobians of a batch stay ``(n, rows, cols)``
    or column-major ``(cols, n)`` where speed needs it; each docstring says which.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .alignment import (
        Alignment,
        GroupedBias,
        LinearTerm,
        alignment_cost,
        frame_factor,
        pixel_to_point_factor,
        point_to_pixel_factor,
        residuals,
        silhouette_factor,
        stacked,
        weighted_residuals,
    )
    from .camera import MIN_DEPTH_M, PinholeCamera
    from .camera_motion import Between, camera_motion_factor
    from .camera_pose import camera_pose_factor
    from .condensed import condense
    from .custom.cloning import PackedGraph, clone_factor, clone_graph, rekeyed
    from .custom.factor import FactorRecipe, custom_factor, recipe_of
    from .custom.gnc import GncParams, GncSolution, gnc
    from .custom.jacobian_check import JacobianBlock, JacobianReport, check_gradient, check_jacobians
    from .custom.variables import Kind, Vector
    from .errors import FactorError
    from .hand_eye import CameraMotion, LidarMotion, hand_eye_factor, rotation_hand_eye
    from .motion import CameraTwist, MotionModel, PointwiseMoved, RigidlyMoved, move_points
    from .pose_alignment import pose_alignment_factor
    from .priors import beta_regularizer, extrinsic_drift, time_offset_drift, time_offset_prior
    from .robust import KernelKind, RobustKernel
    from .velocity import (
        DirectionSigmas,
        LidarTwist,
        mean_velocity_factor,
        twist_jerk_factor,
        twist_smoothness_factor,
        twist_transfer_factor,
        velocity_direction_factor,
        velocity_factor,
    )

__all__ = [
    "MIN_DEPTH_M",
    "Alignment",
    "Between",
    "CameraMotion",
    "CameraTwist",
    "DirectionSigmas",
    "FactorError",
    "FactorRecipe",
    "GncParams",
    "GncSolution",
    "GroupedBias",
    "JacobianBlock",
    "JacobianReport",
    "KernelKind",
    "Kind",
    "LidarMotion",
    "LidarTwist",
    "LinearTerm",
    "MotionModel",
    "PackedGraph",
    "PinholeCamera",
    "PointwiseMoved",
    "RigidlyMoved",
    "RobustKernel",
    "Vector",
    "alignment_cost",
    "beta_regularizer",
    "camera_motion_factor",
    "camera_pose_factor",
    "check_gradient",
    "check_jacobians",
    "clone_factor",
    "clone_graph",
    "condense",
    "custom_factor",
    "extrinsic_drift",
    "frame_factor",
    "gnc",
    "hand_eye_factor",
    "mean_velocity_factor",
    "move_points",
    "pixel_to_point_factor",
    "point_to_pixel_factor",
    "pose_alignment_factor",
    "recipe_of",
    "rekeyed",
    "residuals",
    "rotation_hand_eye",
    "silhouette_factor",
    "stacked",
    "time_offset_drift",
    "time_offset_prior",
    "twist_jerk_factor",
    "twist_smoothness_factor",
    "twist_transfer_factor",
    "velocity_direction_factor",
    "velocity_factor",
    "weighted_residuals",
]

_MODULES = {
    "alignment": (
        "Alignment GroupedBias LinearTerm alignment_cost frame_factor pixel_to_point_factor "
        "point_to_pixel_factor residuals silhouette_factor stacked weighted_residuals"
    ),
    "camera": "MIN_DEPTH_M PinholeCamera",
    "camera_motion": "Between camera_motion_factor",
    "camera_pose": "camera_pose_factor",
    "condensed": "condense",
    "custom.cloning": "PackedGraph clone_factor clone_graph rekeyed",
    "custom.factor": "FactorRecipe custom_factor recipe_of",
    "custom.gnc": "GncParams GncSolution gnc",
    "custom.jacobian_check": "JacobianBlock JacobianReport check_gradient check_jacobians",
    "custom.variables": "Kind Vector",
    "errors": "FactorError",
    "hand_eye": "CameraMotion LidarMotion hand_eye_factor rotation_hand_eye",
    "motion": "CameraTwist MotionModel PointwiseMoved RigidlyMoved move_points",
    "pose_alignment": "pose_alignment_factor",
    "priors": "beta_regularizer extrinsic_drift time_offset_drift time_offset_prior",
    "robust": "KernelKind RobustKernel",
    "velocity": (
        "DirectionSigmas LidarTwist mean_velocity_factor twist_jerk_factor twist_smoothness_factor "
        "twist_transfer_factor velocity_direction_factor velocity_factor"
    ),
}
"""The public names of each module."""
_HOMES = {name: module for module, names in _MODULES.items() for name in names.split()}


def __getattr__(name: str) -> Any:
    """Import what is asked for when it is asked for: the exceptions need neither gtsam nor NumPy."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"sst_graph.factors.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])

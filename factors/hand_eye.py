"""Motion-based factors: the LiDAR's own motion against the camera's, without a common field of view.

    c1Tc2 = cTl . l1Tl2(d) . cTl^-1,    l1Tl2(d) = Exp(-l_twist_1 d) . l1Tl2 . Exp(l_twist_2 d)

The camera moves from its stamp t1 to t2, on the LiDAR's clock from t1 + D to t2 + D. The LiDAR's motion
l1Tl2 was measured over [t1 + D0, t2 + D0], D0 = ``time_offset_0_s``, and is carried by d = D - D0 at both
ends with the LiDAR's twist there. Turns determine the rotation, and turns that begin or end the time offset;
translation along the axis of a plane motion stays free. Sources: Taylor & Nieto, Motion-based calibration
of multimodal sensor extrinsics and timing offset estimation, T-RO 2016; Park et al., Spatiotemporal
camera-LiDAR calibration, 2020.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from .arguments import (
    FloatArray,
    checked_array,
    checked_covariance,
    checked_gtsam,
    checked_number,
    checked_type,
)
from .custom.factor import ResidualFunction, custom_factor
from .custom.variables import Kind, Vector
from .errors import FactorError

MotionError = Callable[[gtsam.Pose3, bool], tuple[FloatArray, FloatArray | None]]
"""Of a predicted motion of the camera: error (6,) and derivative (6, 6) by its right perturbation."""

_A_LIDAR_MOTION = "a sst_graph.factors.LidarMotion"

LOW_TRANSLATION_M = 0.02
"""Below this length [m] of the predicted translation its direction is known less and less well."""


@dataclass(frozen=True, eq=False)
class CameraMotion:
    """What visual odometry measured between two images.

    Attributes:
        c1Tc2: pose of the camera at 2 in the camera at 1; any length where the scale is unknown.
        covariance: (6, 6) of the error [rot, trans], right perturbation of c1Tc2. With an unknown scale its
            part across the translation, divided by the length that c1Tc2 has, is the direction's [rad^2];
            that along it is not used.
        scale_known: False where the translation's direction alone was measured.

    Raises:
        FactorError: no pose, no covariance, or no direction where it is all that was measured.
    """

    c1Tc2: gtsam.Pose3
    covariance: FloatArray
    scale_known: bool = True

    def __post_init__(self) -> None:
        checked_gtsam("c1Tc2 of CameraMotion", self.c1Tc2, gtsam.Pose3)
        covariance = checked_covariance("covariance of CameraMotion", self.covariance, 6)
        object.__setattr__(self, "covariance", covariance)
        if not self.scale_known and not np.any(self.c1Tc2.translation()):
            raise FactorError("translation of c1Tc2", "zero", "a direction, where the scale is unknown")


@dataclass(frozen=True, eq=False)
class LidarMotion:
    """What LiDAR odometry measured between the same two images.

    Attributes:
        l1Tl2: pose of the LiDAR at 2 in the LiDAR at 1, over the interval at ``time_offset_0_s``.
        l_twist_1, l_twist_2: (6,) twist of the LiDAR in its own frame at both ends [rad/s, m/s].
        time_offset_0_s: the time offset at which l1Tl2 was measured [s].

    Raises:
        FactorError: no pose, or numbers of a wrong shape.
    """

    l1Tl2: gtsam.Pose3
    l_twist_1: FloatArray
    l_twist_2: FloatArray
    time_offset_0_s: float

    def __post_init__(self) -> None:
        checked_gtsam("l1Tl2 of LidarMotion", self.l1Tl2, gtsam.Pose3)
        for name in ("l_twist_1", "l_twist_2"):
            object.__setattr__(self, name, checked_array(f"{name} of LidarMotion", getattr(self, name), (6,)))
        time_offset_0_s = checked_number("time_offset_0_s of LidarMotion", self.time_offset_0_s)
        object.__setattr__(self, "time_offset_0_s", time_offset_0_s)

    @classmethod
    def of_turn(
        cls, l1Rl2: gtsam.Rot3, l_omega_1: ArrayLike, l_omega_2: ArrayLike, time_offset_0_s: float
    ) -> LidarMotion:
        """A motion of which only the rotation is known, for :func:`rotation_hand_eye`.

        Args:
            l1Rl2: rotation of the LiDAR at 2 in the LiDAR at 1.
            l_omega_1, l_omega_2: (3,) its rate at both ends, in the LiDAR's frame [rad/s].
            time_offset_0_s: as of the class [s].
        """
        checked_gtsam("l1Rl2 of LidarMotion", l1Rl2, gtsam.Rot3)
        twists = [
            np.concatenate([checked_array("l_omega of LidarMotion", w, (3,)), np.zeros(3)])
            for w in (l_omega_1, l_omega_2)
        ]
        return cls(gtsam.Pose3(l1Rl2, np.zeros(3)), twists[0], twists[1], time_offset_0_s)

    def in_camera(
        self, cTl: gtsam.Pose3, offset: tuple[FloatArray, ...], jacobians: bool
    ) -> tuple[gtsam.Pose3, list[FloatArray]]:
        """cTl . l1Tl2(d) . cTl^-1, and where they are asked for its Jacobians (6, dim) by cTl [and the
        offset], right perturbations.

        Args:
            offset: the time offset as a (1,) array, or none for d = 0 [s].
        """
        d = float(offset[0][0]) - self.time_offset_0_s if offset else 0.0
        before, after = gtsam.Pose3.Expmap(-d * self.l_twist_1), gtsam.Pose3.Expmap(d * self.l_twist_2)
        moved = before * self.l1Tl2 * after
        predicted = cTl * moved * cTl.inverse()
        if not jacobians:
            return predicted, []
        back, cAd = moved.inverse().AdjointMap(), cTl.AdjointMap()
        H = [cAd @ (back - np.eye(6))]
        if offset:
            H.append((cAd @ (self.l_twist_2 - back @ self.l_twist_1)).reshape(6, 1))
        return predicted, H


def hand_eye_factor(
    E: int, D: int | None, camera_motion: CameraMotion, lidar_motion: LidarMotion
) -> gtsam.CustomFactor:
    """Log(c1Tc2^-1 . cTl . l1Tl2(d) . cTl^-1), predicted - measured [rad, m].

    Of a camera's motion whose scale is unknown, the translation enters by its direction only: [Log of the
    rotation (rad); t / sqrt(|t|^2 + s^2) - t_m / |t_m|], s = :data:`LOW_TRANSLATION_M`, t predicted, t_m
    measured.

    Args:
        E: extrinsic.
        D: time offset, or None where the motions are known to be synchronous (d = 0).
        camera_motion: its covariance is that of the error: both motions' together, that of the LiDAR carried
            to the camera.
        lidar_motion: over the same interval.

    Raises:
        FactorError: no keys, or motions that are none.
    """
    checked_type(
        "camera_motion of hand_eye_factor", camera_motion, CameraMotion, "a sst_graph.factors.CameraMotion"
    )
    checked_type("lidar_motion of hand_eye_factor", lidar_motion, LidarMotion, _A_LIDAR_MOTION)
    motion_error, noise = camera_motion_error(camera_motion)
    return _factor("hand_eye_factor", E, D, partial(_hand_eye, lidar_motion, motion_error), noise, 6)


def _hand_eye(
    motion: LidarMotion, error_of: MotionError, cTl: gtsam.Pose3, *offset: FloatArray, jacobians: bool
) -> tuple[FloatArray, list[FloatArray] | None]:
    predicted, P_H = motion.in_camera(cTl, offset, jacobians)
    error, error_H_P = error_of(predicted, jacobians)
    return error, None if error_H_P is None else [error_H_P @ H for H in P_H]


def rotation_hand_eye(
    E: int, D: int | None, c1Rc2: gtsam.Rot3, lidar_motion: LidarMotion, covariance: ArrayLike
) -> gtsam.CustomFactor:
    """Log(c1Rc2^-1 . cRl . l1Rl2(d) . cRl^-1) [rad], the rotation of :func:`hand_eye_factor` alone.

    The Jacobian by the extrinsic's translation is zero: something else must hold it.

    Args:
        E: extrinsic.
        D: time offset, or None where the motions are known to be synchronous (d = 0).
        c1Rc2: measured rotation of the camera at 2 in the camera at 1.
        lidar_motion: only its rotation counts; see :meth:`LidarMotion.of_turn`.
        covariance: (3, 3) of the error, both motions' together [rad^2].

    Raises:
        FactorError: no keys, no rotation, no motion, no covariance.
    """
    checked_gtsam("c1Rc2 of rotation_hand_eye", c1Rc2, gtsam.Rot3)
    checked_type("lidar_motion of rotation_hand_eye", lidar_motion, LidarMotion, _A_LIDAR_MOTION)
    noise = gtsam.noiseModel.Gaussian.Covariance(
        checked_covariance("covariance of the rotation", covariance, 3)
    )
    function = partial(_rotation_hand_eye, lidar_motion, c1Rc2)
    return _factor("rotation_hand_eye", E, D, function, noise, 3)


def _rotation_hand_eye(
    motion: LidarMotion, c1Rc2: gtsam.Rot3, cTl: gtsam.Pose3, *offset: FloatArray, jacobians: bool
) -> tuple[FloatArray, list[FloatArray] | None]:
    predicted, P_H = motion.in_camera(cTl, offset, jacobians)
    error = gtsam.Rot3.Logmap(c1Rc2.between(predicted.rotation()))
    if not jacobians:
        return error, None
    Log_H = gtsam.Rot3.LogmapDerivative(error)
    return error, [Log_H @ H[:3] for H in P_H]


def _factor(
    name: str, E: int, D: int | None, function: ResidualFunction, noise: Any, rows: int
) -> gtsam.CustomFactor:
    kinds: list[Kind] = [gtsam.Pose3, Vector(1)]
    keys = {"E": E} if D is None else {"E": E, "D": D}
    return custom_factor(noise, keys, function, kinds[: len(keys)], rows, name)


def camera_motion_error(measured: CameraMotion) -> tuple[MotionError, gtsam.noiseModel.Base]:
    """Error of a predicted c1Tc2 against the measured one, with its derivative, and the noise of it.

    The equation is that of :func:`hand_eye_factor`.
    """
    c1Tc2, covariance = measured.c1Tc2, measured.covariance
    if measured.scale_known:
        return partial(_pose_error, c1Tc2), gtsam.noiseModel.Gaussian.Covariance(covariance)
    t = np.asarray(c1Tc2.translation())
    length = float(np.linalg.norm(t))
    noise = gtsam.noiseModel.Gaussian.Covariance(_direction_covariance(c1Tc2, covariance))
    return partial(_direction_error, c1Tc2.rotation(), t / length), noise


def _pose_error(
    c1Tc2: gtsam.Pose3, predicted: gtsam.Pose3, jacobians: bool
) -> tuple[FloatArray, FloatArray | None]:
    error = np.asarray(gtsam.Pose3.Logmap(c1Tc2.between(predicted)))
    return error, np.asarray(gtsam.Pose3.LogmapDerivative(error)) if jacobians else None


def _direction_error(
    c1Rc2: gtsam.Rot3, direction: FloatArray, predicted: gtsam.Pose3, jacobians: bool
) -> tuple[FloatArray, FloatArray | None]:
    log = gtsam.Rot3.Logmap(c1Rc2.between(predicted.rotation()))
    t = np.asarray(predicted.translation())
    length = np.sqrt(t @ t + LOW_TRANSLATION_M**2)
    error = np.concatenate([log, t / length - direction])
    if not jacobians:
        return error, None
    H = np.zeros((6, 6))
    H[:3, :3] = gtsam.Rot3.LogmapDerivative(log)
    # t of P Exp([w, v]) is t + R v
    H[3:, 3:] = (np.eye(3) - np.outer(t, t) / length**2) / length @ predicted.rotation().matrix()
    return error, H


def _direction_covariance(c1Tc2: gtsam.Pose3, covariance: FloatArray) -> FloatArray:
    """(6, 6) of [rotation, unit direction] from that of the pose.

    Across the direction it is the pose's, by length; along it, where the difference of two unit vectors
    is of second order, the mean of the two across keeps it regular.
    """
    t = np.asarray(c1Tc2.translation())
    length = np.linalg.norm(t)
    d = t / length
    transfer = np.eye(6)
    transfer[3:, 3:] = (np.eye(3) - np.outer(d, d)) / length @ c1Tc2.rotation().matrix()
    result = transfer @ covariance @ transfer.T
    result[3:, 3:] += 0.5 * np.trace(result[3:, 3:]) * np.outer(d, d)
    return np.asarray(0.5 * (result + result.T))

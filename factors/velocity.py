"""Factors on the camera's twist at each image: measured velocity, mean motion, smoothness, the LiDAR's twist.

Twists are ``Vector(6)`` = [omega, v] of the camera in its own frame [rad/s, m/s].
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from .arguments import (
    FloatArray,
    checked_array,
    checked_covariance,
    checked_number,
    checked_positive,
    checked_type,
)
from .custom.factor import custom_factor, own_factor
from .custom.variables import Kind, Vector, checked_key, checked_keys
from .errors import FactorError
from .motion import twist_ad

LOW_SPEED_MPS = 0.5
"""Below this speed [m/s] a direction of motion is known less and less well; see velocity_direction_factor."""


def velocity_factor(V_key: int, c_twist: ArrayLike, covariance: ArrayLike) -> gtsam.PriorFactorVector:
    """V - c_twist, with the (6, 6) covariance of the measured twist (visual odometry, one frame)."""
    measured = checked_array("c_twist", c_twist, (6,))
    noise = gtsam.noiseModel.Gaussian.Covariance(checked_covariance("covariance of the twist", covariance, 6))
    return gtsam.PriorFactorVector(checked_key("velocity_factor", "V_key", V_key), measured, noise)


@dataclass(frozen=True)
class DirectionSigmas:
    """Standard deviations of a measured motion whose scale is apart.

    Attributes:
        omega: of the rotation rate, each axis [rad/s].
        direction_rad: of the direction, each of the two axes across it [rad].
        speed_mps: of the speed along it [m/s].

    Raises:
        FactorError: one that is not above 0.
    """

    omega: float
    direction_rad: float
    speed_mps: float

    def __post_init__(self) -> None:
        for name in ("omega", "direction_rad", "speed_mps"):
            checked = checked_positive(f"{name} of DirectionSigmas", getattr(self, name))
            object.__setattr__(self, name, checked)


def velocity_direction_factor(
    V_key: int,
    omega: ArrayLike,
    direction: ArrayLike,
    speed_mps: float,
    sigmas: DirectionSigmas,
    low_speed_mps: float = LOW_SPEED_MPS,
) -> gtsam.CustomFactor:
    """[omega_V - omega; B^T v / sqrt(|v|^2 + s^2); d . v - speed], for odometry whose scale is apart.

    The five-point method gives a rotation and a direction d; the metric speed comes from elsewhere with
    another sigma. B (3, 2) spans the plane normal to d, so that at speed rows 3 and 4 are the angle from
    d to v [rad]; at a speed below s they turn into B^T v / s, which bounds what a direction may claim:
    a sigma of sigmas.direction_rad * max(|v|, s) [m/s] across d, without a singularity at rest. The sign
    of d is decided by the last row.

    Args:
        V_key: twist.
        omega: (3,) rotation rate in the camera frame [rad/s].
        direction: (3,) direction of the camera's motion in its own frame, any length but zero.
        speed_mps: metric speed along the direction [m/s].
        sigmas: of the three.
        low_speed_mps: s [m/s].
    """
    name = "sigmas of velocity_direction_factor"
    checked_type(name, sigmas, DirectionSigmas, "a sst_graph.factors.DirectionSigmas")
    measured_omega = checked_array("omega", omega, (3,))
    d = checked_array("direction", direction, (3,))
    length = float(np.linalg.norm(d))
    if length == 0.0:
        raise FactorError("direction", "the zero vector", "a direction")
    d = d / length
    speed = checked_number("speed_mps", speed_mps)
    s = checked_positive("low_speed_mps", low_speed_mps)
    across = np.asarray(gtsam.Unit3(d).basis()).T  # (2, 3)
    function = _DirectionError(measured_omega, d, across, speed, s)
    rows = np.repeat([sigmas.omega, sigmas.direction_rad, sigmas.speed_mps], [3, 2, 1])
    noise = gtsam.noiseModel.Diagonal.Sigmas(rows)
    return custom_factor(noise, {"V_key": V_key}, function, [Vector(6)], 6, "velocity_direction_factor")


@dataclass(frozen=True)
class _DirectionError:
    """The error of :func:`velocity_direction_factor`; ``across`` is B^T, ``low_speed_mps`` s."""

    omega: FloatArray
    direction: FloatArray
    across: FloatArray
    speed_mps: float
    low_speed_mps: float

    def __call__(self, twist: FloatArray, *, jacobians: bool) -> tuple[FloatArray, list[FloatArray] | None]:
        v, d = twist[3:], self.direction
        smooth_speed = np.sqrt(v @ v + self.low_speed_mps**2)
        sideways = self.across @ v / smooth_speed
        error = np.concatenate([twist[:3] - self.omega, sideways, [d @ v - self.speed_mps]])
        if not jacobians:
            return error, None
        H = np.zeros((6, 6))
        H[:3, :3] = np.eye(3)
        H[3:5, 3:] = self.across / smooth_speed - np.outer(sideways, v) / smooth_speed**2
        H[5, 3:] = d
        return error, [H]


def mean_velocity_factor(
    V_a: int, V_b: int, mean_twist: ArrayLike, covariance: ArrayLike
) -> gtsam.CustomFactor:
    """(V_a + V_b) / 2 - mean_twist: odometry from image a to b measures the mean twist between them.

    Args:
        V_a, V_b: twists at the two images.
        mean_twist: (6,) Log(aTb) / interval [rad/s, m/s].
        covariance: (6, 6) of the mean twist.
    """
    measured = checked_array("mean_twist", mean_twist, (6,))
    noise = gtsam.noiseModel.Gaussian.Covariance(checked_covariance("covariance of the twist", covariance, 6))
    function = partial(_linear, (0.5, 0.5), measured)
    kinds = [Vector(6), Vector(6)]
    return custom_factor(noise, {"V_a": V_a, "V_b": V_b}, function, kinds, 6, "mean_velocity_factor")


def _linear(
    scales: tuple[float, ...], measured: FloatArray, *twists: FloatArray, jacobians: bool
) -> tuple[FloatArray, list[FloatArray] | None]:
    """sum scale_i V_i - measured."""
    error = sum((scale * twist for scale, twist in zip(scales, twists, strict=True)), -measured)
    return np.asarray(error), [scale * np.eye(6) for scale in scales] if jacobians else None


def twist_smoothness_factor(
    V_a: int, V_b: int, seconds: float, sigma_rot_acc: float, sigma_lin_acc: float
) -> gtsam.BetweenFactorVector:
    """V_b - V_a with sigma = seconds * [sigma_rot_acc, sigma_lin_acc]: a limit on the mean acceleration.

    Args:
        V_a, V_b: twists, b after a.
        seconds: from a to b [s].
        sigma_rot_acc: rad/s^2, each axis.
        sigma_lin_acc: m/s^2, each axis.
    """
    sigmas = _sigmas_by_kind("acc", sigma_rot_acc, sigma_lin_acc) * checked_positive("seconds", seconds)
    a, b = checked_keys("twist_smoothness_factor", {"V_a": V_a, "V_b": V_b})
    return gtsam.BetweenFactorVector(a, b, np.zeros(6), gtsam.noiseModel.Diagonal.Sigmas(sigmas))


def twist_jerk_factor(
    V_a: int,
    V_b: int,
    V_c: int,
    seconds: tuple[float, float],
    sigma_rot_jerk: float,
    sigma_lin_jerk: float,
) -> gtsam.CustomFactor:
    """((V_c - V_b) / s_bc - (V_b - V_a) / s_ab) / ((s_ab + s_bc) / 2): a limit on the jerk.

    Zero under any constant acceleration, also with unequal intervals.

    Args:
        V_a, V_b, V_c: twists in the order of time.
        seconds: from a to b, and from b to c [s].
        sigma_rot_jerk: rad/s^3, each axis.
        sigma_lin_jerk: m/s^3, each axis.
    """
    ab, bc = checked_array("seconds of twist_jerk_factor", seconds, (2,)).tolist()
    ab, bc = checked_positive("seconds from a to b", ab), checked_positive("seconds from b to c", bc)
    middle = 0.5 * (ab + bc)
    scales = (1.0 / ab / middle, (-1.0 / ab - 1.0 / bc) / middle, 1.0 / bc / middle)
    noise = gtsam.noiseModel.Diagonal.Sigmas(_sigmas_by_kind("jerk", sigma_rot_jerk, sigma_lin_jerk))
    function = partial(_linear, scales, np.zeros(6))
    keys = {"V_a": V_a, "V_b": V_b, "V_c": V_c}
    return custom_factor(noise, keys, function, [Vector(6)] * 3, 6, "twist_jerk_factor")


def _sigmas_by_kind(name: str, rotation: float, translation: float) -> FloatArray:
    return np.repeat(
        [checked_positive(f"sigma_rot_{name}", rotation), checked_positive(f"sigma_lin_{name}", translation)],
        3,
    )


@dataclass(frozen=True, eq=False)
class LidarTwist:
    """The LiDAR's twist at the instant of an image, by odometry.

    Attributes:
        l_twist: (6,) in its own frame, at LiDAR time t_image_stamp + time_offset_0_s [rad/s, m/s].
        l_acceleration: (6,) its rate of change [rad/s^2, m/s^2].
        time_offset_0_s: the time offset under which it was looked up [s].

    Raises:
        FactorError: numbers of a wrong shape.
    """

    l_twist: FloatArray
    l_acceleration: FloatArray
    time_offset_0_s: float

    def __post_init__(self) -> None:
        for name in ("l_twist", "l_acceleration"):
            object.__setattr__(self, name, checked_array(f"{name} of LidarTwist", getattr(self, name), (6,)))
        time_offset_0_s = checked_number("time_offset_0_s of LidarTwist", self.time_offset_0_s)
        object.__setattr__(self, "time_offset_0_s", time_offset_0_s)


def twist_transfer_factor(
    V_key: int, E_key: int, D_key: int, lidar_twist: LidarTwist, covariance: ArrayLike
) -> gtsam.CustomFactor:
    """V - Ad(E) (l_twist + (D - time_offset_0_s) l_acceleration) [rad/s, m/s].

    Together with a velocity from images this is the hand-eye constraint in velocities (Taylor & Nieto,
    Motion-based calibration of multimodal sensor extrinsics and timing offset, T-RO 2016): turns determine
    the rotation, changes of the twist the time offset.

    Args:
        V_key: camera twist at the image's instant.
        E_key: extrinsic cTl.
        D_key: time offset.
        lidar_twist: of the LiDAR at the image's instant.
        covariance: (6, 6) of its twist, expressed in the camera frame.

    Raises:
        FactorError: no keys, no twist, no covariance.
    """
    name = "lidar_twist of twist_transfer_factor"
    checked_type(name, lidar_twist, LidarTwist, "a sst_graph.factors.LidarTwist")
    noise = gtsam.noiseModel.Gaussian.Covariance(checked_covariance("covariance of the twist", covariance, 6))
    keys = {"V_key": V_key, "E_key": E_key, "D_key": D_key}
    kinds: list[Kind] = [Vector(6), gtsam.Pose3, Vector(1)]
    function = partial(_twist_error, lidar_twist)
    return own_factor(noise, keys, function, kinds, 6, "twist_transfer_factor")


def _twist_error(
    lidar: LidarTwist, twist: FloatArray, cTl: gtsam.Pose3, time_offset_s: FloatArray, *, jacobians: bool
) -> tuple[FloatArray, list[FloatArray] | None]:
    since_s = float(time_offset_s[0]) - lidar.time_offset_0_s
    error, by_cTl, by_offset = transferred(
        lidar.l_twist, lidar.l_acceleration, since_s, twist, cTl, jacobians
    )
    if by_cTl is None or by_offset is None:
        return error, None
    return error, [np.eye(6), by_cTl, by_offset[:, None]]


def transferred(
    l_twists: FloatArray,
    l_accelerations: FloatArray,
    since_s: float | FloatArray,
    c_twists: FloatArray,
    cTl: gtsam.Pose3,
    jacobians: bool,
) -> tuple[FloatArray, FloatArray | None, FloatArray | None]:
    """The error of :func:`twist_transfer_factor`, of one image or of many.

    Args:
        l_twists, l_accelerations: (..., 6) of the LiDAR, as of :class:`LidarTwist` [rad/s, m/s] and [/s].
        since_s: time offset less the one under which they were looked up, one for all or (..., 1) [s].
        c_twists: (..., 6) of the camera.

    Returns:
        Errors (..., 6) and, where ``jacobians`` is true, their derivatives by the extrinsic (..., 6, 6) and
        the time offset (..., 6); that by the camera's twist is the identity.
    """
    Ad = np.asarray(cTl.AdjointMap())
    now = l_twists + since_s * l_accelerations
    error = c_twists - now @ Ad.T
    if not jacobians:
        return error, None, None
    return error, Ad @ twist_ad(now), -(l_accelerations @ Ad.T)

"""The camera's twist from the LiDAR's: the two are rigidly joined."""

from __future__ import annotations

from functools import partial

import gtsam
import numpy as np
from numpy.typing import ArrayLike, NDArray

from .custom import custom_factor
from .errors import checked_array, checked_covariance
from .motion import twist_ad
from .variables import Kind, Vector

FloatArray = NDArray[np.float64]


def twist_transfer_factor(
    V_key: int,
    E_key: int,
    D_key: int,
    l_twist: ArrayLike,
    l_acceleration: ArrayLike,
    offset_0_s: float,
    covariance: ArrayLike,
) -> gtsam.CustomFactor:
    """V - Ad(E) (l_twist + (D - offset_0) l_acceleration) [rad/s, m/s].

    Together with a velocity from images this is the hand-eye constraint in velocities (Taylor & Nieto,
    Motion-based calibration of multimodal sensor extrinsics and timing offset, T-RO 2016): turns tie the
    rotation, changes of the twist tie the time offset.

    Args:
        V_key: camera twist at the image's instant.
        E_key: extrinsic cTl.
        D_key: time offset.
        l_twist: (6,) LiDAR twist at LiDAR time t_image_stamp + offset_0 [rad/s, m/s].
        l_acceleration: (6,) its rate of change [rad/s^2, m/s^2].
        offset_0_s: the time offset under which ``l_twist`` was looked up [s].
        covariance: (6, 6) of ``l_twist``, expressed in the camera frame.
    """
    measured = checked_array("l_twist", l_twist, (6,))
    rate = checked_array("l_acceleration", l_acceleration, (6,))
    noise = gtsam.noiseModel.Gaussian.Covariance(checked_covariance("covariance of the twist", covariance, 6))
    reference = float(checked_array("offset_0_s", [offset_0_s], (1,))[0])
    keys = {"V_key": V_key, "E_key": E_key, "D_key": D_key}
    kinds: list[Kind] = [Vector(6), gtsam.Pose3, Vector(1)]
    function = partial(_twist_error, measured, rate, reference)
    return custom_factor(noise, keys, function, kinds, 6, "twist_transfer_factor")


def _twist_error(
    measured: FloatArray,
    rate: FloatArray,
    offset_0_s: float,
    twist: FloatArray,
    cTl: gtsam.Pose3,
    offset_s: FloatArray,
    *,
    jacobians: bool,
) -> tuple[FloatArray, list[FloatArray] | None]:
    error, by_cTl, by_offset = transferred(
        measured, rate, float(offset_s[0]) - offset_0_s, twist, cTl, jacobians
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
        l_twists, l_accelerations: (..., 6) of the LiDAR, as there.
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

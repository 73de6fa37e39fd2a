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
    Ad = np.asarray(cTl.AdjointMap())
    now = measured + (float(offset_s[0]) - offset_0_s) * rate
    error = twist - Ad @ now
    if not jacobians:
        return error, None
    return error, [np.eye(6), Ad @ twist_ad(now), -(Ad @ rate)[:, None]]

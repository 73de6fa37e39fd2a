"""The regularizer beta of SST-Calib: keeps the joint stage near the static stage's extrinsic."""

from __future__ import annotations

from functools import partial
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from .custom import custom_factor
from .errors import checked_positive

FloatArray = NDArray[np.float64]


def beta_regularizer(
    key: int, cTl_static: gtsam.Pose3, lambda_t: float, lambda_r: float
) -> gtsam.CustomFactor:
    """cost = 1/2 (lambda_t |t - t_static|^2 + lambda_r |Log(R R_static^-1)|^2).

    SST-Calib (Kodaira et al., ITSC 2022), eq. 6; printed ||R R_static^-1||^2 is constant over rotations,
    so the logarithm is meant. The rotation is left-multiplied, in the camera frame, and so is the
    difference of translations: unlike a ``PriorFactorPose3`` on cTl, whose error is Log(cTl_static^-1 cTl).

    The half is gtsam's: against alignment factors of sigma 1 px, whose cost is half the sum of squares,
    the balance is the paper's.

    Args:
        key: extrinsic.
        cTl_static: the static stage's result.
        lambda_t: 1/m^2 (the paper: 1e6).
        lambda_r: 1/rad^2 (the paper: 1e9).

    Returns:
        A factor whose error is [Log(R R_static^-1) (rad), t - t_static (m)], sigmas lambda^-1/2.
    """
    R_static, t_static = cTl_static.rotation(), cTl_static.translation()
    weights = (checked_positive("lambda_r", lambda_r), checked_positive("lambda_t", lambda_t))
    sigmas = np.repeat([weight**-0.5 for weight in weights], 3)
    noise: Any = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
    function = partial(_difference, R_static, np.asarray(t_static))
    return custom_factor(noise, {"key": key}, function, [gtsam.Pose3], 6, "beta_regularizer")


def _difference(
    R_static: gtsam.Rot3, t_static: FloatArray, cTl: gtsam.Pose3, *, jacobians: bool
) -> tuple[FloatArray, list[FloatArray] | None]:
    difference = cTl.rotation() * R_static.inverse()
    log = gtsam.Rot3.Logmap(difference)
    error = np.concatenate([log, cTl.translation() - t_static])
    if not jacobians:
        return error, None
    H = np.zeros((6, 6))
    # R Exp(w) R_static^-1 = (R R_static^-1) Exp(R_static w)
    H[:3, :3] = gtsam.Rot3.LogmapDerivative(log) @ R_static.matrix()
    H[3:, 3:] = cTl.rotation().matrix()
    return error, [H]

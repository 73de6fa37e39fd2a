"""Priors and random walks of the time offset and of a drifting extrinsic, and SST-Calib's regularizer.

All but the last are factors of gtsam itself, so graphs that hold them serialize. gtsam's own factors are of
one type of variable: for an offset that is kept as a ``double`` in place of a ``Vector(1)``, say
``double=True``.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import gtsam
import numpy as np

from .arguments import FloatArray, checked_gtsam, checked_number, checked_positive
from .custom.factor import custom_factor
from .custom.variables import checked_key, checked_keys


def time_offset_prior(
    D_key: int, time_offset_s: float, sigma_s: float, *, double: bool = False
) -> gtsam.PriorFactorVector | gtsam.PriorFactorDouble:
    """D - time_offset_s with sigma_s [s]; ``double``: D is kept as a ``double``."""
    key = checked_key("time_offset_prior", "D_key", D_key)
    prior = checked_number("time_offset_s", time_offset_s)
    noise = gtsam.noiseModel.Isotropic.Sigma(1, checked_positive("sigma_s", sigma_s))
    if double:
        return gtsam.PriorFactorDouble(key, prior, noise)
    return gtsam.PriorFactorVector(key, np.array([prior]), noise)


def time_offset_drift(
    D_a: int, D_b: int, seconds: float, sigma_s_per_sqrt_s: float, *, double: bool = False
) -> gtsam.BetweenFactorVector | gtsam.BetweenFactorDouble:
    """D_b - D_a, a random walk over ``seconds``: sigma = sigma_s_per_sqrt_s * sqrt(seconds) [s].

    ``double``: both are kept as ``double``.
    """
    a, b = checked_keys("time_offset_drift", {"D_a": D_a, "D_b": D_b})
    sigma = checked_positive("sigma_s_per_sqrt_s", sigma_s_per_sqrt_s) * _sqrt_seconds(seconds)
    noise = gtsam.noiseModel.Isotropic.Sigma(1, sigma)
    if double:
        return gtsam.BetweenFactorDouble(a, b, 0.0, noise)
    return gtsam.BetweenFactorVector(a, b, np.zeros(1), noise)


def extrinsic_drift(
    E_a: int, E_b: int, seconds: float, sigma_rot: float, sigma_trans: float
) -> gtsam.BetweenFactorPose3:
    """Log(E_a^-1 E_b), a random walk over ``seconds`` in the LiDAR frame.

    Args:
        E_a, E_b: extrinsics, b after a.
        seconds: from a to b [s].
        sigma_rot: rad / sqrt(s), each axis.
        sigma_trans: m / sqrt(s), each axis.
    """
    a, b = checked_keys("extrinsic_drift", {"E_a": E_a, "E_b": E_b})
    rates = [checked_positive("sigma_rot", sigma_rot), checked_positive("sigma_trans", sigma_trans)]
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.repeat(rates, 3) * _sqrt_seconds(seconds))
    return gtsam.BetweenFactorPose3(a, b, gtsam.Pose3(), noise)


def _sqrt_seconds(seconds: float) -> float:
    return float(np.sqrt(checked_positive("seconds", seconds)))


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
    checked_gtsam("cTl_static of beta_regularizer", cTl_static, gtsam.Pose3)
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

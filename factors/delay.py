"""Priors and random walks of the time offset and of a drifting extrinsic.

All are factors of gtsam itself, so graphs that hold them serialize. gtsam's own factors are of one type of
variable: for an offset that is kept as a ``double`` in place of a ``Vector(1)``, say ``double=True``.
"""

from __future__ import annotations

import gtsam
import numpy as np

from .errors import checked_array, checked_positive
from .variables import checked_key, checked_keys


def time_offset_prior(
    D_key: int, offset_s: float, sigma_s: float, *, double: bool = False
) -> gtsam.PriorFactorVector | gtsam.PriorFactorDouble:
    """D - offset_s with sigma_s [s]; ``double``: D is kept as a ``double``."""
    key = checked_key("time_offset_prior", "D_key", D_key)
    prior = checked_array("offset_s", [offset_s], (1,))
    noise = gtsam.noiseModel.Isotropic.Sigma(1, checked_positive("sigma_s", sigma_s))
    if double:
        return gtsam.PriorFactorDouble(key, float(prior[0]), noise)
    return gtsam.PriorFactorVector(key, prior, noise)


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

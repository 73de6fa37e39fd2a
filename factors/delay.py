"""Priors and random walks of the time offset and of a drifting extrinsic.

All are factors of gtsam itself, so graphs that hold them serialize.
"""

from __future__ import annotations

import gtsam
import numpy as np

from .errors import checked_array, checked_positive


def delay_prior(D_key: int, offset_s: float, sigma_s: float) -> gtsam.PriorFactorVector:
    """D - offset_s with sigma_s [s]; D is a ``Vector(1)``."""
    prior = checked_array("offset_s", [offset_s], (1,))
    noise = gtsam.noiseModel.Isotropic.Sigma(1, checked_positive("sigma_s", sigma_s))
    return gtsam.PriorFactorVector(D_key, prior, noise)


def delay_drift(D_a: int, D_b: int, seconds: float, sigma_s_per_sqrt_s: float) -> gtsam.BetweenFactorVector:
    """D_b - D_a, a random walk over ``seconds``: sigma = sigma_s_per_sqrt_s * sqrt(seconds) [s]."""
    sigma = checked_positive("sigma_s_per_sqrt_s", sigma_s_per_sqrt_s) * _sqrt_seconds(seconds)
    return gtsam.BetweenFactorVector(D_a, D_b, np.zeros(1), gtsam.noiseModel.Isotropic.Sigma(1, sigma))


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
    rates = [checked_positive("sigma_rot", sigma_rot), checked_positive("sigma_trans", sigma_trans)]
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.repeat(rates, 3) * _sqrt_seconds(seconds))
    return gtsam.BetweenFactorPose3(E_a, E_b, gtsam.Pose3(), noise)


def _sqrt_seconds(seconds: float) -> float:
    return float(np.sqrt(checked_positive("seconds", seconds)))

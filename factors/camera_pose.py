"""The known pose of one camera in another, as a factor on the extrinsics of both.

    cTb = cTl . bTl^-1

for cameras b and c that see the same LiDAR l: a stereo rig, or Kalibr's ``T_cn_cnm1`` of a camera chain.
"""

from __future__ import annotations

from functools import partial

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from .arguments import FloatArray, checked_covariance, checked_gtsam
from .custom.factor import custom_factor


def camera_pose_factor(E_b: int, E_c: int, cTb: gtsam.Pose3, covariance: ArrayLike) -> gtsam.CustomFactor:
    """Log(cTb^-1 . cTl . bTl^-1), predicted - measured [rad, m].

    Args:
        E_b, E_c: extrinsics bTl and cTl.
        cTb: measured pose of camera b in camera c: p_c = cTb . p_b.
        covariance: (6, 6) of it [rot, trans], right perturbation, so along the axes of b.

    Raises:
        FactorError: no keys, no pose, no covariance.
    """
    checked_gtsam("cTb of camera_pose_factor", cTb, gtsam.Pose3)
    noise = gtsam.noiseModel.Gaussian.Covariance(
        checked_covariance("covariance of the camera's pose", covariance, 6)
    )
    function = partial(camera_pose_error, cTb)
    keys = {"E_b": E_b, "E_c": E_c}
    return custom_factor(noise, keys, function, [gtsam.Pose3, gtsam.Pose3], 6, "camera_pose_factor")


def camera_pose_error(
    cTb: gtsam.Pose3, bTl: gtsam.Pose3, cTl: gtsam.Pose3, jacobians: bool = True
) -> tuple[FloatArray, list[FloatArray] | None]:
    """(6,) error of :func:`camera_pose_factor`, and its derivatives (6, 6) by bTl and cTl."""
    error = np.asarray(gtsam.Pose3.Logmap(cTb.between(cTl * bTl.inverse())))
    if not jacobians:
        return error, None
    # cTl Exp(xi) bTl^-1 = cTl bTl^-1 Exp(Ad(bTl) xi), and the same of bTl with the other sign.
    H = np.asarray(gtsam.Pose3.LogmapDerivative(error) @ bTl.AdjointMap())
    return error, [-H, H]

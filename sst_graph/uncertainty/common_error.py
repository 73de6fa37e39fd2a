"""What no number of frames averages out: an error that all contours of a picture share.

The camera's principal point, a bias of the LiDAR's edges, the place of a pixel's centre: they move all
contours alike, which is to say they turn the camera. Residuals never show it: the answer takes it up whole.
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from factors.camera import PinholeCamera
from sst_graph.config import Settings, setting

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class CommonErrorConfig(Settings):
    """How far all contours may err together.

    Attributes:
        sigma_px: deviation, in either direction of the picture [px]. Top edges of simulated streets, whose
            camera is known to the digit, lie 0.08 to 0.15 px too high (docs/accuracy.md).
    """

    sigma_px: float = setting(0.1, at_least=0.0, at_most=100.0)


def common_covariance(cTl: gtsam.Pose3, camera: PinholeCamera, config: CommonErrorConfig) -> FloatArray:
    """(7, 7) covariance of extrinsic and offset by the common error, to be added to that of the matches.

    A shift of the picture is a turn of the camera about its own centre, to first order about the picture's
    middle (:func:`camera_turns`).

    Args:
        cTl: the extrinsic.
        camera: for its focal lengths [px].

    Returns:
        In the order of the extrinsic's tangent (right perturbation: rotation [rad], translation [m]) and the
        offset [s], which it leaves alone.
    """
    root = camera_turns(cTl) * (config.sigma_px / np.array([camera.fy, camera.fx]))
    covariance = np.zeros((7, 7))
    covariance[:6, :6] = root @ root.T
    return covariance


def camera_turns(cTl: gtsam.Pose3) -> FloatArray:
    """(6, 2) tangents of the extrinsic for turns of the camera by 1 rad about its own x and y axis.

    Exp(d_c) cTl = cTl Exp(Ad(cTl^-1) d_c).
    """
    return np.asarray(cTl.inverse().AdjointMap()[:, :2])

"""What no number of frames averages out: an error that all contours of a picture share.

The camera's principal point, a bias of the LiDAR's edges, the place of a pixel's centre: they move all
contours alike, which is to say they turn the camera. Residuals never show it: the answer takes it up whole.
"""

from __future__ import annotations

import gtsam
import numpy as np
from numpy.typing import NDArray

from factors.camera import PinholeCamera
from sst_graph.uncertainty.assumptions import AssumptionConfig

FloatArray = NDArray[np.float64]


def common_covariance(cTl: gtsam.Pose3, camera: PinholeCamera, config: AssumptionConfig) -> FloatArray:
    """(7, 7) covariance of extrinsic and offset by the common error, to be added to that of the matches.

    A shift of the picture is a turn of the camera about its own centre, to first order about the picture's
    middle (:func:`camera_turns`); its size is the principal point's deviation.

    Args:
        cTl: the extrinsic.
        camera: for its focal lengths [px].
        config: for the deviations of cx and cy.

    Returns:
        In the order of the extrinsic's tangent (right perturbation: rotation [rad], translation [m]) and the
        offset [s], which it leaves alone.
    """
    root = camera_turns(cTl) * np.array([config.sigma("cy") / camera.fy, config.sigma("cx") / camera.fx])
    covariance = np.zeros((7, 7))
    covariance[:6, :6] = root @ root.T
    return covariance


def camera_turns(cTl: gtsam.Pose3) -> FloatArray:
    """(6, 2) tangents of the extrinsic for turns of the camera by 1 rad about its own x and y axis.

    Exp(d_c) cTl = cTl Exp(Ad(cTl^-1) d_c).
    """
    return np.asarray(cTl.inverse().AdjointMap()[:, :2])

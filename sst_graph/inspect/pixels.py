"""How far a point of the cloud may be drawn from where the picture shows it."""

from __future__ import annotations

import gtsam
import numpy as np

from sst_graph.assumptions import ASSUMPTIONS
from sst_graph.assumptions.model import Scene, View
from sst_graph.inspect.considered import considered_errors
from sst_graph.result import CalibrationResult
from sst_graph.types import FloatArray


def cP_H_cTl(cTl: gtsam.Pose3, cP: FloatArray) -> FloatArray:
    """(3, 6) derivative of cP = cTl . lP by the extrinsic."""
    x, y, z = cTl.transformTo(cP)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(cTl.rotation().matrix() @ np.hstack([-cross, np.eye(3)]))


def pixel_covariance(result: CalibrationResult, cP: FloatArray, pose_H_unknowns: FloatArray) -> FloatArray:
    """(2, 2) covariance of a point's pixel by the result, from where the picture shows the point [px^2].

    A lens that is not the given one moves the picture, too, and the estimate follows it: the pose takes up
    most of a wrong principal point. If its parameter were theta, the estimate would be dx/dtheta theta away
    and the picture of the point e theta away from its pixel there. With J the derivative of the pixel by the
    unknowns x and sigma what is considered of theta, it adds

        sigma^2 (J dx/dtheta + e)(J dx/dtheta + e)'

    here, in the place of its share sigma^2 (J dx/dtheta)(J dx/dtheta)' of J P J'.

    Args:
        cP: (3,) the point, in the camera's frame [m].
        pose_H_unknowns: (6, 7) derivative of the extrinsic by extrinsic and time offset.
    """
    uv_H_pose = result.camera.uv_H_cP(cP[None])[0] @ cP_H_cTl(result.T_camera_lidar, cP)
    J = uv_H_pose @ pose_H_unknowns
    found = J @ result.covariance @ J.T
    view = _view(result, cP)
    for name, (sigma, sensitivity) in considered_errors(result).items():
        shift = ASSUMPTIONS[name].effect(view).pixel_shift if name in ASSUMPTIONS else None
        if shift is not None:
            step, picture = sigma * (J @ sensitivity), sigma * shift[0]
            found += np.outer(step + picture, step + picture) - np.outer(step, step)
    return np.asarray(found)


def _view(result: CalibrationResult, cP: FloatArray) -> View:
    """The point, at rest."""
    camera = result.camera
    lP = result.T_camera_lidar.transformTo(cP)
    return Scene(camera, np.zeros(6), 0.0, 0.1).view(lP[None], np.zeros(1), camera.project(cP[None]))

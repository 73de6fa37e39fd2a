"""How far a point of the cloud may be drawn from where the picture shows it."""

from __future__ import annotations

import gtsam
import numpy as np

from sst_graph.assumptions import ASSUMPTIONS
from sst_graph.assumptions.model import Scene, View
from sst_graph.assumptions.of_camera import CX, CY, FOCAL, K1, K2
from sst_graph.inspect.considered import considered_errors, covered_errors
from sst_graph.inspect.frame_information import positive_part
from sst_graph.result import CalibrationResult
from sst_graph.types import FloatArray

LENS = tuple(assumption.name for assumption in (FOCAL, CX, CY, K1, K2))
"""Names of the assumptions about the lens: they move the picture."""


def cP_H_cTl(cTl: gtsam.Pose3, cP: FloatArray) -> FloatArray:
    """(3, 6) derivative of cP = cTl . lP by the extrinsic."""
    x, y, z = cTl.transformTo(cP)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(cTl.rotation().matrix() @ np.hstack([-cross, np.eye(3)]))


def pose_pixel_covariance(
    result: CalibrationResult, cP: FloatArray, pose_H_unknowns: FloatArray
) -> FloatArray:
    """(2, 2) covariance of a point's pixel by the covariance of extrinsic and time offset alone [px^2].

    Args:
        cP: (3,) the point, in the camera's frame [m].
        pose_H_unknowns: (6, 7) derivative of the extrinsic by extrinsic and time offset.
    """
    J = _uv_H_unknowns(result, cP, pose_H_unknowns)
    return np.asarray(J @ result.covariance @ J.T)


def pixel_covariance(result: CalibrationResult, cP: FloatArray, pose_H_unknowns: FloatArray) -> FloatArray:
    """(2, 2) covariance of a point's pixel by the result, from where the picture shows the point [px^2].

    A lens that is not the given one moves the picture, too, and the estimate follows it: the pose takes up
    most of a wrong principal point. If its parameter were theta, the estimate would be dx/dtheta theta away
    and the picture of the point e theta away from its pixel there. With J the derivative of the pixel by the
    unknowns x and sigma what is considered of theta, it adds

        sigma^2 (J dx/dtheta + e)(J dx/dtheta + e)'

    here, in the place of its share sigma^2 (J dx/dtheta)(J dx/dtheta)' of J P J'. Parameters that are known
    to be off (:func:`~sst_graph.inspect.considered.covered_errors`) were estimated together, and one may take
    back what another does: with s = sum theta e they add s s'. The step of the estimate is in P already.

    Args:
        cP: (3,) the point, in the camera's frame [m].
        pose_H_unknowns: (6, 7) derivative of the extrinsic by extrinsic and time offset.
    """
    lP, uv = result.T_camera_lidar.transformTo(cP), result.camera.project(cP[None])[0]
    return drawn_covariance(result, lP, uv, _uv_H_unknowns(result, cP, pose_H_unknowns))


def drawn_covariance(result: CalibrationResult, lP: FloatArray, uv: FloatArray, J: FloatArray) -> FloatArray:
    """(2, 2) the same of a point in any motion [px^2].

    Args:
        lP: (3,) the point in the LiDAR frame [m].
        uv: (2,) its pixel [px].
        J: (2, 7) derivative of the pixel by extrinsic and time offset.
    """
    found = J @ result.covariance @ J.T
    view = Scene(result.camera, np.zeros(6), 0.0, 0.1).view(lP[None], np.zeros(1), uv[None])
    for name, (sigma, sensitivity) in considered_errors(result).items():
        shift = _picture_shift(name, view)
        if shift is not None:
            step, picture = sigma * (J @ sensitivity), sigma * shift
            found += np.outer(step + picture, step + picture) - np.outer(step, step)
    off = np.zeros(2)
    for name, value in covered_errors(result).items():
        shift = _picture_shift(name, view)
        if shift is not None:
            off += value * shift
    return np.asarray(found + np.outer(off, off))


def covariance_of_given_lens(result: CalibrationResult) -> FloatArray:
    """(7, 7) the result's covariance without what it considers of a lens that is not the given one."""
    found, variances = result.covariance.copy(), np.diag(result.covariance)
    for name, (sigma, sensitivity) in considered_errors(result).items():
        step = sigma * sensitivity
        # A part of the covariance is no larger than the whole, whatever a file says.
        if name in LENS and (step**2 <= variances * (1.0 + 1e-3)).all():
            found -= np.outer(step, step)
    return positive_part(found)


def _uv_H_unknowns(result: CalibrationResult, cP: FloatArray, pose_H_unknowns: FloatArray) -> FloatArray:
    """(2, 7) derivative of a point's pixel by extrinsic and time offset."""
    uv_H_cP = result.camera.uv_H_cP(cP[None])[0]
    return np.asarray(uv_H_cP @ cP_H_cTl(result.T_camera_lidar, cP) @ pose_H_unknowns)


def _picture_shift(name: str, view: View) -> FloatArray | None:
    """(2,) by how much one unit of an assumption moves the pixel [px]; None where it moves none."""
    shift = ASSUMPTIONS[name].effect(view).pixel_shift if name in LENS else None
    return None if shift is None else np.asarray(shift[0])

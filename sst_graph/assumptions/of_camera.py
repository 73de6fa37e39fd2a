"""The camera is the pinhole that is given: focal length, principal point, no distortion left in pictures."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np

from sst_graph.assumptions.model import Assumption, Effect, View
from sst_graph.cameras.estimated_camera import squared_radius
from sst_graph.factors.camera import PinholeCamera
from sst_graph.types import FloatArray


def _focal(view: View) -> Effect:
    """u - cx and v - cy grow by the same share."""
    camera = view.camera
    return Effect(pixel_shift=view.uvs - np.array([camera.cx, camera.cy]))


FOCAL = Assumption(
    name="focal",
    unit="",
    effect=_focal,
    sigma=5e-4,
    source="spread of repeated target calibrations: 0.3 px of 700 px",
    span=0.05,
    violation="the focal length does not fit the pictures (share by which it is too short)",
    remedy="check that the camera matrix belongs to this camera, lens setting and image size",
    by_edges=True,
)


def _right(view: View) -> Effect:
    return Effect(pixel_shift=np.broadcast_to(np.array([1.0, 0.0]), view.uvs.shape))


def _down(view: View) -> Effect:
    return Effect(pixel_shift=np.broadcast_to(np.array([0.0, 1.0]), view.uvs.shape))


def _turned(cTl: gtsam.Pose3, turn: list[float]) -> FloatArray:
    """(7,) step of an extrinsic whose camera is turned so far about its own axes [rad]."""
    return np.append(cTl.inverse().AdjointMap()[:, :3] @ turn, 0.0)


def _motion_by_cx(camera: PinholeCamera, cTl: gtsam.Pose3) -> FloatArray:
    """The rays of pixels turn by 1 / fx, and with them the direction in which the camera seems to move: 0.8
    deg for 10 px at 700 px of focal length."""
    return _turned(cTl, [0.0, 1.0 / camera.fx, 0.0])


def _motion_by_cy(camera: PinholeCamera, cTl: gtsam.Pose3) -> FloatArray:
    return _turned(cTl, [-1.0 / camera.fy, 0.0, 0.0])


CX = Assumption(
    name="cx",
    unit="px",
    effect=_right,
    sigma=0.3,
    source="spread of repeated target calibrations: 0.2 to 0.5 px",
    span=30.0,
    violation="the pictures lie beside the principal point cx",
    remedy="check that the camera matrix belongs to this image size and crop",
    # A judgement: pictures are cropped, and matrices taken from another day or camera, about that often.
    prevalence=0.1,
    by_edges=True,
    motion_step=_motion_by_cx,
)
CY = replace(
    CX,
    name="cy",
    effect=_down,
    violation="the pictures lie beside the principal point cy",
    motion_step=_motion_by_cy,
)


def _radial(view: View, power: int) -> Effect:
    """uv = c + f (x, y) (1 + k1 r^2 + k2 r^4), r^2 = x^2 + y^2 (Brown 1971; OpenCV's k1 and k2)."""
    rays, camera = view.rays, view.camera
    square = squared_radius(camera, rays)
    return Effect(pixel_shift=np.array([camera.fx, camera.fy]) * rays * square**power)


def _k1(view: View) -> Effect:
    return _radial(view, 1)


def _k2(view: View) -> Effect:
    return _radial(view, 2)


K1 = Assumption(
    name="k1",
    unit="",
    effect=_k1,
    sigma=1e-3,
    source="what target calibrations leave in rectified pictures",
    span=0.3,
    violation="the pictures look distorted",
    remedy="undistort the pictures and masks, give the camera's distortion, or use --estimate k1",
    prevalence=0.5,  # pictures come as they were taken about as often as undistorted
    by_edges=True,
)
K2 = replace(
    K1,
    name="k2",
    effect=_k2,
    prevalence=0.02,
    by_edges=False,
    # A lens that bends by r^4 bends by r^2: with k1 held at zero, k2 alone takes up a part of it.
    remedy=K1.remedy.replace("k1", "k1,k2"),
)

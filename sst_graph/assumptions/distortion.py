"""The pictures are those of a pinhole camera: no radial distortion is left in them.

    uv = c + f (x, y) (1 + k1 r^2 + k2 r^4),   r^2 = x^2 + y^2, x = X/Z, y = Y/Z

(Brown 1971; OpenCV's k1 and k2).
"""

from __future__ import annotations

import numpy as np

from sst_graph.assumptions.model import Assumption, Effect, View


def _radial(view: View, power: int) -> Effect:
    rays = view.rays
    square = (rays**2).sum(axis=1, keepdims=True)
    focal = np.array([view.camera.fx, view.camera.fy])
    return Effect(pixel_shift=focal * rays * square**power)


def _k1(view: View) -> Effect:
    return _radial(view, 1)


def _k2(view: View) -> Effect:
    return _radial(view, 2)


_SOURCE = "what target calibrations leave in rectified pictures"
_VIOLATION = "the pictures look distorted"
_REMEDY = "undistort the pictures and masks, or give the camera's distortion"

K1 = Assumption(
    name="k1",
    unit="",
    effect=_k1,
    sigma=1e-3,
    source=_SOURCE,
    span=0.3,
    prevalence=0.5,  # pictures come as they were taken about as often as undistorted
    violation=_VIOLATION,
    remedy=_REMEDY,
    by_edges=True,
)
K2 = Assumption(
    name="k2",
    unit="",
    effect=_k2,
    sigma=1e-3,
    source=_SOURCE,
    span=0.3,
    violation=_VIOLATION,
    remedy=_REMEDY,
)

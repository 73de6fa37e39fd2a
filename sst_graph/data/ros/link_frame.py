"""The axes of the frame that images are stamped with.

REP 103 has the optical ones: x right, y down, z forward. Many drivers stamp images with the camera's link: x
forward, y left, z up. By the axes of a link a level camera looks at the sky, and the LiDAR measures nothing
there.
"""

from __future__ import annotations

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.cameras import CameraModel
from sst_graph.metrics import LINK_FROM_OPTICAL

LINK_AXES = "x forward, y left, z up"
_UPWARD = np.cos(np.radians(45.0))
"""Least cosine between the LiDAR's z axis and the z axis of a level camera's link. That of a LiDAR that hangs
upside down is also that of a camera that looks at the ground: such a frame is believed."""
LEAST_SEEN, _TIMES_MORE = 50, 20.0
"""Fewest points in the image by the axes of a link, and how many times more they are than by optical axes."""


def may_be_link(name: str, oTl: gtsam.Pose3) -> bool:
    """Whether the frame of the images may be the camera's link, before any cloud is read.

    Args:
        name: of the frame; one that says "optical" is believed.
        oTl: pose of the LiDAR in it.
    """
    return "optical" not in name.lower() and float(oTl.rotation().matrix()[2, 2]) >= _UPWARD


def is_link(name: str, oTl: gtsam.Pose3, points: NDArray[np.float32], model: CameraModel) -> bool:
    """Whether the frame of the images shows to be the camera's link.

    Args:
        name, oTl: as of :func:`may_be_link`.
        points: (n, 3) of a scan, frame of the LiDAR [m].
        model: of the camera that took the images.
    """
    if not may_be_link(name, oTl):
        return False
    by_link = _seen(LINK_FROM_OPTICAL.inverse() * oTl, points, model)
    return by_link >= LEAST_SEEN and by_link > _TIMES_MORE * _seen(oTl, points, model)


def _seen(cTl: gtsam.Pose3, points: NDArray[np.float32], model: CameraModel) -> int:
    """Number of points in the image."""
    uvs, valid = model.project(cTl.transformFrom(points.T.astype(np.float64)).T)
    with np.errstate(invalid="ignore"):
        inside = (uvs >= -0.5) & (uvs < np.array([model.width, model.height]) - 0.5)
    return int(np.count_nonzero(valid & inside.all(axis=1)))

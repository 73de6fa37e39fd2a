"""The camera's model of sensor_msgs/CameraInfo."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from sst_graph.cameras import CameraModel
from sst_graph.cameras.readers import camera_of
from sst_graph.errors import DataError
from sst_graph.factors.camera import PinholeCamera
from sst_graph.types import FloatArray

Size = tuple[int, int]
"""Width, height [px]."""


@dataclass(frozen=True)
class ImageGeometry:
    """What the images are projected by.

    Attributes:
        camera: intrinsics.
        lens: with its distortion, where the images have any.
        cRo: rotation of the camera's optical frame into that of the images; not the identity where these
            are rectified for a stereo pair.
    """

    camera: PinholeCamera
    lens: CameraModel | None
    cRo: gtsam.Rot3


def image_geometry(message: Any, image_topic: str, size: Size, place: str) -> ImageGeometry:
    """Geometry of images of ``size`` by their CameraInfo.

    Images of a topic with "rect" in its name, as image_proc writes them, have the intrinsics of P and the
    rotation R; all others have those of K and the distortion D.

    Raises:
        DataError: no calibration, one of another size, or an unknown distortion.
    """
    K, D, R, P = (np.asarray(_field(message, name), np.float64) for name in ("K", "D", "R", "P"))
    _check_size(message, size, place)
    rectified = "rect" in image_topic and "unrect" not in image_topic
    matrix = P.reshape(3, 4)[:, :3] if rectified else K.reshape(3, 3)
    if not (matrix[0, 0] > 0.0 and matrix[1, 1] > 0.0 and np.isfinite(matrix).all()):
        raise DataError(place, f"{'P' if rectified else 'K'} without a focal length", "a calibrated camera")
    camera = PinholeCamera(matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *size)
    if rectified:
        return ImageGeometry(camera, None, _rotation(R.reshape(3, 3)))
    # Drivers without a calibrated lens leave D empty or at zero.
    lens = camera_of(camera, str(message.distortion_model), D, place) if D.any() else None
    return ImageGeometry(camera, lens, gtsam.Rot3())


def _check_size(message: Any, size: Size, place: str) -> None:
    binning = max(int(message.binning_x), 1), max(int(message.binning_y), 1)
    roi = message.roi
    cropped = (roi.x_offset, roi.y_offset) != (0, 0) or (roi.width, roi.height) not in ((0, 0), size)
    if binning != (1, 1) or cropped:
        raise DataError(place, "binning or a region of interest", "images of the size that was calibrated")
    calibrated = int(message.width), int(message.height)
    if calibrated not in ((0, 0), size):
        expected = f"{size[0]}x{size[1]} px, the size of the images"
        raise DataError(place, f"{calibrated[0]}x{calibrated[1]} px", expected)


def _rotation(R: FloatArray) -> gtsam.Rot3:
    """R, which drivers leave at zero where nothing is rectified."""
    return gtsam.Rot3(R) if abs(np.linalg.det(R) - 1.0) < 1e-3 else gtsam.Rot3()


def _field(message: Any, name: str) -> Any:
    """Upper-case in ROS 1, lower-case in ROS 2."""
    return getattr(message, name) if hasattr(message, name) else getattr(message, name.lower())

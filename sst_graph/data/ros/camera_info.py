"""The camera of a drive's images by their sensor_msgs/CameraInfo, or by a file."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from sst_graph.cameras import CameraModel
from sst_graph.cameras.readers import camera_from_camera_info, camera_info_of_size
from sst_graph.data.folder.camera_file import read_camera
from sst_graph.errors import DataError
from sst_graph.files.checked_values import checked_pose

Size = tuple[int, int]
"""Width, height [px]."""

_RECTIFIED = re.compile(r"(?:^|[/_])rect")


@dataclass(frozen=True)
class ImageGeometry:
    """What the images are projected by.

    Attributes:
        model: the camera.
        cRo: rotation of the camera's optical frame into that of the images; not the identity where these
            are rectified for a stereo pair.
    """

    model: CameraModel
    cRo: gtsam.Rot3

    def extrinsic(self, oTl: gtsam.Pose3) -> gtsam.Pose3:
        """cTl from the pose of the LiDAR in the optical frame."""
        return gtsam.Pose3(self.cRo, np.zeros(3)) * oTl


def has_matrix(message: Any) -> bool:
    """Whether a CameraInfo is of a calibrated camera: drivers without a calibration leave K at zero."""
    return bool(np.any(getattr(message, "k", getattr(message, "K", ()))))


def is_other_camera(first: Any, message: Any) -> bool:
    """Whether a CameraInfo differs from the first of its topic in any field but the header."""
    mine, others = ({**vars(one), "header": ""} for one in (first, message))
    return mine.keys() != others.keys() or not all(_same(mine[key], others[key]) for key in mine)


def _same(a: Any, b: Any) -> bool:
    """Whether two fields are equal; NaN is equal to NaN."""
    if hasattr(a, "__dict__") and hasattr(b, "__dict__"):
        return not is_other_camera(a, b)  # the region of interest
    if isinstance(a, str) or isinstance(b, str):
        return bool(a == b)
    return np.array_equal(np.asarray(a, np.float64), np.asarray(b, np.float64), equal_nan=True)


def geometry_by_file(path: Path, image_topic: str, size: Size) -> ImageGeometry:
    """Geometry of images of ``size`` by a file: the camera as the images are, rectified or not.

    Raises:
        DataError: a file that holds none, one of another size, or a lens of images that are rectified by the
            name of their topic.
        MissingDependencyError: PyYAML is not installed.
    """
    model = read_camera(path, image_topic)
    if (model.width, model.height) != size:
        raise DataError(
            path, f"{model.width}x{model.height} px", "{}x{} px, the size of the images".format(*size)
        )
    if _RECTIFIED.search(image_topic) is not None and not model.is_pinhole:
        found = f"a {model.name} lens for {image_topic}, whose name says that its images are rectified"
        raise DataError(path, found, "their fx, fy, cx, cy (those of P) without distortion")
    return ImageGeometry(model, gtsam.Rot3())


def image_geometry(message: Any, image_topic: str, size: Size, place: str) -> ImageGeometry:
    """Geometry of images of ``size`` by their CameraInfo.

    Images of a topic with a word that begins with "rect" in its name, as image_proc writes them, have the
    intrinsics of P and the rotation R; all others have those of K and the distortion D. Where P is left at
    zero and nothing is distorted K holds for either. Images may be a region of the sensor, or binned.

    Raises:
        DataError: no calibration, one of another size, or an unknown distortion.
    """
    table = camera_info_of_size(vars(message), size, place)
    D, P = (table[name] if name in table else table[name.lower()] for name in "DP")
    rectified = _RECTIFIED.search(image_topic) is not None and bool(np.any(P) or np.any(D))
    if not len(D):
        # Drivers without a calibrated lens name a model and leave D empty.
        table["distortion_model"] = "none"
    model = camera_from_camera_info(table, rectified, place)
    pose = np.eye(4)
    pose[:3, :3] = np.asarray(table.get("R", table.get("r")), np.float64).reshape(3, 3)
    # Drivers leave R at zero where nothing is rectified.
    turned = rectified and pose[:3, :3].any()
    return ImageGeometry(model, checked_pose(pose, f"{place}: R").rotation() if turned else gtsam.Rot3())

"""KITTI odometry ``calib.txt``: P0..P3 and Tr.

Projection of a LiDAR point into camera N (KITTI devkit): uv1 ~ PN [Tr; 0 0 0 1] lP1. With
PN = K [I | K^-1 PN[:, 3]] the LiDAR's pose in *that* camera is cTl = [I | K^-1 PN[:, 3]] * Tr.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import gtsam
import numpy as np

from sst_graph.errors import ConfigError, DataError, count_of
from sst_graph.factors.camera import PinholeCamera
from sst_graph.files.checked_values import checked_pose, pinhole_camera
from sst_graph.files.reading import CALIB_TXT, read_text
from sst_graph.types import FloatArray

_LINE = re.compile(r"P\d|Tr")
MAX_ENTRY = 1e12
"""Of a projection matrix [px]: beyond it, or its inverse as a focal length, products overflow."""


def pose_from(matrix: FloatArray, place: str | Path) -> gtsam.Pose3:
    """Pose of a (3, 4) or (4, 4) matrix [R t; 0 0 0 1], t in [m].

    Raises:
        DataError: another shape, another last row, no rotation, or a translation that is none between two
            sensors.
    """
    if matrix.shape == (3, 4):
        matrix = np.vstack([matrix, [0.0, 0.0, 0.0, 1.0]])
    if matrix.shape != (4, 4):
        raise DataError(place, f"an array of shape {matrix.shape}", "(3, 4) or (4, 4)")
    return checked_pose(matrix, str(place))


@dataclass(frozen=True)
class KittiCalibration:
    """Contents of a ``calib.txt``.

    Attributes:
        path: the file, named in errors.
        projections: (3, 4) matrices by number: P0..P3 [px].
        c0Tl: pose of the LiDAR in the rectified camera 0 (the line ``Tr``), or None without that line.
    """

    path: Path
    projections: Mapping[int, FloatArray]
    c0Tl: gtsam.Pose3 | None

    def projection(self, camera: str) -> FloatArray:
        """(3, 4) projection matrix [px] of a camera named as its folder ("image_2").

        Raises:
            DataError: the file has no such line, or it is no pinhole projection.
            ConfigError: the name is not of the form image_N.
        """
        match = re.fullmatch(r"image_0?(\d)", camera)
        if match is None:
            raise ConfigError(f"camera {camera!r}: expected image_N, as in image_2")
        number = int(match.group(1))
        if number not in self.projections:
            raise DataError(self.path, f"no line P{number}", f"the projection matrix of {camera}")
        P = self.projections[number]
        pinhole = (
            np.abs(P).max() < MAX_ENTRY
            and P[0, 0] > 1.0 / MAX_ENTRY
            and P[1, 1] > 1.0 / MAX_ENTRY
            and np.allclose([P[0, 1], P[1, 0]], 0.0, atol=1e-6 * P[0, 0])
            and np.allclose(P[2, :3], [0.0, 0.0, 1.0], atol=1e-9)
        )
        if not pinhole:
            raise DataError(self.path, f"P{number} = {P[:, :3].tolist()}", "[fx 0 cx; 0 fy cy; 0 0 1]")
        return P

    def camera(self, name: str, width: int, height: int) -> PinholeCamera:
        """Intrinsics of camera ``name`` with an image of width x height [px].

        Raises:
            DataError: as :meth:`projection`, or intrinsics that do not go with the image's size.
        """
        P = self.projection(name)
        fx, fy, cx, cy = float(P[0, 0]), float(P[1, 1]), float(P[0, 2]), float(P[1, 2])
        return pinhole_camera((fx, fy, cx, cy), (width, height), f"{self.path} (P of {name})")

    def cTc0(self, camera: str) -> gtsam.Pose3:
        """Pose of the rectified camera 0 in ``camera``: [I | K^-1 P[:, 3]].

        Raises:
            DataError: as :meth:`projection`, or cameras too far apart for one vehicle.
        """
        P = self.projection(camera)
        shift = np.linalg.solve(P[:, :3], P[:, 3])
        return pose_from(np.column_stack([np.eye(3), shift]), f"{self.path} (shift of {camera})")

    def cTl(self, camera: str) -> gtsam.Pose3:
        """Pose of the LiDAR in ``camera``.

        Raises:
            DataError: as :meth:`projection`, or the file has no line Tr.
        """
        if self.c0Tl is None:
            raise DataError(self.path, "no line Tr", "Tr: 12 numbers, the LiDAR in the rectified camera 0")
        return self.cTc0(camera) * self.c0Tl


def read_calibration(path: Path) -> KittiCalibration:
    """Read a KITTI odometry ``calib.txt``.

    Raises:
        DataError: a missing file, a line with the wrong number of values or a value that is no
            finite number, two lines of one name that differ, or a Tr whose rotation is none.
    """
    lines = numbers_by_name(read_text(path, CALIB_TXT), _LINE, path, 12)
    matrices = {name: values.reshape(3, 4) for name, values in lines.items()}
    projections = {int(name[1:]): matrix for name, matrix in matrices.items() if name != "Tr"}
    c0Tl = pose_from(matrices["Tr"], f"{path} (Tr)") if "Tr" in matrices else None
    return KittiCalibration(path, projections, c0Tl)


def numbers_by_name(
    text: str, names: re.Pattern[str], place: str | Path, count: int | None = None
) -> dict[str, FloatArray]:
    """Numbers (n,) of the lines "NAME: NUMBER ...", by name; lines of other names are left out.

    Args:
        count: how many there have to be; None: any.

    Raises:
        DataError: another count, a value that is no finite number, or two lines of one name that differ.
    """
    lines: dict[str, FloatArray] = {}
    expected = "finite numbers" if count is None else f"{count} numbers"
    for number, line in enumerate(text.splitlines(), 1):
        name, colon, rest = line.partition(":")
        name, words, at = name.strip(), rest.split(), f"{place}:{number}"
        if not colon or not names.fullmatch(name):
            continue
        if count is not None and len(words) != count:
            raise DataError(at, f"{count_of(len(words), 'value')} for {name}", str(count))
        wrong = next((word for word in words if not _is_number(word)), None)
        if wrong is not None:
            raise DataError(at, f"{wrong!r:.60} in {name}", expected)
        values = np.array(words, np.float64)
        if not np.isfinite(values).all():
            raise DataError(at, f"NaN or inf in {name}", expected)
        if not np.array_equal(lines.setdefault(name, values), values):
            raise DataError(at, f"another {name} than above", f"one line {name}")
    return lines


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True

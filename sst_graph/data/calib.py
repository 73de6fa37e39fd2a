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
from numpy.typing import NDArray

from factors.camera import PinholeCamera
from sst_graph.errors import ConfigError, DataError

FloatArray = NDArray[np.float64]

ROTATION_TOLERANCE = 1e-3
"""Largest entry of R^T R - I that is put down to rounding in a file."""


def rotation_from(matrix: FloatArray, place: str | Path) -> gtsam.Rot3:
    """Rotation nearest to a (3, 3) matrix that is one but for rounding.

    Raises:
        DataError: not finite, not orthonormal within :data:`ROTATION_TOLERANCE`, or a reflection.
    """
    if not np.isfinite(matrix).all():
        raise DataError(place, "a matrix with NaN or inf", "a rotation")
    error = float(np.abs(matrix.T @ matrix - np.eye(3)).max())
    if error > ROTATION_TOLERANCE:
        raise DataError(place, f"a matrix with |R^T R - I| up to {error:.3g}", "a rotation (orthonormal)")
    if np.linalg.det(matrix) < 0:
        raise DataError(place, "a reflection (determinant -1)", "a rotation (determinant +1)")
    return gtsam.Rot3.ClosestTo(matrix)


def pose_from(matrix: FloatArray, place: str | Path) -> gtsam.Pose3:
    """Pose of a (3, 4) or (4, 4) matrix [R t; 0 0 0 1], t in [m].

    Raises:
        DataError: another shape, another last row, no rotation, or a translation that is not finite.
    """
    if matrix.shape not in ((3, 4), (4, 4)):
        raise DataError(place, f"an array of shape {matrix.shape}", "(3, 4) or (4, 4)")
    if matrix.shape == (4, 4) and not np.allclose(matrix[3], [0, 0, 0, 1]):
        raise DataError(place, f"last row {matrix[3].tolist()}", "0 0 0 1")
    if not np.isfinite(matrix[:3]).all():
        raise DataError(place, "a matrix with NaN or inf", "a rigid transform")
    return gtsam.Pose3(rotation_from(matrix[:3, :3], place), matrix[:3, 3])


@dataclass(frozen=True)
class KittiCalibration:
    """Contents of a ``calib.txt``.

    Attributes:
        path: the file, named in errors.
        projections: (3, 4) matrices by number: P0..P3 [px].
        c0Tl: pose of the LiDAR in the rectified camera 0 (the line ``Tr``).
    """

    path: Path
    projections: Mapping[int, FloatArray]
    c0Tl: gtsam.Pose3

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
            P[0, 0] > 0
            and P[1, 1] > 0
            and np.allclose([P[0, 1], P[1, 0]], 0.0, atol=1e-6 * P[0, 0])
            and np.allclose(P[2, :3], [0.0, 0.0, 1.0], atol=1e-9)
        )
        if not pinhole:
            raise DataError(self.path, f"P{number} = {P[:, :3].tolist()}", "[fx 0 cx; 0 fy cy; 0 0 1]")
        return P

    def camera(self, name: str, width: int, height: int) -> PinholeCamera:
        """Intrinsics of camera ``name`` with an image of width x height [px]."""
        P = self.projection(name)
        return PinholeCamera(
            float(P[0, 0]), float(P[1, 1]), float(P[0, 2]), float(P[1, 2]), width=width, height=height
        )

    def cTc0(self, camera: str) -> gtsam.Pose3:
        """Pose of the rectified camera 0 in ``camera``: [I | K^-1 P[:, 3]]."""
        P = self.projection(camera)
        return gtsam.Pose3(gtsam.Rot3(), np.linalg.solve(P[:, :3], P[:, 3]))

    def cTl(self, camera: str) -> gtsam.Pose3:
        """Pose of the LiDAR in ``camera``."""
        return self.cTc0(camera) * self.c0Tl


def read_calibration(path: Path) -> KittiCalibration:
    """Read a KITTI odometry ``calib.txt``.

    Raises:
        DataError: a missing file, a line with the wrong number of values or a value that is no
            finite number, no line Tr, or a Tr whose rotation is none.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise DataError(path, "no file", "KITTI calib.txt with lines P0..P3 and Tr") from None
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(path, f"an unreadable file ({type(error).__name__})", "KITTI calib.txt") from None
    matrices: dict[str, FloatArray] = {}
    for number, line in enumerate(text.splitlines(), 1):
        name, colon, values = line.partition(":")
        if colon and re.fullmatch(r"P\d|Tr", name.strip()):
            matrices[name.strip()] = _matrix(values.split(), name.strip(), f"{path}:{number}")
    if "Tr" not in matrices:
        raise DataError(path, "no line Tr", "Tr: 12 numbers, the LiDAR in the rectified camera 0")
    projections = {int(name[1:]): matrix for name, matrix in matrices.items() if name != "Tr"}
    return KittiCalibration(path, projections, pose_from(matrices["Tr"], f"{path} (Tr)"))


def _matrix(words: list[str], name: str, place: str) -> FloatArray:
    """(3, 4) matrix of twelve words."""
    if len(words) != 12:
        raise DataError(place, f"{len(words)} values for {name}", "12")
    try:
        values = np.array([float(word) for word in words])
    except ValueError as error:
        raise DataError(place, f"{name}: {error}", "12 numbers") from None
    if not np.isfinite(values).all():
        raise DataError(place, f"NaN or inf in {name}", "12 finite numbers")
    return values.reshape(3, 4)

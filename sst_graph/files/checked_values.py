"""Values that were read from a file, checked: poses, covariances, time offsets, intrinsics, text.

The bounds are those of a LiDAR and a camera on one vehicle, taken wide: what lies beyond them is no
calibration but another unit, a damaged digit or a file of something else.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeGuard

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from sst_graph.errors import DataError
from sst_graph.factors.arguments import ROTATION_TOLERANCE, described, rotation_error
from sst_graph.factors.camera import PinholeCamera
from sst_graph.types import FloatArray

MAX_TRANSLATION_M = 1000.0
"""Between two sensors on one vehicle, ships and cranes included."""
MAX_OFFSET_S = 1e9
"""Between two clocks, also of different epochs (32 years)."""
MIN_SIGMA, MAX_SIGMA = 1e-12, 1e12
"""Standard deviations [rad, m, s]: no measurement is finer than the first, and the second means unknown."""
MAX_IMAGE_SIDE_PX = 1 << 20
FOCAL_LENGTHS = (0.02, 200.0)
"""Focal length over the longer side of the image: a field of view of 175 to 0.3 degrees."""
MAX_PIXEL_ASPECT = 5.0
"""fx over fy or the reverse; the pixels of sensors are square or nearly so."""


def check_finite(place: str, array: FloatArray, shape: tuple[int, ...]) -> None:
    """Require an array of numbers, a shape, and finite values.

    Raises:
        DataError: naming ``place``.
    """
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "iuf":
        raise DataError(place, described(array), f"an array of numbers of shape {shape}")
    if array.shape != shape:
        raise DataError(place, f"shape {array.shape}", f"shape {shape}")
    if not np.isfinite(array).all():
        raise DataError(place, "a value that is not finite", "finite numbers")


def checked_pose(matrix: FloatArray, place: str) -> gtsam.Pose3:
    """The pose of a (4, 4) homogeneous matrix [m]; a rotation off by rounding is made orthonormal.

    Raises:
        DataError: not finite, a last row other than 0 0 0 1, a rotation that is none (ROTATION_TOLERANCE),
            or a translation of more than MAX_TRANSLATION_M.
    """
    check_finite(place, matrix, (4, 4))
    R = matrix[:3, :3]
    if np.abs(matrix[3] - [0.0, 0.0, 0.0, 1.0]).max() > 1e-9:
        raise DataError(place, f"last row {matrix[3].tolist()}", "0 0 0 1")
    off = rotation_error(R)
    if not np.isfinite(off):
        raise DataError(place, f"a 3x3 block with an entry of {np.abs(R).max():.3g}", "a rotation matrix")
    determinant = float(np.dot(np.cross(R[0], R[1]), R[2]))
    if off > ROTATION_TOLERANCE or determinant < 0.0:
        found = f"a 3x3 block with |R R' - I| = {off:.2g}, det {determinant:.3g}"
        raise DataError(place, found, "a rotation matrix")
    if np.abs(matrix[:3, 3]).max() > MAX_TRANSLATION_M:
        found = f"a translation of {np.abs(matrix[:3, 3]).max():.3g} m"
        raise DataError(place, found, f"metres between two sensors, at most {MAX_TRANSLATION_M:g}")
    return gtsam.Pose3(gtsam.Rot3.ClosestTo(R) if off > 1e-12 else gtsam.Rot3(R), matrix[:3, 3])


def pose_by_quaternion(translation: ArrayLike, wxyz: ArrayLike, place: str) -> gtsam.Pose3:
    """The pose of a translation (3,) [m] and a quaternion w x y z, whose length is 1 but for its digits.

    Raises:
        DataError: naming ``place``: another length, or as :func:`checked_pose`.
    """
    length = float(np.linalg.norm(wxyz))
    if not abs(length - 1.0) < ROTATION_TOLERANCE:
        raise DataError(place, f"a quaternion of length {length:.6g}", "1")
    matrix = np.eye(4)
    matrix[:3, :3] = gtsam.Rot3.Quaternion(*(np.asarray(wxyz) / length)).matrix()
    matrix[:3, 3] = translation
    return checked_pose(matrix, place)


def is_number(value: Any) -> TypeGuard[float]:
    """Whether a value from a file is a number of a size that standard deviations have."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= MAX_SIGMA


def read_only(values: FloatArray) -> FloatArray:
    """A copy that cannot be written to: what is frozen does not change with the caller's array."""
    copy = np.array(values, dtype=np.float64)
    copy.flags.writeable = False
    return copy


def check_covariance(place: str, covariance: FloatArray, min_sigma: float = MIN_SIGMA) -> None:
    """Require a covariance: finite, symmetric, positive semi-definite but for rounding, sane sigmas.

    Raises:
        DataError: another matrix, or a sigma outside [min_sigma, MAX_SIGMA].
    """
    check_finite(place, covariance, (len(covariance), len(covariance)))
    variances = np.diag(covariance)
    if (variances < 0.0).any():
        raise DataError(place, f"a variance of {variances.min():.3g}", "variances of at least 0")
    sigmas = np.sqrt(variances)
    wrong = sigmas[(sigmas < min_sigma) | (sigmas > MAX_SIGMA)]
    if len(wrong):
        raise DataError(place, f"a sigma of {wrong[0]:.3g}", f"sigmas of {min_sigma:g} to {MAX_SIGMA:g}")
    sigmas = np.maximum(sigmas, 1e-150)  # a zero has zeros beside it, or is found out below
    with np.errstate(over="ignore", invalid="ignore"):
        correlation = covariance / sigmas[:, None] / sigmas
    if not np.isfinite(correlation).all():
        raise DataError(place, "a covariance far above the variances", "correlations of -1 to 1")
    if (np.abs(correlation - correlation.T) > 1e-6).any():
        raise DataError(place, "a matrix that is not symmetric", "a covariance")
    if not np.abs(correlation).max() <= 1.0 + 1e-6:
        found = f"a correlation of {np.abs(correlation).max():.3g}"
        raise DataError(place, found, "a covariance (correlations of -1 to 1)")
    least = float(np.linalg.eigvalsh(correlation)[0])
    if least < -1e-6:
        found = f"a matrix with the eigenvalue {least:.3g} (scaled to a unit diagonal)"
        raise DataError(place, found, "a covariance (positive semi-definite)")


def checked_time_offset_s(time_offset_s: float, place: str) -> float:
    """A time offset [s].

    Raises:
        DataError: not finite, or more than MAX_OFFSET_S.
    """
    if not abs(time_offset_s) <= MAX_OFFSET_S:
        raise DataError(place, f"{time_offset_s:.6g} s", f"a time offset of at most {MAX_OFFSET_S:g} s")
    return float(time_offset_s)


def checked_camera(camera: PinholeCamera, place: str | Path) -> PinholeCamera:
    """A camera whose intrinsics go with the size of its image.

    Raises:
        DataError: as :func:`pinhole_camera`.
    """
    intrinsics = (camera.fx, camera.fy, camera.cx, camera.cy)
    return pinhole_camera(intrinsics, (camera.width, camera.height), place)


def pinhole_camera(
    intrinsics: tuple[float, float, float, float], size: tuple[int, int], place: str | Path
) -> PinholeCamera:
    """The camera of fx, fy, cx, cy and of width, height [px], which go together.

    Raises:
        DataError: a size without pixels, a focal length that is none (FOCAL_LENGTHS, MAX_PIXEL_ASPECT), or a
            principal point farther from the image than the image is large.
    """
    (fx, fy, cx, cy), (width, height) = intrinsics, size
    if not (0 < width <= MAX_IMAGE_SIDE_PX and 0 < height <= MAX_IMAGE_SIDE_PX):
        raise DataError(place, f"an image of {width}x{height} px", f"1 to {MAX_IMAGE_SIDE_PX} px a side")
    least, most = (share * max(width, height) for share in FOCAL_LENGTHS)
    for name, focal in (("fx", fx), ("fy", fy)):
        if not least <= focal <= most:
            expected = f"a focal length of {least:.4g} to {most:.4g} px for an image of {width}x{height} px"
            raise DataError(place, f"{name} = {focal:.6g} px", expected)
    if not 1.0 / MAX_PIXEL_ASPECT <= fx / fy <= MAX_PIXEL_ASPECT:
        found = f"fx = {fx:.6g} and fy = {fy:.6g} px"
        raise DataError(
            place, found, f"focal lengths that differ by a factor of at most {MAX_PIXEL_ASPECT:g}"
        )
    for name, centre, side in (("cx", cx, width), ("cy", cy, height)):
        if not -side <= centre <= 2 * side:
            expected = f"a principal point of {-side} to {2 * side} px for an image of {width}x{height} px"
            raise DataError(place, f"{name} = {centre:.6g} px", expected)
    return PinholeCamera(fx, fy, cx, cy, width, height)


def checked_text(text: str, place: str) -> str:
    """Text that may stand in a file or on a terminal: no line break, escape sequence or direction mark.

    Raises:
        DataError: it holds one.
    """
    if not text.isprintable():
        raise DataError(place, f"{text:.60}", "text without control characters")
    return text

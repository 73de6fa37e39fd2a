"""Drives whose data break an assumption on purpose, by a known size.

Made by changing what is recorded, never by the effects in :mod:`sst_graph.assumptions`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.data.kept_drive import KeptDrive
from sst_graph.factors.camera import PinholeCamera
from sst_graph.simulator import SimulatedDrive
from sst_graph.types import CameraImage, Scan, SemanticClass


def with_focal(drive: KeptDrive, size: float) -> KeptDrive:
    """The camera's true focal length is larger by the share ``size`` than the one given."""
    camera = drive.camera
    return replace(drive, camera=replace(camera, fx=camera.fx / (1 + size), fy=camera.fy / (1 + size)))


def with_principal_point(drive: KeptDrive, right_px: float, down_px: float) -> KeptDrive:
    """The true principal point lies this far from the one given [px]."""
    camera = drive.camera
    return replace(drive, camera=replace(camera, cx=camera.cx - right_px, cy=camera.cy - down_px))


def with_distortion(drive: KeptDrive, k1: float, k2: float = 0.0) -> KeptDrive:
    """Pictures and masks as a lens with these coefficients (OpenCV's) would have made them."""
    camera = drive.camera
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    uvs = np.stack([u, v], axis=-1).reshape(-1, 1, 2).astype(np.float64)
    coefficients = np.array([k1, k2, 0.0, 0.0])
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-9)
    rays = cv2.undistortPoints(uvs, camera.matrix, coefficients, None, None, None, criteria).reshape(-1, 2)
    ideal = rays * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    columns = ideal.reshape(camera.height, camera.width, 2).astype(np.float32)
    inside = (columns >= 0).all(axis=2) & (columns <= [camera.width - 1, camera.height - 1]).all(axis=2)

    def change(image: CameraImage) -> CameraImage:
        x, y = columns[..., 0], columns[..., 1]
        mask = np.where(inside, cv2.remap(image.mask, x, y, cv2.INTER_NEAREST), int(SemanticClass.IGNORE))
        numbers = image.instances
        if numbers is not None:
            numbers = np.where(inside, cv2.remap(numbers, x, y, cv2.INTER_NEAREST), 0).astype(np.uint16)
        pixels = np.asarray(cv2.remap(image.pixels, x, y, cv2.INTER_LINEAR), np.uint8)
        return CameraImage(image.stamp_ns, mask.astype(np.uint8), pixels, numbers)

    return drive.with_images(change)


def turned_picture(
    picture: NDArray[np.uint8], camera: PinholeCamera, R: gtsam.Rot3, interpolation: int, **border: Any
) -> NDArray[np.uint8]:
    """A picture or a mask as the camera has it after a turn about its centre: a warp by K R inv(K).

    Args:
        interpolation, border: OpenCV's ``flags``, ``borderMode`` and ``borderValue``; of what it did not see.
    """
    H = camera.matrix @ R.matrix() @ np.linalg.inv(camera.matrix)
    size = (camera.width, camera.height)
    return np.asarray(cv2.warpPerspective(picture, H, size, flags=interpolation, **border), np.uint8)


def with_ranges(drive: KeptDrive, bias_m: float, scale: float) -> KeptDrive:
    """The true ranges are longer than the measured ones by a constant [m] and by a share."""

    def change(scan: Scan) -> Scan:
        ranges = np.linalg.norm(scan.points.astype(np.float64), axis=1)
        measured = np.maximum(ranges - bias_m, 0.1) / (1.0 + scale)
        share = measured / np.maximum(ranges, 1e-6)
        return replace(scan, points=(scan.points * share[:, None]).astype(np.float32))

    return drive.with_scans(change)


def with_elevation(drive: KeptDrive, size: float) -> KeptDrive:
    """The true beams are higher than they are said to be [rad]."""

    def change(scan: Scan) -> Scan:
        p = scan.points.astype(np.float64)
        azimuth, ranges = np.arctan2(p[:, 1], p[:, 0]), np.linalg.norm(p, axis=1)
        said = np.arctan2(p[:, 2], np.hypot(p[:, 0], p[:, 1])) - size
        across = ranges * np.cos(said)
        points = np.stack([across * np.cos(azimuth), across * np.sin(azimuth), ranges * np.sin(said)], axis=1)
        return replace(scan, points=points.astype(np.float32))

    return drive.with_scans(change)


def with_skew(drive: KeptDrive, size: float) -> KeptDrive:
    """The camera's clock loses ``size`` seconds a second against the LiDAR's, from the first image on."""
    first = next(frame.image.stamp_ns for frame in drive.frames if frame.image is not None)

    def change(image: CameraImage) -> CameraImage:
        return replace(image, stamp_ns=first + round((image.stamp_ns - first) / (1.0 + size)))

    return drive.with_images(change)


_BANDS = 12
"""Bands of rows that share an instant: the edge of a car is 20 to 60 of 375 rows high."""


def with_line_delay(street: SimulatedDrive, drive: KeptDrive, size: float) -> KeptDrive:
    """Every row exposed ``size`` seconds after the one above it, the middle one at the picture's stamp.

    Put together from bands of rows, each from a picture of the street at the band's own instant.

    Args:
        street: that ``drive`` was kept of.
    """
    height = drive.camera.height
    bands = np.array_split(np.arange(height), _BANDS)
    frames = list(drive.frames)
    for rows in bands:
        late_s = size * (float(rows.mean()) - 0.5 * (height - 1))
        time_offset_s = street.config.time_offset_s + late_s
        then = replace(street, config=replace(street.config, time_offset_s=time_offset_s))
        for position, frame in enumerate(frames):
            seen = then.image(position)
            if frame.image is not None:
                frames[position] = replace(frame, image=_with_rows(frame.image, seen, rows))
    return replace(drive, frames=tuple(frames))


def _with_rows(image: CameraImage, other: CameraImage, rows: NDArray[np.intp]) -> CameraImage:
    """An image with some rows of another one."""
    band = slice(int(rows[0]), int(rows[-1]) + 1)

    def mixed(own: NDArray[np.generic], its: NDArray[np.generic]) -> NDArray[Any]:
        whole = own.copy()
        whole[band] = its[band]
        return whole

    assert image.instances is not None and other.instances is not None
    return replace(
        image,
        mask=mixed(image.mask, other.mask),
        pixels=mixed(image.pixels, other.pixels),
        instances=mixed(image.instances, other.instances),
    )


WRONG: dict[str, Callable[[KeptDrive, float], KeptDrive]] = {
    "focal": with_focal,
    "cx": lambda drive, size: with_principal_point(drive, size, 0.0),
    "cy": lambda drive, size: with_principal_point(drive, 0.0, size),
    "k1": with_distortion,
    "k2": lambda drive, size: with_distortion(drive, 0.0, size),
    "skew": with_skew,
    "range_bias": lambda drive, size: with_ranges(drive, size, 0.0),
    "range_scale": lambda drive, size: with_ranges(drive, 0.0, size),
    "elevation": with_elevation,
}
"""How to break an assumption by the size of its parameter."""

"""Corners of an image, and their tracks into the next one."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sst_graph.config import Settings, setting
from sst_graph.errors import DataError
from sst_graph.types import CameraImage, SemanticClass

FloatArray = NDArray[np.float64]

UNTRACKED_CLASSES = (
    SemanticClass.VEHICLE,
    SemanticClass.PERSON,
    SemanticClass.TWO_WHEELER,
    SemanticClass.SKY,
    SemanticClass.IGNORE,
)
"""Classes on which no corner is taken: what may move by itself, clouds, and what may be anything."""


@dataclass(frozen=True)
class FeatureConfig(Settings):
    """Which corners are tracked, and when a track counts.

    Attributes:
        threshold: least grey-value contrast of a FAST corner.
        cell_px: edge of the grid cells over which corners are spread [px].
        per_cell: most corners of a cell.
        mask_margin_px: corners keep this distance from untracked classes [px].
        window_px: edge of the Lucas-Kanade window [px].
        levels: pyramid levels above the full image.
        max_round_trip_px: largest distance between a corner and its track there and back [px].
    """

    threshold: int = setting(12, at_least=1, at_most=255)
    cell_px: int = setting(32, at_least=4, at_most=1000)
    per_cell: int = setting(2, at_least=1, at_most=1000)
    mask_margin_px: int = setting(5, at_least=0, at_most=100)
    window_px: int = setting(17, at_least=3, at_most=101)
    levels: int = setting(4, at_least=0, at_most=10)
    max_round_trip_px: float = setting(0.5, at_least=0.01, at_most=100.0)


@dataclass(frozen=True)
class Tracks:
    """Corners of image a found again in image b; nothing here depends on a calibration.

    Attributes:
        from_ns, to_ns: stamps of the two images, camera clock [ns].
        uv_a, uv_b: (n, 2) pixels in a and b [px].
    """

    from_ns: int
    to_ns: int
    uv_a: FloatArray
    uv_b: FloatArray

    def __len__(self) -> int:
        return len(self.uv_a)


class FeatureTracker:
    """Tracks between consecutive images; keeps the last one."""

    def __init__(self, config: FeatureConfig | None = None) -> None:
        self.config = config or FeatureConfig()
        self._last: tuple[CameraImage, NDArray[np.uint8]] | None = None

    def add(self, image: CameraImage) -> Tracks | None:
        """Tracks from the image before to this one; None for the first, none where a picture is missing.

        Raises:
            DataError: the image is not later than the one before, or of another size.
        """
        gray = gray_of(image)
        last, self._last = self._last, (image, gray)
        if last is None:
            return None
        image_a, gray_a = last
        if image.stamp_ns <= image_a.stamp_ns:
            raise DataError("visual odometry", f"stamp {image.stamp_ns}", f"one after {image_a.stamp_ns} ns")
        if not (image.has_picture and image_a.has_picture):
            return Tracks(image_a.stamp_ns, image.stamp_ns, np.zeros((0, 2)), np.zeros((0, 2)))
        if gray.shape != gray_a.shape:
            raise DataError("visual odometry", f"image {gray.shape}", f"the size before, {gray_a.shape}")
        corners = detect_corners(gray_a, trackable_area(image_a, self.config), self.config)
        uv_a, uv_b = _track(gray_a, gray, corners, self.config)
        # A corner that slid on to something that may move is no landmark.
        column, row = np.rint(uv_b).astype(np.intp).T
        still = np.full(len(uv_b), True)
        if image.has_mask:
            still = ~np.isin(image.mask[row, column], UNTRACKED_CLASSES)
        return Tracks(image_a.stamp_ns, image.stamp_ns, uv_a[still], uv_b[still])


def track_features(image_a: CameraImage, image_b: CameraImage, config: FeatureConfig | None = None) -> Tracks:
    """FAST corners of image a, spread over the image, followed into image b and back.

    Raises:
        DataError: image b is not later than a, or of another size.
    """
    tracker = FeatureTracker(config)
    tracker.add(image_a)
    tracks = tracker.add(image_b)
    assert tracks is not None
    return tracks


def detect_corners(
    gray: NDArray[np.uint8], trackable: NDArray[np.uint8], config: FeatureConfig
) -> NDArray[np.float32]:
    """(n, 2) FAST corners [px], the strongest few of each grid cell, in row order of the cells.

    Args:
        gray: (h, w) picture.
        trackable: (h, w), 0 where no corner is wanted.
    """
    detector = cv2.FastFeatureDetector.create(threshold=config.threshold)
    keypoints = detector.detect(gray, trackable)
    if not keypoints:
        return np.zeros((0, 2), np.float32)
    uvs = np.asarray(cv2.KeyPoint.convert(keypoints)).reshape(-1, 2)
    response = np.array([keypoint.response for keypoint in keypoints])
    columns = gray.shape[1] // config.cell_px + 1
    column, row = (uvs // config.cell_px).astype(np.intp).T
    cell = row * columns + column
    order = np.lexsort((-response, cell))
    ordered = cell[order]
    rank = np.arange(len(order)) - np.searchsorted(ordered, ordered)
    return np.asarray(uvs[order[rank < config.per_cell]], np.float32)


def trackable_area(image: CameraImage, config: FeatureConfig) -> NDArray[np.uint8]:
    """(h, w) 255 where a corner may be taken: off the untracked classes by a margin, or without a mask."""
    if not image.has_mask:
        return np.full(image.mask.shape, 255, np.uint8)
    table = np.zeros(256, np.uint8)
    table[list(UNTRACKED_CLASSES)] = 255
    width = 2 * config.mask_margin_px + 1
    barred = cv2.dilate(cv2.LUT(image.mask, table), np.ones((width, width), np.uint8))
    return np.asarray(cv2.bitwise_not(barred), np.uint8)


def gray_of(image: CameraImage) -> NDArray[np.uint8]:
    """(h, w) grey picture; empty without one."""
    if not image.has_picture:
        return np.zeros((0, 0), np.uint8)
    return np.asarray(cv2.cvtColor(image.pixels, cv2.COLOR_BGR2GRAY), np.uint8)


def _track(
    gray_a: NDArray[np.uint8],
    gray_b: NDArray[np.uint8],
    corners: NDArray[np.float32],
    config: FeatureConfig,
) -> tuple[FloatArray, FloatArray]:
    """Corners that LK finds in b, inside the image, and that return to where they started."""
    there, good = follow_corners(gray_a, gray_b, corners, config)
    return corners[good].astype(np.float64), there[good]


def follow_corners(
    gray_a: NDArray[np.uint8],
    gray_b: NDArray[np.uint8],
    corners: NDArray[np.float32],
    config: FeatureConfig,
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """(n, 2) where Lucas-Kanade finds corners (n, 2) of a in b [px], and (n,) whether it does: inside the
    image, and returning to where they started."""
    if len(corners) == 0:
        return np.zeros((0, 2)), np.zeros(0, np.bool_)
    there, found = _flow(gray_a, gray_b, corners, None, config)
    # Back from where it went: the pyramid has done its work, two levels check it.
    back, found_back = _flow(gray_b, gray_a, there, corners, config)
    height, width = gray_a.shape[:2]
    good = (
        found
        & found_back
        & (np.linalg.norm(back - corners, axis=1) < config.max_round_trip_px)
        & np.all((there >= 0) & (there <= [width - 1, height - 1]), axis=1)
    )
    return there.astype(np.float64), np.asarray(good, np.bool_)


def _flow(
    gray_a: NDArray[np.uint8],
    gray_b: NDArray[np.uint8],
    uv_a: NDArray[np.float32],
    guess: NDArray[np.float32] | None,
    config: FeatureConfig,
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """(n, 2) pixels of b where Lucas-Kanade finds the windows about uv_a, and (n,) whether it does."""
    there, found, _ = cv2.calcOpticalFlowPyrLK(
        gray_a,
        gray_b,
        uv_a,
        np.empty_like(uv_a) if guess is None else guess.copy(),
        winSize=(config.window_px, config.window_px),
        maxLevel=config.levels if guess is None else 1,
        criteria=(cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.02),
        flags=0 if guess is None else cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    return np.asarray(there, np.float32).reshape(-1, 2), np.asarray(found).reshape(-1) == 1

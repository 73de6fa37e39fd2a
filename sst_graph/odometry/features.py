"""Corners of an image, and their tracks into the next one."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sst_graph.errors import DataError
from sst_graph.types import CameraImage, FloatArray, SemanticClass

UNTRACKED_CLASSES = (
    SemanticClass.VEHICLE,
    SemanticClass.PERSON,
    SemanticClass.TWO_WHEELER,
    SemanticClass.SKY,
    SemanticClass.IGNORE,
)
"""Classes on which no corner is taken: what may move by itself, clouds, and what may be anything."""


_FAST_CONTRAST = 12
"""Least grey-value contrast of a FAST corner; a lower one finds more corners in the dark, and more noise."""
_CELL_PX = 32
"""Edge of the grid cells over which corners are spread, so that one textured wall does not decide [px]."""
_CORNERS_PER_CELL = 2
"""Most corners of a cell; the time of a frame grows with it."""
_MASK_MARGIN_PX = 5
"""Corners keep this distance from untracked classes, for masks end a few pixels beside an object [px]."""
_WINDOW_PX = 17
"""Edge of the Lucas-Kanade window [px]."""
_LEVELS = 4
"""Pyramid levels above the full image: half a window at the coarsest is 8 * 2^4 = 128 px."""
_MAX_ROUND_TRIP_PX = 0.5
"""Largest distance between a corner and its track there and back [px]."""


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

    def __init__(self) -> None:
        self._last: tuple[CameraImage, NDArray[np.uint8]] | None = None

    def seconds_to(self, image: CameraImage) -> float:
        """Time from the last image to this one; infinite before the first [s]."""
        return np.inf if self._last is None else (image.stamp_ns - self._last[0].stamp_ns) * 1e-9

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
        corners = detect_corners(gray_a, trackable_area(image_a))
        found, good = follow_corners(gray_a, gray, corners)
        uv_a, uv_b = corners[good].astype(np.float64), found[good]
        # A corner that slid on to something that may move is no landmark.
        column, row = np.rint(uv_b).astype(np.intp).T
        static = np.full(len(uv_b), True)
        if image.has_mask:
            static = ~np.isin(image.mask[row, column], UNTRACKED_CLASSES)
        if image.valid is not None:
            static &= image.valid[row, column]
        return Tracks(image_a.stamp_ns, image.stamp_ns, uv_a[static], uv_b[static])


def detect_corners(gray: NDArray[np.uint8], trackable: NDArray[np.uint8]) -> NDArray[np.float32]:
    """(n, 2) FAST corners [px], the strongest few of each grid cell, in row order of the cells.

    Args:
        gray: (h, w) picture.
        trackable: (h, w), 0 where no corner is wanted.
    """
    detector = cv2.FastFeatureDetector.create(threshold=_FAST_CONTRAST)
    keypoints = detector.detect(gray, trackable)
    if not keypoints:
        return np.zeros((0, 2), np.float32)
    uvs = np.asarray(cv2.KeyPoint.convert(keypoints)).reshape(-1, 2)
    response = np.array([keypoint.response for keypoint in keypoints])
    columns = gray.shape[1] // _CELL_PX + 1
    column, row = (uvs // _CELL_PX).astype(np.intp).T
    cell = row * columns + column
    order = np.lexsort((-response, cell))
    ordered = cell[order]
    rank = np.arange(len(order)) - np.searchsorted(ordered, ordered)
    return np.asarray(uvs[order[rank < _CORNERS_PER_CELL]], np.float32)


def trackable_area(image: CameraImage) -> NDArray[np.uint8]:
    """(h, w) 255 where a corner may be taken: off the untracked classes by a margin, or without a mask; and
    where no Lucas-Kanade window leaves what the camera saw."""
    trackable = np.full(image.mask.shape, 255, np.uint8)
    if image.has_mask:
        table = np.zeros(256, np.uint8)
        table[list(UNTRACKED_CLASSES)] = 255
        trackable -= _dilated(np.asarray(cv2.LUT(image.mask, table), np.uint8), _MASK_MARGIN_PX)
    if image.valid is not None:
        trackable[_dilated((~image.valid).view(np.uint8), _WINDOW_PX // 2) > 0] = 0
    return trackable


def _dilated(area: NDArray[np.uint8], margin_px: int) -> NDArray[np.uint8]:
    """An area (h, w) with all that is this close to it."""
    side = 2 * margin_px + 1
    return np.asarray(cv2.dilate(area, np.ones((side, side), np.uint8)), np.uint8)


def gray_of(image: CameraImage) -> NDArray[np.uint8]:
    """(h, w) grey picture; empty without one."""
    if not image.has_picture:
        return np.zeros((0, 0), np.uint8)
    return np.asarray(cv2.cvtColor(image.pixels, cv2.COLOR_BGR2GRAY), np.uint8)


def follow_corners(
    gray_a: NDArray[np.uint8],
    gray_b: NDArray[np.uint8],
    corners: NDArray[np.float32],
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """(n, 2) where Lucas-Kanade finds corners (n, 2) of a in b [px], and (n,) whether it does: inside the
    image, and returning to where they started."""
    if len(corners) == 0:
        return np.zeros((0, 2)), np.zeros(0, np.bool_)
    there, found = _flow(gray_a, gray_b, corners, None)
    # The backward track starts at the corner's first position: two pyramid levels are enough to check it.
    back, found_back = _flow(gray_b, gray_a, there, corners)
    height, width = gray_a.shape[:2]
    good = (
        found
        & found_back
        & (np.linalg.norm(back - corners, axis=1) < _MAX_ROUND_TRIP_PX)
        & np.all((there >= 0) & (there <= [width - 1, height - 1]), axis=1)
    )
    return there.astype(np.float64), np.asarray(good, np.bool_)


def _flow(
    gray_a: NDArray[np.uint8],
    gray_b: NDArray[np.uint8],
    uv_a: NDArray[np.float32],
    guess: NDArray[np.float32] | None,
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """(n, 2) pixels of b where Lucas-Kanade finds the windows about uv_a, and (n,) whether it does."""
    there, found, _ = cv2.calcOpticalFlowPyrLK(
        gray_a,
        gray_b,
        uv_a,
        np.empty_like(uv_a) if guess is None else guess.copy(),
        winSize=(_WINDOW_PX, _WINDOW_PX),
        maxLevel=_LEVELS if guess is None else 1,
        criteria=(cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.02),
        flags=0 if guess is None else cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    return np.asarray(there, np.float32).reshape(-1, 2), np.asarray(found).reshape(-1) == 1

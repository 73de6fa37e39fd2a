"""Edges of the picture along a mask's contour.

Networks and people draw a contour one to three pixels off the edge, along a whole side of an object, and
interpolate where the picture is too dark to see an edge. The picture shows where the edge is: there colours
change most. One pixel's profile is noise, so profiles are averaged along the contour. The contour moves to an
edge that is unambiguous within reach; where hardly any change of colour goes with it, it is not matched.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sst_graph.features.sampling import sampled
from sst_graph.types import FloatArray

FloatMap = NDArray[np.float32]
Picture = NDArray[np.uint8]

_REACH_PX = 3.0
"""Farthest that a contour is moved [px]."""
_MASK_SIGMA_PX = 1.4
"""Deviation of the masks' contours from the objects': of two edges within reach the closer one is likelier
[px]."""
_ALONG_PX = 4
"""Length of contour to either side of a pixel over which profiles are averaged [px]."""
_MIN_CONTRAST = 1.5
"""Least ratio of an edge to the mean change of colour within reach."""
_MAX_SECOND_BEST = 0.6
"""An edge is ambiguous if another within reach has more than this share of its weight."""
_MIN_SHARE = 0.2
"""Where the likeliest edge has less than this share of the median weight along all contours, no edge is
visible: nothing is matched there."""
_STEP_PX = 0.5
"""Between the distances from the contour at which the picture is sampled [px]."""
_BLUR_PX = 0.8
"""Gaussian blur of the picture before sampling [px]."""
_EDGE_WIDTH_PX = 1.3
"""What is this close to an edge is part of it [px]."""
_NEARBY = np.arange(-2, 3)
"""In steps around the likeliest distance: the same edge."""
_SLOPE, _CURVATURE = _NEARBY / 10.0, (_NEARBY**2 - 2.0) / 14.0
"""Weights of the parabola through five samples (Savitzky and Golay, 1964)."""
_OWN_PX = 0.7
"""A sample belongs to a contour pixel if the distance field there is its distance from it, by this much
[px]."""
_UNSEEN_PX = 2
"""How far around a contour pixel without a visible edge nothing is matched [px]."""
_SMOOTHING_PX = 1.0
"""Gaussian smoothing of the shifts across the field, in pixels of the image [px]."""
_EVERY = 2
"""One of so many contour pixels is evaluated: neighbours show the same."""


_MOST_SHARE, _ALWAYS = 0.1, 2_000
"""A mask is noise, and no outline of anything, where more than this share of its pixels is evaluated along
contours, and more than so many."""


@dataclass(frozen=True)
class PictureEdges:
    """What the picture shows at each pixel of a mask's contours, in the order of :func:`contour_pixels`.

    Attributes:
        shifts: (n,) how far outside of the mask's contour the edge is [px].
        seen: (n,) False where no edge is visible.
    """

    shifts: FloatMap
    seen: NDArray[np.bool_]

    def fields(self, inside: NDArray[np.uint8]) -> tuple[FloatMap, NDArray[np.uint8]]:
        """Shift at the contour pixel nearest to each pixel (h, w), smoothed [px]; (h, w) 1 near what is not
        seen."""
        u, v = np.concatenate(contour_pixels(inside)).T
        height, width = (side // 2 + side % 2 for side in inside.shape)
        # At half the size: shifts vary slowly along a contour, and this takes most of the time.
        half_u, half_v = u // 2, v // 2
        away = np.ones((height, width), np.uint8)
        away[half_v, half_u] = 0
        labels = cv2.distanceTransformWithLabels(away, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)[1]
        cells = labels[half_v, half_u]
        means = np.bincount(cells, self.shifts) / np.maximum(np.bincount(cells), 1)
        smooth = cv2.GaussianBlur(means.astype(np.float32)[labels], (0, 0), 0.5 * _SMOOTHING_PX)
        shifts = cv2.resize(smooth, (2 * width, 2 * height))[: inside.shape[0], : inside.shape[1]]
        unseen = np.zeros(inside.shape, np.uint8)
        unseen[v[~self.seen], u[~self.seen]] = 1
        around = np.ones((2 * _UNSEEN_PX + 1, 2 * _UNSEEN_PX + 1), np.uint8)
        return np.asarray(shifts, np.float32), np.asarray(cv2.dilate(unseen, around), np.uint8)


def contour_pixels(inside: NDArray[np.uint8]) -> list[NDArray[np.intp]]:
    """(k, 2) every second pixel of a region's outermost ring in order, columns and rows, of each contour."""
    outlines, _ = cv2.findContours(inside, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    return [outline[::_EVERY, 0].astype(np.intp) for outline in outlines]


def find_picture_edges(
    inside: NDArray[np.uint8],
    distance: FloatMap,
    picture: Picture,
    outside: NDArray[np.uint8] | None,
) -> PictureEdges | None:
    """What the picture shows along the contours of a region; None where they fill it, as in noise.

    Args:
        inside: (h, w) 1 in the region, 0 elsewhere.
        distance: (h, w) signed distance to its contour, negative inside, lightly smoothed [px].
        picture: (h, w, 3) BGR.
        outside: (h, w) 1 beside pixels that the lens does not show: a contour is not moved there.
    """
    along, outlines = _ALONG_PX // _EVERY, contour_pixels(inside)
    if sum(map(len, outlines)) > max(_ALWAYS, _MOST_SHARE * inside.size):
        return None
    pixels, own = _closed(outlines, 3 * along)
    ts = np.arange(-_REACH_PX, _REACH_PX + 1e-9, _STEP_PX)
    strength = _strength(pixels, ts, distance, picture, along)
    likely = strength * np.exp(-0.5 * (ts / _MASK_SIGMA_PX) ** 2).astype(np.float32)[:, None]
    shifts, clear = _best_edges(strength, likely, ts)
    size = 2 * along + 1
    shifts = ndimage.median_filter(np.where(clear, shifts, 0.0), size, mode="nearest")
    shifts = ndimage.uniform_filter1d(shifts, size, mode="nearest")
    strongest = likely.max(axis=0)
    # At the image's border the object is cut: no edge of its own.
    cut = (pixels == 0).any(axis=1) | (pixels == np.array(inside.shape[::-1]) - 1).any(axis=1)
    foreign = np.zeros(len(pixels), np.bool_)
    if outside is not None:
        foreign = outside[pixels[:, 1], pixels[:, 0]] > 0
        cut |= foreign
    whole = own[~cut[own]]
    usual = np.median(strongest[whole]) if len(whole) else 0.0
    seen = ndimage.median_filter(strongest >= _MIN_SHARE * usual, size, mode="nearest")
    shifts, seen = np.where(foreign, 0.0, shifts), seen & ~foreign
    return PictureEdges(shifts[own].astype(np.float32), np.asarray(seen[own], np.bool_))


def _closed(outlines: Sequence[NDArray[np.intp]], pad: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """(n, 2) pixels of all contours, each with ``pad`` more before its first and behind its last, for it is
    closed; and which of them are the contours' own."""
    rounds = [np.arange(-pad, len(outline) + pad) % len(outline) for outline in outlines]
    starts = np.cumsum([0] + [len(order) for order in rounds[:-1]])
    own = [start + pad + np.arange(len(outline)) for start, outline in zip(starts, outlines, strict=True)]
    pixels = [outline[order] for outline, order in zip(outlines, rounds, strict=True)]
    return np.concatenate(pixels), np.concatenate(own)


def _strength(
    pixels: NDArray[np.intp], ts: FloatArray, distance: FloatMap, picture: Picture, along: int
) -> FloatMap:
    """(m, n) change of colour at m distances outside of n contour pixels' contour, averaged along it, in
    grey levels a pixel (root of the sum of squares over the channels)."""
    beside = pixels[None] + np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])[:, None]
    around = sampled(distance, beside[..., 0], beside[..., 1])
    normals = np.stack([around[1] - around[2], around[3] - around[4]], axis=1)
    normals /= np.maximum(np.linalg.norm(normals, axis=1), 1e-6)[:, None]
    feet = pixels - around[0][:, None] * normals
    # Colours half a pixel to either side of the samples.
    samples = np.concatenate([[ts[0] - _STEP_PX], ts, [ts[-1] + _STEP_PX]])
    u, v = (feet[:, k] + samples[:, None] * normals[:, k] for k in (0, 1))
    blurred = np.asarray(cv2.GaussianBlur(picture, (3, 3), _BLUR_PX), np.uint8)
    colours = sampled(blurred, u, v).astype(np.float32)
    change = (colours[2:] - colours[:-2]) / np.float32(2.0 * _STEP_PX)
    # First with its sign, which holds along an edge and not in a texture; then its size.
    size = along + 1
    steady = cv2.blur(change, (size, 1), borderType=cv2.BORDER_REPLICATE)
    strength = np.sqrt(np.einsum("ijk,ijk->ij", steady, steady))
    strength *= np.abs(sampled(distance, u[1:-1], v[1:-1]) - ts[:, None]) < _OWN_PX
    size = 2 * along + 1
    return np.asarray(cv2.blur(strength, (size, 1), borderType=cv2.BORDER_REPLICATE), np.float32)


def _best_edges(strength: FloatMap, likely: FloatMap, ts: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
    """(n,) distances of the likeliest edges [px], and whether they are unambiguous."""
    # The likelihood selects the edge; its position is that in the picture.
    column = np.arange(strength.shape[1])
    likeliest = likely.argmax(axis=0)
    nearby = np.clip(likeliest + _NEARBY[:, None], 2, len(ts) - 3)
    best = nearby[strength[nearby, column].argmax(axis=0), column]
    # The top of a parabola through five places: an edge within a pixel has a flat one.
    slope, curvature = (
        weights @ strength[best + _NEARBY[:, None], column] for weights in (_SLOPE, _CURVATURE)
    )
    shifts = ts[best] + np.clip(-0.5 * slope / np.minimum(curvature, -1e-9), -2.0, 2.0) * _STEP_PX
    top = strength[best, column]
    clear = top > _MIN_CONTRAST * strength.mean(axis=0)
    second = np.where(np.abs(ts[:, None] - shifts) > _EDGE_WIDTH_PX, likely, 0.0).max(axis=0)
    clear &= second < _MAX_SECOND_BEST * likely[likeliest, column]
    return np.asarray(shifts), np.asarray(clear)

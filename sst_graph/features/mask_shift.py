"""Whether masks lie where their pictures show edges, and how far they are shifted if they do not.

The contour of each object is laid over the picture at every shift within reach; where the masks lie right,
colours change most across it at no shift. One object may be drawn badly: the shift that all of them share is
the masks' own, and how much they disagree about it is its uncertainty (a jackknife over clusters of objects).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sst_graph.sampling import step_for
from sst_graph.types import FloatArray, SemanticClass

REACH_PX = 10
"""Farthest shift that is tried, either way [px]."""
SIDE = 2 * REACH_PX + 1
"""Shifts that are tried along each axis."""
_MARGIN_PX = REACH_PX + 2
"""Contour pixels this close to the image's border or to pixels to ignore are left out [px]."""
_AROUND_PX = 16
"""Pixels this far from an object have no part in what its contour shows: the longest shift and half the
filters' widths [px]."""
_LEAST_PIXELS = 60
"""Contour pixels of an object that takes part."""
_MOST_PIXELS = 400
"""Most that are looked at: neighbours show the same."""
_COLUMNS = 8
"""Objects in one such part of the image's width form a cluster: over a drive they are the same ones."""
_APART_PX = 4.0
"""Shifts farther apart than this see different edges [px]."""
_LEAST_OBJECTS, _LEAST_CLUSTERS = 8, 3
"""Fewest objects, and clusters of them, that a shift and its uncertainty are told from."""


@dataclass(frozen=True)
class ContourProfile:
    """Change of colour across one object's contour under every shift.

    Attributes:
        strength: (SIDE, SIDE) at shifts of -REACH_PX .. REACH_PX down (rows) and right (columns), with mean 0
            and standard deviation 1.
        weight: of the object: root of its contour's pixels.
        cluster: part of the image's width that it lies in.
    """

    strength: NDArray[np.float32]
    weight: float
    cluster: int


@dataclass(frozen=True)
class MaskShift:
    """Shift of the masks against the edges of the pictures.

    Attributes:
        right_px, down_px: where the masks lie, seen from the pictures' edges [px].
        sigma_px: standard deviations of the two, (2,) [px].
        contrast: how far the mean strength at the best shift stands out, in standard deviations of an
            object's strength over the shifts.
        second_best: the highest strength at a shift elsewhere, as a share of the best one's: near 1 where the
            picture is that of another mask.
        objects: that took part.
    """

    right_px: float
    down_px: float
    sigma_px: FloatArray
    contrast: float
    second_best: float
    objects: int

    @property
    def within_reach(self) -> bool:
        """Whether the best shift is one: at the end of what is tried there may be better ones beyond."""
        return max(abs(self.right_px), abs(self.down_px)) < REACH_PX - 1.5

    @property
    def length_px(self) -> float:
        """How far the masks are shifted [px]."""
        return float(np.hypot(self.right_px, self.down_px))

    @property
    def sigma_along_px(self) -> float:
        """Standard deviation of the shift along itself [px]."""
        direction = np.array([self.right_px, self.down_px]) / max(self.length_px, 1e-9)
        return float(np.sqrt(direction**2 @ self.sigma_px**2))


def contour_profiles(
    mask: NDArray[np.uint8], picture: NDArray[np.uint8], semantic_class: SemanticClass
) -> tuple[ContourProfile, ...]:
    """Profiles of the objects of a class in a mask (h, w) over its picture (h, w, 3)."""
    inside = (mask == int(semantic_class)).view(np.uint8)
    # Only around the class: nothing else is looked at.
    x, y, columns, rows = cv2.boundingRect(inside)
    left, top = max(0, x - _AROUND_PX), max(0, y - _AROUND_PX)
    part = slice(top, y + rows + _AROUND_PX), slice(left, x + columns + _AROUND_PX)
    inside = np.ascontiguousarray(inside[part])
    outlines, _ = cv2.findContours(inside, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    gradients = _gradients(picture[part])
    ignored = (mask[part] == int(SemanticClass.IGNORE)).view(np.uint8)
    unknown = cv2.dilate(ignored, np.ones((2 * _MARGIN_PX + 1,) * 2, np.uint8))
    normals_x, normals_y = _normals(inside)
    (height, width), margin, found = mask.shape, _MARGIN_PX, []
    for outline in outlines:
        u, v = outline[:, 0].T.astype(np.intp)
        usable = (u + left >= margin) & (u + left < width - margin)
        usable &= (v + top >= margin) & (v + top < height - margin)
        usable[usable] &= unknown[v[usable], u[usable]] == 0
        u, v = u[usable], v[usable]
        if len(u) < _LEAST_PIXELS:
            continue
        step = step_for(len(u), _MOST_PIXELS)
        u, v = u[::step], v[::step]
        strength = _strength(gradients, u, v, normals_x[v, u], normals_y[v, u])
        spread = float(strength.std())
        if spread > 1e-3:
            scaled = ((strength - strength.mean()) / spread).astype(np.float32)
            cluster = int((u + left).mean() * _COLUMNS / width)
            found.append(ContourProfile(scaled, float(np.sqrt(len(u))), cluster))
    return tuple(found)


def mask_shift(profiles: Sequence[ContourProfile]) -> MaskShift | None:
    """The shift that the masks of all objects share; None where there are too few of them."""
    clusters = sorted({profile.cluster for profile in profiles})
    if len(profiles) < _LEAST_OBJECTS or len(clusters) < _LEAST_CLUSTERS:
        return None
    sums = np.stack([sum_of([p for p in profiles if p.cluster == c]) for c in clusters])
    weights = np.array([sum(p.weight for p in profiles if p.cluster == c) for c in clusters])
    whole = sums.sum(axis=0)
    best, contrast = _peak(whole)
    n = len(clusters)
    without = np.array([_peak(whole - part)[0] for part in sums])
    variance = (n - 1) / n * ((without - without.mean(axis=0)) ** 2).sum(axis=0)
    # The picture's edge lies at +shift of the contour: the mask at -shift of the edge.
    sigma = np.sqrt(variance + 0.1**2)
    right, down = -best
    at_best = contrast / float(weights.sum())
    return MaskShift(float(right), float(down), sigma, at_best, _second_best(whole, best), len(profiles))


def _second_best(total: FloatArray, best: FloatArray) -> float:
    """The highest strength farther than :data:`_APART_PX` from the best, as a share of the highest."""
    down, right = np.mgrid[-REACH_PX : REACH_PX + 1, -REACH_PX : REACH_PX + 1]
    elsewhere = np.hypot(right - best[0], down - best[1]) > _APART_PX
    return float(total[elsewhere].max() / total.max())


def sum_of(profiles: Sequence[ContourProfile]) -> FloatArray:
    """(SIDE, SIDE) weighted sum of strengths."""
    return np.asarray(sum(p.weight * p.strength.astype(np.float64) for p in profiles))


def _gradients(picture: NDArray[np.uint8]) -> NDArray[np.float32]:
    """(h, w, 6) derivatives of the lightly blurred picture: to the right of each channel, and down."""
    blurred = cv2.GaussianBlur(picture, (0, 0), 1.0).astype(np.float32)
    parts = [cv2.Sobel(blurred, cv2.CV_32F, *order, ksize=3, scale=0.125) for order in ((1, 0), (0, 1))]
    return np.asarray(np.concatenate(parts, axis=2), np.float32)


def _normals(inside: NDArray[np.uint8]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Unit normals (h, w) of a region's border, right and down parts."""
    smooth = cv2.GaussianBlur(inside.astype(np.float32), (0, 0), 2.0)
    x, y = (cv2.Sobel(smooth, cv2.CV_32F, *order, ksize=3) for order in ((1, 0), (0, 1)))
    length = np.maximum(np.hypot(x, y), 1e-6)
    return np.asarray(x / length, np.float32), np.asarray(y / length, np.float32)


def _strength(
    gradients: NDArray[np.float32],
    u: NDArray[np.intp],
    v: NDArray[np.intp],
    nx: NDArray[np.float32],
    ny: NDArray[np.float32],
) -> FloatArray:
    """(SIDE, SIDE) mean change of colour across the contour at every shift, in grey levels a pixel; strong
    edges count no more than a few times a usual one."""
    steps = np.arange(-REACH_PX, REACH_PX + 1)
    rows = (v[None, :] + steps[:, None])[:, None, :]
    columns = (u[None, :] + steps[:, None])[None, :, :]
    # Both derivatives of all channels lie side by side: one look-up.
    found = gradients.reshape(-1, 6).take(rows * gradients.shape[1] + columns, axis=0)
    # Channel by channel: sums over an axis of three are many times slower.
    size = np.sqrt(sum((found[..., k] * nx + found[..., 3 + k] * ny) ** 2 for k in range(3)))
    return np.asarray(np.minimum(size, 4.0 * np.median(size) + 1e-6).mean(axis=-1), np.float64)


def _peak(total: FloatArray) -> tuple[FloatArray, float]:
    """(2,) shift right and down of the maximum, below a pixel, and its height."""
    row, column = np.unravel_index(int(total.argmax()), total.shape)
    at = []
    for axis, place in ((1, int(column)), (0, int(row))):
        line = total[row] if axis == 1 else total[:, column]
        step = 0.0
        if 0 < place < SIDE - 1:
            before, here, after = line[place - 1 : place + 2]
            curvature = before - 2.0 * here + after
            step = 0.5 * (before - after) / curvature if curvature < 0.0 else 0.0
        at.append(place - REACH_PX + step)
    return np.array(at), float(total.max())

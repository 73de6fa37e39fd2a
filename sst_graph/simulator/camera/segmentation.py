"""What imperfect segmentation networks would make of the exact labels."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sst_graph.simulator.lidar import Returns
from sst_graph.simulator.surfaces import FaceKind
from sst_graph.types import FloatArray

JITTER_PX = 0.8
"""Deviation of the boundaries at level 1 [px], correlated over CORRELATION_PX along the contour."""
CORRELATION_PX = 7.0
GROWTH_PX = (-1.0, 2.0)
"""At level 1 each object's mask is shrunk or dilated by an amount from this range [px]."""
MISSED = 0.05
"""Share of vehicles that a network misses at level 1 (for MISSED_FRAMES frames in a row)."""
MISSED_FRAMES = 6
FALSE_BLOBS = 0.4
"""Mean number of false vehicle areas in an image at level 1."""
WRONG_POINTS = 0.004
"""Share of points with any other label at level 1, beside those at borders."""
BORDER_POINTS = 0.12
"""Share of the points beside a border that take the label of the other side, at level 1."""

Labels = NDArray[np.uint8]
Numbers = NDArray[np.uint16]


def noisy_mask(
    kinds: Labels, instances: Numbers, level: float, seeds: tuple[int, int]
) -> tuple[Labels, Numbers]:
    """Kinds and instances (h, w) as a network would see them; ``seeds``: of the drive, of the frame."""
    if level == 0.0:
        return kinds, instances
    rng = np.random.default_rng([seeds[0], 31, seeds[1]])
    shift = _jitter(kinds.shape, level, rng)
    for number in np.unique(instances):
        if number:
            # A network that sees an object too large does so for a while.
            habit = np.random.default_rng([seeds[0], 32, int(number)]).uniform(*GROWTH_PX)
            growth = level * (0.7 * habit + 0.3 * rng.uniform(*GROWTH_PX))
            _grow(shift, instances == number, growth)
    h, w = kinds.shape
    rows = np.clip(np.rint(np.arange(h)[:, None] + shift[1]), 0, h - 1).astype(np.intp)
    columns = np.clip(np.rint(np.arange(w)[None, :] + shift[0]), 0, w - 1).astype(np.intp)
    kinds, instances = kinds[rows, columns], instances[rows, columns]
    _miss(kinds, instances, level, seeds, 33)
    for _ in range(rng.poisson(FALSE_BLOBS * level)):
        _false_blob(kinds, instances, rng)
    return kinds, instances


def _jitter(shape: tuple[int, ...], level: float, rng: np.random.Generator) -> FloatArray:
    """(2, h, w) smooth shift of the look-ups [px], along u and v."""
    field = rng.standard_normal((2, *shape), dtype=np.float32)
    smooth = np.stack([cv2.GaussianBlur(f, (0, 0), CORRELATION_PX / 2) for f in field])
    return np.asarray(smooth * (JITTER_PX * level / smooth.std()))


def _grow(shift: FloatArray, mask: NDArray[np.bool_], growth: float) -> None:
    """Adds to ``shift`` what dilates the object of ``mask`` by ``growth`` pixels (shrinks where negative)."""
    margin = int(abs(growth)) + 5
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    y0, y1 = max(rows[0] - margin, 0), rows[-1] + margin + 1
    x0, x1 = max(columns[0] - margin, 0), columns[-1] + margin + 1
    crop = mask[y0:y1, x0:x1].astype(np.uint8)
    if crop.all():  # it fills the picture, and has no border in it
        return
    outside = cv2.distanceTransform(1 - crop, cv2.DIST_L2, 5)
    distance = cv2.GaussianBlur(outside - cv2.distanceTransform(crop, cv2.DIST_L2, 5), (0, 0), 1.0)
    gradient: NDArray[Any] = np.stack(
        [cv2.Sobel(distance, cv2.CV_32F, 1, 0), cv2.Sobel(distance, cv2.CV_32F, 0, 1)]
    )
    gradient /= np.maximum(np.linalg.norm(gradient, axis=0), 1e-6)
    weight = np.clip(1.0 - (np.abs(distance) - abs(growth) - 1.0) / 2.0, 0.0, 1.0)
    shift[:, y0:y1, x0:x1] -= growth * weight * gradient


def _miss(kinds: Labels, instances: Numbers, level: float, seeds: tuple[int, int], salt: int) -> None:
    """Turns some vehicles into background, for a few frames in a row."""
    for number in np.unique(instances):
        fate = np.random.default_rng([seeds[0], salt, int(number), seeds[1] // MISSED_FRAMES])
        if number and fate.uniform() < MISSED * level:
            where = instances == number
            kinds[where] = FaceKind.BUILDING if fate.uniform() < 0.5 else FaceKind.VEGETATION
            instances[where] = 0


def _false_blob(kinds: Labels, instances: Numbers, rng: np.random.Generator) -> None:
    """Paints a vehicle that is not there, somewhere below the horizon's sky."""
    h, w = kinds.shape
    centre = (int(rng.integers(0, w)), int(rng.integers(h // 3, h)))
    size = (int(rng.uniform(0.008, 0.03) * w) + 1, int(rng.uniform(0.006, 0.016) * w) + 1)
    angles = np.linspace(0.0, 2 * np.pi, 14, endpoint=False)
    outline = (
        np.stack([np.cos(angles), np.sin(angles)], axis=1) * size * rng.uniform(0.7, 1.2, (14, 1)) + centre
    )
    blob = np.zeros((h, w), np.uint8)
    cv2.fillPoly(blob, [np.rint(outline).astype(np.int32).reshape(-1, 1, 2)], (1,))
    where = (blob > 0) & ~np.isin(kinds, (FaceKind.SKY, FaceKind.CAR, FaceKind.TRUCK))
    kinds[where] = FaceKind.CAR
    instances[where] = 0


def noisy_points(
    kinds: Labels, instances: Numbers, returns: Returns, level: float, seeds: tuple[int, int]
) -> tuple[Labels, Numbers]:
    """Kinds and instances (n,) of the returns as a network would see them."""
    if level == 0.0 or not len(kinds):
        return kinds, instances
    rng = np.random.default_rng([seeds[0], 41, seeds[1]])
    kinds, instances = kinds.copy(), instances.copy()
    _miss(kinds, instances, 0.6 * level, seeds, 42)
    # Points beside a border along their ring or across rings take the other side's label.
    shape = (int(returns.rings.max()) + 1, int(returns.columns.max()) + 1)
    grid = np.full(shape, -1, np.intp)
    grid[returns.rings, returns.columns] = np.arange(len(kinds))
    row_step, column_step = ((0, 0, 1, -1), (1, -1, 0, 0))
    way = rng.integers(0, 4, len(kinds))
    row = np.clip(returns.rings + np.array(row_step)[way], 0, shape[0] - 1)
    column = np.clip(returns.columns + np.array(column_step)[way], 0, shape[1] - 1)
    other = grid[row, column]
    swap = (other >= 0) & (rng.uniform(size=len(kinds)) < 2.0 * BORDER_POINTS * level)
    new_kinds = np.where(swap, kinds[other], kinds)
    new_instances = np.where(swap, instances[other], instances)
    wrong = rng.uniform(size=len(kinds)) < WRONG_POINTS * level
    new_kinds[wrong] = rng.choice(np.arange(int(FaceKind.SKY), dtype=np.uint8), int(wrong.sum()))
    new_instances[wrong] = 0
    return new_kinds, new_instances

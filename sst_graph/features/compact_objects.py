"""Compact objects of a scan, without labels: what stands on the ground, apart from its surroundings.

Neighbours in the scan's own order, along a ring and across rings, belong together where they are near each
other for their range (Bogoslavskyi and Stachniss, IROS 2016, cluster the range image in the same order).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from sst_graph.features.ground import heights_above_ground, on_ground
from sst_graph.features.lidar_beams import Beams, arrange_beams
from sst_graph.features.up import levelled, up_direction
from sst_graph.types import FloatArray, IntArray

_APART_M = 0.4
"""Neighbours along a ring at least this far apart are separate ..."""
_APART_STEPS = 6.0
"""... or this many steps between beams at their range, whichever is more."""
_APART_UP_STEPS = 2.5
"""Neighbours in adjacent rings are separate beyond this many steps between the rings."""
_RINGS_UP = 2
"""A missing return, or a window, does not cut an object: so many rings up are compared."""
_AHEAD = 2
"""And so many returns ahead along the ring."""
_MAX_HEIGHT_M = 4.5
"""Vehicles are lower; what is higher (crowns of trees, facades) is cut off there [m]."""
_MIN_POINTS = 6
"""Fewest points of an object."""


class ObjectShape(IntEnum):
    """What a group of points is, by its size."""

    GROUND = 0
    VEHICLE_LIKE = 1
    POLE_LIKE = 2
    REST = 3


@dataclass(frozen=True)
class CompactObjects:
    """Objects of a scan.

    Attributes:
        numbers: (n,) number of each point's object, from 1 without gaps; 0 for the ground and for what is too
            small.
        kinds: (k + 1,) of :class:`ObjectShape` of each object, by number; of 0: GROUND.
        heights_m: (n,) above ground [m].
    """

    numbers: IntArray
    kinds: NDArray[np.uint8]
    heights_m: FloatArray


def find_compact_objects(points: FloatArray, rings: NDArray[np.integer] | None) -> CompactObjects:
    """Ground removed, the rest split into objects, each classified by its size.

    Args:
        points: (n, 3) in the LiDAR frame [m].
        rings: (n,) laser of each point, or None.
    """
    n = len(points)
    if n == 0:
        return CompactObjects(np.zeros(0, np.intp), np.zeros(1, np.uint8), np.zeros(0))
    # 1. The ground.
    level = levelled(points, up_direction(points))
    heights = heights_above_ground(level)
    raised = ~on_ground(heights) & (heights < _MAX_HEIGHT_M)
    # 2. Neighbours that are near each other.
    a, b = _linked(points, raised, arrange_beams(points, rings))
    # 3. Connected points are one object.
    links = coo_array((np.ones(len(a), np.bool_), (a, b)), shape=(n, n)).tocsr()
    _, labels = connected_components(links, directed=False)
    labels = np.where(raised, labels + 1, 0)
    counts = np.bincount(labels)
    kept = counts >= _MIN_POINTS
    kept[0] = False
    numbers = np.where(kept, np.cumsum(kept), 0)[labels]
    return CompactObjects(numbers, _kinds(level, heights, numbers), heights)


def _linked(points: FloatArray, raised: NDArray[np.bool_], beams: Beams) -> tuple[IntArray, IntArray]:
    """Pairs of raised points, neighbours in the scan, that are near each other for their range."""
    pairs, columns = [], np.ascontiguousarray(points.T)
    order, some = beams.order, np.flatnonzero(raised[beams.order])
    along = order[some]
    for ahead in range(1, _AHEAD + 1):
        a, b = along[:-ahead], along[ahead:]
        limit = np.maximum(_APART_M, _APART_STEPS * beams.step * beams.rho[a])
        pairs.append(_near(columns, a, b, beams.ring[a] == beams.ring[b], limit))
    # Across rings: the next raised point of the ring above, from the same azimuth on.
    keys = beams.keys[some]
    for up in range(1, min(_RINGS_UP, len(beams.elevation) - 1) + 1):
        ring = beams.ring[along] + up
        a = along[ring < len(beams.elevation)]
        ring = beams.ring[a] + up
        place = np.searchsorted(keys, Beams.key(ring, beams.azimuth[a]))
        # Rings of some scanners come in close pairs, which tell nothing of the distance of others.
        usual = up * float(np.median(np.diff(beams.elevation)))
        gap = np.maximum(beams.elevation[ring] - beams.elevation[beams.ring[a]], usual)
        limit = np.maximum(_APART_M, _APART_UP_STEPS * gap * beams.rho[a])
        b = along[np.minimum(place, len(along) - 1)]
        pairs.append(_near(columns, a, b, beams.ring[b] == ring, limit))
    return np.concatenate([a for a, _ in pairs]), np.concatenate([b for _, b in pairs])


def _near(
    columns: FloatArray, a: IntArray, b: IntArray, same: NDArray[np.bool_], limit_m: FloatArray
) -> tuple[IntArray, IntArray]:
    """The pairs of points, columns (3, n), that are candidates and not farther apart than a limit each."""
    square = np.zeros(len(a))
    for column in columns:
        step = column[b] - column[a]
        square += step * step
    near = same & (square < limit_m * limit_m)
    return a[near], b[near]


_VEHICLE_LENGTH_M, _VEHICLE_WIDTH_M = 20.0, 5.0
"""Largest extents of a vehicle's points along and across them, seen from above [m]: trailers, with what
stands close beside."""
_VEHICLE_LEAST_M = 0.2
"""Least extent of a vehicle: of what is seen of it, partly hidden [m]."""
_POLE_WIDTH_M, _POLE_HEIGHT_M = 0.6, 1.2
"""Widest and lowest pole [m]."""


def _kinds(points: FloatArray, heights: FloatArray, numbers: IntArray) -> NDArray[np.uint8]:
    """(k + 1,) kind of each object by its extents."""
    some = np.flatnonzero(numbers)
    count = int(numbers.max(initial=0)) + 1
    kinds = np.full(count, ObjectShape.REST, np.uint8)
    kinds[0] = ObjectShape.GROUND
    if len(some) == 0:
        return kinds
    # Principal axes seen from above.
    own, xy = numbers[some], points[some, :2]
    total = np.maximum(np.bincount(own, minlength=count), 1)
    mean = np.stack([np.bincount(own, xy[:, k], count) / total for k in (0, 1)], axis=1)
    x, y = (xy - mean[own]).T
    xx, xy_, yy = (np.bincount(own, each, count) for each in (x * x, x * y, y * y))
    angle = 0.5 * np.arctan2(2.0 * xy_, xx - yy)
    c, s = np.cos(angle)[own], np.sin(angle)[own]
    order = np.argsort(own, kind="stable")
    starts = np.flatnonzero(np.diff(own[order], prepend=-1))
    length, width, height = (
        np.maximum.reduceat(each[order], starts) - np.minimum.reduceat(each[order], starts)
        for each in (c * x + s * y, c * y - s * x, heights[some])
    )
    top = np.maximum.reduceat(heights[some][order], starts)
    extent = np.maximum(length, height)
    vehicle = (length < _VEHICLE_LENGTH_M) & (width < _VEHICLE_WIDTH_M) & (extent > _VEHICLE_LEAST_M)
    vehicle &= top < _MAX_HEIGHT_M - 0.2
    pole = (length < _POLE_WIDTH_M) & (height > _POLE_HEIGHT_M)
    kinds[1:] = np.select(
        [pole, vehicle], [ObjectShape.POLE_LIKE, ObjectShape.VEHICLE_LIKE], ObjectShape.REST
    )
    return kinds

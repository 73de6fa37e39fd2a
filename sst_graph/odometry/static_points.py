"""Which points of movable classes lie on static objects: objects that are where they were a while ago."""

from __future__ import annotations

from collections import deque

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sst_graph.types import BoolArray, FloatArray

_MEMORY_S = 0.6
"""Age of the scan with which an object is compared [s]: at 1 m/s it has left its place by four times
``_MAX_DISTANCE_M``."""
_MAX_DISTANCE_M = 0.15
"""Farthest that points of a static object lie from those of the older scan [m]."""
_MIN_SHARE = 0.75
"""Part of an object's points that have to lie within it."""
_CELL_M = 0.4
"""Objects are separate where this much of the ground between them is empty [m]."""
_VOXEL_M = 0.15
"""Edge of the voxels of which one point is compared [m]."""


class StaticPoints:
    """Memory of the movable points of past scans, in the world: those that are still there are static."""

    def __init__(self) -> None:
        self._past: deque[tuple[int, FloatArray]] = deque()

    def find(self, wPs: FloatArray, stamp_ns: int) -> BoolArray:
        """(n,) whether points wPs (n, 3) of movable classes, in the world [m], belong to a static object.

        None does before the memory reaches back far enough.
        """
        before = [points for past_ns, points in self._past if stamp_ns - past_ns >= 0.95e9 * _MEMORY_S]
        if not before or len(before[-1]) == 0 or len(wPs) == 0:
            return np.zeros(len(wPs), np.bool_)
        return on_static_objects(wPs, before[-1])

    def insert(self, wPs: FloatArray, stamp_ns: int) -> None:
        """Keep the movable points wPs (n, 3) of a scan, and drop those that are too old to be needed."""
        self._past.append((stamp_ns, wPs[_voxel_representatives(wPs, _VOXEL_M)]))
        while len(self._past) > 2 and stamp_ns - self._past[1][0] >= 1e9 * _MEMORY_S:
            self._past.popleft()


def on_static_objects(
    wPs: FloatArray,
    others: FloatArray,
    max_distance_m: float = _MAX_DISTANCE_M,
    max_missing_m: float | None = None,
) -> BoolArray:
    """(n,) whether points wPs (n, 3) in the world [m] belong to an object that is where points of another
    time, ``others`` (m, 3), are.

    Args:
        max_distance_m: farthest that points of a static object lie from those of the other time; more where
            the poses are less certain [m].
        max_missing_m: longest part of a static object that is not there [m], or None for any: a tram drives
            along itself, and nearly all of it is where another part of it was.
    """
    if len(wPs) == 0 or len(others) == 0:
        return np.zeros(len(wPs), np.bool_)
    keys = _voxel_representatives(wPs, _VOXEL_M)
    labels = _objects(wPs, _CELL_M)
    tree = cKDTree(others, balanced_tree=False, compact_nodes=False)
    distance, _ = tree.query(wPs[keys], distance_upper_bound=max_distance_m)
    near = np.isfinite(distance).astype(np.float64)
    total = np.bincount(labels[keys], minlength=labels.max() + 1)
    share = np.bincount(labels[keys], near, labels.max() + 1) / np.maximum(total, 1)
    static = share >= _MIN_SHARE
    if max_missing_m is not None:
        static &= (1.0 - share) * _lengths(wPs, labels) <= max_missing_m
    return np.asarray(static[labels])


def _lengths(wPs: FloatArray, labels: NDArray[np.intp]) -> FloatArray:
    """Diagonal of each object's ground plan [m]; ``labels`` (n,) are those of its points."""
    spans = []
    for column in wPs[:, :2].T:
        low, high = (np.full(labels.max() + 1, sign * np.inf) for sign in (1.0, -1.0))
        np.minimum.at(low, labels, column)
        np.maximum.at(high, labels, column)
        spans.append(np.where(high >= low, high - low, 0.0))
    return np.hypot(*spans)


def _voxel_representatives(points: FloatArray, voxel_m: float) -> NDArray[np.intp]:
    """Index of one point of each occupied voxel."""
    if len(points) == 0:
        return np.zeros(0, np.intp)
    x, y, z = _cells(points, voxel_m)
    keys = (x * (y.max() + 1) + y) * (z.max() + 1) + z
    # Sorted together with their places: several times faster than sorting places by keys.
    ordered = np.sort(keys * len(keys) + np.arange(len(keys)))
    voxels = ordered // len(keys)
    first = np.flatnonzero(np.concatenate([[True], voxels[1:] != voxels[:-1]]))
    return np.asarray(ordered[first] - voxels[first] * len(keys), np.intp)


def _objects(points: FloatArray, cell_m: float) -> NDArray[np.intp]:
    """(n,) number of the connected patch of ground plan that each point stands on."""
    x, y = _cells(points[:, :2], cell_m)
    plan = np.zeros((x.max() + 1, y.max() + 1), np.uint8)
    plan[x, y] = 1
    _, numbers = cv2.connectedComponents(plan, connectivity=8)
    return np.asarray(numbers[x, y], np.intp)


def _cells(points: FloatArray, edge_m: float) -> list[NDArray[np.intp]]:
    """(n,) numbers of the cells of a grid that points (n, d) lie in, axis by axis, which is faster."""
    return [np.floor((column - column.min()) / edge_m).astype(np.intp) for column in points.T]

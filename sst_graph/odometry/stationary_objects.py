"""Which objects of movable classes stand still: those that are where they were a while ago."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sst_graph.config import Settings, setting

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True)
class MoverConfig(Settings):
    """When an object of a movable class counts as standing.

    Attributes:
        memory_s: age of the scan with which an object is compared [s].
        cell_m: objects are apart where this much of the ground between them is empty [m].
        voxel_m: edge of the voxels of which one point is compared [m].
        slack_m: farthest that points of a standing object lie from those of the older scan [m].
        share: part of an object's points that must lie within it.
    """

    memory_s: float = setting(0.6, at_least=0.0, at_most=30.0)
    cell_m: float = setting(0.4, at_least=0.1, at_most=10.0)
    voxel_m: float = setting(0.15, at_least=0.02, at_most=5.0)
    slack_m: float = setting(0.15, at_least=0.001, at_most=10.0)
    share: float = setting(0.75, at_least=0.0, at_most=1.0)


class StandingObjects:
    """Memory of the movable points of past scans, in the world."""

    def __init__(self, config: MoverConfig | None = None) -> None:
        self.config = config or MoverConfig()
        self._past: deque[tuple[int, FloatArray]] = deque()

    def still(self, wPs: FloatArray, stamp_ns: int) -> BoolArray:
        """(n,) whether points wPs (n, 3) of movable classes, in the world [m], belong to a standing object.

        Nothing counts as standing before the memory reaches back far enough.
        """
        config = self.config
        before = [points for past_ns, points in self._past if stamp_ns - past_ns >= 0.95e9 * config.memory_s]
        if not before or len(before[-1]) == 0 or len(wPs) == 0:
            return np.zeros(len(wPs), np.bool_)
        return standing(wPs, before[-1], config)

    def remember(self, wPs: FloatArray, stamp_ns: int) -> None:
        """Keep the movable points wPs (n, 3) of a scan, and forget what is too old to be asked for."""
        self._past.append((stamp_ns, wPs[_voxel_representatives(wPs, self.config.voxel_m)]))
        while len(self._past) > 2 and stamp_ns - self._past[1][0] >= 1e9 * self.config.memory_s:
            self._past.popleft()


def standing(wPs: FloatArray, others: FloatArray, config: MoverConfig) -> BoolArray:
    """(n,) whether points wPs (n, 3) in the world [m] belong to an object that is where points of another
    time, ``others`` (m, 3), are."""
    if len(wPs) == 0 or len(others) == 0:
        return np.zeros(len(wPs), np.bool_)
    keys = _voxel_representatives(wPs, config.voxel_m)
    labels = _objects(wPs, config.cell_m)
    tree = cKDTree(others, balanced_tree=False, compact_nodes=False)
    distance, _ = tree.query(wPs[keys], distance_upper_bound=config.slack_m)
    near = np.isfinite(distance).astype(np.float64)
    total = np.bincount(labels[keys], minlength=labels.max() + 1)
    share = np.bincount(labels[keys], near, labels.max() + 1) / np.maximum(total, 1)
    return np.asarray((share >= config.share)[labels])


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

"""The local map that scans are registered to."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import small_gicp
from numpy.typing import NDArray

MappedCloud = tuple[int, small_gicp.PointCloud, NDArray[np.float64]]
"""Number of a cloud, itself, and its (4, 4) pose in the map."""


class LocalMap:
    """Gaussian voxels of the latest clouds.

    It can only grow. So a cloud is put in when the next scan is looked for in the map: until then, the scan
    that it is of may be taken back.
    """

    rolls_back = False

    def __init__(self, voxel_m: float, age: int) -> None:
        """voxel_m: edge of the voxels [m]; age: clouds after which one not seen again is forgotten."""
        self._voxels = small_gicp.GaussianVoxelMap(voxel_m)
        self._voxels.set_lru(age, max(1, age // 2))
        self._next = 0

    def with_all(self, clouds: Iterable[MappedCloud]) -> small_gicp.GaussianVoxelMap:
        """The voxels, with those of the clouds, in the order of their numbers, that were not in them yet."""
        for number, cloud, wTl in clouds:
            if number >= self._next:
                self._voxels.insert(cloud, wTl)
                self._next = number + 1
        return self._voxels

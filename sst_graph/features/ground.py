"""Which points of a scan lie on the ground, without labels.

The ground is the lower envelope of the scan over a plan of cells: in each cell the lowest points, and nowhere
higher than a slope allows from the cells around. A roof over which no beam reaches the ground is so judged by
the road beside it. Sources: lower envelopes and slope limits are those of morphological ground filters (Zhang
et al., TGRS 2003).
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from sst_graph.types import FloatArray

_CELL_M = 2.0
"""Edge of the plan's cells [m]."""
_REACH_M = 80.0
"""Half width of the plan; points beyond count with its border's cells [m]."""
_STEEPEST = 0.12
"""Steepest ground relative to the plane that fits all of it, as a slope: ramps have less."""
_LOWEST_SHARE = 0.05
"""Share of a cell's points below its ground: returns by way of puddles and windows."""
_MIN_POINTS = 4
"""Fewest points of a cell that counts: with fewer, the lowest may be stray."""
_MARGIN_M = 0.2
"""Points are ground up to this height above it [m]: kerbs, and the spread of a road's returns."""
_PLANE_ROUNDS = 4
"""Fits of the plane to what lies near the last one."""
_PLANE_BAND_M = 0.5
"""What lies this near a plane takes part in the next fit [m]."""
_DEEPEST_M, _DEEPEST_SLOPE = 0.5, 0.05
"""Ground lies no deeper below the plane than this at the sensor, and this much more a metre away from it:
lower returns came by way of a mirror."""


def heights_above_ground(points: FloatArray) -> FloatArray:
    """(n,) height of points (n, 3), in axes with z up, above the ground below them [m]."""
    if len(points) == 0:
        return np.zeros(0)
    # 1. The plane that fits the lowest points of all cells.
    cells, size = _cells(points), int(2.0 * _REACH_M / _CELL_M)
    lowest = lowest_of_cells(points, cells)
    plane = fitted_plane(points[lowest])
    heights = points[:, 2] - points[:, :2] @ plane[:2] - plane[2]
    # 2. The lower envelope of the cells' lowest heights above it.
    rho = np.sqrt(points[lowest, 0] ** 2 + points[lowest, 1] ** 2)
    lowest = lowest[heights[lowest] > -(_DEEPEST_M + _DEEPEST_SLOPE * rho)]
    floor = np.full(size * size, 1e3, np.float32)
    floor[cells[lowest]] = heights[lowest]
    envelope = _slope_limited(floor.reshape(size, size))
    # A cell that shows no ground of its own has that of the lowest cell beside it.
    beside = cv2.erode(envelope, np.ones((3, 3), np.uint8)).reshape(-1)
    envelope = np.where(envelope.reshape(-1) < floor, beside, envelope.reshape(-1))
    return np.asarray(heights - envelope[cells])


def lowest_of_cells(points: FloatArray, cells: NDArray[np.intp] | None = None) -> NDArray[np.intp]:
    """Which points (n, 3) are the lowest of their cells, stray ones aside, where there are enough of them.

    Args:
        cells: (n,) number of each point's cell, where it is known.
    """
    if len(points) == 0:
        return np.zeros(0, np.intp)
    cells = _cells(points) if cells is None else cells
    # By cell, then by height: one key is sorted much faster than two.
    order = np.argsort(cells * (np.ptp(points[:, 2]) + 1.0) + points[:, 2])
    first = np.flatnonzero(np.diff(cells[order], prepend=-1))
    counts = np.diff(first, append=len(order))
    lowest = order[first + (_LOWEST_SHARE * counts).astype(np.intp)]
    enough = counts >= _MIN_POINTS
    return np.asarray(lowest[enough] if enough.any() else lowest)


def on_ground(heights_m: FloatArray) -> NDArray[np.bool_]:
    """(n,) whether points at these heights above ground belong to it."""
    return np.asarray(heights_m < _MARGIN_M)


def _cells(points: FloatArray) -> NDArray[np.intp]:
    """(n,) number of the plan's cell that each point lies in."""
    size = int(2.0 * _REACH_M / _CELL_M)
    columns, rows = (
        np.clip((points[:, k] + _REACH_M) / _CELL_M, 0, size - 1).astype(np.intp) for k in (0, 1)
    )
    return np.asarray(rows * size + columns)


def fitted_plane(lowest: FloatArray) -> FloatArray:
    """(3,) a, b, c of z = a x + b y + c through the ground among the lowest points (n, 3) of cells.

    The first plane is level, at the height below which a third of them lies: on a street most cells show the
    road, some only roofs.
    """
    plane = np.array([0.0, 0.0, np.quantile(lowest[:, 2], 1.0 / 3.0)])
    X = np.column_stack([lowest[:, :2], np.ones(len(lowest))])
    for _ in range(_PLANE_ROUNDS):
        near = np.abs(lowest[:, 2] - X @ plane) < _PLANE_BAND_M
        if np.count_nonzero(near) < 10:
            break
        A = X[near]
        ridge = np.diag([1.0, 1.0, 1e-6])
        plane = np.linalg.solve(A.T @ A + ridge, A.T @ lowest[near, 2])
    return plane


def _slope_limited(floor: NDArray[np.float32]) -> NDArray[np.float32]:
    """Highest field below ``floor`` (h, w) that nowhere rises by more than the steepest slope."""
    step = np.float32(_STEEPEST * _CELL_M)
    cross, square = np.ones((3, 3), np.uint8), np.ones((3, 3), np.uint8)
    cross[::2, ::2] = 0
    for _ in range(max(floor.shape)):
        # Along rows and columns by one cell, along diagonals by its root of two.
        lower = np.minimum(cv2.erode(floor, cross) + step, cv2.erode(floor, square) + step * np.sqrt(2.0))
        lower = np.minimum(floor, lower).astype(np.float32)
        if np.array_equal(lower, floor):
            break
        floor = lower
    return floor

"""Laser numbers of clouds that are stored firing after firing, each from its upper to its lower beam or back.

Elevations alone do not show the laser: where points were moved to one instant, those of a ring are smeared by
as much as rings are apart, and by more behind the vehicle than ahead. But the beams of a firing, a column,
come in their order, and only returns are missing. So each column is aligned with a table of elevations:
numbers rise within it, and the sum of squared differences is least (dynamic programming, many columns at
once). The table is that of columns with all beams, and follows from there what neighbouring columns show.
"""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from sst_graph.types import FloatArray, IntArray

MAX_RINGS = 256
"""Most lasers of a LiDAR."""
_BACK_RAD = np.radians(1.5)
"""A column begins where the elevation goes back by more: neighbours that are out of order by less are a near
and a far return, from where the LiDAR was and where it is said to be."""
_FEWEST_COLUMNS, _FEWEST_POINTS = 16, 4.0
"""Fewest columns, and the least mean number of points in one."""
_MIN_TURNING = 0.9
"""Least share of the steps from column to column that turn the same way."""
_LONGEST_SHARE = 0.005
"""Share of the columns that have all beams, at least: the few longer ones were not told apart."""
_BLOCK = 10
"""Columns in a row that share a table: at 17 m/s it moves by a ring in 40 of 1800."""
_FEWEST_OF_RING = 2
"""Fewest points of a ring in a block that move its elevation."""
_MIN_ALIGNED = 0.9
"""Least share of the points within half the distance of two rings from their own."""


def rings_from_columns(points: NDArray[np.float32]) -> NDArray[np.uint16] | None:
    """Ring number (n,) of points (n, 3) [m] stored column after column, or None where they are not."""
    if len(points) < _FEWEST_COLUMNS * _FEWEST_POINTS:
        return None
    x, y, z = points.T.astype(np.float64)
    down = -np.arctan2(z, np.hypot(x, y))
    if np.median(np.diff(down)) < 0.0:
        down = -down
    # 1. Columns, and whether they turn.
    starts = np.concatenate([[0], np.flatnonzero(np.diff(down) < -_BACK_RAD) + 1])
    counts = np.diff(starts, append=len(points))
    if len(starts) < _FEWEST_COLUMNS or counts.mean() < _FEWEST_POINTS:
        return None
    longest = int(np.sort(counts)[-1 - int(_LONGEST_SHARE * len(counts))])
    if longest > MAX_RINGS or not _turns(np.arctan2(y, x)[starts]):
        return None
    # 2. The block with most columns that have all beams, and from there to both sides.
    angles = down[np.minimum(np.arange(longest), counts[:, None] - 1) + starts[:, None]]
    used, whole = np.minimum(counts, longest), counts == longest
    blocks = [np.arange(a, min(a + _BLOCK, len(starts))) for a in range(0, len(starts), _BLOCK)]
    best = int(np.argmax([np.count_nonzero(whole[block]) for block in blocks]))
    middle = np.median(angles[blocks[best]][whole[blocks[best]]], axis=0)
    rings, aligned = np.zeros(angles.shape, np.intp), 0
    tables = [middle, middle]
    for both in itertools.zip_longest(blocks[best:], blocks[:best][::-1]):
        ways = [(way, block) for way, block in enumerate(both) if block is not None]
        some = np.concatenate([block for _, block in ways])
        of_each = np.concatenate([np.tile(tables[way], (len(block), 1)) for way, block in ways])
        rings[some] = _aligned(angles[some], used[some], of_each)
        for way, block in ways:
            tables[way], fit = _followed(angles[block], used[block], rings[block], tables[way])
            aligned += fit
    # 3. Whether they fit; points of a longer column than any is have its last number.
    if aligned < _MIN_ALIGNED * len(points):
        return None
    of_column = np.repeat(np.arange(len(starts)), counts)
    place = np.minimum(np.arange(len(points)) - starts[of_column], longest - 1)
    return np.asarray(rings[of_column, place], np.uint16)


def _turns(azimuths: FloatArray) -> bool:
    """Whether the columns' azimuths [rad] go round one way."""
    steps = np.angle(np.exp(1j * np.diff(azimuths)))
    return max(float(np.mean(steps > 0.0)), float(np.mean(steps < 0.0))) >= _MIN_TURNING


def _aligned(down: FloatArray, counts: IntArray, tables: FloatArray) -> IntArray:
    """(c, r) rising ring numbers of the points of each column; of a column's first ``counts`` ones.

    Args:
        down: (c, r) angles of the points [rad], rising but for their errors.
        tables: (c, r) angles of the rings of each column [rad].
    """
    size, numbers = down.shape[1], np.arange(down.shape[1])
    came_from = np.zeros((size, *down.shape), np.uint8)
    sums, last = (down[:, :1] - tables) ** 2, np.zeros(down.shape)
    for j in range(size):
        if j:
            least = np.minimum.accumulate(sums, axis=1)
            at = np.maximum.accumulate(np.where(sums <= least, numbers, 0), axis=1)
            came_from[j, :, 1:] = at[:, :-1]
            sums = (down[:, j : j + 1] - tables) ** 2
            sums[:, 1:] += least[:, :-1]
            sums[:, 0] = np.inf
        ends = counts == j + 1
        last[ends] = sums[ends]
    found, here = np.zeros(down.shape, np.intp), last.argmin(axis=1)
    for j in range(size - 1, -1, -1):
        within = np.flatnonzero(j < counts)
        found[within, j] = here[within]
        here[within] = came_from[j, within, here[within]]
    return found


def _followed(
    down: FloatArray, counts: IntArray, rings: IntArray, table: FloatArray
) -> tuple[FloatArray, int]:
    """The table (r,) [rad] moved to what some columns show, and how many of their points fit that."""
    used = np.arange(down.shape[1]) < counts[:, None]
    own, off = rings[used], (down - table[rings])[used]
    half = 0.5 * float(np.median(np.diff(table)))
    number = np.bincount(own, minlength=len(table))
    known = np.flatnonzero(number >= _FEWEST_OF_RING)
    if not len(known):
        return table, 0
    step = np.bincount(own, np.clip(off, -half, half), len(table))[known] / number[known]
    moved = table + np.interp(np.arange(len(table)), known, step)
    return moved, int(np.count_nonzero(np.abs(down[used] - moved[own]) < half))

"""What the order of the points in a spinning scanner's file shows: laser numbers."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sst_graph.data.scan_columns import MAX_RINGS, rings_from_columns

MIN_POINTS_PER_RING = 8
"""Mean number of points in a ring below which rings are not accepted."""

MIN_EXPLAINED = 0.9
"""Share of the variance of the elevation that rings must explain to be accepted."""

_TURN_RAD = 2.0 * np.pi
_SEAMS_RAD = (0.0, np.pi, 0.5 * np.pi, -0.5 * np.pi)
_BACK_STEP_RAD = np.deg2rad(10.0)
"""Steps back by less than this are jitter of the firing order, not a new turn."""


def rings_from_order(points: NDArray[np.float32]) -> NDArray[np.uint16] | None:
    """Ring number (n,) of points (n, 3) [m] stored beam after beam, or None where they are not.

    A beam's points turn monotonically; the next beam starts where the last one did. Turning is
    summed modulo a full turn (so a gap of a cropped cloud is a step ahead, a start over likewise),
    and a ring ends wherever the sum passes the seam. The seam lies ahead (KITTI), behind or
    abeam; the one whose rings explain the elevation best is taken. None where rings do not explain
    it, nor those of columns (:mod:`sst_graph.data.scan_columns`): a cloud in another order, or one that was
    shuffled or thinned too far.

    Rings are counted from the first that has points: lasers without any return are not counted.
    """
    if len(points) < MIN_POINTS_PER_RING:
        return None
    x, y = points[:, 0], points[:, 1]
    azimuth = np.arctan2(y, x)
    elevation = np.arctan2(points[:, 2], np.hypot(x, y)).astype(np.float64)
    steps = np.diff(azimuth)
    # Points that are there twice (two returns) have no sense of rotation.
    if np.count_nonzero(steps < 0.0) > np.count_nonzero(steps > 0.0):
        azimuth, steps = -azimuth, -steps
    turned = np.cumsum(_modulo_turn(steps.astype(np.float64)))
    turned = np.maximum.accumulate(np.concatenate([[0.0], turned]))
    best, best_explained = None, MIN_EXPLAINED
    for seam in _SEAMS_RAD:
        start = _modulo_turn(np.float64(azimuth[0]) - seam)
        # The sum never falls: a ring ends where it reaches the next whole turn.
        turns = np.arange(1, int((turned[-1] + start) // _TURN_RAD) + 1)
        borders = np.searchsorted(turned + start, turns * _TURN_RAD)
        counts = np.diff(borders, prepend=0, append=len(points))
        explained = _explained(elevation, counts)
        if explained > best_explained:
            best, best_explained = counts, explained
    if best is None:
        return rings_from_columns(points)
    return np.repeat(np.arange(len(best), dtype=np.uint16), best)


def _modulo_turn(angle: Any) -> Any:
    """Angles [rad] modulo a full turn, but small steps back stay negative."""
    return np.mod(angle + _BACK_STEP_RAD, _TURN_RAD) - _BACK_STEP_RAD


def _explained(elevation: NDArray[np.float64], counts: NDArray[np.intp]) -> float:
    """Share of the elevation's variance that lies between rings, one after the other, of so many points each;
    0 where there is no ring structure."""
    if not 2 <= len(counts) <= min(MAX_RINGS, len(elevation) // MIN_POINTS_PER_RING):
        return 0.0
    rings = np.repeat(np.arange(len(counts)), counts)
    means = np.bincount(rings, elevation, len(counts)) / np.maximum(counts, 1)
    total = float(np.var(elevation))
    return 1.0 - float(np.mean((elevation - means[rings]) ** 2)) / total if total > 0.0 else 0.0

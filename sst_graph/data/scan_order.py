"""What the order of the points in a spinning scanner's file tells: laser numbers and times."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

MAX_RINGS = 256
MIN_EXPLAINED = 0.9
"""Share of the variance of the elevation that rings must explain to be believed."""

_BACK_STEP_RAD = np.deg2rad(10.0)
"""Steps back by less than this are jitter of the firing order, not a new turn."""


def rings_from_order(points: NDArray[np.float32]) -> NDArray[np.uint16] | None:
    """Laser number (n,) of points (n, 3) [m] stored beam after beam, or None where they are not.

    A beam's points turn monotonically; the next beam starts where the last one did. Turning is
    summed modulo a full turn (so a gap of a cropped cloud is a step ahead, a start over likewise),
    and a ring ends wherever the sum passes the seam. The seam lies ahead (KITTI) or behind;
    the one whose rings explain the elevation better is taken. None where rings do not explain it: a
    cloud in another order, or one that was shuffled or filtered too far.
    """
    if len(points) < 2:
        return None
    x, y, z = (points[:, k].astype(np.float64) for k in range(3))
    azimuth = np.arctan2(y, x)
    elevation = np.arctan2(z, np.hypot(x, y))
    if np.median(np.diff(azimuth)) < 0.0:
        azimuth = -azimuth
    candidates = [_rings_at_seam(azimuth, seam) for seam in (0.0, np.pi)]
    explained = [_explained(elevation, rings) for rings in candidates]
    best = int(explained[1] > explained[0])
    if explained[best] < MIN_EXPLAINED:
        return None
    return candidates[best].astype(np.uint16)


def sweep_offsets_s(points: NDArray[np.float32], period_s: float) -> NDArray[np.float32]:
    """Time (n,) [s] of each point relative to the stamp, for an uncompensated sweep (KITTI's).

    The scanner turns clockwise seen from above and is stamped when it faces forward (+x):
    offset = -azimuth / (2 pi) * period, from +period/2 behind on the left ... to the right.

    Args:
        points: (n, 3) LiDAR frame [m].
        period_s: duration of one turn [s].
    """
    azimuth = np.arctan2(points[:, 1].astype(np.float64), points[:, 0].astype(np.float64))
    return (azimuth * (-period_s / (2.0 * np.pi))).astype(np.float32)


def _rings_at_seam(azimuth: NDArray[np.float64], seam: float) -> NDArray[np.int64]:
    """(n,) number of passes over the seam before each point, for rising azimuths (n,) [rad]."""
    turn = 2.0 * np.pi
    steps = np.mod(np.diff(azimuth) + _BACK_STEP_RAD, turn) - _BACK_STEP_RAD
    start = np.mod(azimuth[0] - seam + _BACK_STEP_RAD, turn) - _BACK_STEP_RAD
    phase = np.maximum.accumulate(np.concatenate([[start], start + np.cumsum(steps)]))
    return np.maximum(np.floor(phase / turn), 0.0).astype(np.int64)


def _explained(elevation: NDArray[np.float64], rings: NDArray[np.int64]) -> float:
    """Share of the elevation's variance that lies between rings; 0 where there is no ring structure."""
    if not 2 <= rings[-1] + 1 <= MAX_RINGS:
        return 0.0
    counts = np.maximum(np.bincount(rings), 1)
    means = np.bincount(rings, elevation) / counts
    total = float(np.var(elevation))
    return 1.0 - float(np.mean((elevation - means[rings]) ** 2)) / total if total > 0.0 else 0.0

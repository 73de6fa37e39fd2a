"""Share of the boundary points that are close to their contour, and what a perfect calibration would give.

A wrong calibration moves the outlines of all objects in a stretch of time alike: to first order it turns
them. So the error of the labels alone is what remains after each stretch was turned by three angles of its
own that fit it best. That also takes out errors that change with time, such as a mount that moved or a wrong
time offset. What is left includes the labels' own scatter and is too small by the three angles that were
fitted; residuals are enlarged for that, by how many of them are independent.
"""

from __future__ import annotations

import numpy as np

from sst_graph.factors.robust import RobustKernel
from sst_graph.fit import CLOSE_PX
from sst_graph.types import FloatArray, IntArray

SIDES_OF_STRETCH = 24
"""Fewest sides of objects that a stretch has, counted in each frame: eight for each angle that is fitted."""
_LEAST_INDEPENDENT = 6.0
"""Fewest independent residuals from which a stretch is turned: of fewer, as of one vehicle in all frames,
three angles leave nothing that tells how the labels err. Those count as they are."""
_KERNELS_PX = (7.0, 7.0, 5.0, 5.0, 3.0, 3.0)
"""Scales of the robust kernel, iteration by iteration [px]."""
_GATE_PX = 9.0
"""Residuals that count for the correlation within sides [px]: three times the last kernel."""
_RIDGE = 1e-9
"""Added to the diagonal, as a share of it: a stretch with one kind of edge does not determine all angles."""


def close_share(residuals_px: FloatArray) -> float:
    """Share of residuals (n,) below :data:`~sst_graph.fit.CLOSE_PX`; 0 of none."""
    return float(np.mean(np.abs(residuals_px) < CLOSE_PX)) if len(residuals_px) else 0.0


def attainable_share(
    residuals_px: FloatArray, by_rotation: FloatArray, frames: IntArray, sides: IntArray
) -> float:
    """:func:`close_share` under a perfect calibration with labels like these.

    Args:
        residuals_px: (n,) under some calibration, not more than half a degree off [px].
        by_rotation: (n, 3) their derivatives by the rotation [px/rad].
        frames: (n,) number of the frame of each, in the order of time, drive by drive.
        sides: (n,) number of the object's side of each.
    """
    left = np.array(residuals_px)
    for stretch, count in _stretches(frames, sides):
        r, J = residuals_px[stretch], by_rotation[stretch]
        if count > 3:
            turned = r + J @ _best_turn(r, J)
            independent = _independent(turned, sides[stretch])
            if independent >= _LEAST_INDEPENDENT:
                left[stretch] = np.sqrt(independent / (independent - 3.0)) * turned
    return close_share(left)


def _independent(r: FloatArray, sides: IntArray) -> float:
    """How many independent residuals the residuals (n,) are worth, whose sides err as a whole, too.

    n / (1 + (m - 1) c) with m points a side and c the correlation within sides, by the variances of the
    sides' means and about them (Kish's design effect); residuals beyond the gate of the last kernel are left
    out.
    """
    fewest = float(len(np.unique(sides)))
    near = np.abs(r) < _GATE_PX
    _, number, counts = np.unique(sides[near], return_inverse=True, return_counts=True)
    if len(counts) == 0:
        return fewest
    means = np.bincount(number.reshape(-1), r[near]) / counts
    within = float(np.mean((r[near] - means[number.reshape(-1)]) ** 2))
    m = len(number) / len(counts)
    between = max(0.0, float(np.mean(means**2)) - within / m)
    correlation = between / max(between + within, 1e-12)
    return max(fewest, len(number) / (1.0 + (m - 1.0) * correlation))


def _best_turn(r: FloatArray, J: FloatArray) -> FloatArray:
    """(3,) rotation that robustly minimises r + J x [rad]."""
    x: FloatArray = np.zeros(3)
    for scale in _KERNELS_PX:
        w = RobustKernel("geman_mcclure", scale).weight(r + J @ x)
        H = J.T @ (w[:, None] * J)
        H += _RIDGE * np.trace(H) * np.eye(3)
        x = np.asarray(np.linalg.solve(H, -J.T @ (w * r)))
    return x


def _stretches(frames: IntArray, sides: IntArray) -> list[tuple[IntArray, int]]:
    """Positions of the points of each stretch, and its number of sides."""
    order = np.argsort(frames, kind="stable")
    of_frames = np.split(order, np.flatnonzero(np.diff(frames[order])) + 1)
    found: list[tuple[list[IntArray], int]] = []
    points: list[IntArray] = []
    count = 0
    for own in of_frames:
        points.append(own)
        count += len(np.unique(sides[own]))
        if count >= SIDES_OF_STRETCH:
            found.append((points, count))
            points, count = [], 0
    if points and found:  # what remains belongs to the last stretch
        found[-1] = (found[-1][0] + points, found[-1][1] + count)
    elif points:
        found.append((points, count))
    return [(np.concatenate(parts), sides_seen) for parts, sides_seen in found]

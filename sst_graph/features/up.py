"""Which way is up in a scan, for LiDARs that are mounted aslant or upside down.

The ground is the plane that most of the lowest points of a plan's cells lie on. Sensors are taken for level
unless another plane is clearly the ground.
"""

from __future__ import annotations

import numpy as np

from sst_graph.features.ground import fitted_plane, lowest_of_cells
from sst_graph.types import FloatArray

LEVEL = np.array([0.0, 0.0, 1.0])
"""Up where the sensor is level."""
_MOST_POINTS = 8_000
"""Points that are looked at, about."""
_BAND_M = 0.3
"""Lowest points of cells this near to a plane lie on it [m]."""
_SURELY = 0.5
"""Where more of the cells than this share lie on a level plane, no other plane is tried."""
_CLEARLY = 1.5
"""Another plane is the ground where so many times as many cells lie on it as on the level one: a garage's
ceiling has about as many as its floor."""
_LEVEL_TILT, _MOST_TILT = np.cos(np.radians(10.0)), np.cos(np.radians(60.0))
"""Ground is level up to 10 deg, which slopes have, too; planes more than 60 deg from the axis are walls."""
_BENEATH_M, _FEW_BENEATH = 1.0, 0.02
"""At most so few points lie farther than this below the ground: returns by way of puddles and windows."""
_TRIALS = 100
"""Planes through three cells that are tried: with a third of the cells on it, one of them is the ground's."""


def up_direction(points: FloatArray) -> FloatArray:
    """(3,) unit vector away from the ground, in the frame of the points (n, 3) [m]; the z axis where the
    ground is level in it, or cannot be found."""
    some = points[:: 1 + len(points) // _MOST_POINTS]
    upright = some[lowest_of_cells(some)]
    if len(upright) < 3:
        return LEVEL
    # 1. A level plane that most cells lie on.
    normal, distance = _normal(fitted_plane(upright))
    below = normal[2] > _LEVEL_TILT and distance < 0.0
    share = float((np.abs(upright @ normal - distance) < _BAND_M).mean()) if below else 0.0
    if share > _SURELY:
        return LEVEL
    # 2. Any other plane, below the sensor or, upside down, above it.
    best = LEVEL
    turned = some * [1.0, -1.0, -1.0]
    for sign, candidates in ((1.0, upright), (-1.0, some[lowest_of_cells(turned)])):
        found = _ground(candidates, some, sign)
        if found is not None and found[1] > _CLEARLY * share:
            best, share = found[0], found[1] / _CLEARLY
    return best


def _normal(plane: FloatArray) -> tuple[FloatArray, float]:
    """Upward unit normal of z = a x + b y + c, and the plane's distance along it from the origin [m]."""
    normal = np.array([-plane[0], -plane[1], 1.0])
    length = float(np.linalg.norm(normal))
    return normal / length, float(plane[2]) / length


def _ground(cells: FloatArray, points: FloatArray, sign: float) -> tuple[FloatArray, float] | None:
    """The plane with hardly a point beneath that most cells' lowest points (k, 3) lie on: its normal, away
    from the ground, and the share of the cells; None where all planes have points beneath."""
    if len(cells) < 3:
        return None
    triples = cells[np.random.default_rng(0).integers(0, len(cells), (_TRIALS, 3))]
    normals = np.cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    normals *= (sign * np.sign(normals[:, 2]) / np.maximum(lengths, 1e-9))[:, None]
    distances = np.einsum("ij,ij->i", normals, triples[:, 0])
    on = np.abs(cells @ normals.T - distances) < _BAND_M
    usable = (sign * normals[:, 2] > _MOST_TILT) & (distances < 0.0)
    for k in np.argsort(-on.mean(axis=0) * usable, kind="stable"):
        if not usable[k]:
            return None
        if (points @ normals[k] < distances[k] - _BENEATH_M).mean() < _FEW_BENEATH:
            break
    else:
        return None
    # Least squares of the cells on it.
    centre = cells[on[:, k]].mean(axis=0)
    normal = np.linalg.svd(cells[on[:, k]] - centre, full_matrices=False)[2][2]
    normal *= np.sign(normal @ normals[k])
    share = float((np.abs((cells - centre) @ normal) < _BAND_M).mean())
    return normal, share


def levelled(points: FloatArray, up: FloatArray) -> FloatArray:
    """Points (n, 3) turned by the least rotation that brings ``up`` to the z axis, where it points down after
    half a turn about the x axis; the same array where ``up`` is the z axis."""
    if up is LEVEL:
        return points
    if up[2] < 0.0:
        flip = np.array([1.0, -1.0, -1.0])
        points, up = points * flip, up * flip
    axis = np.cross(up, LEVEL)
    skew = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    turn = np.eye(3) + skew + skew @ skew / (1.0 + float(up[2]))
    return np.asarray(points @ turn.T)

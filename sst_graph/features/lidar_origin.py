"""Where the LiDAR is in the axes of its cloud, by the rings of its points.

The lasers of a spinning scanner each keep one elevation about its axis. Seen from there the points of a scan
lie in narrow strips of elevation; seen from anywhere else the strips run into one another. So the origin is
where they stand out most, whatever the order of the points, and without laser numbers.
"""

from __future__ import annotations

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from sst_graph.features.lidar_beams import PARTS_OF_RINGS, clearness
from sst_graph.types import FloatArray

MOST_POINTS = 8_000
"""Points of a scan that are looked at, about."""
_NEAREST_M = 2.0
"""Points nearer to the axis are left out: the lasers sit some centimetres beside it."""
_PLACES = np.array([[x, 0.0, z, 0.0, 0.0] for x in (-1.0, 0.0, 1.0, 2.0) for z in (-1.0, 0.0, 0.7, 1.4, 2.1)])
"""(n, 5) axes that are tried first [m], [rad]: a vehicle's begin at an axle, on the ground, at its front."""
_HEIGHTS_M = np.linspace(-0.3, 0.4, 8)
"""Heights of the lasers over the origin of a LiDAR: 0.2 of an HDL-64E."""
_BEST_PLACES = 6
_SIDES = np.array([0.5, 0.5, 0.5, 0.03, 0.03])
"""Sides of the first simplex [m], [rad]."""
_STAGES = ((100, 1.0), (200, 0.25), (PARTS_OF_RINGS, 0.1))
"""Parts that are compared with strips, and the size of the simplex: coarse parts have a wide optimum."""
_EVALUATIONS = 150
"""Of each stage."""


def some_points(points: NDArray[np.float32]) -> NDArray[np.float32]:
    """About :data:`MOST_POINTS` of the points (n, 3), evenly in their order."""
    return points[:: 1 + len(points) // MOST_POINTS]


def own_clearness(points: FloatArray) -> float:
    """How clearly rings stand out of points (n, 3) [m] from their own origin, or a little above it."""
    return max(clearness_from(points, np.array([0.0, 0.0, z, 0.0, 0.0])) for z in _HEIGHTS_M)


def clearness_from(points: FloatArray, axes: FloatArray, parts: int = PARTS_OF_RINGS) -> float:
    """How clearly rings stand out of points (n, 3) [m] seen from some axes; 0 of too few points.

    Args:
        axes: (5,) their origin [m], and their turn about x and y [rad].
    """
    up = gtsam.Rot3.RzRyRx(float(axes[3]), float(axes[4]), 0.0).matrix()[:, 2]
    away = points - axes[:3]
    height = away @ up
    rho = np.linalg.norm(away - height[:, None] * up, axis=1)
    far = rho > _NEAREST_M
    return clearness(height[far] / rho[far], parts) if np.count_nonzero(far) >= PARTS_OF_RINGS else 0.0


def lidar_origin(points: FloatArray) -> gtsam.Pose3:
    """T_cloud_lidar where rings stand out most, of points (n, 3) [m] in axes whose z points up within some
    degrees. The turn about the LiDAR's own axis is not known, and 0."""
    parts, size = _STAGES[0]
    places = sorted(_PLACES, key=lambda axes: -clearness_from(points, axes, parts))[:_BEST_PLACES]
    axes = max((_climbed(points, place, parts, size) for place in places), key=lambda found: found[1])[0]
    for parts, size in _STAGES[1:]:
        axes = _climbed(points, axes, parts, size)[0]
    return gtsam.Pose3(gtsam.Rot3.RzRyRx(float(axes[3]), float(axes[4]), 0.0), axes[:3])


def _climbed(points: FloatArray, begin: FloatArray, parts: int, size: float) -> tuple[FloatArray, float]:
    """Axes near others, from which rings stand out more, and how clearly."""
    simplex = np.vstack([begin, begin + np.diag(size * _SIDES)])
    found = minimize(
        lambda axes: -clearness_from(points, axes, parts),
        begin,
        method="Nelder-Mead",
        options={"initial_simplex": simplex, "maxfev": _EVALUATIONS, "xatol": 5e-3, "fatol": 1e-4},
    )
    return np.asarray(found.x), -float(found.fun)

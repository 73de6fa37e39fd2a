"""The LiDAR's beams have the elevations that its intrinsic calibration says."""

from __future__ import annotations

import numpy as np

from sst_graph.assumptions.model import Assumption, Effect, View


def _elevation(view: View) -> Effect:
    """Every point rises by 1 rad along the circle of its azimuth: range * d(ray)/d(elevation)."""
    x, y, z = view.lPs.T
    across = np.maximum(np.hypot(x, y), 1e-9)
    return Effect(l_shift=np.stack([-x * z / across, -y * z / across, across], axis=1))


ELEVATION = Assumption(
    name="elevation",
    unit="rad",
    effect=_elevation,
    sigma=5e-4,
    source="a judgement, 0.03 deg; KISS-ICP corrects 0.2 deg in KITTI's HDL-64E",
    span=0.01,
    of_lidar=True,
    violation="the LiDAR's beams are higher or lower than they should be (by how much they should be higher)",
    remedy="check the LiDAR's intrinsic calibration",
    prevalence=0.05,
)

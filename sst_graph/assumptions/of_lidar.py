"""The LiDAR measures as its calibration says: ranges without bias or scale, beams at their elevations."""

from __future__ import annotations

import numpy as np

from sst_graph.assumptions.model import Assumption, Effect, View


def _bias(view: View) -> Effect:
    """Every point moves away by 1 m along its ray."""
    ranges = np.linalg.norm(view.lPs, axis=1, keepdims=True)
    return Effect(l_shift=view.lPs / np.maximum(ranges, 1e-9))


def _scale(view: View) -> Effect:
    """Every range grows by its own length, and with it all motion that is measured by ranges."""
    return Effect(l_shift=view.lPs, twist_shift=view.l_twist * np.repeat([0.0, 1.0], 3))


RANGE_BIAS = Assumption(
    name="range_bias",
    unit="m",
    effect=_bias,
    sigma=0.01,
    source="data sheets: accuracy of 2 cm at two sigma (HDL-64E)",
    span=0.5,
    of_lidar=True,
    violation="the LiDAR's ranges are off by a constant (by how much they should be longer)",
    remedy="check the LiDAR's intrinsic calibration and the driver's range correction",
)
RANGE_SCALE = Assumption(
    name="range_scale",
    unit="",
    effect=_scale,
    sigma=5e-4,
    source="data sheets: 2 cm at 40 m",
    span=0.1,
    of_lidar=True,
    violation="the LiDAR's ranges are off by a scale (share by which they should be longer)",
    remedy="check the unit of the clouds and the LiDAR's range resolution",
)


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

"""The LiDAR's ranges have neither a bias nor a scale."""

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

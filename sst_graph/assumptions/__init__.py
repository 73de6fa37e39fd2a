"""What a calibration takes for granted: tested against the data, considered in the covariance, or estimated.

One more assumption is one more small file here, and its name in :data:`ASSUMPTIONS`.
"""

from sst_graph.assumptions.clocks import LINE_DELAY, SKEW
from sst_graph.assumptions.distortion import K1, K2
from sst_graph.assumptions.focal_length import FOCAL
from sst_graph.assumptions.lidar_range import RANGE_BIAS, RANGE_SCALE
from sst_graph.assumptions.model import Assumption, Effect, View, combined
from sst_graph.assumptions.principal_point import CX, CY
from sst_graph.assumptions.sweep import SWEEP

ASSUMPTIONS: dict[str, Assumption] = {
    assumption.name: assumption
    for assumption in (FOCAL, CX, CY, K1, K2, SWEEP, SKEW, LINE_DELAY, RANGE_BIAS, RANGE_SCALE)
}
"""All assumptions by name, in the order in which they are shown."""

__all__ = ["ASSUMPTIONS", "Assumption", "Effect", "View", "combined"]

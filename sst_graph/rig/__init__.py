"""Several cameras on one LiDAR."""

from sst_graph.rig.calibrate import calibrate_rig
from sst_graph.rig.known import KnownPose, KnownRig
from sst_graph.rig.marginal import RelativePose, RigMarginal
from sst_graph.rig.result import RigResult, read_rig

__all__ = ["KnownPose", "KnownRig", "RelativePose", "RigMarginal", "RigResult", "calibrate_rig", "read_rig"]

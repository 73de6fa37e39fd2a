"""Motion of each sensor by itself: LiDAR odometry, visual odometry, standing frames."""

from __future__ import annotations

from sst_graph.odometry.lidar import LidarOdometry, LidarOdometryConfig, lidar_odometry
from sst_graph.odometry.registration import (
    LoopClosure,
    LoopConfig,
    RegisteredScan,
    RegistrationConfig,
    loop_closures,
    scan_to_scan,
)
from sst_graph.odometry.standing import StandingConfig, standing_frames
from sst_graph.odometry.visual import (
    ImagePair,
    VisualOdometry,
    VisualOdometryConfig,
    image_pairs,
    metric_motions,
    visual_odometry,
)

__all__ = [
    "ImagePair",
    "LidarOdometry",
    "LidarOdometryConfig",
    "LoopClosure",
    "LoopConfig",
    "RegisteredScan",
    "RegistrationConfig",
    "StandingConfig",
    "VisualOdometry",
    "VisualOdometryConfig",
    "image_pairs",
    "lidar_odometry",
    "loop_closures",
    "metric_motions",
    "scan_to_scan",
    "standing_frames",
    "visual_odometry",
]

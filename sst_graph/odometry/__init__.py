"""Motion of each sensor by itself: LiDAR odometry, visual odometry, standstill."""

from __future__ import annotations

from sst_graph.odometry.lidar import LidarOdometry, LidarOdometryConfig, lidar_odometry
from sst_graph.odometry.registration import (
    LoopClosure,
    RegisteredScan,
    loop_closures,
    scan_to_scan,
)
from sst_graph.odometry.standstill import standstill_frames
from sst_graph.odometry.visual import ImagePair, image_pairs, metric_motions, next_pair

__all__ = [
    "ImagePair",
    "LidarOdometry",
    "LidarOdometryConfig",
    "LoopClosure",
    "RegisteredScan",
    "image_pairs",
    "lidar_odometry",
    "loop_closures",
    "metric_motions",
    "next_pair",
    "scan_to_scan",
    "standstill_frames",
]

"""Drives in ROS 1 bags, rosbag2 folders and mcap files, read with the package rosbags (the extra ``ros``)."""

from __future__ import annotations

from sst_graph.data.ros.source import ROS_LOADER

__all__ = ["ROS_LOADER"]

"""Readers of drives. A new format is one module or package and one line of registration here."""

from __future__ import annotations

from sst_graph.data.folder.reader import FOLDER_LOADER
from sst_graph.data.kitti.odometry import KITTI_LOADER, KittiSource
from sst_graph.data.kitti.raw import RAW_LOADER
from sst_graph.data.nuscenes.reader import NUSCENES_LOADER
from sst_graph.data.ros import ROS_LOADER
from sst_graph.data.source import Loader, SourceOptions, loader_names, open_source, register_loader
from sst_graph.data.two_clocks import DriveProperties, Sensor, merged

register_loader("kitti", KITTI_LOADER)
register_loader("kitti-raw", RAW_LOADER)
register_loader("folder", FOLDER_LOADER)
register_loader("nuscenes", NUSCENES_LOADER)
register_loader("ros", ROS_LOADER)

__all__ = [
    "DriveProperties",
    "KittiSource",
    "Loader",
    "Sensor",
    "SourceOptions",
    "loader_names",
    "merged",
    "open_source",
    "register_loader",
]

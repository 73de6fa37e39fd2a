"""Readers of drives. A new format is one module or package and one line of registration here."""

from __future__ import annotations

from sst_graph.data.folder.reader import FOLDER_LOADER
from sst_graph.data.kitti.odometry import KITTI_LOADER, KittiSource
from sst_graph.data.kitti.raw import RAW_LOADER
from sst_graph.data.nuscenes.reader import NUSCENES_LOADER
from sst_graph.data.ros import ROS_LOADER
from sst_graph.data.source import Loader, SourceOptions, loader_names, open_source, register_loader

register_loader("kitti", KITTI_LOADER)
register_loader("kitti-raw", RAW_LOADER)
register_loader("folder", FOLDER_LOADER)
register_loader("nuscenes", NUSCENES_LOADER)
register_loader("ros", ROS_LOADER)

__all__ = [
    "KittiSource",
    "Loader",
    "SourceOptions",
    "loader_names",
    "open_source",
    "register_loader",
]

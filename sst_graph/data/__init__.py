"""Readers of drives. A new format is one module and one line of registration here."""

from __future__ import annotations

from sst_graph.data.kitti.odometry import KITTI_LOADER, KittiSource
from sst_graph.data.source import Loader, SourceOptions, loader_names, open_source, register_loader

register_loader("kitti", KITTI_LOADER)

__all__ = ["KittiSource", "Loader", "SourceOptions", "loader_names", "open_source", "register_loader"]

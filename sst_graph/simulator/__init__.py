"""A street simulator with exact truth: images, masks and LiDAR scans of one and the same geometry."""

from __future__ import annotations

from sst_graph.simulator.bag import write_bag
from sst_graph.simulator.config import Motion, SimulationConfig
from sst_graph.simulator.drive import SimulatedDrive, simulate
from sst_graph.simulator.write import DRIVE, fill_drive, write_drive

__all__ = [
    "DRIVE",
    "Motion",
    "SimulatedDrive",
    "SimulationConfig",
    "fill_drive",
    "simulate",
    "write_bag",
    "write_drive",
]

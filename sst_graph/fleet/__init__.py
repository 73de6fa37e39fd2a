"""Many drives: each calibrated in a process of its own, their vehicles fused, one summary.

The command is ``sst-graph batch`` (docs/how-to/batch.md).
"""

from __future__ import annotations

from sst_graph.fleet.batch import BatchConfig, BatchOutcome, Progress, open_batch, run_batch, write_summary
from sst_graph.fleet.drives import ListedDrive, find_drives, with_vehicles
from sst_graph.fleet.isolated import Limits
from sst_graph.fleet.places import Place
from sst_graph.fleet.record import Record
from sst_graph.fleet.vehicles.changes import Findings, VehicleChange, find_changes
from sst_graph.fleet.vehicles.fused import Vehicle, vehicles_of
from sst_graph.fleet.vehicles.walk import DriveEstimate, Smoothed, WalkConfig, smoothed

__all__ = [
    "BatchConfig",
    "BatchOutcome",
    "DriveEstimate",
    "Findings",
    "Limits",
    "ListedDrive",
    "Place",
    "Progress",
    "Record",
    "Smoothed",
    "Vehicle",
    "VehicleChange",
    "WalkConfig",
    "find_changes",
    "find_drives",
    "open_batch",
    "run_batch",
    "smoothed",
    "vehicles_of",
    "with_vehicles",
    "write_summary",
]

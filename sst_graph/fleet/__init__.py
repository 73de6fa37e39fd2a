"""Many drives: each calibrated in a process of its own, their vehicles fused, one summary.

The command is ``sst-graph batch`` (docs/how-to/batch.md).
"""

from __future__ import annotations

from sst_graph.fleet.batch import BatchConfig, Outcome, Progress, open_batch, run_batch, write_summary
from sst_graph.fleet.drives import Drive, find_drives, with_vehicles
from sst_graph.fleet.isolated import Limits
from sst_graph.fleet.places import Place
from sst_graph.fleet.record import Record
from sst_graph.fleet.vehicles.changes import Finding, Findings, find_changes
from sst_graph.fleet.vehicles.fused import Vehicle, vehicles_of
from sst_graph.fleet.vehicles.walk import DriveEstimate, Smoothed, WalkConfig, smoothed

__all__ = [
    "BatchConfig",
    "Drive",
    "DriveEstimate",
    "Finding",
    "Findings",
    "Limits",
    "Outcome",
    "Place",
    "Progress",
    "Record",
    "Smoothed",
    "Vehicle",
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

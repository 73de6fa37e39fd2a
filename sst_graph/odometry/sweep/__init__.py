"""When each point of a scan was measured, where the data do not have it: decided from the scans
(docs/understand/sweep.md)."""

from __future__ import annotations

from sst_graph.odometry.sweep.decision import (
    FRACTIONS,
    REMEDY,
    SweepDecision,
    SweepKind,
    decide_sweep,
)
from sst_graph.odometry.sweep.source import SWEEP_KEY, SweptSource, timed, with_sweep, with_sweep_of
from sst_graph.sweep_timing import SweepStamp, SweepTiming

__all__ = [
    "FRACTIONS",
    "REMEDY",
    "SWEEP_KEY",
    "SweepDecision",
    "SweepKind",
    "SweepStamp",
    "SweepTiming",
    "SweptSource",
    "decide_sweep",
    "timed",
    "with_sweep",
    "with_sweep_of",
]

"""Clouds that do not tell by which laser each point was measured."""

from __future__ import annotations

from collections.abc import Sequence

from sst_graph.diagnosis.finding import Finding
from sst_graph.drive.preparation import Drive
from sst_graph.errors import count_of

_MOST = 0.5
"""Share of the scans above which it is said: a scan now and then is cut short."""


def unknown_lasers(drives: Sequence[Drive]) -> Finding | None:
    """Scans without laser numbers, which were then recovered from elevations. That may be right."""
    known = [scan.lasers for d in drives if d.statistics is not None for scan in d.statistics.scans]
    missing = known.count(False)
    if missing <= _MOST * len(known):
        return None
    return Finding(
        "which laser measured a point is not known and was recovered from elevations; upper edges of objects "
        "may be off by up to half the distance of two rings, beyond the sigmas",
        f"{missing} of {count_of(len(known), 'scan')} have no field 'ring', and their points come neither "
        "ring after ring nor firing after firing",
        "give the clouds with the field 'ring', or as the LiDAR's driver stores them",
    )

"""Drives with some of their boundary points."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sst_graph.drive.preparation import Drive, ScanFeatures, boundary_count
from sst_graph.features.lidar_edges import Boundaries, Edge, with_points
from sst_graph.files.array_store import replaced
from sst_graph.objects.tracks import ObjectId, numbers_in, of_each
from sst_graph.sampling import spread_places, step_for
from sst_graph.types import BoolArray, SemanticClass


def thinned(drive: Drive, most: int) -> Drive:
    """The drive with at most so many boundary points, evenly spread, of each class in each scan."""
    return replace(drive, scans=tuple(thinned_scan(scan, most, scan.boundaries) for scan in drive.scans))


def thinned_scan(scan: ScanFeatures, most: int, classes: Collection[SemanticClass]) -> ScanFeatures:
    """The scan with at most so many boundary points, evenly spread, of each of some classes."""
    boundaries = {
        c: points.take(np.arange(0, len(points), step_for(len(points), most))) if c in classes else points
        for c, points in scan.boundaries.items()
    }
    return replaced(scan, boundaries=boundaries)


def thinned_together(drives: Sequence[Drive], most: int) -> list[Drive]:
    """The drives with at most so many boundary points in all, evenly spread over each."""
    counts = [sum(boundary_count(scan, ()) for scan in drive.scans) for drive in drives]
    if sum(counts) <= most:
        return list(drives)
    return [
        _spread(drive, spread_places(np.arange(count), max(1, most * count // sum(counts))))
        for drive, count in zip(drives, counts, strict=True)
    ]


def _spread(drive: Drive, kept: NDArray[np.intp]) -> Drive:
    """The drive with some of its boundary points, by their rising places among those of all scans."""
    scans, first = [], 0
    for scan in drive.scans:
        boundaries = {}
        for c, points in scan.boundaries.items():
            here, end = np.searchsorted(kept, (first, first + len(points)))
            boundaries[c] = points.take(kept[here:end] - first)
            first += len(points)
        scans.append(replaced(scan, boundaries=with_points(boundaries)))
    return replace(drive, scans=tuple(scans))


def with_objects(drive: Drive, tracks: Mapping[ObjectId, int], kept: BoolArray) -> Drive:
    """The drive with the boundary points of some groups of objects; tracks go round the groups."""

    def of_groups(position: int, c: SemanticClass, points: Boundaries) -> BoolArray:
        numbers = {n: tracks[position, c, n] for n in numbers_in(points.objects)}
        return np.asarray(kept[of_each(points.objects, numbers) % len(kept)])

    return _with_some(drive, of_groups)


def without_kind(drive: Drive, kind: Edge) -> Drive:
    """The drive without the boundary points of one kind."""
    return _with_some(drive, lambda _position, _class, points: points.edges != kind)


def _with_some(drive: Drive, kept: Callable[[int, SemanticClass, Boundaries], BoolArray]) -> Drive:
    """The drive with the boundary points (n,) that are kept of each class in each scan, by its position."""
    scans = []
    for position, scan in enumerate(drive.scans):
        some = {
            c: points.take(np.flatnonzero(kept(position, c, points))) for c, points in scan.boundaries.items()
        }
        scans.append(replaced(scan, boundaries=with_points(some)))
    return replace(drive, scans=tuple(scans))

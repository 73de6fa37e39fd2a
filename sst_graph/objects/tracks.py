"""The same object in many scans: tracks through the world, for clusters of matches whose errors are
correlated."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.drive.preparation import Drive
from sst_graph.features.lidar_edges import Boundaries
from sst_graph.objects.occupancy import ObjectName
from sst_graph.types import FloatArray, IntArray, SemanticClass

ObjectId = tuple[int, SemanticClass, int]
"""Position of the scan, class, number of the object within the scan."""

_Scalar = TypeVar("_Scalar", int, float)

_REACH_M = 2.0
"""Farthest an object's centre may seem to jump between scans [m]."""


class ObjectTracker:
    """Tracks of objects, scan by scan; those not seen lately are forgotten.

    Attributes:
        memory: scans after which an unseen track is forgotten, or None for never.
        live: class and place (3,) in the world [m] of each track, by its number.
        last_seen: scan that saw it last, counted from 0.
        scans: scans so far.
        next_track: number of the next new track.
    """

    def __init__(self, memory: int | None = None) -> None:
        self.memory = memory
        self.live: dict[int, tuple[SemanticClass, FloatArray]] = {}
        self.last_seen: dict[int, int] = {}
        self.scans = 0
        self.next_track = 0

    def forget(self) -> None:
        """Forget all tracks; their numbers are not used again."""
        self.live.clear()
        self.last_seen.clear()

    def add(self, boundaries: Mapping[SemanticClass, Boundaries], wTl: gtsam.Pose3) -> dict[ObjectName, int]:
        """Number of the track of each (class, object) of the next scan, posed at ``wTl``."""
        tracks: dict[ObjectName, int] = {}
        seen: dict[int, tuple[SemanticClass, FloatArray]] = {}
        for (c, number), centre in object_centres(boundaries, wTl).items():
            track = _nearest(self.live, seen, c, centre)
            if track is None:
                track, self.next_track = self.next_track, self.next_track + 1
            tracks[c, number] = track
            seen[track] = (c, centre)
            self.last_seen[track] = self.scans
        self.live.update(seen)
        self.scans += 1
        if self.memory is not None:
            for track in [t for t, last in self.last_seen.items() if last < self.scans - self.memory]:
                del self.live[track], self.last_seen[track]
        return tracks


def object_centres(
    boundaries: Mapping[SemanticClass, Boundaries], wTl: gtsam.Pose3
) -> dict[ObjectName, FloatArray]:
    """(3,) mean of each object's boundary points in the world [m], of a scan posed at ``wTl``."""
    centres: dict[ObjectName, FloatArray] = {}
    for c, points in boundaries.items():
        lPs, (numbers, which) = points.lPs, np.unique(points.objects, return_inverse=True)
        for k, number in enumerate(numbers):
            centres[c, int(number)] = wTl.transformFrom(lPs[which == k].mean(axis=0))
    return centres


def numbers_in(objects: IntArray) -> list[int]:
    """Numbers (>= 0) of the objects that occur, rising."""
    return list(np.flatnonzero(np.bincount(objects)).tolist())


def of_each(objects: IntArray, values: Mapping[int, _Scalar]) -> NDArray[Any]:
    """(n,) value of the object of each entry (n,), given by the object's number (>= 0)."""
    table = np.zeros(max(values, default=0) + 1, np.array([*values.values()]).dtype)
    table[[*values]] = [*values.values()]
    return table[objects]


def object_tracks(drive: Drive) -> dict[ObjectId, int]:
    """Number of the track that each object of each scan belongs to.

    Centres of an object's boundary points are carried into the world by LiDAR odometry and joined to
    the nearest track of the same class that was seen before.
    """
    tracker = ObjectTracker()
    tracks: dict[ObjectId, int] = {}
    for position, wTl in enumerate(scan_poses(drive)):
        for (c, number), track in tracker.add(drive.scans[position].boundaries, wTl).items():
            tracks[position, c, number] = track
    return tracks


def tracks_of_scans(tracks: Mapping[ObjectId, int], scans: Sequence[int]) -> dict[ObjectId, int]:
    """Tracks of the objects of some scans (positions, rising), which are renumbered from 0."""
    place = {position: k for k, position in enumerate(scans)}
    return {(place[scan], c, n): track for (scan, c, n), track in tracks.items() if scan in place}


def scan_poses(drive: Drive) -> Sequence[gtsam.Pose3]:
    """Pose of every scan in the first scan's frame."""
    poses = [gtsam.Pose3()]
    for motion in drive.lidar_motions:
        poses.append(poses[-1].compose(motion.aTb))
    return poses


def _nearest(
    live: dict[int, tuple[SemanticClass, FloatArray]],
    taken: dict[int, tuple[SemanticClass, FloatArray]],
    c: SemanticClass,
    centre: FloatArray,
) -> int | None:
    """The live track of a class nearest to a place, if within reach and not taken in this scan."""
    best, reach = None, _REACH_M
    for track, (track_class, place) in live.items():
        if track_class == c and track not in taken:
            distance = float(np.linalg.norm(place - centre))
            if distance < reach:
                best, reach = track, distance
    return best

"""The same object in many scans: tracks through the world, for clusters of matches that err together."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.problem.drive import Drive
from sst_graph.types import SemanticClass

FloatArray = NDArray[np.float64]
ObjectId = tuple[int, SemanticClass, int]
"""Position of the scan, class, number of the object within the scan."""

_REACH_M = 2.0
"""Farthest an object's centre may seem to jump between scans [m]."""


def object_tracks(drive: Drive) -> dict[ObjectId, int]:
    """Number of the track that each object of each scan belongs to.

    Centres of an object's boundary points are carried into the world by LiDAR odometry and joined to
    the nearest track of the same class that was seen lately.
    """
    tracks: dict[ObjectId, int] = {}
    live: dict[int, tuple[SemanticClass, FloatArray]] = {}
    following = 0
    for position, wTl in enumerate(_scan_poses(drive)):
        seen: dict[int, tuple[SemanticClass, FloatArray]] = {}
        for c, boundaries in drive.scans[position].boundaries.items():
            numbers, which = np.unique(boundaries.objects, return_inverse=True)
            for k, number in enumerate(numbers):
                centre = wTl.transformFrom(boundaries.lPs[which == k].mean(axis=0))
                track = _nearest(live, seen, c, centre)
                if track is None:
                    track, following = following, following + 1
                tracks[position, c, int(number)] = track
                seen[track] = (c, centre)
        live.update(seen)
    return tracks


def _scan_poses(drive: Drive) -> Sequence[gtsam.Pose3]:
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
        distance = float(np.linalg.norm(place - centre))
        if track_class == c and track not in taken and distance < reach:
            best, reach = track, distance
    return best

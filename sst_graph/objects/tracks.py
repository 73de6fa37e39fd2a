"""The same object in many scans: tracks through the world, for clusters of matches that err together.

And which of them move by themselves: by the way of their centres where they are followed long enough, which
tells slow ones best, by :mod:`sst_graph.objects.persistence`, and by :mod:`sst_graph.objects.velocity`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.config import Settings, setting
from sst_graph.drive.preparation import Drive
from sst_graph.features.lidar_edges import Boundaries
from sst_graph.objects.persistence import ObjectName, Persistence
from sst_graph.objects.velocity import ObjectVelocity, Velocities
from sst_graph.types import SemanticClass

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]
ObjectId = tuple[int, SemanticClass, int]
"""Position of the scan, class, number of the object within the scan."""

_Name = TypeVar("_Name")
_Scalar = TypeVar("_Scalar", int, float)

_REACH_M = 2.0
"""Farthest an object's centre may seem to jump between scans [m]."""


@dataclass(frozen=True)
class MovingConfig(Settings):
    """What counts as an object that moves by itself.

    Attributes:
        window_s: half width of the time around a scan that is looked at [s].
        min_sightings: fewest scans within it.
        min_speed_mps: least speed [m/s].
        min_travel_m: least way within the window [m].
        max_scatter: largest rms distance from a steady motion, as a share of the way.
    """

    window_s: float = setting(0.8, at_least=0.01, at_most=60.0)
    min_sightings: int = setting(4, at_least=2, at_most=1000)
    min_speed_mps: float = setting(1.0, at_least=0.0, at_most=100.0)
    min_travel_m: float = setting(0.8, at_least=0.0, at_most=1000.0)
    max_scatter: float = setting(0.1, at_least=0.0, at_most=10.0)


class ObjectTracker:
    """Tracks of objects, scan by scan; those not seen lately are forgotten.

    Attributes:
        memory: scans after which an unseen track is forgotten, or None for never.
        live: class and place (3,) in the world [m] of each track, by its number.
        last_seen: scan that saw it last, counted from 0.
        scans: scans so far.
        following: number of the next new track.
    """

    def __init__(self, memory: int | None = None) -> None:
        self.memory = memory
        self.live: dict[int, tuple[SemanticClass, FloatArray]] = {}
        self.last_seen: dict[int, int] = {}
        self.scans = 0
        self.following = 0

    def forget(self) -> None:
        """Forget all tracks; their numbers are not used again."""
        self.live.clear()
        self.last_seen.clear()

    def add(
        self, boundaries: Mapping[SemanticClass, Boundaries], wTl: gtsam.Pose3
    ) -> dict[tuple[SemanticClass, int], int]:
        """Number of the track of each (class, object) of the next scan, posed at ``wTl``."""
        tracks: dict[tuple[SemanticClass, int], int] = {}
        seen: dict[int, tuple[SemanticClass, FloatArray]] = {}
        for c, points in boundaries.items():
            numbers, which = np.unique(points.objects, return_inverse=True)
            for k, number in enumerate(numbers):
                centre = wTl.transformFrom(points.lPs[which == k].mean(axis=0))
                track = _nearest(self.live, seen, c, centre)
                if track is None:
                    track, self.following = self.following, self.following + 1
                tracks[c, int(number)] = track
                seen[track] = (c, centre)
                self.last_seen[track] = self.scans
        self.live.update(seen)
        self.scans += 1
        if self.memory is not None:
            for track in [t for t, last in self.last_seen.items() if last < self.scans - self.memory]:
                del self.live[track], self.last_seen[track]
        return tracks


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
    for position, wTl in enumerate(_scan_poses(drive)):
        for (c, number), track in tracker.add(drive.scans[position].boundaries, wTl).items():
            tracks[position, c, number] = track
    return tracks


def tracks_of_scans(tracks: Mapping[ObjectId, int], scans: Sequence[int]) -> dict[ObjectId, int]:
    """Tracks of the objects of some scans (positions, rising), which are numbered anew from 0."""
    place = {position: k for k, position in enumerate(scans)}
    return {(place[scan], c, n): track for (scan, c, n), track in tracks.items() if scan in place}


@dataclass(frozen=True)
class Mover:
    """An object that moves in the world by itself.

    Attributes:
        speed_mps: that it passes for [m/s].
        velocity: where it is followed well enough.
    """

    speed_mps: float
    velocity: ObjectVelocity | None = None

    @property
    def unknown_mps(self) -> float:
        """How much of its motion is not known."""
        return self.speed_mps if self.velocity is None else min(self.speed_mps, self.velocity.sigma_mps)


def moving_objects(
    drive: Drive, tracks: Mapping[ObjectId, int], config: MovingConfig | None = None
) -> dict[ObjectId, Mover]:
    """The objects that move in the world by themselves, scan by scan.

    Around every scan an object's centres within ``window_s`` are fitted by a straight, steady motion. A
    parked object's centre wanders too, as other sides of it come into view, but neither far nor straight.
    Those that do not stay where they are pass for at least as fast as :class:`Persistence` says, those that
    are followed by their near end shortly before or after for as fast as :class:`Velocities` says.
    """
    poses = _scan_poses(drive)
    followed = _speeds_of_tracks(drive, tracks, poses, config or MovingConfig())
    others = _speeds_without_tracks(drive, poses)
    by_scan: list[dict[ObjectName, int]] = [{} for _ in poses]
    for (position, c, n), track in tracks.items():
        by_scan[position][c, n] = track
    velocities = Velocities()
    for position, (scan, own, wTl) in enumerate(zip(drive.scans, by_scan, poses, strict=True)):
        velocities.remember(position, scan, own, wTl)
    velocities.judge_all()
    lately = {(k, c, n): mps for k in range(len(poses)) for (c, n), mps in velocities.speeds(k).items()}
    return {
        (position, c, n): Mover(speed, velocities.of(position, (c, n)))
        for (position, c, n), speed in higher_speeds(followed, higher_speeds(others, lately)).items()
    }


def higher_speeds(a: Mapping[_Name, float], b: Mapping[_Name, float]) -> dict[_Name, float]:
    """The higher of two speeds of each object."""
    return {name: max(a.get(name, 0.0), b.get(name, 0.0)) for name in {**a, **b}}


def _speeds_without_tracks(drive: Drive, poses: Sequence[gtsam.Pose3]) -> dict[ObjectId, float]:
    persistence = Persistence()
    for position, wTl in enumerate(poses):
        persistence.add(position, drive.scans[position], wTl)
    return {
        (position, c, n): speed
        for position in range(len(poses))
        for (c, n), speed in persistence.speeds(position).items()
    }


def _speeds_of_tracks(
    drive: Drive, tracks: Mapping[ObjectId, int], poses: Sequence[gtsam.Pose3], config: MovingConfig
) -> dict[ObjectId, float]:
    places: dict[int, list[tuple[ObjectId, float, FloatArray]]] = {}
    for (position, c, number), track in tracks.items():
        boundaries = drive.scans[position].boundaries[c]
        centre = poses[position].transformFrom(boundaries.lPs[boundaries.objects == number].mean(axis=0))
        seconds = (drive.scans[position].stamp_ns - drive.scans[0].stamp_ns) * 1e-9
        places.setdefault(track, []).append(((position, c, number), seconds, centre[:2]))
    found: dict[ObjectId, float] = {}
    for sightings in places.values():
        times = np.array([seconds for _, seconds, _ in sightings])
        centres = np.stack([centre for _, _, centre in sightings])
        for object_id, seconds, _ in sightings:
            near = np.abs(times - seconds) <= config.window_s
            speed = speed_of(times[near], centres[near], config)
            if speed > 0.0:
                found[object_id] = speed
    return found


_LEAST_SHARE = 0.1
"""An object that would keep less of its weight is left out."""
_SHORTEST_S = 0.005
"""Intervals count as no shorter: the offset is not known better while it is sought, and the outline of an
object that moves by itself does not follow the offset as that of a standing one does."""


def standing_share(unknown_mps: float, tau_s: float, reach_m: float) -> float:
    """Share of its weight that an object keeps which moves by itself, in a way not known, within an interval.

    Half where it comes as far as ``reach_m``; 0 far beyond it. Were it all or nothing, objects would come and
    go with the time offset's last millisecond, and the estimate with them.
    """
    return float(standing_shares(np.array([unknown_mps]), np.array([tau_s]), reach_m)[0])


def standing_shares(unknown_mps: FloatArray, taus_s: FloatArray, reach_m: float) -> FloatArray:
    """(n,) the same of objects (n,) within intervals (n,)."""
    shares = 1.0 / (1.0 + (unknown_mps * np.hypot(taus_s, _SHORTEST_S) / reach_m) ** 2)
    return np.where(shares >= _LEAST_SHARE, shares, 0.0)


def speed_of(times: FloatArray, centres: FloatArray, config: MovingConfig) -> float:
    """Speed of centres (n, 2) [m] at times (n,) [s]; 0 where they wander like a parked object's."""
    span = float(np.ptp(times)) if len(times) else 0.0
    if len(times) < config.min_sightings or span <= 0.0:
        return 0.0
    # The line through the mean that fits best.
    t, places = times - times.mean(), centres - centres.mean(axis=0)
    velocity = (t @ places) / (t @ t)
    scatter = float(np.sqrt(np.mean((places - t[:, None] * velocity) ** 2)))
    travelled = float(np.linalg.norm(velocity)) * span
    moves = travelled > config.min_travel_m and scatter < config.max_scatter * travelled
    speed = travelled / span
    return speed if moves and speed > config.min_speed_mps else 0.0


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
        if track_class == c and track not in taken:
            distance = float(np.linalg.norm(place - centre))
            if distance < reach:
                best, reach = track, distance
    return best

"""Velocity of dynamic objects over ground: their near end, followed through the scans around.

The centre of an outline wanders over a vehicle while other sides of it come into view, by half a metre a
second close by. Its end towards the LiDAR along its direction of motion, and its side towards the LiDAR
across it, are the same parts of it in every scan, as long as it does not pass alongside.

Objects move along the ground. The world's axes, those of the first scan, are taken for level unless the
LiDAR is clearly mounted aslant (:mod:`sst_graph.features.up`): then outlines are looked at in level axes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import gtsam
import numpy as np
from scipy.spatial.distance import cdist

from sst_graph.drive.preparation import ScanFeatures
from sst_graph.features.lidar_edges import Boundaries, Edge
from sst_graph.features.up import LEVEL, levelled, up_direction
from sst_graph.objects.occupancy import ObjectName
from sst_graph.odometry.lidar import TESTED_CLASSES
from sst_graph.types import FloatArray, SemanticClass

_WINDOW_S = 0.35
"""Half width of the time around a scan in which the near end is followed [s]."""
_MIN_DETECTIONS = 4
"""Fewest scans within it."""
_MIN_SPEED_MPS = 1.0
"""Slower objects have no reliable direction [m/s]."""
_MIN_SIGMAS = 3.0
"""Nor have those whose velocity is not so many sigmas from zero."""
_MIN_POINTS = 8
"""Fewest points of an outline."""
_STRAY_SHARE = 0.02
"""Share of an outline that lies beyond its end, for stray points."""
_MAX_SCATTER_M = 0.25
"""Largest rms distance of end and side from a steady motion [m]."""
_ACCELERATION_MPS2 = 1.0
"""Sigma of the velocity's rate of change; it counts where the scans do not lie evenly around [m/s^2]."""
_FLOOR_MPS = 0.03
"""Least sigma of a velocity [m/s]."""
_MEMORY_S = 0.8
"""An object that moved within this time before or after is dynamic [s]."""
_REACH_M = 0.2
"""Farthest that a point of an outline may be from the same outline in another scan [m] ..."""
_MIN_SHARE, _MIN_GAIN = 0.4, 0.2
"""... for this share of the points at least where the outline is moved with the velocity, and this share more
than where it is not. An end that the field of view cuts off moves along with the LiDAR; the rest of the
outline does not."""


@dataclass(frozen=True)
class ObjectVelocity:
    """Velocity over ground at a scan's stamp.

    Attributes:
        l_velocity: (3,) in the LiDAR frame of the scan [m/s].
        sigma_mps: deviation of either horizontal component [m/s].
    """

    l_velocity: FloatArray
    sigma_mps: float


class ObjectVelocities:
    """Velocities of the movable objects of the latest scans, which are numbered without gaps as they come.

    An object's velocity is found when its scan comes, and again when all around it has been seen.

    Attributes:
        found: by the object's track and the scan.
    """

    def __init__(self) -> None:
        self._scans: dict[int, _ScanOutlines] = {}
        self.found: dict[int, dict[int, ObjectVelocity]] = {}
        self._level_R_world: gtsam.Rot3 | None = None

    def add(
        self, number: int, scan: ScanFeatures, tracks: Mapping[ObjectName, int], wTl: gtsam.Pose3
    ) -> set[int]:
        """A further scan, posed at ``wTl``, and the tracks of its objects.

        Returns:
            Numbers of the earlier scans in which an object becomes dynamic, or static, by this.
        """
        before = max((seen.stamp_ns for seen in self._scans.values()), default=scan.stamp_ns)
        self.insert(number, scan, tracks, wTl)
        reach = round(1e9 * _WINDOW_S)
        whole = {k for k, seen in self._scans.items() if before <= seen.stamp_ns + reach < scan.stamp_ns}
        return whole.union(*(self._update(k) for k in sorted({number, *whole}))) - {number}

    def insert(
        self, number: int, scan: ScanFeatures, tracks: Mapping[ObjectName, int], wTl: gtsam.Pose3
    ) -> None:
        """Keep a scan's outlines, in level axes."""
        if self._level_R_world is None and len(scan.lPs):
            self._level_R_world = _level_axes(up_direction(scan.lPs), wTl)
        if self._level_R_world is not None:
            wTl = gtsam.Pose3(self._level_R_world, np.zeros(3)) * wTl
        self._scans[number] = _ScanOutlines.of(scan, tracks, wTl)

    def update_all(self) -> None:
        """Estimate the velocities in all scans, from all scans."""
        for number in self._scans:
            self._update(number)

    def forget(self, before: int) -> None:
        """Drop all scans before one."""
        for old in [k for k in self._scans if k < before]:
            for track in self._scans.pop(old).tracks.values():
                self.found.get(track, {}).pop(old, None)
                if not self.found.get(track, True):
                    del self.found[track]

    def of(self, number: int, name: ObjectName) -> ObjectVelocity | None:
        """Velocity of an object of a scan, or None where it is not followed well enough."""
        seen = self._scans.get(number)
        track = None if seen is None else seen.tracks.get(name)
        return None if track is None else self.found.get(track, {}).get(number)

    def speeds(self, number: int) -> dict[ObjectName, float]:
        """Speed of the objects of a scan that moved a little before or after [m/s]."""
        found = {}
        for name, track in self._scans[number].tracks.items() if number in self._scans else ():
            near = self._known_near(track, number)
            if near:
                found[name] = max(float(np.linalg.norm(velocity.l_velocity)) for velocity in near.values())
        return found

    def _known_near(self, track: int, number: int) -> dict[int, ObjectVelocity]:
        """Velocities of an object a little before or after a scan."""
        known = self.found.get(track)
        return {k: known[k] for k in self._around(number, _MEMORY_S) if k in known} if known else {}

    def _around(self, number: int, seconds: float) -> list[int]:
        """The scans within some seconds of one, itself included, in their order."""
        stamp_ns, reach = self._scans[number].stamp_ns, round(1e9 * seconds)
        first = last = number
        while first - 1 in self._scans and stamp_ns - self._scans[first - 1].stamp_ns <= reach:
            first -= 1
        while last + 1 in self._scans and self._scans[last + 1].stamp_ns - stamp_ns <= reach:
            last += 1
        return list(range(first, last + 1))

    def _update(self, number: int) -> set[int]:
        """Estimate the velocities of a scan's objects; scans in which only these show, or showed, motion."""
        changed = set[int]()
        for name, track in self._scans[number].tracks.items():
            found, known = self._estimate(number, name), self.found.setdefault(track, {})
            if (found is None) == (number in known):
                known.pop(number, None)
                near = [k for k in self._around(number, _MEMORY_S) if track in self._scans[k].names]
                changed |= {k for k in near if not self._known_near(track, k)}
            if found is not None:
                known[number] = found
            if not known:
                del self.found[track]
        return changed

    def _estimate(self, number: int, name: ObjectName) -> ObjectVelocity | None:
        here = self._scans[number]
        if len(here.outlines[name]) < _MIN_POINTS:
            return None
        names = {k: self._scans[k].names.get(here.tracks[name]) for k in self._around(number, _WINDOW_S)}
        near = [(k, own) for k, own in names.items() if own is not None]
        if len(near) < _MIN_DETECTIONS:
            return None
        times_s = np.array([1e-9 * (self._scans[k].stamp_ns - here.stamp_ns) for k, _ in near])
        centres = np.array([self._scans[k].centres[own] for k, own in near])
        rough = _slopes(times_s, centres)
        if np.hypot(*rough) < _MIN_SPEED_MPS:
            return None
        outlines = [self._scans[k].outlines[own] for k, own in near]
        places = [self._scans[k].place for k, _ in near]
        found = near_end_velocity(times_s, outlines, places, rough)
        if found is None or not _is_carried(found[0], here.outlines[name], times_s, outlines):
            return None
        w_velocity, sigma_mps = found
        return ObjectVelocity(here.wTl.rotation().unrotate(np.append(w_velocity, 0.0)), sigma_mps)


def _level_axes(l_up: FloatArray, wTl: gtsam.Pose3) -> gtsam.Rot3:
    """Rotation of the world in axes whose z is up, given in the LiDAR frame of a scan posed at ``wTl``."""
    if l_up is LEVEL:
        return gtsam.Rot3()
    return gtsam.Rot3(levelled(np.eye(3), l_up).T) * wTl.rotation().inverse()


def _is_carried(
    w_velocity: FloatArray, outline: FloatArray, times_s: FloatArray, outlines: Sequence[FloatArray]
) -> bool:
    """Whether an outline, moved with a velocity, is where the first and the last scan around show it.

    Scans within a millisecond of its own show nothing.
    """
    others, shares = [i for i in (0, -1) if abs(times_s[i]) > 1e-3], []
    if not others:
        return False
    for velocity in (w_velocity, np.zeros(2)):
        distances = [cdist(outline + times_s[i] * velocity, outlines[i]).min(axis=1) for i in others]
        shares.append(float(np.mean(np.concatenate(distances) < _REACH_M)))
    return shares[0] >= max(_MIN_SHARE, shares[1] + _MIN_GAIN)


@dataclass(frozen=True)
class _ScanOutlines:
    """A scan: stamp, pose in level axes, the LiDAR's place (2,); outlines (n, 2), centres, tracks of movable
    objects, and their names by track."""

    stored_apart: ClassVar[bool] = True

    stamp_ns: int
    wTl: gtsam.Pose3
    place: FloatArray
    outlines: dict[ObjectName, FloatArray]
    centres: dict[ObjectName, tuple[float, float]]
    tracks: dict[ObjectName, int]
    names: dict[int, ObjectName]

    @classmethod
    def of(cls, scan: ScanFeatures, tracks: Mapping[ObjectName, int], wTl: gtsam.Pose3) -> _ScanOutlines:
        outlines = {}
        for c in TESTED_CLASSES:
            if (points := scan.boundaries.get(c)) is None:
                continue
            points = points.take(np.flatnonzero(points.edges == Edge.SIDE))
            if len(points):
                wPs = points.lPs @ wTl.rotation().matrix()[:2].T + wTl.translation()[:2]
                order = np.argsort(points.objects, kind="stable")
                numbers, starts = np.unique(points.objects[order], return_index=True)
                parts = np.split(wPs[order], starts[1:])
                outlines.update({(c, int(n)): part for n, part in zip(numbers, parts, strict=True)})
        followed = {name: outline for name, outline in outlines.items() if name in tracks}
        own = {name: tracks[name] for name in followed}
        centres = {name: tuple((part.sum(axis=0) / len(part)).tolist()) for name, part in followed.items()}
        names = {track: name for name, track in own.items()}
        return cls(scan.stamp_ns, wTl, np.asarray(wTl.translation()[:2]), followed, centres, own, names)


def velocities_of_points(
    l_velocities: Mapping[ObjectName, FloatArray], boundaries: Mapping[SemanticClass, Boundaries]
) -> dict[SemanticClass, FloatArray]:
    """(n, 3) velocity over ground of each boundary point's object [m/s], by class where any moves.

    Args:
        l_velocities: (3,) of objects that move, in the LiDAR frame of the scan [m/s].
    """
    found: dict[SemanticClass, FloatArray] = {}
    for (c, n), l_velocity in l_velocities.items():
        if c in boundaries:
            objects = boundaries[c].objects
            found.setdefault(c, np.zeros((len(objects), 3)))[objects == n] = l_velocity
    return {c: velocities for c, velocities in found.items() if velocities.any()}


def near_end_velocity(
    times_s: FloatArray,
    outlines: Sequence[FloatArray],
    places: Sequence[FloatArray],
    rough: FloatArray,
) -> tuple[FloatArray, float] | None:
    """Velocity (2,) at time 0 and its deviation [m/s] of an outline (n, 2), seen from a place (2,) each time.

    None where it does not move steadily, or passes alongside.

    Args:
        rough: (2,) velocity, good enough to separate along from across [m/s].
    """
    speed = float(np.hypot(*rough))
    axes = np.array([[rough[0], rough[1]], [-rough[1], rough[0]]]) / speed
    ends = []
    for outline, place in zip(outlines, places, strict=True):
        along, across = axes @ (outline - place).T
        if along.min() < 0.0 < along.max():
            return None
        ends.append(axes @ place + [_near_end(along, _STRAY_SHARE), _near_end(across, _STRAY_SHARE)])
    X, t = np.stack(ends), times_s - times_s.mean()
    slopes = _slopes(times_s, X)
    variances = ((X - X.mean(axis=0) - t[:, None] * slopes) ** 2).sum(axis=0) / (len(t) - 2)
    if variances.max() > _MAX_SCATTER_M**2:
        return None
    drift = _ACCELERATION_MPS2 * float(times_s.mean())
    sigma_mps = np.sqrt(variances.mean() / (t @ t) + drift**2 + _FLOOR_MPS**2)
    if np.hypot(*slopes) < max(_MIN_SPEED_MPS, _MIN_SIGMAS * sigma_mps):
        return None
    return axes.T @ slopes, float(sigma_mps)


def _near_end(values: FloatArray, share: float) -> float:
    """The end of some coordinates (n,) that is nearest to 0, but for a share of them."""
    beyond = int(share * len(values))
    place = beyond if values.sum() > 0.0 else len(values) - 1 - beyond
    return float(np.partition(values, place)[place])


def _slopes(times_s: FloatArray, values: FloatArray) -> FloatArray:
    """(k,) slopes of the lines that fit values (n, k) over times (n,) best."""
    t = times_s - times_s.mean()
    return np.asarray(t @ values / (t @ t))

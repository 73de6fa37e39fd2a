"""Velocity over ground of objects that move: their near end, followed through the scans around.

The centre of an outline wanders over a vehicle while other sides of it come into view, by half a metre a
second close by. Its end towards the LiDAR along the way that it takes, and its side towards the LiDAR across
it, are the same pieces of it in every scan, as long as it does not pass alongside.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from sst_graph.association.boundary import Edge
from sst_graph.odometry.lidar import MOVABLE_CLASSES
from sst_graph.problem.drive import ScanFeatures
from sst_graph.problem.persistence import ObjectName

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class VelocityConfig:
    """When an object is followed well enough.

    Attributes:
        window_s: half width of the time around a scan that is looked at [s].
        min_sightings: fewest scans within it.
        least_mps: slower ones have no direction to speak of [m/s].
        end: share of an outline that lies beyond its end, for stray points.
        max_scatter_m: largest rms distance of end and side from a steady motion [m].
        acceleration_mps2: deviation of the velocity's rate of change; it counts where the scans do not lie
            evenly around [m/s^2].
        floor_mps: least deviation of a velocity [m/s].
        reach_m: farthest that a point of an outline may be from the same outline in another scan [m] ...
        kept: ... for this share of the points at least where the outline is moved on ...
        gained: ... and this share more than where it is not. An end that the field of view cuts off moves
            along with the LiDAR, and the rest of the outline does not.
    """

    window_s: float = 0.35
    min_sightings: int = 4
    least_mps: float = 1.0
    end: float = 0.02
    max_scatter_m: float = 0.25
    acceleration_mps2: float = 1.0
    floor_mps: float = 0.03
    reach_m: float = 0.2
    kept: float = 0.4
    gained: float = 0.2


@dataclass(frozen=True)
class ObjectVelocity:
    """Velocity over ground at a scan's stamp.

    Attributes:
        l_velocity: (3,) in the LiDAR frame of the scan [m/s].
        sigma_mps: deviation of either horizontal component [m/s].
    """

    l_velocity: FloatArray
    sigma_mps: float


class Velocities:
    """Velocities of the movable objects of the latest scans; scans are told apart by their number."""

    def __init__(self, config: VelocityConfig | None = None) -> None:
        self.config = config or VelocityConfig()
        self._scans: dict[int, _Seen] = {}
        self._sightings: dict[int, dict[int, ObjectName]] = {}
        self._known: dict[tuple[int, ObjectName], tuple[int, ObjectVelocity | None]] = {}

    def add(
        self, number: int, scan: ScanFeatures, tracks: Mapping[ObjectName, int], wTl: gtsam.Pose3
    ) -> set[int]:
        """A further scan, posed at ``wTl``, and the tracks of its objects.

        Returns:
            Numbers of the scans around which all has been seen now.
        """
        before = max((seen.stamp_ns for seen in self._scans.values()), default=scan.stamp_ns)
        self._scans[number] = _Seen.of(scan, tracks, wTl)
        for name in self._scans[number].outlines:
            self._sightings.setdefault(tracks[name], {})[number] = name
        reach = round(1e9 * self.config.window_s)
        return {k for k, seen in self._scans.items() if before <= seen.stamp_ns + reach < scan.stamp_ns}

    def forget(self, before: int) -> None:
        """Drop all scans before one."""
        for old in [k for k in self._scans if k < before]:
            for name, track in self._scans.pop(old).tracks.items():
                self._known.pop((old, name), None)
                self._sightings.get(track, {}).pop(old, None)
                if not self._sightings.get(track, True):
                    del self._sightings[track]

    def of(self, number: int, name: ObjectName) -> ObjectVelocity | None:
        """Velocity of an object of a scan, or None where it is not followed well enough."""
        if number not in self._scans or name not in self._scans[number].outlines:
            return None
        newest = max(self._scans)
        known = self._known.get((number, name))
        if known is None or (known[0] < newest and not self._whole(number, known[0])):
            known = self._known[number, name] = (newest, self._followed(number, name))
        return known[1]

    def _whole(self, number: int, newest: int) -> bool:
        """Whether all around a scan had been seen when some scan was the newest."""
        reach = round(1e9 * self.config.window_s)
        return self._scans[newest].stamp_ns > self._scans[number].stamp_ns + reach

    def _followed(self, number: int, name: ObjectName) -> ObjectVelocity | None:
        here = self._scans[number]
        sightings = sorted(self._sightings[here.tracks[name]].items())
        seen = [(self._scans[k], own) for k, own in sightings]
        times = np.array([1e-9 * (one.stamp_ns - here.stamp_ns) for one, _ in seen])
        near = np.flatnonzero(np.abs(times) <= self.config.window_s)
        outlines = [seen[i][0].outlines[seen[i][1]] for i in near]
        places = [seen[i][0].place for i in near]
        found = near_end_velocity(times[near], outlines, places, self.config)
        if found is None or not self._carried(found[0], here.outlines[name], times[near], outlines):
            return None
        w_velocity, sigma_mps = found
        return ObjectVelocity(here.wTl.rotation().unrotate(np.append(w_velocity, 0.0)), sigma_mps)

    def _carried(
        self, w_velocity: FloatArray, outline: FloatArray, times_s: FloatArray, outlines: Sequence[FloatArray]
    ) -> bool:
        """Whether a velocity carries an outline to where the first and the last scan around show it."""
        shares = []
        for velocity in (w_velocity, np.zeros(2)):
            distances = [
                cdist(outline + times_s[i] * velocity, outlines[i]).min(axis=1)
                for i in (0, -1)
                if abs(times_s[i]) > 1e-3
            ]
            shares.append(float(np.mean(np.concatenate(distances) < self.config.reach_m)))
        return shares[0] >= max(self.config.kept, shares[1] + self.config.gained)


@dataclass(frozen=True)
class _Seen:
    """A scan: stamp, pose, the LiDAR's place (2,), outlines (n, 2) and tracks of its movable objects."""

    stamp_ns: int
    wTl: gtsam.Pose3
    place: FloatArray
    outlines: dict[ObjectName, FloatArray]
    tracks: dict[ObjectName, int]

    @classmethod
    def of(cls, scan: ScanFeatures, tracks: Mapping[ObjectName, int], wTl: gtsam.Pose3) -> _Seen:
        outlines = {}
        for c in MOVABLE_CLASSES:
            if (points := scan.boundaries.get(c)) is not None and len(points):
                points = points.take(np.flatnonzero(points.edges == Edge.SIDE))
                wPs = points.lPs @ wTl.rotation().matrix()[:2].T + wTl.translation()[:2]
                order = np.argsort(points.objects, kind="stable")
                numbers, starts = np.unique(points.objects[order], return_index=True)
                parts = np.split(wPs[order], starts[1:])
                outlines.update({(c, int(n)): part for n, part in zip(numbers, parts, strict=True)})
        followed = {name: outline for name, outline in outlines.items() if name in tracks}
        own = {name: tracks[name] for name in followed}
        return cls(scan.stamp_ns, wTl, np.asarray(wTl.translation()[:2]), followed, own)


def near_end_velocity(
    times_s: FloatArray, outlines: Sequence[FloatArray], places: Sequence[FloatArray], config: VelocityConfig
) -> tuple[FloatArray, float] | None:
    """Velocity (2,) at time 0 and its deviation [m/s] of an outline (n, 2), seen from a place (2,) each time.

    None where it is seen too seldom, does not move steadily, or passes alongside.
    """
    if len(times_s) < config.min_sightings:
        return None
    t = times_s - times_s.mean()
    rough = t @ np.stack([outline.mean(axis=0) for outline in outlines]) / (t @ t)
    speed = float(np.linalg.norm(rough))
    if speed < config.least_mps:
        return None
    axes = np.array([[rough[0], rough[1]], [-rough[1], rough[0]]]) / speed
    ends = []
    for outline, place in zip(outlines, places, strict=True):
        along, across = axes @ (outline - place).T
        if along.min() < 0.0 < along.max():
            return None
        ends.append(axes @ place + [_near_end(along, config.end), _near_end(across, config.end)])
    X = np.stack(ends)
    slopes = t @ X / (t @ t)
    variances = ((X - X.mean(axis=0) - t[:, None] * slopes) ** 2).sum(axis=0) / (len(t) - 2)
    if variances.max() > config.max_scatter_m**2:
        return None
    drift = config.acceleration_mps2 * float(times_s.mean())
    sigma_mps = np.sqrt(variances.mean() / (t @ t) + drift**2 + config.floor_mps**2)
    return axes.T @ slopes, float(sigma_mps)


def _near_end(values: FloatArray, share: float) -> float:
    """The end of some coordinates (n,) that is nearest to 0, but for a share of them."""
    beyond = int(share * len(values))
    place = beyond if np.median(values) > 0.0 else len(values) - 1 - beyond
    return float(np.partition(values, place)[place])

"""Which objects are dynamic: one test for the batch and the tracker.

An object is dynamic by any of three tests, and its speed is the highest that one of them gives:

1. A straight line of constant speed fits the centres of its track around a scan (Detection): finds slow ones.
2. Its place is free in a scan shortly before and after (:mod:`sst_graph.objects.occupancy`): needs no track.
3. Its near end moves (:mod:`sst_graph.objects.velocity`): gives the velocity, too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from sst_graph.drive.preparation import Drive, ScanFeatures
from sst_graph.objects.occupancy import ObjectName, OccupancyTest
from sst_graph.objects.tracks import ObjectId, object_centres, scan_poses
from sst_graph.objects.velocity import ObjectVelocities, ObjectVelocity
from sst_graph.types import FloatArray

_WINDOW_NS = 800_000_000
"""Half width of the time around a scan in which a track's centres are fitted [ns]."""
_MIN_DETECTIONS = 4
"""Fewest centres of a fit: two more than a line has parameters an axis."""
_MIN_SPEED_MPS = 1.0
"""Least speed: the centre of a parked object moves as other sides of it come into view [m/s]."""
_MIN_TRAVEL_M = 0.8
"""Least distance along the line [m]."""
_MAX_SCATTER = 0.1
"""Largest rms distance from the line, as a share of the distance along it."""
_SPEED_CHANGE = 0.2
"""A scan is to be matched again where the speed of an object changes by more than this fraction."""
_RECENTLY_MOVING_MPS = 0.6
"""Slower objects have not moved: half of their points are where they were [m/s]."""
_MIN_WEIGHT = 0.1
"""An object whose factor would be smaller is left out."""
_SHORTEST_S = 0.005
"""Intervals count as no shorter: the offset is not known better while it is estimated, and the outline of a
dynamic object does not follow the offset as that of a static one does [s]."""


@dataclass(frozen=True)
class DynamicObject:
    """An object that moves over ground.

    Attributes:
        speed_mps: assumed speed [m/s].
        velocity: where its near end could be followed.
    """

    speed_mps: float
    velocity: ObjectVelocity | None = None

    @property
    def unknown_mps(self) -> float:
        """Speed that is not known: all of it, or the velocity's sigma [m/s]."""
        return self.speed_mps if self.velocity is None else min(self.speed_mps, self.velocity.sigma_mps)


@dataclass(frozen=True)
class Detection:
    """An object in a scan.

    Attributes:
        scan: number of the scan.
        name: class and number of the object within it.
        stamp_ns: of the scan.
        centre: (2,) in the world, seen from above [m].
    """

    scan: int
    name: ObjectName
    stamp_ns: int
    centre: FloatArray


class DynamicObjectTest:
    """Which objects of a drive's scans, or of its latest ones, are dynamic; scans are numbered without gaps.

    :meth:`add` tests with every scan that comes. :meth:`insert`, for all scans of a drive, and then
    :meth:`test_all` test every object once, with all that is around it.

    Attributes:
        detections: of each track, in the order of time; with :meth:`add` the latest ones.
        path_speeds: speed of the objects that are dynamic by their track, by the scan's number [m/s].
        occupancy: the test by place.
        velocities: the test by the near end.
        changed_scans: scans in which an object has become dynamic, or static, or changed its speed, since
            somebody cleared them.
    """

    def __init__(self) -> None:
        self.detections: dict[int, list[Detection]] = {}
        self.path_speeds: dict[int, dict[ObjectName, float]] = {}
        self.occupancy = OccupancyTest()
        self.velocities = ObjectVelocities()
        self.changed_scans: set[int] = set()
        self._tested_before_ns: int | None = None

    def add(
        self,
        number: int,
        scan: ScanFeatures,
        tracks: Mapping[ObjectName, int],
        wTl: gtsam.Pose3,
        first: int,
    ) -> None:
        """Test with the next scan.

        Args:
            number: of the scan.
            tracks: of its objects.
            wTl: its pose.
            first: number of the oldest scan that is still needed.
        """
        self._detect(number, scan, tracks, wTl)
        self._test_latest_paths(number, scan.stamp_ns)
        self.occupancy.forget(first)
        self.changed_scans |= self.occupancy.add(number, scan, wTl)
        self.velocities.forget(first)
        self.changed_scans |= self.velocities.add(number, scan, tracks, wTl)
        for old in [k for k in self.path_speeds if k < first]:
            del self.path_speeds[old]
        self.changed_scans = {k for k in self.changed_scans if k >= first}

    def insert(
        self, number: int, scan: ScanFeatures, tracks: Mapping[ObjectName, int], wTl: gtsam.Pose3
    ) -> None:
        """Keep the next scan for :meth:`test_all`; the arguments are those of :meth:`add`."""
        self._detect(number, scan, tracks, wTl)
        self.occupancy.add(number, scan, wTl)
        self.velocities.insert(number, scan, tracks, wTl)

    def test_all(self) -> None:
        """Test the objects around which not all had been seen yet, as at the end of a drive."""
        self.velocities.update_all()
        for seen in self.detections.values():
            self._test_path(seen, self._tested_before_ns, whole=True)

    def speeds(self, number: int) -> dict[ObjectName, float]:
        """Speed of the dynamic objects of a scan [m/s]."""
        highest = dict(self.path_speeds.get(number, {}))
        for speeds in (self.occupancy.speeds(number), self.velocities.speeds(number)):
            for name, speed in speeds.items():
                highest[name] = max(speed, highest.get(name, 0.0))
        return highest

    def dynamic_objects(self, number: int) -> dict[ObjectName, DynamicObject]:
        """The dynamic objects of a scan."""
        return {
            name: DynamicObject(speed, self.velocities.of(number, name))
            for name, speed in self.speeds(number).items()
        }

    def recently_moving(self) -> set[int]:
        """Tracks of objects that were dynamic in any of their latest detections, without a known velocity.

        While an object starts or stops, no line fits its centres, and it may be found static.
        """
        numbers = {detection.scan for seen in self.detections.values() for detection in seen}
        speeds = {number: self.speeds(number) for number in numbers}
        return {
            track
            for track, seen in self.detections.items()
            if any(speeds[one.scan].get(one.name, 0.0) > _RECENTLY_MOVING_MPS for one in seen)
            and self.velocities.of(seen[-1].scan, seen[-1].name) is None
        }

    def _detect(
        self, number: int, scan: ScanFeatures, tracks: Mapping[ObjectName, int], wTl: gtsam.Pose3
    ) -> None:
        for name, centre in object_centres(scan.boundaries, wTl).items():
            if name in tracks:
                detection = Detection(number, name, scan.stamp_ns, centre[:2])
                self.detections.setdefault(tracks[name], []).append(detection)

    def _test_latest_paths(self, number: int, stamp_ns: int) -> None:
        """Test the tracks that the newest scan continues or ends, and drop what is older than any window."""
        self._tested_before_ns = stamp_ns - _WINDOW_NS
        for track, seen in list(self.detections.items()):
            seen = [one for one in seen if stamp_ns - one.stamp_ns <= 2 * _WINDOW_NS]
            self.detections[track] = seen
            if not seen:
                del self.detections[track]
            elif seen[-1].scan >= number - 1:
                self._test_path(seen, self._tested_before_ns, whole=seen[-1].scan < number)

    def _test_path(self, seen: Sequence[Detection], since_ns: int | None, whole: bool) -> None:
        """Speeds of one object in its detections since a stamp, each from those around it.

        A detection is tested when it is new, when all those around it are there, and when the newest one is
        found dynamic and the one before static or the other way; with ``whole``, now.
        """
        recent = [i for i, one in enumerate(seen) if since_ns is None or one.stamp_ns >= since_ns]
        if not recent:
            return
        centres = np.stack([one.centre for one in seen])
        stamps = np.array([one.stamp_ns for one in seen], dtype=np.int64)
        # A line fitted to n points rises by less than 1.5 times their spread.
        never = 1.5 * float(np.linalg.norm(np.ptp(centres, axis=0))) < _MIN_TRAVEL_M
        before = self._path_speed(seen[recent[-2]]) if len(recent) > 1 else 0.0
        for i in (recent[-1], recent[0], *recent[1:-1]):
            near = np.abs(stamps - stamps[i]) <= _WINDOW_NS
            times_s = np.asarray((stamps[near] - stamps[i]) * 1e-9, np.float64)
            self._set_path_speed(seen[i], 0.0 if never else speed_of_path(times_s, centres[near]))
            if not whole and i == recent[0] and (before > 0.0) == (self._path_speed(seen[-1]) > 0.0):
                break

    def _path_speed(self, detection: Detection) -> float:
        return self.path_speeds.get(detection.scan, {}).get(detection.name, 0.0)

    def _set_path_speed(self, detection: Detection, speed: float) -> None:
        before = self._path_speed(detection)
        if speed > 0.0:
            self.path_speeds.setdefault(detection.scan, {})[detection.name] = speed
        elif before > 0.0:
            del self.path_speeds[detection.scan][detection.name]
        if abs(speed - before) > _SPEED_CHANGE * max(speed, before):
            self.changed_scans.add(detection.scan)


def find_dynamic_objects(drive: Drive, tracks: Mapping[ObjectId, int]) -> dict[ObjectId, DynamicObject]:
    """The dynamic objects of all scans of a drive.

    Args:
        tracks: of :func:`sst_graph.objects.tracks.object_tracks`.
    """
    by_scan: list[dict[ObjectName, int]] = [{} for _ in drive.scans]
    for (position, c, n), track in tracks.items():
        by_scan[position][c, n] = track
    test = DynamicObjectTest()
    for position, (scan, own, wTl) in enumerate(zip(drive.scans, by_scan, scan_poses(drive), strict=True)):
        test.insert(position, scan, own, wTl)
    test.test_all()
    return {
        (position, c, n): found
        for position in range(len(drive.scans))
        for (c, n), found in test.dynamic_objects(position).items()
    }


def speed_of_path(times_s: FloatArray, centres: FloatArray) -> float:
    """Speed of centres (n, 2) [m] at times (n,) [s]; 0 where no line of constant speed fits them."""
    span = float(np.ptp(times_s)) if len(times_s) else 0.0
    if len(times_s) < _MIN_DETECTIONS or span <= 0.0:
        return 0.0
    t, places = times_s - times_s.mean(), centres - centres.mean(axis=0)
    velocity = (t @ places) / (t @ t)
    scatter = float(np.sqrt(np.mean((places - t[:, None] * velocity) ** 2)))
    travelled = float(np.linalg.norm(velocity)) * span
    moves = travelled > _MIN_TRAVEL_M and scatter < _MAX_SCATTER * travelled
    speed = travelled / span
    return speed if moves and speed > _MIN_SPEED_MPS else 0.0


def dynamic_object_weights(unknown_mps: FloatArray, taus_s: FloatArray, reach_m: float) -> FloatArray:
    """(n,) factors on the weights of objects of unknown speeds (n,) [m/s] within intervals (n,) [s].

    1 / (1 + (distance / reach)^2): one half where an object may move by ``reach_m``, 0 far beyond it. A hard
    limit would let objects come and go with the time offset's last millisecond, and the estimate with them.
    """
    weights = 1.0 / (1.0 + (unknown_mps * np.hypot(taus_s, _SHORTEST_S) / reach_m) ** 2)
    return np.where(weights >= _MIN_WEIGHT, weights, 0.0)

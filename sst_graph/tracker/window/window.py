"""The last scans, images and motions: what the tracker can still match anew."""

from __future__ import annotations

import dataclasses
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.drive.preparation import Drive, ImageFeatures, ScanFeatures
from sst_graph.errors import DataError
from sst_graph.factors.camera import PinholeCamera
from sst_graph.objects.persistence import ObjectName, Persistence
from sst_graph.objects.tracks import (
    Mover,
    MovingConfig,
    ObjectId,
    ObjectTracker,
    higher_speeds,
    speed_of,
    standing_share,
)
from sst_graph.objects.velocity import Velocities
from sst_graph.types import RelativeMotion, SemanticClass

FloatArray = NDArray[np.float64]

_SPEED_CHANGE = 0.2
"""Speeds of an object that differ by more than this fraction make its scans be matched again."""

_RECENTLY_MOVING_MPS = 0.6
"""Objects with an estimated speed below this have not moved: half of their points are where they were."""

OBJECT_MEMORY = 50
"""Scans after which an object that was not seen again is another one."""
MOVING = MovingConfig()
"""What counts as a dynamic object, as in the batch."""
_REACH_NS = round(MOVING.window_s * 1e9)


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


class Window:
    """Bounded buffers of one drive; scans are numbered from 0 and never twice.

    Attributes:
        size: most scans, but while nothing may leave.
        sampled: latest scans of which the sample of labelled points is kept: a search looks at no others.
        growing: no scan leaves; afterwards two leave with each that comes, until ``size`` are left.
        tracks: track of each (class, object) of a scan, by the scan's number.
        detections: the latest ones of each track, in the order of time.
        moving: speed of the objects that are dynamic by their detections, by the scan's number [m/s].
        persistence: which objects are static, whatever their detections are.
        velocities: of those that are dynamic.
        changed_scans: scans in which an object has become dynamic, or static, since they were matched.
        next_image: number of the next image; images are numbered by ``index`` as they come, never twice.
        origin_ns: stamp of the first image, from which a clock's skew counts; None before there is one.
    """

    def __init__(self, camera: PinholeCamera, scans: int, sampled: int | None = None) -> None:
        self.camera = camera
        self.size = scans
        self.sampled = scans if sampled is None else sampled
        self.objects = ObjectTracker(memory=OBJECT_MEMORY)
        self.next_scan = 0
        self.next_image = 0
        self.restart()

    def restart(self) -> None:
        """Forget all scans, images and motions; numbers go on."""
        self.growing = False
        self.origin_ns: int | None = None
        self.objects.forget()
        self.scans: deque[tuple[int, ScanFeatures]] = deque()
        self.images: list[ImageFeatures] = []
        self.motions: deque[RelativeMotion] = deque()
        self.tracks: dict[int, dict[ObjectName, int]] = {}
        self.detections: dict[int, list[Detection]] = {}
        self.moving: dict[int, dict[ObjectName, float]] = {}
        self.persistence = Persistence()
        self.velocities = Velocities()
        self.changed_scans: set[int] = set()
        self.wTl = gtsam.Pose3()

    @property
    def first_scan(self) -> int:
        """Number of the oldest scan, or the next one where there is none."""
        return self.scans[0][0] if self.scans else self.next_scan

    @property
    def place(self) -> tuple[int, int]:
        """Numbers of the next image and the next scan."""
        return self.next_image, self.next_scan

    @property
    def last_stamp_ns(self) -> int | None:
        """Stamp of the newest scan."""
        return self.scans[-1][1].stamp_ns if self.scans else None

    def latest_step(self) -> tuple[float, float]:
        """Seconds from the scan before to the newest one, and the LiDAR's speed; 0 if unknown [m/s]."""
        if len(self.scans) < 2:
            return 0.0, 0.0
        seconds = 1e-9 * (self.scans[-1][1].stamp_ns - self.scans[-2][1].stamp_ns)
        motion = self.motions[-1] if self.motions else None
        if motion is None or motion.to_ns != self.last_stamp_ns:
            return seconds, 0.0
        return seconds, float(np.linalg.norm(motion.aTb.translation())) / seconds

    def leaving(self) -> list[int]:
        """The scans that leave when the next one comes, oldest first."""
        count = 0 if self.growing else min(2, len(self.scans) + 1 - self.size)
        return [self.scans[i][0] for i in range(count)]

    def add_scan(self, features: ScanFeatures, motion: RelativeMotion | None) -> int:
        """Keep a scan and the motion that led to it; its number."""
        number = self.next_scan
        self.next_scan += 1
        for _ in self.leaving():
            self.scans.popleft()
        if motion is not None:
            self.motions.append(motion)
            while len(self.motions) > max(self.size, len(self.scans)) + 10:
                self.motions.popleft()
            self.wTl = self.wTl.compose(motion.aTb)
        lean = dataclasses.replace(
            features, depth_lPs=features.depth_lPs[:0], depth_offsets_s=features.depth_offsets_s[:0]
        )
        self.scans.append((number, lean))
        self._thin_out()
        self.tracks[number] = self.objects.add(features.boundaries, self.wTl)
        self._test_objects(number, features.stamp_ns)
        self.persistence.forget(self.first_scan)
        self.changed_scans |= self.persistence.add(number, lean, self.wTl)
        self.velocities.forget(self.first_scan)
        self.changed_scans |= self.velocities.add(number, lean, self.tracks[number], self.wTl)
        for by_scan in (self.tracks, self.moving):
            for old in [k for k in by_scan if k < self.first_scan]:
                del by_scan[old]
        self.changed_scans = {k for k in self.changed_scans if k >= self.first_scan}
        return number

    def _thin_out(self) -> None:
        """Drop the sample of the scan that has just ceased to be among the latest; it is most of a scan."""
        if len(self.scans) > self.sampled:
            number, scan = self.scans[-1 - self.sampled]
            # Copies, for a part of an array keeps all of it.
            thin = dataclasses.replace(
                scan,
                lPs=scan.lPs[:0].copy(),
                classes=scan.classes[:0].copy(),
                offsets_s=scan.offsets_s[:0].copy(),
            )
            self.scans[-1 - self.sampled] = (number, thin)

    def _test_objects(self, number: int, stamp_ns: int) -> None:
        """Which objects of the latest scans are dynamic: the batch's test, from the detections so far."""
        for name, track in self.tracks[number].items():
            centre = self.objects.live[track][1][:2]
            self.detections.setdefault(track, []).append(Detection(number, name, stamp_ns, centre))
        for track, seen in list(self.detections.items()):
            seen = [detection for detection in seen if stamp_ns - detection.stamp_ns <= 2 * _REACH_NS]
            self.detections[track] = seen
            if not seen:
                del self.detections[track]
            elif seen[-1].scan >= number - 1:
                self._test_track(seen, stamp_ns - _REACH_NS, whole=seen[-1].scan < number)

    def test_all_objects(self) -> None:
        """Test all latest detections by those around them, as at the end of a drive."""
        self.velocities.judge_all()
        for seen in self.detections.values():
            self._test_track(seen, self.scans[-1][1].stamp_ns - _REACH_NS, whole=True)

    def _test_track(self, seen: Sequence[Detection], since_ns: int, whole: bool) -> None:
        """Speeds of one object in its detections since a stamp, each from those around it.

        A detection is tested when it is new, when all those around it are there, and when the newest one is
        found dynamic and the one before static or the other way; with ``whole``, now.
        """
        recent = [i for i, detection in enumerate(seen) if detection.stamp_ns >= since_ns]
        if not recent:
            return
        centres = np.stack([detection.centre for detection in seen])
        stamps = np.array([detection.stamp_ns for detection in seen], dtype=np.int64)
        # A line fitted to n places rises by less than 1.5 times their spread.
        never = 1.5 * float(np.linalg.norm(np.ptp(centres, axis=0))) < MOVING.min_travel_m
        before = self._speed(seen[recent[-2]]) if len(recent) > 1 else 0.0
        for i in (recent[-1], recent[0], *recent[1:-1]):
            near = np.abs(stamps - stamps[i]) <= _REACH_NS
            times = np.asarray((stamps[near] - stamps[i]) * 1e-9, np.float64)
            self._set_speed(seen[i], 0.0 if never else speed_of(times, centres[near], MOVING))
            if not whole and i == recent[0] and (before > 0.0) == (self._speed(seen[-1]) > 0.0):
                break

    def _speed(self, detection: Detection) -> float:
        return self.moving.get(detection.scan, {}).get(detection.name, 0.0)

    def _set_speed(self, detection: Detection, speed: float) -> None:
        before = self._speed(detection)
        speeds = self.moving.setdefault(detection.scan, {})
        speeds.pop(detection.name, None)
        if speed > 0.0:
            speeds[detection.name] = speed
        if abs(speed - before) > _SPEED_CHANGE * max(speed, before):
            self.changed_scans.add(detection.scan)

    def left_out(
        self, number: int, tau_s: float, reach_m: float
    ) -> frozenset[tuple[SemanticClass, int, int]]:
        """The dynamic objects of a scan, with the tenths of their weight that they lose in an interval."""
        lost = [
            (c, name, round(10.0 * (1.0 - standing_share(mover.unknown_mps, tau_s, reach_m))))
            for (c, name), mover in self.movers(number).items()
        ]
        return frozenset(entry for entry in lost if entry[2] > 0)

    def speeds(self, number: int) -> dict[ObjectName, float]:
        """Speed of the dynamic objects of a scan [m/s]."""
        others = higher_speeds(self.persistence.speeds(number), self.velocities.speeds(number))
        return higher_speeds(self.moving.get(number, {}), others)

    def movers(self, number: int) -> dict[ObjectName, Mover]:
        """The dynamic objects of a scan."""
        return {
            name: Mover(speed, self.velocities.of(number, name))
            for name, speed in self.speeds(number).items()
        }

    def recently_moving(self) -> set[int]:
        """Tracks of the objects that were dynamic in any of their latest detections, at an unknown velocity.

        While an object starts or stops, no line fits its positions, and the test may find it static.
        """
        numbers = {detection.scan for seen in self.detections.values() for detection in seen}
        speeds = {number: self.speeds(number) for number in numbers}
        return {
            track
            for track, seen in self.detections.items()
            if any(
                speeds[detection.scan].get(detection.name, 0.0) > _RECENTLY_MOVING_MPS for detection in seen
            )
            and self.velocities.of(seen[-1].scan, seen[-1].name) is None
        }

    def objects_of(self, numbers: Sequence[int]) -> tuple[dict[ObjectId, int], dict[ObjectId, Mover]]:
        """Tracks of the objects of some scans, and the dynamic ones, by the scan's position."""
        tracks: dict[ObjectId, int] = {}
        movers: dict[ObjectId, Mover] = {}
        for position, number in enumerate(numbers):
            tracks.update({(position, c, n): track for (c, n), track in self.tracks[number].items()})
            movers.update({(position, c, n): mover for (c, n), mover in self.movers(number).items()})
        return tracks, movers

    def add_image(self, features: ImageFeatures) -> None:
        """Keep an image, with a number of its own, in the order of stamps.

        Raises:
            DataError: one with this stamp is there already.
        """
        stamps = [image.stamp_ns for image in self.images]
        place = int(np.searchsorted(stamps, features.stamp_ns))
        if place < len(stamps) and stamps[place] == features.stamp_ns:
            raise DataError("tracker", f"a second image of stamp {features.stamp_ns} ns", "one image a stamp")
        self.images.insert(place, dataclasses.replace(features, index=self.next_image))
        self.next_image += 1
        if self.origin_ns is None:
            self.origin_ns = features.stamp_ns

    def forget_images(self, margin_ns: int, most: int) -> None:
        """Drop images that no scan can meet: those near the window's scans stay, and the newest ones.

        Args:
            margin_ns: how far from a scan of the window, or behind the newest image, an image may lie.
            most: of all; beyond it the oldest go, whatever they lie near. Two always stay.
        """
        if not self.images:
            return
        newest = self.images[-1].stamp_ns
        stamps = [scan.stamp_ns for _, scan in self.scans] or [newest]
        kept = [
            image
            for image in self.images
            if stamps[0] - margin_ns <= image.stamp_ns <= stamps[-1] + margin_ns
            or image.stamp_ns >= newest - margin_ns
        ]
        if len(kept) < 2:
            kept = self.images[-2:]
        self.images = kept[-max(2, most) :]

    def forget_images_before(self, number: int) -> None:
        """Drop all images that came before the one of a number."""
        self.images = [image for image in self.images if image.index >= number]

    def keep_scans(self, last: int) -> None:
        """Forget all scans but the last few."""
        while len(self.scans) > last:
            self.scans.popleft()
        self.persistence.forget(self.first_scan)

    def stamps_ns(self) -> dict[int, int]:
        """Stamp of each scan by its number."""
        return {number: scan.stamp_ns for number, scan in self.scans}

    def drive(self, chosen: Callable[[int], bool] | None = None) -> tuple[Drive, list[int]]:
        """The window as a drive, and the numbers of its scans; or some of its scans, under all motions."""
        numbers = [number for number, _ in self.scans if chosen is None or chosen(number)]
        scans = [scan for number, scan in self.scans if chosen is None or chosen(number)]
        motions = tuple(self.motions)
        if chosen is None and scans:
            # As in a drive: the k-th motion leads from the k-th scan to the next.
            motions = tuple(motion for motion in motions if motion.from_ns >= scans[0].stamp_ns)
        images = tuple(self.images)
        drive = Drive("window", self.camera, tuple(scans), images, motions, (), origin_ns=self.origin_ns)
        return drive, numbers

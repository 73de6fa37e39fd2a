"""The last scans, images and motions, which the tracker can still match."""

from __future__ import annotations

import dataclasses
from collections import deque
from collections.abc import Collection, Mapping, Sequence, Sized

import gtsam
import numpy as np

from sst_graph.batch.by_edges.parts import thinned_scan
from sst_graph.batch.by_edges.problem import POINTS_A_SCAN
from sst_graph.drive.preparation import Drive, ImageFeatures, ScanFeatures
from sst_graph.errors import DataError, count_of
from sst_graph.factors.camera import PinholeCamera
from sst_graph.graph.drive_motion import DriveMotion
from sst_graph.objects.dynamic_objects import DynamicObject, DynamicObjectTest, dynamic_object_weights
from sst_graph.objects.occupancy import ObjectName
from sst_graph.objects.tracks import ObjectId, ObjectTracker
from sst_graph.odometry.visual import ImagePair
from sst_graph.tracker.by_edges.kinds import both_kinds, by_edges, by_labels
from sst_graph.types import RelativeMotion, SemanticClass

FARTHEST_NS = 86_400 * 10**9
"""A stamp that is farther ahead of the one before is an error, not a pause: a day [ns]."""
OBJECT_MEMORY = 50
"""Scans after which an object that was not seen again is another one, and its sides are closed."""


@dataclasses.dataclass(frozen=True)
class Stretch:
    """Some scans of the window that are solved as the batch does.

    Attributes:
        drive: with their images and motions.
        tracks: of their objects, by the scan's position.
        dynamic: those that move.
        at_end: all that there is: an estimate from them is reviewed after it.
    """

    drive: Drive
    tracks: Mapping[ObjectId, int]
    dynamic: Mapping[ObjectId, DynamicObject]
    at_end: bool = False

    def motion(self, drive: Drive) -> DriveMotion:
        """Motion of the LiDAR and the objects; drive: this one, with some of its boundary points."""
        return DriveMotion.of(drive).with_objects(self.tracks, self.dynamic)


class Window:
    """Bounded buffers of one drive; scans are numbered from 0 and never twice.

    Attributes:
        size: most scans, but while nothing may leave.
        sampled: latest scans of which the sample of labelled points is kept: the search uses no others.
        growing: no scan leaves; afterwards two leave with each that comes, until ``size`` are left.
        tracks: track of each (class, object) of a scan, by the scan's number.
        poses: of each scan in the world.
        dynamics: which objects are dynamic.
        image_pairs: what consecutive images show of the camera's motion, where that is asked for.
        labelled_ns: stamps of the scans and of the images that have labels, where edges are aligned, too.
        next_image: number of the next image; images are numbered by ``index`` as they come, never twice.
        origin_ns: stamp of the first image, from which a clock's skew counts; None before there is one.
    """

    def __init__(
        self,
        camera: PinholeCamera,
        scans: int,
        sampled: int | None = None,
        classes: Collection[SemanticClass] = (),
    ) -> None:
        """classes: that are aligned."""
        self.camera = camera
        self.edges, self.labels = by_edges(classes), by_labels(classes)
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
        self.image_pairs: deque[ImagePair] = deque(maxlen=self.size + 10)
        self.labelled_ns: tuple[set[int], set[int]] = (set(), set())
        self.tracks: dict[int, dict[ObjectName, int]] = {}
        self.poses: dict[int, gtsam.Pose3] = {}
        self.dynamics = DynamicObjectTest()
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

    def seconds_since_scan(self, stamp_ns: int) -> float:
        """Time from the newest scan to a stamp of its clock; 0 where there is none, or for an error."""
        newest = self.last_stamp_ns
        later = 0 if newest is None else stamp_ns - newest
        return 1e-9 * later if 0 < later <= FARTHEST_NS else 0.0

    def latest_step(self) -> tuple[float, float]:
        """Seconds from the scan before to the newest one, and the LiDAR's speed; 0 if unknown [m/s]."""
        if len(self.scans) < 2:
            return 0.0, 0.0
        seconds = 1e-9 * (self.scans[-1][1].stamp_ns - self.scans[-2][1].stamp_ns)
        motion = self.motions[-1] if self.motions else None
        if motion is None or motion.to_ns != self.last_stamp_ns:
            return seconds, 0.0
        return seconds, float(np.linalg.norm(motion.aTb.translation())) / seconds

    def lacking_labels(self) -> str:
        """A sentence: the latest images, or scans, show no object of the classes that are aligned while the
        other sensor's do; empty where both do, or none does, or edges are aligned."""
        images = _without([image.contours for image in self.images])
        scans = _without([scan.boundaries for _, scan in self.scans])
        if self.edges or (images > 0) == (scans > 0):
            return ""
        count, what, other = (images, "image", "scans") if images else (scans, "scan", "images")
        return f"the latest {count_of(count, what)} without labels of objects, which the {other} have"

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
        if self.edges:
            if self.labels and features.by_geometry is not None:
                self.labelled_ns[0].add(features.stamp_ns)
            features = both_kinds(features)
        lean = dataclasses.replace(
            features, depth_lPs=features.depth_lPs[:0], depth_offsets_s=features.depth_offsets_s[:0]
        )
        # Edges keep no more points than are matched.
        few = thinned_scan(lean, POINTS_A_SCAN, (SemanticClass.OBJECT,)) if self.edges else lean
        self.scans.append((number, few))
        self._thin_out()
        self.tracks[number] = self.objects.add(features.boundaries, self.wTl)
        self.dynamics.add(number, lean, self.tracks[number], self.wTl, self.first_scan)
        self.poses[number] = self.wTl
        for old in [k for k in self.tracks if k < self.first_scan]:
            del self.tracks[old], self.poses[old]
        self.labelled_ns[0].intersection_update(scan.stamp_ns for _, scan in self.scans)
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

    def left_out(
        self, number: int, tau_s: float, reach_m: float
    ) -> frozenset[tuple[SemanticClass, int, int]]:
        """The dynamic objects of a scan, with the tenths of their weight that they lose in an interval."""
        found = self.dynamics.dynamic_objects(number)
        speeds = np.array([one.unknown_mps for one in found.values()])
        weights = dynamic_object_weights(speeds, np.array([tau_s]), reach_m).tolist()
        lost = [(c, name, round(10.0 * (1.0 - w))) for (c, name), w in zip(found, weights, strict=True)]
        return frozenset(entry for entry in lost if entry[2] > 0)

    def latest(self, most: int) -> tuple[Stretch, list[int]]:
        """The last scans, where edges are aligned with their objects; and the scans' numbers."""
        drive, numbers = self.drive()
        scans, numbers = drive.scans[-most:], numbers[-most:]
        motions = tuple(m for m in drive.lidar_motions if m.from_ns >= scans[0].stamp_ns)
        part = dataclasses.replace(drive, scans=scans, lidar_motions=motions)
        objects = self.objects_of(numbers) if self.edges else ({}, {})
        return Stretch(part, *objects), numbers

    def objects_of(self, numbers: Sequence[int]) -> tuple[dict[ObjectId, int], dict[ObjectId, DynamicObject]]:
        """Tracks of the objects of some scans, and the dynamic ones, by the scan's position."""
        tracks: dict[ObjectId, int] = {}
        dynamic: dict[ObjectId, DynamicObject] = {}
        for position, number in enumerate(numbers):
            tracks.update({(position, c, n): track for (c, n), track in self.tracks[number].items()})
            found = self.dynamics.dynamic_objects(number)
            dynamic.update({(position, c, n): one for (c, n), one in found.items()})
        return tracks, dynamic

    def add_image(self, features: ImageFeatures, pair: ImagePair | None = None) -> None:
        """Keep an image, with a number of its own, in the order of stamps.

        Args:
            pair: what it shows, with the image before it, of the camera's motion.

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
        if pair is not None:
            self.image_pairs.append(pair)
        if self.edges and self.labels and (features.mask != int(SemanticClass.IGNORE)).any():
            self.labelled_ns[1].add(features.stamp_ns)

    def forget_images(self, offset_ns: int, margin_ns: int, most: int) -> None:
        """Drop images that no scan can meet: those near the window's scans stay, and the newest ones.

        Args:
            offset_ns: from the images' clock to the scans'.
            margin_ns: how far from a scan of the window, or behind the newest image, an image may lie.
            most: of all; beyond it the oldest go, whatever scan they are near. Two always stay.
        """
        if not self.images:
            return
        newest = self.images[-1].stamp_ns
        # By the images' clock, which may be far from the scans'.
        stamps = [scan.stamp_ns - offset_ns for _, scan in self.scans] or [newest]
        kept = [
            image
            for image in self.images
            if stamps[0] - margin_ns <= image.stamp_ns <= stamps[-1] + margin_ns
            or image.stamp_ns >= newest - margin_ns
        ]
        if len(kept) < 2:
            kept = self.images[-2:]
        self.images = kept[-max(2, most) :]
        self.labelled_ns[1].intersection_update(image.stamp_ns for image in self.images)

    def forget_images_before(self, number: int) -> None:
        """Drop all images that came before the one of a number."""
        self.images = [image for image in self.images if image.index >= number]

    def keep_scans(self, last: int) -> None:
        """Forget all scans but the last few."""
        while len(self.scans) > last:
            self.scans.popleft()
        self.dynamics.occupancy.forget(self.first_scan)

    def frame(self, number: int) -> int:
        """Number, in the drive, of the frame of a scan that is kept."""
        return next(scan.index for own, scan in self.scans if own == number)

    def stamps_ns(self) -> dict[int, int]:
        """Stamp of each scan by its number."""
        return {number: scan.stamp_ns for number, scan in self.scans}

    def drive(self, chosen: Collection[int] | None = None) -> tuple[Drive, list[int]]:
        """The window as a drive, and the numbers of its scans; or some of its scans, under all motions."""
        kept = [(number, scan) for number, scan in self.scans if chosen is None or number in chosen]
        numbers, scans = [number for number, _ in kept], [scan for _, scan in kept]
        motions = tuple(self.motions)
        if chosen is None and scans:
            # As in a drive: the k-th motion leads from the k-th scan to the next.
            motions = tuple(motion for motion in motions if motion.from_ns >= scans[0].stamp_ns)
        images = tuple(self.images)
        # Images are forgotten on their own.
        stamps = {image.stamp_ns for image in images}
        pairs = (
            pair for pair in self.image_pairs if stamps.issuperset((pair.tracks.from_ns, pair.tracks.to_ns))
        )
        drive = Drive(
            "window",
            self.camera,
            tuple(scans),
            images,
            motions,
            tuple(pairs),
            origin_ns=self.origin_ns,
            labelled_ns=(frozenset(self.labelled_ns[0]), frozenset(self.labelled_ns[1])),
        )
        return drive, numbers


def _without(shown: Sequence[Sized]) -> int:
    """How many of the last ones are empty."""
    filled = [k for k, own in enumerate(shown) if len(own)]
    return len(shown) - 1 - filled[-1] if filled else len(shown)

"""The last scans, images and motions: what the tracker can still match anew."""

from __future__ import annotations

import dataclasses
from collections import deque
from collections.abc import Callable

import gtsam
import numpy as np

from factors.camera import PinholeCamera
from sst_graph.errors import DataError
from sst_graph.problem.drive import Drive, ImageFeatures, ScanFeatures
from sst_graph.problem.objects import ObjectTracker
from sst_graph.types import RelativeMotion, SemanticClass

OBJECT_MEMORY = 50
"""Scans after which an object that was not seen again is another one."""


class Window:
    """Bounded buffers of one drive; scans are numbered from 0 and never twice."""

    def __init__(self, camera: PinholeCamera, scans: int) -> None:
        self.camera = camera
        self.scans: deque[tuple[int, ScanFeatures]] = deque(maxlen=scans)
        self.images: list[ImageFeatures] = []
        self.motions: deque[RelativeMotion] = deque(maxlen=scans + 10)
        self.tracks: dict[int, dict[tuple[SemanticClass, int], int]] = {}
        self.objects = ObjectTracker(memory=OBJECT_MEMORY)
        self.next_scan = 0
        self.wTl = gtsam.Pose3()

    @property
    def first_scan(self) -> int:
        """Number of the oldest scan, or the next one where there is none."""
        return self.scans[0][0] if self.scans else self.next_scan

    @property
    def last_stamp_ns(self) -> int | None:
        """Stamp of the newest scan."""
        return self.scans[-1][1].stamp_ns if self.scans else None

    def add_scan(self, features: ScanFeatures, motion: RelativeMotion | None) -> int:
        """Keep a scan and the motion that led to it; its number."""
        number = self.next_scan
        self.next_scan += 1
        if motion is not None:
            self.motions.append(motion)
            self.wTl = self.wTl.compose(motion.aTb)
        lean = dataclasses.replace(
            features, depth_lPs=features.depth_lPs[:0], depth_offsets_s=features.depth_offsets_s[:0]
        )
        self.scans.append((number, lean))
        self.tracks[number] = self.objects.add(features.boundaries, self.wTl)
        for old in [k for k in self.tracks if k < self.first_scan]:
            del self.tracks[old]
        return number

    def add_image(self, features: ImageFeatures) -> None:
        """Keep an image in the order of stamps.

        Raises:
            DataError: one with this stamp is there already.
        """
        stamps = [image.stamp_ns for image in self.images]
        place = int(np.searchsorted(stamps, features.stamp_ns))
        if place < len(stamps) and stamps[place] == features.stamp_ns:
            raise DataError("tracker", f"a second image of stamp {features.stamp_ns} ns", "one image a stamp")
        self.images.insert(place, features)

    def forget_images(self, before_ns: int) -> None:
        """Drop images of a camera stamp before ``before_ns``, but never the newest two."""
        while len(self.images) > 2 and self.images[0].stamp_ns < before_ns:
            del self.images[0]

    def keep_scans(self, last: int) -> None:
        """Forget all scans but the last few."""
        while len(self.scans) > last:
            self.scans.popleft()

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
        drive = Drive("window", self.camera, tuple(scans), tuple(self.images), motions, ())
        return drive, numbers

"""Input of the tracker: data are checked, features and motion extracted and kept."""

from __future__ import annotations

import dataclasses
import zlib
from collections import deque
from typing import Any, TypeVar

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.drive.geometric_labels import labelled_by_geometry
from sst_graph.drive.input_statistics import shows_something
from sst_graph.drive.preparation import TRACK_INTERVAL_S, image_features, scan_features
from sst_graph.drive.stamp_intervals import Jump, StampMonitor
from sst_graph.errors import DataError
from sst_graph.factors.camera import PinholeCamera
from sst_graph.odometry.features import FeatureTracker
from sst_graph.odometry.lidar import LidarOdometry
from sst_graph.odometry.visual import ImagePair, next_pair
from sst_graph.tracker.by_edges.kinds import by_edges
from sst_graph.tracker.config import TrackerConfig
from sst_graph.tracker.estimate import OnlineEstimate
from sst_graph.tracker.storage.resume import SeenFrames
from sst_graph.tracker.window.window import FARTHEST_NS, Window
from sst_graph.types import CameraImage, Scan
from sst_graph.validation import checked_image, checked_scan

_Data = TypeVar("_Data", Scan, CameraImage)

_CLOSEST_NS = 1_000_000
"""Scans that are nearer to each other are one; no LiDAR turns a thousand times a second [ns]."""
_ELSEWHERE = 5
"""Stamps in a row, rising but far from those before, that show that the clock was set."""
_MAX_IMAGES = 600
"""Most images that are kept, for any number of them may come while no scan does: a minute at 10 Hz."""
_MAX_EDGE_IMAGES = 100
"""Most images that are kept where edges are aligned: the gradients of a picture take 8.5 bytes a pixel."""
_MAX_FAILURES = 10
"""Failures in a row after which the window is given up: it is then their likely cause."""
_MOVED_M, _FASTEST_STOP_MPS = 0.05, 2.0
"""Motion after which a picture is another one [m]; and the speed from which no vehicle stops within a
scan: it would brake with 20 m/s^2 at 10 Hz [m/s]."""
_SEARCH_MARGIN_S = 1.0
"""Images farther from a scan are kept, too, until the time offset is known [s]."""


class StampOrder:
    """Whether a sensor's stamps go on from those before.

    A single stamp that is out of order, or a day ahead, is refused; several in a row mean that the clock was
    set, else every later frame would be refused.

    Attributes:
        newest_ns: latest stamp that was used; None before the first.
    """

    def __init__(self, sensor: str, may_be_late: bool) -> None:
        """may_be_late: stamps before the newest are allowed."""
        self.sensor, self.may_be_late = sensor, may_be_late
        self.newest_ns: int | None = None
        self._elsewhere: deque[int] = deque(maxlen=_ELSEWHERE)

    def __getstate__(self) -> dict[str, Any]:
        """All but the stamps that were refused."""
        return {**vars(self), "_elsewhere": deque(maxlen=_ELSEWHERE)}

    def check(self, stamp_ns: int) -> int:
        """Whether a stamp may be used; nothing but a refusal is remembered.

        Returns:
            0, or by how much the clock was set [ns].

        Raises:
            DataError: it is out of place; those after it may show that the clock was set.
        """
        newest = self.newest_ns
        if newest is None or self._follows(stamp_ns, newest):
            return 0
        found = f"a stamp of {stamp_ns} ns"
        return self.step(stamp_ns, DataError(self.sensor, found, f"one after {newest} ns, by a day at most"))

    def step(self, stamp_ns: int, refusal: DataError) -> int:
        """By how much the clock was set, as a stamp out of place and those before it show [ns].

        Raises:
            DataError: the refusal, until they do.
        """
        newest, elsewhere = self.newest_ns, self._elsewhere
        if elsewhere and not _CLOSEST_NS <= stamp_ns - elsewhere[-1] <= FARTHEST_NS:
            elsewhere.clear()
        elsewhere.append(stamp_ns)
        if len(elsewhere) < _ELSEWHERE or newest is None:
            raise refusal
        return stamp_ns - newest

    @property
    def first_elsewhere_ns(self) -> int:
        """The first of the stamps that show that the clock was set [ns]."""
        return self._elsewhere[0]

    def add(self, stamp_ns: int, restarted: bool) -> None:
        """A stamp was used; ``restarted``: the stamps go on from there."""
        newest = self.newest_ns
        self.newest_ns = stamp_ns if restarted or newest is None else max(newest, stamp_ns)
        self._elsewhere.clear()

    def _follows(self, stamp_ns: int, before_ns: int) -> bool:
        step = stamp_ns - before_ns
        return step <= FARTHEST_NS and (self.may_be_late or step >= _CLOSEST_NS)


def _with_own_arrays(data: _Data) -> _Data:
    """A scan or an image that is kept: the caller may fill its arrays anew, as drivers do."""
    arrays: dict[str, Any] = {
        name: value.copy() for name, value in vars(data).items() if isinstance(value, np.ndarray)
    }
    return dataclasses.replace(data, **arrays)


class FrozenSensors:
    """Whether a sensor delivers its last frame again while the vehicle moves: no sensor measures the same
    twice, to the last bit.

    Attributes:
        image: digest of the latest picture that was used, 0 of one that shows nothing; the LiDAR's pose then.
        scan: digest of the latest scan that was used; the LiDAR's speed then [m/s].
    """

    def __init__(self) -> None:
        self.image, self.scan = (0, gtsam.Pose3()), (0, 0.0)

    def check_image(self, image: CameraImage, wTl: gtsam.Pose3) -> None:
        """Refuse an image that the LiDAR's motion since the one before contradicts.

        Raises:
            DataError: it does.
        """
        before, place = self.image
        moved_m = float(np.linalg.norm(place.between(wTl).translation()))
        if before and moved_m > _MOVED_M and before == _of_picture(image):
            found = f"the picture before once more, to the last bit, after {moved_m:.1f} m (a frozen camera)"
            raise DataError("image", found, "a new one: look at the camera's driver and its recording")

    def check_scan(self, scan: Scan) -> None:
        """Refuse a scan that would be the last one of a vehicle that stops at once.

        Raises:
            DataError: it would.
        """
        before, speed_mps = self.scan
        if before and speed_mps > _FASTEST_STOP_MPS and before == _digest(scan.points):
            found = f"the scan before once more, to the last bit, at {speed_mps:.0f} m/s (a frozen LiDAR)"
            raise DataError("scan", found, "a new one: look at the LiDAR's driver and its recording")

    def add_image(self, image: CameraImage, wTl: gtsam.Pose3) -> None:
        """An image was used."""
        shown = _of_picture(image)
        if shown != self.image[0]:
            self.image = shown, wTl

    def add_scan(self, scan: Scan, speed_mps: float) -> None:
        """A scan was used."""
        shown = _digest(scan.points) if len(scan.points) else 0
        if shown != self.scan[0]:
            self.scan = shown, speed_mps


def _digest(array: NDArray[Any]) -> int:
    """Checksum of every fourth row: noise is in all of them."""
    return zlib.crc32(np.ascontiguousarray(array[::4]).data)


def _of_picture(image: CameraImage) -> int:
    """Digest of the picture; 0 of one that shows nothing. Labels of what is far away may stay the same."""
    return _digest(image.pixels) if shows_something(image) else 0


class SensorInputs:
    """The latest scans and images, the LiDAR's motion, and the stamps of both sensors.

    Attributes:
        camera: of the images.
        window: latest scans and images, reduced to what matching needs.
        odometry: of the LiDAR.
        stamps: intervals of both sensors' stamps.
        image_order, scan_order: which stamps may come next.
        frozen: whether a sensor repeats its last frame.
        seen: by which a drive is recognized when a tracker is resumed.
        last_scan: the newest scan.
        failures: why scans or images in a row could not be used.
    """

    def __init__(self, camera: PinholeCamera, config: TrackerConfig, searched_scans: int) -> None:
        """searched_scans: latest scans that a start may be made of."""
        self.camera, self.config = camera, config
        self.window = Window(camera, config.window, searched_scans, config.calibration.classes)
        self.image_order, self.scan_order = StampOrder("image", True), StampOrder("scan", False)
        self.seen = SeenFrames()
        self.last_scan: Scan | None = None
        self.failures: deque[str] = deque(maxlen=_MAX_FAILURES)
        self._restart_motion()

    def __getstate__(self) -> dict[str, Any]:
        """All but the failures."""
        return {**vars(self), "failures": deque(maxlen=_MAX_FAILURES)}

    def restart(self) -> None:
        """Forget scans, images and motion so far."""
        self._restart_motion()
        self.window.restart()

    def _restart_motion(self) -> None:
        self.odometry = LidarOdometry(self.config.calibration.lidar_odometry)
        self.stamps = StampMonitor(self.config.alarm.chi2)
        self.image_features = FeatureTracker()
        self.frozen = FrozenSensors()

    def check_image(self, image: CameraImage, time_offset_s: float) -> tuple[CameraImage, int]:
        """The image as it may be used, and by how much its clock was set, 0 if it was not [ns].

        Raises:
            DataError: it cannot be used.
        """
        checked = checked_image(image, self.camera)
        clock_step_ns = self.image_order.check(checked.stamp_ns)
        if not clock_step_ns and (too_late := self._too_late(checked, time_offset_s)):
            clock_step_ns = self.image_order.step(checked.stamp_ns, too_late)
        if self.image_order.newest_ns is not None and checked.stamp_ns > self.image_order.newest_ns:
            self.frozen.check_image(checked, self.window.wTl)
        return _with_own_arrays(checked), clock_step_ns

    def check_scan(self, scan: Scan) -> tuple[Scan, int]:
        """The scan as it may be used, and by how much its clock was set, 0 if it was not [ns].

        Raises:
            DataError: it cannot be used.
        """
        checked = checked_scan(scan)
        clock_step_ns = self.scan_order.check(checked.stamp_ns)
        self.frozen.check_scan(checked)
        return _with_own_arrays(checked), clock_step_ns

    def add_image(self, image: CameraImage, clock_step_ns: int, estimate: OnlineEstimate) -> None:
        """Put a checked image's contours into the window."""
        if clock_step_ns:
            self.window.forget_images_before(self.window.next_image)
            self.stamps.set_image_clock(
                self.image_order.first_elsewhere_ns, image.stamp_ns, self.window.place
            )
        else:
            self.stamps.add_image(image.stamp_ns, self.window.place)
        self.image_order.add(image.stamp_ns, clock_step_ns != 0)
        self.frozen.add_image(image, self.window.wTl)
        calibration = self.config.calibration
        features = image_features(self.window.next_image, image, calibration.classes, calibration.image_edges)
        self.window.add_image(features, self._image_motion(image, estimate))
        self._forget_images(estimate)
        self.seen.add(image)

    def add_scan(
        self, scan: Scan, clock_step_ns: int, estimate: OnlineEstimate, frame: int | None = None
    ) -> Jump | None:
        """Put a checked scan's boundary points and motion into the window; a jump of the stamps, if any.

        Args:
            frame: its number in the drive; None: scans are counted as they come.
        """
        self.scan_order.add(scan.stamp_ns, clock_step_ns != 0)
        if clock_step_ns:
            self.restart()
        jump = self.stamps.add_scan(scan.stamp_ns, self.window.place)
        calibration = self.config.calibration
        prepare = dataclasses.replace(calibration.prepare, use_visual_odometry=False)
        used = calibration.lower_edges != "never"
        by_geometry = calibration.method == "edges"
        labelled = labelled_by_geometry(scan) if by_geometry else scan
        index = self.window.next_scan if frame is None else frame
        features = scan_features(index, labelled, calibration.classes, prepare, with_lower_edges=used)
        self.window.add_scan(features, self.odometry.add(labelled))
        self.frozen.add_scan(scan, self.window.latest_step()[1])
        self.last_scan = scan
        self._forget_images(estimate)
        self.seen.add(scan)
        self.failures.clear()
        alarm = self.config.alarm
        return jump if alarm.enabled and alarm.stamps else None

    def _too_late(self, image: CameraImage, time_offset_s: float) -> DataError | None:
        """The refusal of an image that is far behind the newest scan in true time."""
        newest, images = self.window.last_stamp_ns, self.window.images
        if newest is None or not images:
            return None
        late_s = (newest - image.stamp_ns) * 1e-9 - time_offset_s
        if late_s <= self.config.late_s or image.stamp_ns >= images[-1].stamp_ns:
            return None
        found = f"one {late_s:.2f} s behind the newest scan"
        return DataError("image", found, f"at most {self.config.late_s:g} s")

    def _image_motion(self, image: CameraImage, estimate: OnlineEstimate) -> ImagePair | None:
        """What an image shows of the camera's motion: a start by edges needs it, nothing else does."""
        if not by_edges(self.config.calibration.classes) or estimate.exists:
            self.image_features = FeatureTracker()
            return None
        return next_pair(self.image_features, image, self.camera, TRACK_INTERVAL_S)

    def failed(self, why: str) -> bool:
        """Note why a scan or an image could not be used; whether that has gone on for too long."""
        self.failures.append(why)
        return len(self.failures) == self.failures.maxlen

    def _forget_images(self, estimate: OnlineEstimate) -> None:
        """Drop the images that no scan, present or to come, can be paired with."""
        offset_s = estimate.point.time_offset_s
        margin_s = self.config.late_s + (0.0 if estimate.exists else _SEARCH_MARGIN_S)
        most = _MAX_EDGE_IMAGES if by_edges(self.config.calibration.classes) else _MAX_IMAGES
        self.window.forget_images(round(1e9 * offset_s), round(1e9 * margin_s), most)

"""Calibration frame by frame: :class:`Tracker`."""

from __future__ import annotations

import dataclasses
import logging
from collections import deque
from collections.abc import Callable, Container
from functools import partial
from typing import Any

import gtsam
import numpy as np

from sst_graph.errors import DataError, EstimationError
from sst_graph.factors.camera import PinholeCamera
from sst_graph.files.object_store import lay_out
from sst_graph.initialization.selection import narrowed
from sst_graph.tracker.config import TrackerConfig
from sst_graph.tracker.history import HistoryEntry
from sst_graph.tracker.marginal import TrackedMarginal, increment, tracked_marginal
from sst_graph.tracker.start.solution import Guess
from sst_graph.tracker.start.steps import EXPECTED
from sst_graph.tracker.status import Known
from sst_graph.tracker.storage.resume import FirstFrames, Setup
from sst_graph.tracker.storage.snapshot import Snapshot
from sst_graph.tracker.track_update import Sensor, TrackUpdate
from sst_graph.tracker.update import Tracking
from sst_graph.tracker.window.relinearization import relinearize_window
from sst_graph.types import CameraImage, Frame, Scan
from sst_graph.validation import LATEST_NS, checked_image, checked_scan

_LOG = logging.getLogger(__name__)

_MOST_FAILURES = 10
"""After so many scans or images in a row that could not be taken in, what is kept is the likely reason."""


class Tracker(Tracking):
    """Extrinsic and time offset of one LiDAR and one camera, frame by frame.

    Frames, or scans and images on their own, come in the order of their stamps (images may come a little
    late). Nothing that they bring raises: what cannot be used, whatever its arrays hold, leaves everything as
    it was, and the answer says why.
    """

    def __init__(
        self,
        camera: PinholeCamera,
        config: TrackerConfig | None = None,
        initial: gtsam.Pose3 | None = None,
        initial_offset_s: float = 0.0,
    ) -> None:
        """initial: rough guess of cTl, or None when nothing is known; the offset's beside it [s]."""
        config = config or TrackerConfig()
        super().__init__(camera, config, Guess(initial, initial_offset_s))
        self.setup = Setup(camera, config, initial, initial_offset_s)
        self.first_frames = FirstFrames()
        self.failures: deque[str] = deque(maxlen=_MOST_FAILURES)
        self.settled = False

    @property
    def newest_ns(self) -> int | None:
        """Stamp of the newest scan that was taken in [ns]."""
        return self.scan_order.newest_ns

    def __getstate__(self) -> dict[str, Any]:
        """All but what failed."""
        return {**vars(self), "failures": deque(maxlen=_MOST_FAILURES)}

    def add(self, frame: Frame) -> TrackUpdate:
        """Take in a frame; its image, or its scan, may be missing, and either may be refused alone."""
        if not isinstance(frame, Frame) or (frame.image is None and frame.scan is None):
            return self.answer(0, "a frame without scan and without image")
        of_image = None if frame.image is None else self.add_image(frame.image)
        if frame.scan is None:
            assert of_image is not None
            return of_image
        update = self.add_scan(frame.scan)
        if of_image is None or of_image.accepted:
            return update
        reason = "; ".join(filter(None, (of_image.reason, update.reason)))
        return dataclasses.replace(
            update, accepted=False, reason=reason, refused=(*of_image.refused, *update.refused)
        )

    def add_image(self, image: CameraImage) -> TrackUpdate:
        """Take in an image; it is used as soon as a scan close to it in true time is there."""
        try:
            checked = checked_image(image, self.camera)
            moved_ns = self.image_order.check(checked.stamp_ns)
        except DataError as error:
            return self._refused("image", image, str(error))
        return self._whole("image", checked, partial(self.take_image, checked, moved_ns))

    def add_scan(self, scan: Scan) -> TrackUpdate:
        """Take in a scan, match it and whatever of the window is to be renewed, and estimate."""
        try:
            checked = checked_scan(scan)
            moved_ns = self.scan_order.check(checked.stamp_ns)
        except DataError as error:
            return self._refused("scan", scan, str(error))
        return self._whole("scan", checked, partial(self.take_scan, checked, moved_ns))

    def _whole(
        self, sensor: Sensor, data: Scan | CameraImage, take: Callable[[], TrackUpdate]
    ) -> TrackUpdate:
        """Take in a sensor's data whole; where anything fails, everything is as it was."""
        before = Snapshot(self)
        try:
            self.settled = False
            update = take()
            self.first_frames.take(data)
        except DataError as error:
            before.restore()
            return self._refused(sensor, data, str(error))
        except Exception as error:
            before.restore()
            if not isinstance(error, EXPECTED):
                _LOG.exception("tracker: an error while a %s was taken in", sensor)
            return self._failed(sensor, data, " ".join(f"{type(error).__name__}: {error}".split())[:300])
        except BaseException:
            before.restore()
            raise
        if sensor == "scan":
            self.failures.clear()
        return update

    def _refused(self, sensor: Sensor, data: object, why: str) -> TrackUpdate:
        """The answer to data that are not taken in."""
        stamp_ns = getattr(data, "stamp_ns", 0)
        known = isinstance(stamp_ns, int | np.integer) and abs(int(stamp_ns)) <= LATEST_NS
        return dataclasses.replace(self.answer(int(stamp_ns) if known else 0, why), refused=(sensor,))

    def _failed(self, sensor: Sensor, data: object, why: str) -> TrackUpdate:
        """The answer to data that could not be taken in; if that goes on, the window is given up."""
        self.failures.append(why)
        if len(self.failures) == self.failures.maxlen:
            _LOG.warning("tracker: begins anew after %d failures: %s", len(self.failures), why)
            self.forget_all(Guess(self.point.cTl, self.point.offset_s, self.guess.search))
            why = f"{why}; the tracker begins anew"
        return self._refused(sensor, data, why)

    def current(self, after: TrackUpdate | None = None) -> TrackUpdate:
        """The present estimate as an answer, without a frame.

        Args:
            after: answer to the last frame; what it says of that frame stays.
        """
        update = dataclasses.replace(self.answer(self.window.last_stamp_ns or 0), settled=self.settled)
        if after is None:
            return update
        of_frame = ["stamp_ns", "refused", "chi2", "alarm", "adopted"]
        if after.covariance is not None or update.covariance is None or after.refused:
            of_frame += ["accepted", "reason"]
        return dataclasses.replace(update, **{name: getattr(after, name) for name in of_frame})

    def marginal(self) -> TrackedMarginal:
        """What is known so far of extrinsic and time offset, as a factor for a graph of one's own.

        Linearized at the estimate, as sure as the reported covariance: parameters of assumptions that are
        estimated are marginalized out, those that are not are considered.

        Raises:
            EstimationError: there is no estimate yet.
        """
        if self.smoother is None:
            raise EstimationError("the tracker has no estimate yet: no marginal")
        return tracked_marginal(self.point.cTl, self.point.offset_s, self.reported(), self.starts)

    def marginal_since(self, previous: TrackedMarginal) -> TrackedMarginal:
        """What to add to an earlier marginal for the present one: nothing counts twice.

        ``known = tracker.marginal()`` once; then, whenever wanted, ``more = tracker.marginal_since(known)``
        into the graph and ``known = known.plus(more)``. All parts are linearized at the first one's point,
        and their sum is the tracker's information. A part alone may be negative in some direction: frames
        may also show that less is known than it seemed.

        Args:
            previous: an earlier marginal of this tracker, with what was added since.

        Raises:
            EstimationError: there is no estimate, or the calibration has changed since: take the parts told
                before out of the graph, and begin with :meth:`marginal`.
        """
        whole = self.marginal()
        if previous.start != whole.start:
            raise EstimationError(
                f"found a marginal of start {previous.start}, expected one of start {whole.start}: "
                "the calibration has changed since"
            )
        return increment(whole, previous)

    def history(self) -> list[HistoryEntry]:
        """The calibration of every epoch, smoothed over all of them, with covariances (drift mode)."""
        if self.smoother is None:
            return []
        entries = self.history_store.smoothed(self.smoother)
        beside = self.considered().covariance(7)
        return [dataclasses.replace(entry, covariance=entry.covariance + beside) for entry in entries]

    def consolidate(self, laid_out: Container[int] = ()) -> None:
        """Begin iSAM2 and the odometry's map anew from what a checkpoint holds.

        The estimate stays; from here on this tracker and one loaded from a checkpoint of it go on alike.

        Args:
            laid_out: ids of values that have their memory layout already.
        """
        lay_out(self, laid_out)
        self.odometry.rebuild_map()
        if self.smoother is not None:
            self.smoother.relinearize()

    def settle(self, most: int = 20) -> bool:
        """Solve the whole window again as the batch does, as at the end of a drive.

        A start that is not done yet is brought to its end first.

        Returns:
            Whether it rests: the last whole step was below 0.02 standard deviations.
        """
        joint = self.config.calibration.joint
        at_last = self.smoother is None and self._finish_start()
        smoother = self.smoother
        if smoother is None:
            return False
        self.stop_relinearization()
        self.window.test_all_objects()
        self.matcher.check_lower_edges(smoother.point)
        alive = self.window.objects.live
        try:
            rests = relinearize_window(
                smoother, self.matcher, narrowed(joint).kernel_px, most, joint.full_steps, alive, self._share
            )
            self.known = Known.of(smoother)
            self.tests.look(smoother)
        except EstimationError as error:
            _LOG.warning("tracker: not settled: %s", error)
            return False
        self.entered.extend(set(smoother.entries) - set(self.entered))
        if at_last:
            self.trial.look_last(self.watch, smoother, self.known, self.window.recently_moving())
        self.settled = True
        return rests

    def _finish_start(self) -> bool:
        """All that is left of a start, where one can be made; whether there is an estimate."""
        try:
            started = self.starting.finish(self.matcher)
        except EXPECTED as error:
            _LOG.warning("tracker: no start: %s", error)
            return False
        if started is not None:
            self.begin(started, self.window.last_stamp_ns or 0)
        return self.started

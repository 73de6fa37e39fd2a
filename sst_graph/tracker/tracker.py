"""Calibration frame by frame: :class:`Tracker`."""

from __future__ import annotations

import dataclasses
import logging
from pathlib import Path

import gtsam
import numpy as np

from sst_graph.config import expect_settings
from sst_graph.drive.stamp_intervals import Jump
from sst_graph.errors import DataError, EstimationError, one_line
from sst_graph.factors.arguments import checked_count, checked_type, is_whole
from sst_graph.factors.camera import PinholeCamera
from sst_graph.floating_point import with_usual_errors
from sst_graph.marginal import inverse
from sst_graph.odometry.sweep import SweepDecision
from sst_graph.result import UNNAMED_CAMERA, CalibrationResult
from sst_graph.timestamps import LATEST_NS
from sst_graph.tracker.config import TrackerConfig
from sst_graph.tracker.estimate import FrameMatches, OnlineEstimate
from sst_graph.tracker.inputs import SensorInputs
from sst_graph.tracker.marginal import TrackedMarginal, increment
from sst_graph.tracker.monitor.monitor import Monitor
from sst_graph.tracker.result import tracker_result
from sst_graph.tracker.spread_work import NUMERICAL_ERRORS
from sst_graph.tracker.start.first_estimate import StartGuess
from sst_graph.tracker.start.initializer import (
    Initialization,
    Initializer,
    Restart,
    searched_scans,
)
from sst_graph.tracker.storage.checkpoint import Saver, load_checkpoint
from sst_graph.tracker.storage.resume import Setup
from sst_graph.tracker.storage.snapshot import Snapshot
from sst_graph.tracker.track_update import Sensor, TrackUpdate, current_update, make_update
from sst_graph.tracker.window.matcher import WindowMatcher
from sst_graph.types import CameraImage, Frame, Scan
from sst_graph.validation import checked_frame, checked_guess, checked_index, checked_intrinsics

_LOG = logging.getLogger(__name__)


class Tracker:
    """Extrinsic and time offset of one LiDAR and one camera, frame by frame.

    Frames, or scans and images on their own, come in the order of their stamps (images may come a little
    late). No input raises: what cannot be used leaves everything as it was, and the update says why.

    Attributes:
        setup: camera, settings and guess that it was made with.
        inputs: latest scans and images, odometry, stamps.
        matcher: matches of the latest scans.
        initializer: the start that is being made.
        estimate: extrinsic, time offset and their covariance.
        monitor: whether the calibration has changed, and which one to use.
        last_update: of the last frame, scan or image that was given, or None.
    """

    def __init__(
        self,
        camera: PinholeCamera,
        config: TrackerConfig | None = None,
        initial: gtsam.Pose3 | None = None,
        initial_time_offset_s: float = 0.0,
        sweep: SweepDecision | None = None,
    ) -> None:
        """
        Args:
            camera: of all images.
            config: settings; the defaults fit driving data.
            initial: rough guess of cTl, or None when nothing is known.
            initial_time_offset_s: rough guess of the time offset [s].
            sweep: what was decided of the sweep of the scans (``SweptSource.sweep_decision``). Undecided, its
                effect is in the covariance, and where it matters no estimate is ``ok``.

        Raises:
            DataError: no camera, or no guess of two sensors on one vehicle.
            ConfigError: no settings of a tracker.
            FactorError: something else than a decision about the sweep.
        """
        checked_type("sweep", sweep, (SweepDecision, type(None)), "a SweepDecision, or None")
        camera = checked_intrinsics(camera)
        initial, initial_time_offset_s = checked_guess(initial, initial_time_offset_s)
        settings = expect_settings(config, TrackerConfig)
        self.setup = Setup(camera, settings, initial, initial_time_offset_s)
        config = self.setup.config.estimating
        guess = StartGuess(initial, initial_time_offset_s, search=config.calibration.search.enabled)
        self.inputs = SensorInputs(camera, config, searched_scans(config))
        self.matcher = WindowMatcher(self.inputs.window, config)
        self.initializer = Initializer(guess, config)
        self.estimate = OnlineEstimate(self.matcher, config, guess)
        self.estimate.sweep = sweep
        self.monitor = Monitor(self.matcher, config)
        self.last_update: TrackUpdate | None = None

    def add(self, frame: Frame) -> TrackUpdate:
        """Add a frame's image and scan; either may be missing, and either may be refused alone."""
        try:
            frame = checked_frame(frame)
        except DataError as error:
            return make_update(self, 0, str(error))
        if frame.image is None and frame.scan is None:
            return make_update(self, 0, "a frame without scan and without image")
        self.last_update = dataclasses.replace(self._add_sensors(frame), frame=frame.index)
        return self.last_update

    def add_image(self, image: CameraImage) -> TrackUpdate:
        """Add an image; it is used as soon as a scan close to it in true time is there."""
        self.last_update = update = self._use_image(image, with_update=True)
        assert update is not None
        return update

    def add_scan(self, scan: Scan, frame: int | None = None) -> TrackUpdate:
        """Add a scan, and estimate; where anything fails, everything is as it was.

        Args:
            frame: its number in the drive, by which the result names it; None: scans are counted.
        """
        self.last_update = update = self._use_scan(scan, frame)
        return update

    @with_usual_errors
    def optimize(self, max_iterations: int = 20) -> TrackUpdate:
        """Solve the whole window as the batch does, as at the end of a drive.

        A start that is under way is completed first.

        Args:
            max_iterations: under the narrowest kernel.

        Returns:
            The last frame's update with the solution; ``converged`` says whether it converged.

        Raises:
            FactorError: a number of iterations that is none.
        """
        checked_count("max_iterations", max_iterations)
        at_end = not self.estimate.exists and self._finish_start()
        converged = self.estimate.optimize(max_iterations)
        if converged is not None and (at_end or self.estimate.edges is not None):
            self.monitor.check_start_at_end(self.estimate)
        return dataclasses.replace(current_update(self, self.last_update), converged=converged)

    @with_usual_errors
    def result(self, drive: str = "stream", camera_name: str = UNNAMED_CAMERA) -> CalibrationResult:
        """The present estimate as a calibration result; the frames used are those of the window."""
        return tracker_result(self, drive, camera_name)

    @with_usual_errors
    def marginal(self, since: TrackedMarginal | None = None) -> TrackedMarginal:
        """The marginal on extrinsic and time offset, as a factor for a graph of your own.

        Linearized at the estimate, with the reported covariance: estimated parameters of assumptions are
        marginalized out, those that are not estimated are considered.

        To add it incrementally: ``known = tracker.marginal()`` once; then, whenever wanted,
        ``more = tracker.marginal(since=known)`` into the graph and ``known = known.plus(more)``. All parts
        are linearized at the first one's point, and their sum is the tracker's information. A single part
        may be negative in some direction: frames may also show that the covariance was too small.

        Args:
            since: an earlier marginal of this tracker, with what was added since.

        Raises:
            EstimationError: there is no estimate; or the calibration has changed since: take the earlier
                parts out of the graph, and begin with the whole.
            FactorError: ``since`` is no marginal of a tracker.
        """
        if since is not None:
            checked_type("since", since, TrackedMarginal, "what Tracker.marginal() gave, or None")
        if not self.estimate.exists:
            raise EstimationError("the tracker has no estimate yet: no marginal")
        point, starts = self.estimate.point, self.estimate.starts
        information = inverse(self.estimate.reported_covariance(), "covariance of the tracker")
        whole = TrackedMarginal(point.cTl, point.time_offset_s, information, np.zeros(7), start=starts)
        if since is None:
            return whole
        if since.start != whole.start:
            raise EstimationError(
                f"found a marginal of start {since.start}, expected one of start {whole.start}: "
                "the calibration has changed since"
            )
        return increment(whole, since)

    @with_usual_errors
    def save(self, path: str | Path) -> None:
        """Write a checkpoint; a file that exists is replaced in one step.

        iSAM2 and the odometry's map are built again first, so that this tracker and one that is loaded go on
        alike. :class:`~sst_graph.tracker.storage.checkpoint.Saver` spreads the work over frames.

        Raises:
            OSError: it cannot be written; what stood there is untouched.
        """
        with Saver(path) as saver:
            saver.save(self)

    @staticmethod
    @with_usual_errors
    def load(path: str | Path, setup: Setup | None = None, sweep: SweepDecision | None = None) -> Tracker:
        """The tracker in a checkpoint, at the estimate it was saved with.

        Args:
            setup: camera, settings and guess that it must have been made with; None for any.
            sweep: what was decided of the sweep of the scans to come, as for a new tracker; None: what the
                checkpoint says.

        Raises:
            CheckpointError: no such file, not a checkpoint of this version, or one that was changed or
                damaged.
            DataError: one of a tracker that was made with another camera, other settings or another guess.
            FactorError: something else than a setup, or than a decision about the sweep.
        """
        checked_type("setup", setup, (Setup, type(None)), "the setup of a tracker (Tracker.setup), or None")
        checked_type("sweep", sweep, (SweepDecision, type(None)), "a SweepDecision, or None")
        return load_checkpoint(path, setup, sweep)

    # ------------------------------------------------------------------ steps

    @with_usual_errors
    def _use_image(self, image: CameraImage, with_update: bool) -> TrackUpdate | None:
        """Add an image; the update, which one that was used has only where it is asked for."""
        try:
            # 1. Check the image and its stamp.
            checked, clock_step_ns = self.inputs.check_image(image, self.estimate.point.time_offset_s)
            with Snapshot(self.inputs):
                # 2. Its contours go into the window.
                self.inputs.add_image(checked, clock_step_ns, self.estimate)
                return make_update(self, checked.stamp_ns, sensor="image") if with_update else None
        except Exception as error:
            return self._not_added("image", image, error)

    @with_usual_errors
    def _use_scan(self, scan: Scan, frame: int | None) -> TrackUpdate:
        """Add a scan, and estimate."""
        try:
            # 1. Check the scan, its number and its stamp.
            frame = None if frame is None else checked_index(frame)
            checked, clock_step_ns = self.inputs.check_scan(scan)
            with Snapshot(self):
                # 2. Its boundary points, and the motion that led to it, go into the window.
                jump = self.inputs.add_scan(checked, clock_step_ns, self.estimate, frame)
                # 3. Restart where stamps jumped: earlier frames have another time offset.
                if restart := self._restart_by_stamps(clock_step_ns, jump):
                    return self._restart(restart, checked.stamp_ns)
                # 4. Without an estimate: some work on the initialization.
                if not self.estimate.exists:
                    return self._initialize(checked.stamp_ns)
                # 5. Match new scans, and some of the window again.
                matches = self.estimate.match(self.inputs.window.next_scan - 1)
                # 6. Change detection: compare new frames with the estimate before they are used.
                chi2, change = self.monitor.check(matches, self.estimate)
                if change is not None:
                    return self._restart(change, checked.stamp_ns)
                # 7. Add the matches to the graph, and estimate.
                self.estimate.update(matches)
                # 8. Check the start against later frames; adopt the estimate where held-out frames agree.
                return self._review(matches, checked.stamp_ns, chi2)
        except Exception as error:
            return self._not_added("scan", scan, error)

    def _add_sensors(self, frame: Frame) -> TrackUpdate:
        """Add a frame's image, then its scan."""
        of_image = None if frame.image is None else self._use_image(frame.image, frame.scan is None)
        if frame.scan is None:
            assert of_image is not None
            return of_image
        update = self._use_scan(frame.scan, frame.index)
        if of_image is None:
            return update
        reason = "; ".join(filter(None, (of_image.reason, update.reason)))
        refused = (*of_image.refused, *update.refused)
        return dataclasses.replace(update, accepted=False, reason=reason, refused=refused)

    def _initialize(self, stamp_ns: int) -> TrackUpdate:
        """Do the work of one frame towards a first estimate."""
        try:
            initialization = self.initializer.work(self.matcher)
        except NUMERICAL_ERRORS as error:
            why = one_line(error)
            self.initializer.failed(why)
            return make_update(self, stamp_ns, f"no start yet: {why}")
        if initialization is not None:
            return self._begin(initialization, stamp_ns)
        under_way = self.initializer.under_way
        return make_update(
            self, stamp_ns, "searching for a start" if under_way else "collecting frames for a start"
        )

    def _finish_start(self) -> bool:
        """Complete a start, where one can be made; whether there is an estimate."""
        try:
            initialization = self.initializer.finish(self.matcher)
        except NUMERICAL_ERRORS as error:
            _LOG.warning("tracker: no start: %s", error)
            self.initializer.why = one_line(error)
            return False
        if initialization is not None:
            self._begin(initialization, self.inputs.window.last_stamp_ns or 0)
        return self.estimate.exists

    def _begin(self, initialization: Initialization, stamp_ns: int) -> TrackUpdate:
        """Go on from a first estimate, if the frames that it is made of agree with it."""
        window, why = self.inputs.window, ""
        if initialization.first.reviewed:
            why = self.monitor.changes.check_start(initialization.for_comparison())
        if why:
            return self._restart(Restart(self.initializer.guess, len(window.scans) // 2, why), stamp_ns)
        self.estimate.begin(initialization)
        self.initializer.succeeded()
        self.monitor.begin(window.next_scan)
        return make_update(self, stamp_ns)

    @property
    def _near(self) -> StartGuess:
        """Where the calibration is searched again: at the estimate; at the guess while there is none."""
        point, guess = self.estimate.point, self.initializer.guess
        return StartGuess(point.cTl, point.time_offset_s, guess.search) if self.estimate.exists else guess

    def _restart_by_stamps(self, clock_step_ns: int, jump: Jump | None) -> Restart | None:
        """The restart after a jump of the stamps: a clock was set, or stamps jumped against their
        interval."""
        window, guess = self.inputs.window, self.initializer.guess
        if clock_step_ns:
            moved = f"the scan stamps moved by {1e-9 * clock_step_ns:+.3f} s and go on from there"
            why = f"{moved}: the calibration is estimated again"
            return Restart(self._near, len(window.scans), why, alarm=self.estimate.exists)
        if jump is None:
            return None
        image, scan = jump.place
        images = window.images
        if jump.sensor == "image":
            window.forget_images_before(image)
        since = window.next_scan - scan
        if not self.estimate.exists:
            return Restart(guess, since, jump.sentence)
        changes, compared = self.monitor.changes, self.estimate.for_comparison()
        if changes.offset_held(scan, jump.time_offset_s, compared):
            _LOG.info("tracker: %s, and the time offset has not changed", jump.sentence)
            window.images = images
            return None
        # Most likely the clock was set.
        before = changes.before(scan, compared).point
        near = StartGuess(before.cTl, before.time_offset_s + jump.time_offset_s, search=changes.far)
        return Restart(near, since, jump.sentence, alarm=True, chi2=jump.chi2)

    def _restart(self, restart: Restart, stamp_ns: int) -> TrackUpdate:
        """Give up the estimate and all scans but the last few."""
        level = logging.WARNING if restart.alarm else logging.INFO
        _LOG.log(level, "tracker: estimates again from %d ns on: %s", stamp_ns, restart.reason)
        self.estimate.restart(restart.guess)
        self.monitor.restart()
        self.inputs.window.keep_scans(restart.scans)
        self.initializer.restart(restart.guess, len(self.inputs.window.scans), restart.alarm)
        self.initializer.why = "" if restart.alarm else restart.reason
        return make_update(self, stamp_ns, restart.reason, chi2=restart.chi2, alarm=restart.alarm)

    def _review(self, matches: FrameMatches, stamp_ns: int, chi2: float | None) -> TrackUpdate:
        """The update for a scan that has been used; the estimate is adopted where held-out frames agree."""
        self.monitor.changes.recheck_start(matches.scan, self.estimate.for_comparison())
        reason = "" if matches.new else "no match: no scan met an image that shows the same objects"
        if reason and (lacking := self.inputs.window.lacking_labels()):
            reason = f"{reason} ({lacking})"
        update = make_update(self, stamp_ns, reason, chi2=chi2)
        trusted = bool(matches.new) and update.status == "ok"
        adopted = self.monitor.adoption.propose(self.estimate.point, trusted)
        return dataclasses.replace(update, adopted=adopted)

    def _not_added(self, sensor: Sensor, data: object, error: Exception) -> TrackUpdate:
        """The update for data that could not be used; if that goes on, the window is given up."""
        why = str(error)
        if not isinstance(error, DataError):
            if not isinstance(error, NUMERICAL_ERRORS):
                _LOG.error("tracker: an error while a %s was added", sensor, exc_info=error)
            why = " ".join(f"{type(error).__name__}: {error}".split())[:300]
            if self.inputs.failed(why):
                self.inputs.restart()
                self._restart(Restart(self._near, 0, why), 0)
                why = f"{why}; the calibration is estimated again"
        stamp_ns = data.stamp_ns if isinstance(data, Scan | CameraImage) else 0
        known = is_whole(stamp_ns) and abs(int(stamp_ns)) <= LATEST_NS
        update = make_update(self, int(stamp_ns) if known else 0, why, sensor=sensor)
        return dataclasses.replace(update, refused=(sensor,))

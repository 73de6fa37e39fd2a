"""How scans and images move the tracker's estimate."""

from __future__ import annotations

import dataclasses
import logging
from collections import deque
from functools import partial

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.batch.assumption_tests import contradiction_of, told_by
from sst_graph.batch.lower_edges import without_undersides
from sst_graph.covariance.considered import Considered, considered
from sst_graph.covariance.observability import open_directions
from sst_graph.drive.preparation import ScanFeatures, image_features, scan_features
from sst_graph.drive.stamp_intervals import Clocks, Jump
from sst_graph.factors.camera import PinholeCamera
from sst_graph.odometry.lidar import LidarOdometry
from sst_graph.result import WeakDirection
from sst_graph.tracker.admission import StampOrder, check_lateness
from sst_graph.tracker.assumption_tests import AssumptionTests
from sst_graph.tracker.config import TrackerConfig
from sst_graph.tracker.history import History
from sst_graph.tracker.monitor.adoption import Adoption
from sst_graph.tracker.monitor.comparison import Watch
from sst_graph.tracker.monitor.start_check import Trial
from sst_graph.tracker.start.solution import Guess
from sst_graph.tracker.start.steps import EXPECTED, Started, Starting
from sst_graph.tracker.status import Known
from sst_graph.tracker.track_update import TrackStatus, TrackUpdate
from sst_graph.tracker.window.gaussian import Point
from sst_graph.tracker.window.information_log import InformationLog
from sst_graph.tracker.window.matcher import WindowMatcher
from sst_graph.tracker.window.relinearization import RelinearizationSchedule, WindowRelinearization
from sst_graph.tracker.window.rematching import scans_to_match
from sst_graph.tracker.window.smoother import WindowSmoother
from sst_graph.tracker.window.window import Window
from sst_graph.types import CameraImage, RelativeMotion, Scan

_LOG = logging.getLogger(__name__)

FloatArray = NDArray[np.float64]


class Tracking:
    """The estimate and all that it needs, moved on by checked scans and images.

    An error half way leaves it half way: :class:`~sst_graph.tracker.tracker.Tracker` puts it back.
    """

    def __init__(self, camera: PinholeCamera, config: TrackerConfig, guess: Guess) -> None:
        self.camera = camera
        self.config = config = config.estimating
        calibration = self.config.calibration
        self.classes = calibration.classes
        self.window = Window(camera, config.window, config.searched_scans)
        self.matcher = WindowMatcher(self.window, self.config)
        self.odometry = LidarOdometry(calibration.prepare.lidar_odometry)
        self.last_scan: Scan | None = None
        self.starting = Starting(dataclasses.replace(guess, search=calibration.start.enabled), config)
        self.smoother: WindowSmoother | None = None
        self.known = Known.nothing()
        sigma_px = calibration.joint.graph.object_bias_sigma_px
        self.watch = Watch(self.matcher, self.config.alarm, sigma_px)
        self.clocks = Clocks(self.config.alarm.chi2)
        self.adoption = Adoption(self.config.adoption)
        self.history_store = History(self.config.drift.history)
        self.entered: deque[int] = deque(maxlen=4 * self.config.window)
        self.relinearization_schedule = RelinearizationSchedule(0, self.config.window, self.config.window)
        self.relinearization: WindowRelinearization | None = None
        self.information_log = InformationLog()
        self.trial = Trial(self.config)
        self.tests = AssumptionTests(calibration.assumptions)
        self.doubt = ""
        self.starts = 0
        self.image_order, self.scan_order = StampOrder("image", True), StampOrder("scan", False)

    @property
    def guess(self) -> Guess:
        """Where a start begins, or began."""
        return self.starting.guess

    @property
    def started(self) -> bool:
        """Whether there is an estimate beyond the guess."""
        return self.smoother is not None

    @property
    def point(self) -> Point:
        """The present estimate, or the guess."""
        if self.smoother is not None:
            return self.smoother.point
        guess, names = self.guess, self.estimated_names
        return Point.unbiased(guess.cTl or gtsam.Pose3(), guess.offset_s, self.classes, names)

    @property
    def covariance(self) -> FloatArray:
        """(m, m) of extrinsic [rad, m], time offset [s], mask biases [px] and estimated parameters of
        assumptions; of the first two only, and wide, before the start."""
        return self.known.covariance

    @property
    def adopted(self) -> Point | None:
        """The calibration in use: the last candidate that its covariance and held-out frames spoke for."""
        return self.adoption.adopted

    def reported(self) -> FloatArray:
        """(7, 7) covariance of the present estimate, with what assumptions that may be wrong add to it."""
        return self.covariance[:7, :7] + self.considered().covariance(7)

    def considered(self) -> Considered:
        """How the present estimate follows the assumptions that are not estimated beside it."""
        beside = considered(self.known.steps, self.config.calibration.assumptions)
        return told_by(beside, self.tests.findings)

    @property
    def estimated_names(self) -> tuple[str, ...]:
        """Assumptions whose parameters are estimated."""
        return tuple(name for name, _ in self.config.calibration.assumptions.estimated)

    @property
    def estimated(self) -> dict[str, tuple[float, float]]:
        """Value and deviation of each parameter that is estimated, by name; none before the start."""
        if self.smoother is None:
            return {}
        point, sigmas = self.point, np.sqrt(np.diag(self.covariance))
        sigmas = sigmas[point.parameter_columns]
        return {
            name: (value, float(sigma))
            for (name, value), sigma in zip(point.nuisances.items(), sigmas, strict=True)
        }

    def take_image(self, image: CameraImage, moved_ns: int) -> TrackUpdate:
        """A checked image into the window; ``moved_ns``: the stamps have moved by as much for good."""
        if moved_ns:
            self.window.forget_images_before(self.window.next_image)
        check_lateness(image, self.window, self.point.offset_s, self.config.late_s)
        self.image_order.take(image.stamp_ns, moved_ns != 0)
        self.clocks.take_image(image.stamp_ns, self.window.place)
        picture = self.config.calibration.prepare.picture
        self.window.add_image(image_features(self.window.next_image, image, self.classes, picture))
        self._forget_images()
        return self.answer(image.stamp_ns)

    def take_scan(self, scan: Scan, moved_ns: int) -> TrackUpdate:
        """A checked scan into the window, and the estimate with it."""
        self.scan_order.take(scan.stamp_ns, moved_ns != 0)
        if moved_ns:
            self.forget_all(Guess(self.point.cTl, self.point.offset_s, self.guess.search))
        jump = self.clocks.take_scan(scan.stamp_ns, self.window.place)
        number = self.keep_scan(*self._features(scan))
        if moved_ns:
            self.starting.alarmed = True
            why = f"the scan stamps moved by {1e-9 * moved_ns:+.3f} s and go on from there: it begins anew"
            return dataclasses.replace(self.answer(scan.stamp_ns, why), alarm=True)
        if jump is not None and self.config.alarm.enabled and self.config.alarm.stamps:
            return self._jumped(jump, scan.stamp_ns)
        if self.smoother is None:
            return self._start(scan.stamp_ns)
        return self._track(scan.stamp_ns, number)

    def _features(self, scan: Scan) -> tuple[ScanFeatures, RelativeMotion | None]:
        """What is kept of a scan, and the motion that led to it."""
        prepare = dataclasses.replace(self.config.calibration.prepare, use_visual_odometry=False)
        if self.config.calibration.undersides.use == "never":
            prepare = without_undersides(prepare)
        features = scan_features(self.window.next_scan, scan, self.classes, prepare)
        motion = self.odometry.add(scan)
        self.last_scan = scan
        return features, motion

    def keep_scan(self, features: ScanFeatures, motion: RelativeMotion | None) -> int:
        """Put prepared features of a scan into the window; its number."""
        number = self.window.add_scan(features, motion)
        self._forget_images()
        return number

    def _forget_images(self) -> None:
        """Keep no more images than scans may meet that are there, or still come."""
        margin_s = self.config.late_s + max(0.0, self.point.offset_s) + (0.0 if self.started else 1.0)
        self.window.forget_images(round(1e9 * margin_s), self.config.images)

    def _start(self, stamp_ns: int) -> TrackUpdate:
        """Some work towards a first estimate."""
        try:
            started = self.starting.work(self.matcher)
        except EXPECTED as error:
            self.starting.failed()
            return self.answer(stamp_ns, f"no start yet: {' '.join(str(error).split())}")
        if started is not None:
            return self.begin(started, stamp_ns)
        under_way = self.starting.under_way
        return self.answer(stamp_ns, "looking for a start" if under_way else "collecting frames for a start")

    def begin(self, started: Started, stamp_ns: int) -> TrackUpdate:
        """Go on from an estimate, if the frames that it is made of agree with it."""
        smoother, known, window = started.smoother, started.known, self.window
        if why := self.trial.check(self.watch, smoother, known, window.recently_moving()):
            return self._refuse_start(stamp_ns, len(window.scans) // 2, why)
        self.known, self.smoother = known, smoother
        self.tests.look(smoother)
        self.starting.succeeded()
        self.starts += 1
        self.trial.begin(window.next_scan)
        self.watch.begin()
        self.adoption.restart()
        soon = len(window.scans) + started.scans
        self.relinearization_schedule = RelinearizationSchedule(window.first_scan, soon, self.config.window)
        self.entered.extend(smoother.entries)
        self.information_log.restart()
        self.information_log.add(window.next_scan - 1, self.reported())
        _LOG.info("tracker: started over %d scans", started.scans)
        return self.answer(stamp_ns)

    def _refuse_start(self, stamp_ns: int, keep: int, why: str) -> TrackUpdate:
        """A start that does not hold: the calibration changed among its frames, or it was none."""
        _LOG.info("tracker: %s", why)
        self.trial.refused += 1
        guess = self.guess if self.smoother is None else Guess(self.point.cTl, self.point.offset_s)
        self._begin_anew(guess, keep)
        return self.answer(stamp_ns, why)

    def _track(self, stamp_ns: int, number: int) -> TrackUpdate:
        """One frame of the running tracker."""
        smoother = self.smoother
        assert smoother is not None
        before = smoother.point
        # 1. Matches at the present estimate: new scans, those about to leave, and some in turn.
        chosen = scans_to_match(
            number, self.matcher, smoother, self.entered, self.covariance, self.config, self.relinearization
        )
        sigma_s = 0.0 if self.config.drift.enabled else float(np.sqrt(self.covariance[6, 6]))
        found, missing = self.matcher.match(before, chosen, None, self._share, sigma_s)
        waiting = [scan for scan in chosen if scan not in smoother.entries and scan not in self.entered]
        new = [scan for scan in waiting if scan in found]
        # 2. New frames, before they are used, against the estimate and against the calibration in use.
        recently_moving, matches = (
            self.window.recently_moving(),
            {scan: len(found[scan].pair) for scan in new},
        )
        chi2 = self.watch.take(
            sorted(waiting), matches, before, self.known.joint, smoother.model, recently_moving
        )
        changed, self.doubt = self.watch.verdict(before, smoother.model, recently_moving)
        if changed is not None:
            since = self.watch.since
            if self.trial.over(number):
                return self._change(changed, stamp_ns, since, chi2, "the calibration has changed")
            return self._refuse_start(stamp_ns, since, "new frames contradict the start: it begins anew")
        if new:
            in_use = self.guess.point(self.classes, self.estimated_names)
            self.adoption.hear(partial(self.matcher.cost, chosen=new), before, in_use)
        # 3. The graph takes all in, or nothing.
        first = self.window.first_scan
        if new or not missing <= {number}:
            smoother.update(found, missing, first, self.window.objects.live)
            self.window.changed_scans -= chosen
        self.entered.extend(new)
        self._begin_or_end_relinearization(number)
        self.known = Known.of(smoother)
        if new:
            self.information_log.add(number, self.reported())
        # 4. Does a new start hold, and what is taken for granted?
        self.trial.look_again(number, self.watch, smoother, self.known, recently_moving)
        self.tests.take(number, smoother)
        # 5. A candidate that shows itself is adopted.
        self.history_store.take(smoother)
        reason = "" if new else "no match: no scan met an image that shows the same objects"
        return self.answer(stamp_ns, reason, chi2=chi2, offer=bool(new) and not self.doubt)

    def begin_relinearization(self) -> None:
        """Settle with the frames to come; no scan leaves the window meanwhile if none has yet."""
        self.window.test_all_objects()
        self.relinearization = WindowRelinearization(self.matcher, self.config.settle_scans)
        self.window.growing = self.window.first_scan == self.relinearization_schedule.first

    def stop_relinearization(self) -> None:
        """Leave a settling, if there is one, as it is."""
        self.relinearization, self.window.growing = None, False

    def _begin_or_end_relinearization(self, number: int) -> None:
        """Begin to settle where it is time to."""
        if self.relinearization is not None and self.relinearization.ended:
            # What came while it settled has been matched, too.
            self.relinearization_schedule.reached(number)
            self.stop_relinearization()
        elif (
            self.relinearization is None
            and not self.config.drift.enabled
            and self.relinearization_schedule.reached(number)
        ):
            self.begin_relinearization()

    @property
    def _share(self) -> float:
        """In drift mode matches count as little as their clusters allow, so that the walk has its say."""
        return 1.0 / self.known.inflation if self.config.drift.enabled else 1.0

    def _jumped(self, jump: Jump, stamp_ns: int) -> TrackUpdate:
        """A sensor's stamps have jumped: what came before says nothing of the time offset."""
        image, scan = jump.place
        if jump.sensor == "image":
            self.window.forget_images_before(image)
        since = self.window.next_scan - scan
        if self.started:
            before = self.watch.before(scan) or self.point
            # Most likely the clock was set.
            near = dataclasses.replace(before, offset_s=before.offset_s + jump.offset_s)
            return self._change(near, stamp_ns, since, jump.chi2, jump.sentence)
        self.window.keep_scans(since)
        self.starting.begin(self.guess, len(self.window.scans))
        return self.answer(stamp_ns, jump.sentence)

    def _change(self, near: Point, stamp_ns: int, since: int, chi2: float | None, why: str) -> TrackUpdate:
        """The calibration has changed: begin anew from the ``since`` latest scans, near an estimate before.

        Where the labels have left what ought to be in view, it is looked for all around.
        """
        _LOG.warning("tracker: alarm at %d ns, chi-square %.0f: %s", stamp_ns, chi2 or 0.0, why)
        self._begin_anew(Guess(near.cTl, near.offset_s, search=self.watch.far), since)
        self.starting.alarmed = True
        return dataclasses.replace(self.answer(stamp_ns, why, chi2=chi2), alarm=True)

    def forget_all(self, guess: Guess) -> None:
        """Give up the estimate, the window and the motion so far."""
        self.odometry = LidarOdometry(self.config.calibration.prepare.lidar_odometry)
        self.clocks = Clocks(self.config.alarm.chi2)
        self.window.restart()
        self._begin_anew(guess, 0)

    def _begin_anew(self, guess: Guess, keep: int) -> None:
        """Give up the estimate and all scans but the last few."""
        self.stop_relinearization()
        self.smoother, self.doubt, self.known = None, "", Known.nothing()
        self.tests.restart()
        self.window.keep_scans(keep)
        self.starting.begin(guess, len(self.window.scans))
        self.entered.clear()
        self.history_store.cut()
        self.watch.restart()
        self.adoption.restart()

    def answer(
        self, stamp_ns: int, reason: str = "", *, chi2: float | None = None, offer: bool = False
    ) -> TrackUpdate:
        point, config, alarm = self.point, self.config.calibration, self.config.alarm
        covariance = self.reported()
        status: TrackStatus = "alarm" if self.starting.alarmed else "starting"
        weak: tuple[WeakDirection, ...] = ()
        since, contradictions = self.watch.confirmation, contradiction_of(self.tests.findings)
        if self.smoother is not None:
            weak = open_directions(covariance, self.known.by_static, point.cTl, config.observability)
            late = self.trial.on or since.turn_s > alarm.confirm_s or since.offset_s > alarm.confirm_offset_s
            status = "unobservable" if weak else "unconfirmed" if late else "ok"
            status = "contradicted" if contradictions else status
        found = self.smoother is not None
        return TrackUpdate(
            stamp_ns=stamp_ns,
            T_camera_lidar=point.cTl,
            time_offset_s=point.offset_s,
            covariance=covariance if found else None,
            covariance_reason="" if found else "no estimate yet: this is the guess",
            status=status,
            accepted=not reason,
            reason=reason,
            matches=0 if self.smoother is None else self.smoother.matches,
            chi2=chi2,
            doubt=self.doubt,
            unconfirmed_s=since.turn_s,
            offset_unconfirmed_s=since.offset_s,
            adopted=offer and self.adoption.offer(point, status == "ok"),
            weak_directions=weak,
            contradictions=contradictions,
            estimated=self.estimated,
        )

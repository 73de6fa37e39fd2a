"""Change detection: new frames against the estimate made before them; frames of a start against its estimate.

One test serves both: chi-squared of the frames' scores at the estimate, under a kernel wide enough for
matches to survive a step of the calibration (:mod:`sst_graph.tracker.monitor.statistic`). A start is checked
with parts of its own frames; from then on each new frame is checked before it is used.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sst_graph.factors.robust import RobustKernel
from sst_graph.graph.matching import PairMatches
from sst_graph.tracker.config import TrackerConfig
from sst_graph.tracker.monitor.confirmation import (
    DETECTABLE_OFFSET_S,
    DETECTABLE_TURN_RAD,
    Confirmation,
    detectable_steps,
    steps,
)
from sst_graph.tracker.monitor.statistic import (
    CONFIRMATIONS,
    FRAMES,
    ChangeStatistic,
    ComparedEstimate,
    EstimateCovariance,
    FrameScores,
)
from sst_graph.tracker.start.first_estimate import StartGuess
from sst_graph.tracker.start.initializer import Restart
from sst_graph.tracker.sums.linearized_pair import LinearizedPair
from sst_graph.tracker.window.gaussian import Point
from sst_graph.tracker.window.matcher import InView, WindowMatcher

_KERNEL = RobustKernel("geman_mcclure", 12.0)
"""Kernel of the comparison [px]: wide enough for matches to survive a turn of the camera by 1 degree."""
_LEAST_SHARE_OF_OTHERS = 0.2
"""Share of the statistic that must remain without any one object: the labels of one car may be wrong for a
while."""
_SINGLE_OBJECT_FACTOR = 4.0
"""A single object raises the alarm after FRAMES + CONFIRMATIONS frames at this many times the threshold."""
_MAX_PENDING_FRAMES = 20
"""Frames in a row past the threshold after which a suspected change is given up: the estimate has followed
the objects by then, whether they were right or not."""
_LOST_FRAMES = 8
"""Frames in a row, but for one, in which almost no boundary point in view meets the image's labels: the step
is larger than the range of the matches."""
_LOST_SHARE = 0.12
"""Largest fraction of the boundary points in view that counts as almost none."""
_LACKING = 3.0
"""Contours per boundary point in view that are so many times shorter than usual: labels are missing."""
_MISSING_LABELS = "what ought to be in view has no labels in the images: those of some objects are missing"
_USUAL_SHOWN = 60
"""Frames whose contours say what is usual."""
_LEAST_IN_VIEW = 16
"""Boundary points of an object in view; with fewer, it can happen by chance that none meets a contour."""
_START_CHI2 = 15.0
"""A start is refused where the statistic of some of its own frames is larger. These frames are part of the
estimate, so the statistic is well below chi-squared's where they are of one calibration."""
_WARM_UP_SCANS = 15
"""Scans after a start in which a contradiction gives up the start and is no alarm."""
_MAX_REFUSED_STARTS = 2
"""Starts in a row that are refused because frames contradict them: the labels may have such errors."""
_MOST_S = 0.02
"""Largest step of the time offset that frames are asked whether they show [s]."""
_CONFIRM_SPEED_MPS = 3.0
"""Slower than this a jump of the clock can hardly be seen: such time does not count [m/s]."""


@dataclass(frozen=True)
class Reference:
    """An estimate as it was before some frames were used.

    Attributes:
        point, covariance: the estimate.
        scan: number of the first scan that it does not know.
    """

    point: Point
    covariance: EstimateCovariance
    scan: int

    def compared(self, running: ComparedEstimate) -> ComparedEstimate:
        """For frames whose residuals and scores vary as those of the running estimate."""
        return replace(running, point=self.point, covariance=self.covariance, scans=())


class ChangeDetector:
    """Test of new frames against the estimate that was made before them.

    From the first frame past the threshold on, the estimate from before the frames compared is kept as the
    reference, and all frames since are compared with it: the running estimate uses them, and would follow a
    step before it is detected.

    Attributes:
        kernel: under which frames are compared.
        statistic: of the latest frames.
        scans: the latest frames that were compared.
        reference: the estimate from before a suspected change, while there is one.
        suspected_change: why the statistic is past its threshold without an alarm; empty where it is not.
        confirmation: when frames last confirmed the estimate.
        start_unconfirmed: no frames that came after the start have been found to agree with its own.
        refused_starts: starts in a row that frames contradicted.
        max_pending: frames in a row past the threshold after which a suspected change is given up.
        start_threshold: of the statistic of a start's own frames.
        warm_up_scans: after a start, in which a contradiction gives up the start.
    """

    def __init__(self, matcher: WindowMatcher, config: TrackerConfig) -> None:
        self.matcher, self.config, self.kernel = matcher, config.alarm, _KERNEL
        sigma_px = config.calibration.noise.object_bias_sigma_px
        self.statistic = ChangeStatistic(config.alarm.chi2, sigma_px)
        self.start_threshold, self.warm_up_scans = _START_CHI2, _WARM_UP_SCANS
        self.max_pending = _MAX_PENDING_FRAMES
        self.scans: deque[int] = deque(maxlen=_MAX_PENDING_FRAMES)
        self.reference: Reference | None = None
        self.suspected_change = ""
        self.confirmation = Confirmation()
        self.start_unconfirmed, self.refused_starts = False, 0
        self._first_recheck = config.start_scans // 2
        self._start_scan, self._recheck_after = 0, self._first_recheck
        self._before: deque[Reference] = deque(maxlen=FRAMES)
        self._latest: deque[tuple[Reference, LinearizedPair]] = deque(maxlen=_MAX_PENDING_FRAMES)
        self._unmatched: deque[tuple[bool, frozenset[int]]] = deque(maxlen=_LOST_FRAMES)
        self._shown: deque[tuple[int, int]] = deque(maxlen=_USUAL_SHOWN)
        self._moving: set[int] = set()

    def restart(self) -> None:
        """Forget the frames: the calibration is estimated again."""
        self.statistic.restart()
        self.scans.clear()
        self._before.clear()
        self._latest.clear()
        self._unmatched.clear()
        self.reference, self.suspected_change = None, ""

    # ------------------------------------------------------------------ a start

    def begin(self, scan: int) -> None:
        """An estimate begins, which its own frames have confirmed; the scan of this number comes next."""
        self.restart()
        self.confirmation.begin()
        self._start_scan, self._recheck_after = scan, self._first_recheck
        self.start_unconfirmed = self.config.enabled

    def check_start(self, estimate: ComparedEstimate) -> str:
        """How frames contradict the estimate that was made of them, in words; empty where they do not.

        Where the calibration changed among the frames of a start, or where the start was wrong, its estimate
        is between two calibrations or at neither, with a covariance that does not show it.
        """
        if not self.config.enabled or self.refused_starts >= _MAX_REFUSED_STARTS:
            return ""
        moving = self.matcher.window.dynamics.recently_moving()
        value = self._disagreement(estimate, moving, self.start_threshold)
        if value <= self.start_threshold:
            return ""
        self.refused_starts += 1
        return f"frames of the start contradict each other (chi-square {value:.0f}): it is estimated again"

    def recheck_start(self, scan: int, estimate: ComparedEstimate) -> None:
        """:meth:`check_start` with half as many further frames, and then after each doubling. Wrong labels
        contradict a start as a change does, so the start is not given up; but until its frames agree, the
        status is not ``ok``.
        """
        if self.start_unconfirmed and scan - self._start_scan >= self._recheck_after:
            self._recheck_after *= 2
            self._confirm_start(estimate, self._moving, self.start_threshold)

    def check_start_at_end(self, estimate: ComparedEstimate) -> None:
        """At the end of a drive, the same check of all frames in the graph, for a start without later frames.
        They are more than a start has, so the threshold for new frames applies.
        """
        self._confirm_start(estimate, self.matcher.window.dynamics.recently_moving(), self.config.chi2)

    def confirm_at_end(self, estimate: ComparedEstimate) -> None:
        """The frames of the window confirm the estimate where no part of them contradicts it."""
        moving = self.matcher.window.dynamics.recently_moving()
        chi2 = self.config.chi2
        if not self.start_unconfirmed and self._disagreement(estimate, moving, chi2) <= chi2:
            self.confirmation.begin()

    def start_is_over(self, scan: int) -> bool:
        """Whether a contradiction is a change of the calibration from this scan on, not a wrong start."""
        return scan - self._start_scan >= self.warm_up_scans or self.refused_starts >= _MAX_REFUSED_STARTS

    def _confirm_start(self, estimate: ComparedEstimate, moving: Collection[int], threshold: float) -> None:
        if self.start_unconfirmed and self._disagreement(estimate, moving, threshold) <= threshold:
            self.refused_starts, self.start_unconfirmed = 0, False

    def _disagreement(self, estimate: ComparedEstimate, moving: Collection[int], threshold: float) -> float:
        """Largest statistic of a part of the frames that an estimate was made of, against that estimate.

        The parts are its first ones, its last ones, and any few in a row. An object that alone takes a part
        past the threshold, while the others in it would have shown what it shows, is wrong itself: it is left
        out.
        """
        at, linearized, out = estimate.point, self.matcher.linearized, set(moving)
        pairs = self.matcher.pairs_at(at, sorted(estimate.scans), _KERNEL)
        scores = {scan: linearized({scan: pair}, at, out) for scan, pair in pairs.items()}
        while True:
            value, scans = self._largest_of_parts(scores, estimate)
            if value <= threshold:
                return value
            part = {scan: pairs[scan] for scan in scans}
            odd = self._odd_one_out(part, estimate, out, threshold)
            if odd is None:
                return value
            out.add(odd)
            for scan, pair in pairs.items():
                if odd in self.matcher.tracks_of({scan: pair}):
                    scores[scan] = linearized({scan: pair}, at, out)

    def _largest_of_parts(
        self, scores: Mapping[int, Sequence[LinearizedPair]], estimate: ComparedEstimate
    ) -> tuple[float, list[int]]:
        """The largest statistic of a part of the frames, by scores of each scan, and the part's scans; 0 and
        none without any."""
        # A scan whose matches are all left out has no score.
        scored = [scan for scan, own in scores.items() if own]
        n = len(scored)
        cuts = range(2, n - 1)
        parts = {
            *((0, k) for k in cuts),
            *((k, n) for k in cuts),
            *((k, k + FRAMES) for k in range(n - FRAMES + 1)),
        }
        value, (first, end) = self.statistic.largest_of_parts(
            [score for own in scores.values() for score in own], sorted(parts), estimate
        )
        return value, scored[first:end]

    def _odd_one_out(
        self,
        pairs: Mapping[int, PairMatches],
        estimate: ComparedEstimate,
        out: Collection[int],
        threshold: float,
    ) -> int | None:
        """The object without which frames agree with an estimate though they show as much; None without one.

        They must show a turn of the camera without it, and a jump of the clock where they do with it.
        """
        tried = steps(estimate.point.cTl, DETECTABLE_TURN_RAD, DETECTABLE_OFFSET_S)

        def compared(*without: int) -> FrameScores | None:
            scores = self.matcher.linearized(pairs, estimate.point, {*without, *out})
            return self.statistic.compare(scores, estimate) if scores else None

        whole = compared()
        shown = np.zeros(3, bool) if whole is None else self.statistic.detectable(whole, tried)
        for track in sorted(self.matcher.tracks_of(pairs).difference(out)):
            others = compared(track)
            if others is None or self.statistic.normalized(others) > threshold:
                continue
            by_others = self.statistic.detectable(others, tried)
            if by_others[:2].all() and by_others[2] >= shown[2]:
                return track
        return None

    # ------------------------------------------------------------------ new frames

    def check(
        self, waiting: Sequence[int], matches: Mapping[int, int], estimate: ComparedEstimate
    ) -> float | None:
        """The statistic of the latest frames with some new ones; None while there are too few.

        Args:
            waiting: numbers of scans that have had no match yet; those that have an image and were not
                compared before are compared.
            matches: how many matches scans have under the narrow kernel.
            estimate: made without them.
        """
        if not self.config.enabled:
            return None
        seconds, speed_mps = self.matcher.window.latest_step()
        self.confirmation.wait(seconds, speed_mps > _CONFIRM_SPEED_MPS)
        # Objects that moved lately are left out: one that starts or stops may pass for one that is static.
        self._moving = set(self.matcher.window.dynamics.recently_moving())
        # What is older than all that is remembered may have been compared before.
        first = self.matcher.window.next_scan - _MAX_PENDING_FRAMES
        new = [scan for scan in waiting if scan >= first and scan not in self.scans]
        if not new:
            return None
        # 1. Of scans with an image: do the objects in view meet its labels?
        views = self.matcher.in_view(estimate.point, new, self._moving)
        self._note_unmatched(views, matches)
        if not views:
            return None
        # 2. Their statistic, against the reference or the running estimate.
        self.scans.extend(views)
        self._before.append(Reference(estimate.point, estimate.covariance, min(views)))
        against = self.reference or self._before[-1]
        scores = self.matcher.linearized_at(against.point, list(views), _KERNEL, self._moving)
        value = self.statistic.add(scores, against.compared(estimate))
        self._latest.extend((self._before[-1], score) for score in scores)
        # 3. Keep the reference, or discard it.
        if self.statistic.exceeded > self.max_pending:
            self.confirmation.unreliable |= self.matcher.tracks_of(self.scans) - self._moving
            self.restart()
        elif not self.statistic.exceeded:
            self.reference = None
        elif self.reference is None:
            self.reference = self._before[0]
        # 4. Note which steps of the calibration they would have shown.
        if value is not None and not self.statistic.exceeded and not self.far:
            self._confirm(estimate)
        return value

    def change(self, estimate: ComparedEstimate, chi2: float | None) -> Restart | None:
        """The restart after a change that is certain from the frames so far; one that is only suspected is
        noted.

        Args:
            estimate: the running one.
            chi2: the statistic of the latest frames.
        """
        self.suspected_change = ""
        if self.far and self._lacking:
            self.suspected_change = _MISSING_LABELS
        elif self.lost:
            return self._restart(estimate.point, _LOST_FRAMES, chi2)
        elif self.statistic.confirmed:
            if self.reference is not None and self._contradicted(self.reference, estimate):
                return self._restart(self.reference.point, self.statistic.exceeded, chi2)
            self.suspected_change = "a single object contradicts the calibration: a step, or wrong labels"
        elif self.far:
            self.suspected_change = "what ought to be in view does not meet the image's labels"
        return None

    def _restart(self, before: Point, scans: int, chi2: float | None) -> Restart:
        """From the estimate before a change, with the latest scans, which are surely from after it."""
        near = StartGuess(before.cTl, before.time_offset_s, search=self.far)
        return Restart(near, scans, "the calibration has changed", True, chi2)

    @property
    def contradicted(self) -> bool:
        """Whether the newest frame alone or two in a row are past the threshold, or a change is suspected."""
        return self.statistic.contradicted or bool(self.suspected_change)

    @property
    def lost(self) -> bool:
        """Whether two objects or more in view do not meet the image's labels at all."""
        objects = frozenset[int]().union(*(tracks for unmet, tracks in self._unmatched if unmet))
        return self._is_unmatched(_LOST_FRAMES) and len(objects) > 1

    @property
    def far(self) -> bool:
        """Whether the latest frames do not meet the image's labels at all: a change is a large one then, and
        the new calibration may be anywhere."""
        return self._is_unmatched(CONFIRMATIONS)

    def before(self, scan: int, estimate: ComparedEstimate) -> Reference:
        """The latest estimate that was made without a scan, among those from before the latest frames; the
        running one where none is kept."""
        kept = [before for before in (self.reference, *self._before) if before is not None]
        earlier = [before for before in kept if before.scan <= scan]
        return (*kept[:1], *earlier)[-1] if kept else Reference(estimate.point, estimate.covariance, scan)

    def offset_held(self, first: int, step_s: float, estimate: ComparedEstimate) -> bool:
        """Whether scans from the first one on agree with the estimate before them, though they would have
        shown a step of the time offset [s]."""
        before = self.before(first, estimate)
        scans = range(first, self.matcher.window.next_scan)
        scores = self.matcher.linearized_at(before.point, scans, _KERNEL, self._moving)
        if not scores or self.contradicted or self.far:
            return False
        comparison = self.statistic.compare(scores, before.compared(estimate))
        # A longer step leaves the range of the kernel, and is not shown in proportion.
        step = steps(before.point.cTl, 0.0, min(abs(step_s), _MOST_S))[:, 2:]
        agree = self.statistic.normalized(comparison) <= self.config.chi2
        return bool(agree and self.statistic.detectable(comparison, step).all())

    def _note_unmatched(self, views: Mapping[int, InView], matches: Mapping[int, int]) -> None:
        for scan, view in views.items():
            large = frozenset(track for track, count in view.counts.items() if count >= _LEAST_IN_VIEW)
            if large:
                points = sum(view.counts.values())
                self._unmatched.append((matches.get(scan, 0) < _LOST_SHARE * points, large))
                self._shown.append((points, view.contour_px))

    @property
    def _lacking(self) -> bool:
        """Whether the latest frames show much less of the labels' contours for what ought to be in view than
        those before."""
        points, contours = np.array(self._shown, float).reshape(-1, 2).T
        now = slice(-len(self._unmatched), None)
        before = slice(None, -len(self._unmatched))
        usual = contours[before].sum() / max(points[before].sum(), 1.0)
        return bool(_LACKING * contours[now].sum() < usual * points[now].sum())

    def _is_unmatched(self, frames: int) -> bool:
        """Whether so many of the latest frames, but for one of them, do not meet the labels."""
        latest = [unmet for unmet, _ in self._unmatched][-frames:]
        return len(latest) == frames and sum(latest) >= frames - 1

    def _confirm(self, estimate: ComparedEstimate) -> None:
        """The latest frames agree with the estimate: note which steps they would have shown."""
        comparison = self.statistic.latest
        if unreliable := self.confirmation.unreliable:
            latest = list(self.scans)[-FRAMES:]
            scores = self.matcher.linearized_at(estimate.point, latest, _KERNEL, {*unreliable, *self._moving})
            comparison = None
            if scores:
                comparison = self.statistic.compare(scores, estimate)
                if self.statistic.normalized(comparison) > self.config.chi2:
                    return
        if comparison is not None:
            reported = estimate.covariance.matrix[:7, :7] if estimate.reported is None else estimate.reported
            tried = detectable_steps(estimate.point.cTl, reported)
            shown = self.statistic.detectable(comparison, tried)
            if not (shown.all() or unreliable):
                # They may do so together with those before them.
                more = self._with_earlier_frames(estimate)
                if self.statistic.normalized(more) <= self.config.chi2:
                    shown |= self.statistic.detectable(more, tried)
            self.confirmation.add(shown)

    def _with_earlier_frames(self, estimate: ComparedEstimate) -> FrameScores:
        """The latest scans that have been compared, as many as a change may be pending for, against the
        estimate from before the first of them."""
        first = self.matcher.window.next_scan - _MAX_PENDING_FRAMES
        latest = [(before, score) for before, score in self._latest if before.scan >= first]
        before, _ = latest[0]
        scores = [
            replace(score, information=score.information.at(before.point.seen(score.places)))
            for _, score in latest
        ]
        return self.statistic.compare(scores, before.compared(estimate))

    def _contradicted(self, reference: Reference, estimate: ComparedEstimate) -> bool:
        """Whether all frames since the reference contradict it.

        They must do so with any one object left out, too. Where a single object contradicts, its labels may
        be wrong: with one object in view, or one of dominant weight, it must do so for longer and far above
        the threshold.
        """
        scans = [scan for scan in self.scans if scan >= reference.scan]
        pairs = self.matcher.pairs_at(reference.point, scans, _KERNEL)
        against = reference.compared(estimate)

        def value(*without: int) -> float:
            scores = self.matcher.linearized(pairs, reference.point, {*without, *self._moving})
            return self.statistic.normalized(self.statistic.compare(scores, against))

        # The statistic of a step grows with every frame; that of lasting errors of labels does not.
        more = len(scans) / (FRAMES + CONFIRMATIONS)
        whole, threshold = value(), self.config.chi2 * max(1.0, more)
        if more >= 1.0 and whole > _SINGLE_OBJECT_FACTOR * threshold:
            return True
        least = max(threshold, _LEAST_SHARE_OF_OTHERS * whole)
        objects = self.matcher.tracks_of(scans) - self._moving
        return whole > least and all(value(track) > least for track in objects)

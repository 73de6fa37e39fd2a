"""New frames against the estimate before them: whether the calibration has changed."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sst_graph.covariance.error_model import ErrorModel
from sst_graph.factors.robust import RobustKernel
from sst_graph.tracker.config import AlarmConfig
from sst_graph.tracker.monitor.alarm import Joint, StepAlarm
from sst_graph.tracker.monitor.confirmation import Confirmation, steps
from sst_graph.tracker.window.gaussian import Point
from sst_graph.tracker.window.matcher import WindowMatcher

_LEAST_IN_VIEW = 16
"""Boundary points of an object of which it can be said that next to none of them meets a contour."""


@dataclass(frozen=True)
class Before:
    """An estimate, as it was before some frames were used.

    Attributes:
        point, joint: the estimate and its covariance.
        scan: number of the first scan that it does not know.
    """

    point: Point
    joint: Joint
    scan: int


class Watch:
    """Compares new frames with the estimate before them, under the alarm's wide kernel.

    From the first frame past the threshold on, the estimate from before the frames compared is kept, and all
    frames since are compared with it: the one that goes on hears them, and would follow a step before enough
    is seen of it.

    Attributes:
        alarm: the statistic of the latest frames.
        scans: the latest frames that were compared.
        kept: the estimate from before a doubt, while there is one.
        confirmation: when frames last confirmed the estimate.
    """

    def __init__(self, matcher: WindowMatcher, config: AlarmConfig, object_sigma_px: float) -> None:
        """object_sigma_px: deviation of a new object's mask bias from its class's [px]."""
        self.matcher, self.config = matcher, config
        self.alarm = StepAlarm(config, object_sigma_px)
        self.scans: deque[int] = deque(maxlen=config.patience)
        self.kept: Before | None = None
        self.confirmation = Confirmation()
        self._latest: deque[Before] = deque(maxlen=config.frames)
        self._unmet: deque[tuple[bool, frozenset[int]]] = deque(maxlen=config.lost)
        self._kernel = RobustKernel("geman_mcclure", config.kernel_px)

    def begin(self) -> None:
        """A new calibration begins, which a start has confirmed."""
        self.restart()
        self.confirmation.begin()

    def restart(self) -> None:
        """Forget the frames."""
        self.alarm.restart()
        self.scans.clear()
        self._latest.clear()
        self._unmet.clear()
        self.kept = None

    def take(
        self,
        waiting: Sequence[int],
        matches: Mapping[int, int],
        point: Point,
        joint: Joint,
        model: ErrorModel,
        recently_moving: Collection[int],
    ) -> float | None:
        """The statistic of the latest frames with some new ones; None while it can't be told.

        Args:
            waiting: numbers of scans that have had no match yet; those that have an image and were not
                compared before are compared.
            matches: how many matches scans have under the narrow kernel.
            point, joint: the estimate, which has not heard them, and its covariance.
            recently_moving: tracks of objects that moved lately; they are not asked.
        """
        if not self.config.enabled:
            return None
        seconds, speed_mps = self.matcher.window.latest_step()
        self.confirmation.wait(seconds, speed_mps > self.config.confirm_mps)
        new = [scan for scan in waiting if scan not in self.scans]
        if not new:
            return None
        # 1. Scans that have an image: does what ought to be in view meet its labels?
        views = self.matcher.in_view(point, new, recently_moving)
        for scan, counts in views.items():
            large = frozenset(track for track, count in counts.items() if count >= _LEAST_IN_VIEW)
            if large:
                least = self.config.lost_share * sum(counts.values())
                self._unmet.append((matches.get(scan, 0) < least, large))
        if not views:
            return None
        # 2. What they say.
        self.scans.extend(views)
        self._latest.append(Before(point, joint, min(views)))
        against = self.kept or self._latest[-1]
        scores = self.matcher.linearized_at(against.point, list(views), self._kernel, recently_moving)
        value = self.alarm.check(scores, against.joint, model)
        # 3. Keep an estimate, or let it go.
        if self.alarm.raised > self.config.patience:
            self.confirmation.suspects |= self.matcher.objects_of(self.scans) - set(recently_moving)
            self.restart()
        elif not self.alarm.raised:
            self.kept = None
        elif self.kept is None:
            self.kept = self._latest[0]
        # 4. What do they confirm?
        if value is not None and not self.alarm.raised and not self.far:
            self._confirm(point, joint, model, recently_moving)
        return value

    def disagreement(
        self,
        scans: Sequence[int],
        point: Point,
        joint: Joint,
        model: ErrorModel,
        recently_moving: Collection[int],
    ) -> float:
        """Largest statistic of a part of the frames that an estimate was made of, against that estimate.

        The parts are its first ones, its last ones, and any few in a row. They have all been heard, so the
        statistic is well below chi-square's where they are of one calibration.

        Args:
            scans: in the order of time.
        """
        pairs = self.matcher.pairs_at(point, scans, self._kernel)
        scores = [
            self.matcher.linearized({scan: pairs[scan]}, point, recently_moving) for scan in sorted(pairs)
        ]
        n, few = len(scores), self.config.frames
        cuts = range(2, n - 1)
        parts = {
            *((0, k) for k in cuts),
            *((k, n) for k in cuts),
            *((k, k + few) for k in range(n - few + 1)),
        }
        found = [[score for own in scores[a:b] for score in own] for a, b in parts]
        values = [self.alarm.value(self.alarm.compare(some, joint, model)) for some in found if some]
        return max(values, default=0.0)

    def _confirm(
        self, point: Point, joint: Joint, model: ErrorModel, recently_moving: Collection[int]
    ) -> None:
        """The latest frames agree with the estimate: note which steps they would have shown."""
        config, compared = self.config, self.alarm.compared
        if suspects := self.confirmation.suspects:
            latest = list(self.scans)[-config.frames :]
            scores = self.matcher.linearized_at(point, latest, self._kernel, {*suspects, *recently_moving})
            compared = self.alarm.compare(scores, joint, model) if scores else None
            if compared is not None and self.alarm.value(compared) > config.chi2:
                return
        if compared is not None:
            tried = steps(point.cTl, float(np.radians(config.shown_deg)), config.shown_s)
            self.confirmation.take(self.alarm.shown(compared, tried))

    @property
    def lost(self) -> bool:
        """Whether the image's labels have left what ought to be in view, of two objects or more."""
        objects = frozenset[int]().union(*(tracks for unmet, tracks in self._unmet if unmet))
        return self._gone(self.config.lost) and len(objects) > 1

    @property
    def far(self) -> bool:
        """Whether the latest frames do not meet the image's labels: a change is a large one then."""
        return self._gone(self.config.confirmations)

    def _gone(self, frames: int) -> bool:
        """Whether so many of the latest frames, but for one of them, do not meet the labels."""
        latest = [unmet for unmet, _ in self._unmet][-frames:]
        return len(latest) == frames and sum(latest) >= frames - 1

    @property
    def since(self) -> int:
        """How many of the latest frames are surely from after a change."""
        return self.config.lost if self.lost else self.alarm.raised

    def verdict(
        self, point: Point, model: ErrorModel, recently_moving: Collection[int]
    ) -> tuple[Point | None, str]:
        """Near which estimate to begin again, where the calibration has changed; else what is doubtful.

        Args:
            point: the present estimate.
        """
        if self.lost:
            return point, ""
        if self.alarm.alarm:
            before = self._contradicted(model, recently_moving)
            if before is not None:
                return before.point, ""
            return None, "a single object says that the calibration has changed: a step, or its labels"
        return None, "what ought to be in view does not meet the image's labels" if self.far else ""

    def before(self, scan: int) -> Point | None:
        """The latest estimate that has not heard a scan, among those from before the latest frames."""
        known = [before for before in (self.kept, *self._latest) if before is not None]
        earlier = [before for before in known if before.scan <= scan]
        return earlier[-1].point if earlier else known[0].point if known else None

    def _contradicted(self, model: ErrorModel, recently_moving: Collection[int]) -> Before | None:
        """The estimate from before a doubt, if all frames since say that the calibration has changed.

        They must do so with any one object left out, too. Where a single object says so, its labels may
        err for a while: with one in view, or one that tells far more than the others, it must say so for
        longer and much more clearly.
        """
        if self.kept is None:
            return None
        kept, config = self.kept, self.config
        scans = [scan for scan in self.scans if scan >= kept.scan]
        pairs = self.matcher.pairs_at(kept.point, scans, self._kernel)

        def value(*without: int) -> float:
            scores = self.matcher.linearized(pairs, kept.point, {*without, *recently_moving})
            return self.alarm.value(self.alarm.compare(scores, kept.joint, model))

        # A step shows more clearly with every frame; labels whose errors last do not.
        more = len(scans) / (config.frames + config.confirmations)
        whole, threshold = value(), config.chi2 * max(1.0, more)
        if more >= 1.0 and whole > config.alone * threshold:
            return kept
        least = max(threshold, config.others * whole)
        asked = self.matcher.objects_of(scans) - set(recently_moving)
        return kept if whole > least and all(value(track) > least for track in asked) else None

"""Monitoring of a running estimate: whether it has changed, and which one to use.

Adoption: a new estimate replaces the calibration in use where held-out frames agree.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from functools import partial

import numpy as np

from sst_graph.tracker.config import TrackerConfig
from sst_graph.tracker.estimate import FrameMatches, OnlineEstimate
from sst_graph.tracker.monitor.change_detector import ChangeDetector
from sst_graph.tracker.monitor.turned_poses import TurnedPoses
from sst_graph.tracker.start.first_estimate import StartGuess
from sst_graph.tracker.start.initializer import Restart
from sst_graph.tracker.window.gaussian import Point
from sst_graph.tracker.window.matcher import WindowMatcher

_FRAMES = 10
"""Held-out frames on which the candidate and the calibration in use are compared."""
_MARGIN = 0.02
"""The candidate's held-out cost may exceed that of the one in use by this fraction."""


class Adoption:
    """The calibration in use, and when a candidate replaces it.

    Attributes:
        adopted: the calibration in use; None before the first.
        costs: of the latest held-out frames, under the candidate and under the one in use.
    """

    def __init__(self) -> None:
        self.adopted: Point | None = None
        self.costs: deque[tuple[float, float]] = deque(maxlen=_FRAMES)

    def restart(self) -> None:
        """Forget the comparison; the calibration in use stays until another one is adopted."""
        self.costs.clear()

    def add_held_out(
        self, cost: Callable[[Point], float | None], candidate: Point, guess: Point | None
    ) -> None:
        """Compare candidate and calibration in use on new frames, before these are used.

        Args:
            cost: of the frames at a point; None where no boundary point is in view.
            candidate: the estimate before them.
            guess: what is in use while nothing has been adopted.
        """
        in_use = self.adopted or guess
        ours = theirs = cost(candidate)
        if in_use is not None and float(np.abs(candidate.core().local(in_use.core())).max()) > 0.0:
            theirs = cost(in_use)
        self.compare(ours, theirs)

    def compare(self, candidate: float | None, in_use: float | None) -> None:
        """Held-out costs of one frame: of the candidate made before it, and of the one in use."""
        if candidate is not None and in_use is not None:
            self.costs.append((candidate, in_use))

    def propose(self, candidate: Point, trusted: bool) -> bool:
        """Adopt the candidate if it is trusted and explains held-out frames no worse; whether it was."""
        if not trusted or len(self.costs) < _FRAMES:
            return False
        ours, theirs = np.mean(self.costs, axis=0)
        if ours > (1.0 + _MARGIN) * theirs:
            return False
        self.adopted = candidate
        return True


class Monitor:
    """Change detection, and which calibration to use.

    Attributes:
        changes: whether the calibration has changed.
        adoption: the calibration in use, validated on held-out frames.
        turned: whether new frames agree with a turned pose instead, where edges are aligned.
    """

    def __init__(self, matcher: WindowMatcher, config: TrackerConfig) -> None:
        self.matcher = matcher
        self.changes = ChangeDetector(matcher, config)
        self.adoption = Adoption()
        self.turned = TurnedPoses()

    def begin(self, scan: int) -> None:
        """An estimate begins; the scan of this number comes next."""
        self.changes.begin(scan)
        self.adoption.restart()
        self.turned.restart()

    @property
    def contradicted(self) -> bool:
        """Whether the latest frames contradict the estimate: until it is known why, it is not confirmed."""
        return self.changes.contradicted or self.turned.contradicted

    def restart(self) -> None:
        """The calibration is estimated again."""
        self.changes.restart()
        self.adoption.restart()
        self.turned.restart()

    def check(self, matches: FrameMatches, estimate: OnlineEstimate) -> tuple[float | None, Restart | None]:
        """Compare new frames, before they are used, with the estimate and with the calibration in use.

        Returns:
            Statistic of the change test, and from where to begin again if the calibration has changed.
        """
        counts = {scan: len(matches.found[scan].pair) for scan in matches.new}
        compared = estimate.for_comparison()
        chi2 = self.changes.check(sorted(matches.waiting), counts, compared)
        change = self.changes.change(compared, chi2)
        if change is None and estimate.edges is not None and matches.new:
            wide = partial(self.matcher.cost, chosen=matches.new, kernel=self.changes.kernel)
            self.turned.add(wide, estimate.point)
            change = self._turned(estimate.point, chi2)
        if change is not None:
            if self.changes.start_is_over(matches.scan):
                return chi2, change
            self.changes.refused_starts += 1
            near = StartGuess(estimate.point.cTl, estimate.point.time_offset_s)
            why = "new frames contradict the start: it is estimated again"
            return chi2, Restart(near, change.scans, why)
        if matches.new:
            cost = partial(self.matcher.cost, chosen=matches.new)
            self.adoption.add_held_out(cost, estimate.point, estimate.guessed_point)
        return chi2, None

    def _turned(self, point: Point, chi2: float | None) -> Restart | None:
        """The restart where new frames agree with a turned pose."""
        pose = self.turned.better(point) if self.changes.config.enabled else None
        if pose is None:
            return None
        near = StartGuess(pose.cTl, pose.time_offset_s)
        return Restart(near, len(self.turned.gains), "the calibration has changed", True, chi2)

    def check_start_at_end(self, estimate: OnlineEstimate) -> None:
        """At the end of a drive: check a start without later frames against its own frames; an estimate by
        edges, which few frames hardly confirm, against all frames of the window."""
        compared = estimate.for_comparison()
        self.changes.check_start_at_end(compared)
        if estimate.edges is not None and not estimate.reasons:
            self.changes.confirm_at_end(compared)

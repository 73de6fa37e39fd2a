"""Monitoring of a running estimate."""

from __future__ import annotations

from functools import partial

from sst_graph.tracker.config import TrackerConfig
from sst_graph.tracker.estimate import FrameMatches, OnlineEstimate
from sst_graph.tracker.monitor.adoption import Adoption
from sst_graph.tracker.monitor.change_detector import ChangeDetector
from sst_graph.tracker.start.first_estimate import StartGuess
from sst_graph.tracker.start.initializer import Restart
from sst_graph.tracker.window.matcher import WindowMatcher


class Monitor:
    """Change detection, and which calibration to use.

    Attributes:
        changes: whether the calibration has changed.
        adoption: the calibration in use, validated on held-out frames.
    """

    def __init__(self, matcher: WindowMatcher, config: TrackerConfig) -> None:
        self.matcher = matcher
        self.changes = ChangeDetector(matcher, config)
        self.adoption = Adoption()

    def begin(self, scan: int) -> None:
        """An estimate begins; the scan of this number comes next."""
        self.changes.begin(scan)
        self.adoption.restart()

    def restart(self) -> None:
        """The calibration is estimated again."""
        self.changes.restart()
        self.adoption.restart()

    def check(self, matches: FrameMatches, estimate: OnlineEstimate) -> tuple[float | None, Restart | None]:
        """Compare new frames, before they are used, with the estimate and with the calibration in use.

        Returns:
            Statistic of the change test, and from where to begin again if the calibration has changed.
        """
        counts = {scan: len(matches.found[scan].pair) for scan in matches.new}
        compared = estimate.for_comparison()
        chi2 = self.changes.check(sorted(matches.waiting), counts, compared)
        change = self.changes.change(compared, chi2)
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

    def check_start_at_end(self, estimate: OnlineEstimate) -> None:
        """At the end of a drive: check a start without later frames against its own frames; an estimate by
        edges, which few frames hardly confirm, against all frames of the window."""
        compared = estimate.for_comparison()
        self.changes.check_start_at_end(compared)
        if estimate.edges is not None and not estimate.reasons:
            self.changes.confirm_at_end(compared)

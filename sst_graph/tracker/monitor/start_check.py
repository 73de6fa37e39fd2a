"""Whether a new start holds: against the frames it was made of, and the first that come after it."""

from __future__ import annotations

from collections.abc import Collection

from sst_graph.tracker.config import TrackerConfig
from sst_graph.tracker.monitor.comparison import Watch
from sst_graph.tracker.status import Known
from sst_graph.tracker.window.smoother import WindowSmoother

_MOST_REFUSED = 2
"""Starts in a row that are refused because frames contradict them: labels may err as much."""


class Trial:
    """The first frames of a tracker's estimate.

    Where the calibration changed among the frames of a start, or where the start was none, its estimate lies
    between two or beside all, with a covariance that knows of neither.

    Attributes:
        on: frames that came after the start have not been found to agree with those it was made of.
    """

    def __init__(self, config: TrackerConfig) -> None:
        self.alarm, self.soon = config.alarm, config.start_scans // 2
        self.first, self.after = 0, self.soon
        self.refused = 0
        self.on = False

    def begin(self, scan: int) -> None:
        """An estimate begins; the scan of this number comes next."""
        self.first, self.after, self.on = scan, self.soon, self.alarm.enabled

    def over(self, scan: int) -> bool:
        """Whether a contradiction is a change of the calibration from this scan on, not a bad start."""
        return scan - self.first >= self.alarm.warm_up or self.refused >= _MOST_REFUSED

    def check(
        self, watch: Watch, smoother: WindowSmoother, known: Known, recently_moving: Collection[int]
    ) -> str:
        """In what way frames contradict the estimate that was made of them; empty where they do not."""
        if not self.alarm.enabled or self.refused >= _MOST_REFUSED:
            return ""
        value = self._contradiction(watch, smoother, known, recently_moving)
        if not value:
            return ""
        return f"frames of the start contradict each other (chi-square {value:.0f}): it begins anew"

    def _contradiction(
        self,
        watch: Watch,
        smoother: WindowSmoother,
        known: Known,
        recently_moving: Collection[int],
        limit: float | None = None,
    ) -> float:
        """The statistic of the frames in the graph, where it is past the limit (a start's own); else 0."""
        scans = sorted(smoother.entries)
        value = watch.disagreement(scans, smoother.point, known.joint, smoother.model, recently_moving)
        return value if value > (self.alarm.start_chi2 if limit is None else limit) else 0.0

    def look_again(
        self,
        scan: int,
        watch: Watch,
        smoother: WindowSmoother,
        known: Known,
        recently_moving: Collection[int],
    ) -> None:
        """The same when half as many frames again have come, and then each time after twice as many.

        Labels that err for a while contradict a start as a step does, so it is not given up any more; but
        until its frames agree it is not called ok.
        """
        if self.on and scan - self.first >= self.after:
            self.after *= 2
            self._look(watch, smoother, known, recently_moving)

    def look_last(
        self, watch: Watch, smoother: WindowSmoother, known: Known, recently_moving: Collection[int]
    ) -> None:
        """At the end of a drive, the same of all frames in the graph for a start that no frame came after.

        They are more, in more parts, than a start is made of: they contradict it as new frames would.
        """
        self._look(watch, smoother, known, recently_moving, self.alarm.chi2)

    def _look(
        self,
        watch: Watch,
        smoother: WindowSmoother,
        known: Known,
        recently_moving: Collection[int],
        limit: float | None = None,
    ) -> None:
        if self.on and not self._contradiction(watch, smoother, known, recently_moving, limit):
            self.refused, self.on = 0, False

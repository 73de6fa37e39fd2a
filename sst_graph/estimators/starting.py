"""How a tracker comes to its first estimate, and to the one after an alarm."""

from __future__ import annotations

from dataclasses import dataclass

from sst_graph.estimators.known import Known
from sst_graph.estimators.matcher import WindowMatcher
from sst_graph.estimators.smoother import WindowSmoother
from sst_graph.estimators.tracker_config import TrackerConfig
from sst_graph.estimators.tracker_start import Guess, first_estimate, prior_belief
from sst_graph.estimators.window import Window


@dataclass(frozen=True)
class Started:
    """An estimate: the window's graph, and how well it is known."""

    smoother: WindowSmoother
    known: Known


class Starting:
    """When a start is tried, and from where.

    Attributes:
        guess: where it begins.
        waited: scans since the last attempt, or those kept when it began.
        attempts: how many have failed.
        alarmed: an alarm went before, and nothing has been found since.
    """

    def __init__(self, guess: Guess, config: TrackerConfig) -> None:
        self.guess, self.config = guess, config
        self.waited = self.attempts = 0
        self.alarmed = False

    def begin(self, guess: Guess, scans: int) -> None:
        """From a guess, with some scans that are there already."""
        self.guess, self.waited = guess, scans

    def due(self, window: Window) -> bool:
        """Whether a start is tried with the scan that has come."""
        self.waited += 1
        needed = self.config.restart_scans if self.alarmed else self.config.start_scans
        return self.waited >= needed and self.waited % max(1, needed // 2) == 0 and bool(window.images)

    def attempt(self, matcher: WindowMatcher) -> Started:
        """The batch's estimate over the window, and a graph that goes on from it.

        Raises:
            EstimationError: none was found.
        """
        window, config = matcher.window, self.config
        drive, _ = window.drive()
        point = first_estimate(drive, self.guess, config)
        graph = config.calibration.joint.graph
        matcher.look_below(point)
        prior = prior_belief(point, self.guess, matcher.classes, graph)
        smoother = WindowSmoother(prior, drive.scans[0].stamp_ns, matcher.classes, graph, config.drift)
        found, _ = matcher.match(point, None)
        smoother.update(found, set(), window.first_scan, window.objects.live)
        return Started(smoother, Known.of(smoother))

    def failed(self) -> None:
        """An attempt has failed; after some, the search begins anew."""
        self.attempts += 1
        if self.attempts >= self.config.start_attempts:
            # The last estimate leads nowhere: look all around it.
            self.guess = Guess(self.guess.cTl, self.guess.offset_s)

    def succeeded(self) -> None:
        """There is an estimate."""
        self.alarmed, self.attempts, self.waited = False, 0, 0

"""How a tracker comes to its first estimate, and to the one after an alarm: some work with each frame."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from factors.errors import FactorError
from sst_graph.errors import SstGraphError
from sst_graph.estimators.gaussian import Point
from sst_graph.estimators.known import Known
from sst_graph.estimators.matcher import WindowMatcher
from sst_graph.estimators.smoother import WindowSmoother
from sst_graph.estimators.tracker_config import TrackerConfig
from sst_graph.estimators.tracker_start import Guess, estimating_first, prior_belief
from sst_graph.estimators.window import Window
from sst_graph.problem.drive import Drive
from sst_graph.stepwise import Stepwise

EXPECTED = (SstGraphError, FactorError, RuntimeError, ValueError, ArithmeticError, np.linalg.LinAlgError)
"""Errors that numbers alone may lead to; others are errors of the program."""


@dataclass(frozen=True)
class Started:
    """An estimate: the graph of some scans, how well it is known, and how many scans were matched for it."""

    smoother: WindowSmoother
    known: Known
    scans: int


class _Run:
    """A first estimate as far as it has come.

    It cannot be taken back; what it has done beyond what was asked for is not told before it is asked for.
    """

    rolls_back = False

    def __init__(self, steps: Stepwise[Point]) -> None:
        self._steps = steps
        self._done = 0
        self._answer: Point | Exception | None = None

    def until(self, work: int | None) -> Point | None:
        """The answer, if it takes no more work than this in all (None: any).

        Raises:
            EstimationError: it has none; or another of :data:`EXPECTED`.
        """
        while self._answer is None and (work is None or self._done < work):
            try:
                self._done += next(self._steps)
            except StopIteration as stop:
                self._answer = stop.value
            except EXPECTED as error:
                self._answer = error
        if self._answer is None or (work is not None and self._done >= work):
            return None
        if isinstance(self._answer, Exception):
            raise self._answer
        return self._answer


class Search:
    """A first estimate that is being looked for.

    Attributes:
        drive: the scans and images that it is made of, as they were when it began.
        guess: where it begins.
        work: how much of it was asked for.
    """

    def __init__(self, drive: Drive, guess: Guess, config: TrackerConfig) -> None:
        self.drive, self.guess, self.config = drive, guess, config
        self.work = 0
        self._run: _Run | None = None

    def go_on(self, work: int | None) -> Point | None:
        """Some more work (None: all that is left); the estimate, once it is there.

        Raises:
            EstimationError: none was found; or another of :data:`EXPECTED`.
        """
        if self._run is None:
            # A search that was stored is done again as far as it had come: the steps are the same.
            self._run = _Run(estimating_first(self.drive, self.guess, self.config))
        self.work += work or 0
        return self._run.until(None if work is None else self.work)

    def __getstate__(self) -> dict[str, Any]:
        """All but how far it has come, which follows from the work."""
        return {**vars(self), "_run": None}


class Starting:
    """When a start is tried, and from where.

    Attributes:
        guess: where it begins.
        waited: scans since the last attempt, or those kept when it began.
        attempts: how many have failed.
        alarmed: an alarm went before, and nothing has been found since.
        search: what is being looked for, if anything is.
    """

    def __init__(self, guess: Guess, config: TrackerConfig) -> None:
        self.guess, self.config = guess, config
        self.waited = self.attempts = 0
        self.alarmed = False
        self.search: Search | None = None

    def begin(self, guess: Guess, scans: int) -> None:
        """From a guess, with some scans that are there already."""
        self.guess, self.waited, self.search = guess, scans, None

    @property
    def needed(self) -> int:
        """Scans that a start is made of, at least."""
        return self.config.restart_scans if self.alarmed else self.config.start_scans

    def work(self, matcher: WindowMatcher) -> Started | None:
        """What is done with a scan that has come; an estimate, once it is there.

        Raises:
            EstimationError: none was found; or another of :data:`EXPECTED`.
        """
        if self.search is None:
            if not self._due(matcher.window):
                return None
            self.search = self._search(matcher.window)
        point = self.search.go_on(self.config.start_work or None)
        return None if point is None else self._started(matcher, point)

    def finish(self, matcher: WindowMatcher) -> Started | None:
        """All that is left to do, at the end of a drive; None where too few scans have come.

        Raises:
            EstimationError: none was found; or another of :data:`EXPECTED`.
        """
        window = matcher.window
        if self.search is None and (len(window.scans) < self.needed or not window.images):
            return None
        search = self.search or self._search(window)
        try:
            point = search.go_on(None)
        except EXPECTED:
            if search.drive.scans[-1] is window.scans[-1][1]:
                raise
            point = self._search(window).go_on(None)
        assert point is not None
        return self._started(matcher, point)

    def _due(self, window: Window) -> bool:
        """Whether a start is tried with the scan that has come."""
        self.waited += 1
        needed = self.needed
        return self.waited >= needed and self.waited % max(1, needed // 2) == 0 and bool(window.images)

    def _search(self, window: Window) -> Search:
        """Over the latest scans, no more than twice as many as are needed: a step's work grows with them."""
        drive, _ = window.drive()
        scans = drive.scans[-2 * self.needed :]
        motions = tuple(m for m in drive.lidar_motions if m.from_ns >= scans[0].stamp_ns)
        drive = replace(drive, scans=scans, lidar_motions=motions)
        return Search(drive, self.guess, self.config)

    def _started(self, matcher: WindowMatcher, point: Point) -> Started:
        """A graph of the latest scans that goes on from an estimate."""
        window, config = matcher.window, self.config
        most = len(window.scans) if config.start_work == 0 else self.needed
        chosen = [number for number, _ in window.scans][-most:]
        graph = config.calibration.joint.graph
        if config.calibration.undersides.use != "never":
            matcher.match_below(matcher.support_below(point, chosen))
        prior = prior_belief(point, self.guess, matcher.classes, graph)
        start_ns = window.stamps_ns()[chosen[0]]
        smoother = WindowSmoother(prior, start_ns, matcher.classes, graph, config.drift)
        found, _ = matcher.match(point, chosen)
        smoother.update(found, set(), window.first_scan, window.objects.live)
        return Started(smoother, Known.of(smoother), len(chosen))

    def catch_up(self) -> None:
        """Come as far with what is being looked for as one that was not stored has."""
        if self.search is not None:
            with suppress(*EXPECTED):
                self.search.go_on(0)

    def failed(self) -> None:
        """An attempt has failed; after some, the search begins anew."""
        self.attempts += 1
        self.search = None
        if self.attempts >= self.config.start_attempts:
            # The last estimate leads nowhere: look all around it.
            self.guess = Guess(self.guess.cTl, self.guess.offset_s)

    def succeeded(self) -> None:
        """There is an estimate."""
        self.alarmed, self.attempts, self.waited, self.search = False, 0, 0, None

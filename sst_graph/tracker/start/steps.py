"""How a tracker comes to its first estimate, and to the one after an alarm: some work with each frame."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sst_graph.batch.lower_edges import UndersideSupport
from sst_graph.drive.preparation import Drive
from sst_graph.errors import SstGraphError
from sst_graph.factors.errors import FactorError
from sst_graph.stepwise import Stepwise
from sst_graph.tracker.config import TrackerConfig
from sst_graph.tracker.start.solution import Guess, estimating_first, prior_belief
from sst_graph.tracker.status import Known
from sst_graph.tracker.window.epochs import MatchedPair
from sst_graph.tracker.window.gaussian import Point
from sst_graph.tracker.window.matcher import WindowMatcher
from sst_graph.tracker.window.smoother import WindowSmoother
from sst_graph.tracker.window.window import Window

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
        numbers: of the scans.
        guess: where it begins.
        work: how much of it was asked for.
    """

    def __init__(self, drive: Drive, numbers: Sequence[int], guess: Guess, config: TrackerConfig) -> None:
        self.drive, self.numbers, self.guess, self.config = drive, tuple(numbers), guess, config
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


_LOOK_WORK, _MATCH_WORK = 2, 1
"""To look below a scan, and to match one, in units of work."""


class Entering:
    """A graph of some scans at a first estimate, made of their matches some with each frame.

    First the edges towards the ground are looked at, then each scan is matched.

    Attributes:
        point: the estimate.
        chosen: numbers of the scans.
        waiting: those whose turn is still to come.
        below: support of the edges towards the ground so far; None when it is known.
        found: matches so far, by scan.
    """

    def __init__(self, point: Point, chosen: Sequence[int], config: TrackerConfig) -> None:
        self.point, self.chosen, self.waiting = point, tuple(chosen), tuple(chosen)
        self.below = None if config.calibration.undersides.use == "never" else UndersideSupport()
        self.found: dict[int, MatchedPair] = {}

    def advance(self, matcher: WindowMatcher, work: int | None) -> bool:
        """Some of it (None: all of this pass); whether all scans have been matched."""
        below = self.below
        each = _MATCH_WORK if below is None else _LOOK_WORK
        count = len(self.waiting) if work is None else max(1, work // each)
        some, self.waiting = self.waiting[:count], self.waiting[count:]
        if below is None:
            self.found |= matcher.match(self.point, some)[0]
        else:
            self.below = below.plus(matcher.lower_edge_support(self.point, some))
        if self.below is not None and not self.waiting:
            matcher.set_lower_edges(self.below)
            self.below, self.waiting = None, self.chosen
        return not self.waiting


class Starting:
    """When a start is tried, and from where.

    Attributes:
        guess: where it begins.
        waited: scans since the last attempt, or those kept when it began.
        attempts: how many have failed.
        alarmed: an alarm went before, and nothing has been found since.
        search: what is being looked for, if anything is.
        entering: an estimate that was found, and the graph that is being made at it.
    """

    def __init__(self, guess: Guess, config: TrackerConfig) -> None:
        self.guess, self.config = guess, config
        self.waited = self.attempts = 0
        self.alarmed = False
        self.search: Search | None = None
        self.entering: Entering | None = None

    def begin(self, guess: Guess, scans: int) -> None:
        """From a guess, with some scans that are there already."""
        self.guess, self.waited, self.search, self.entering = guess, scans, None, None

    @property
    def under_way(self) -> bool:
        """Whether a start is being made."""
        return self.search is not None or self.entering is not None

    @property
    def needed(self) -> int:
        """Scans that a start is made of, at least."""
        return self.config.restart_scans if self.alarmed else self.config.start_scans

    def work(self, matcher: WindowMatcher) -> Started | None:
        """What is done with a scan that has come; an estimate, once it is there.

        Raises:
            EstimationError: none was found; or another of :data:`EXPECTED`.
        """
        if not self.under_way and self._due(matcher.window):
            self.search = self._search(matcher.window)
        if self.search is not None:
            point = self.search.go_on(self.config.start_work or None)
            if point is not None:
                self._enter(matcher.window, point, self.search.numbers)
            if self.config.start_work > 0:
                return None
        return None if self.entering is None else self._entered(matcher, self.config.start_work or None)

    def finish(self, matcher: WindowMatcher) -> Started | None:
        """All that is left to do, at the end of a drive; None where too few scans have come.

        Raises:
            EstimationError: none was found; or another of :data:`EXPECTED`.
        """
        window = matcher.window
        if self.entering is None:
            if self.search is None and (len(window.scans) < self.needed or not window.images):
                return None
            search = self.search or self._search(window)
            try:
                point = search.go_on(None)
            except EXPECTED:
                if search.drive.scans[-1] is window.scans[-1][1]:
                    raise
                search = self._search(window)
                point = search.go_on(None)
            assert point is not None
            self._enter(window, point, search.numbers)
        return self._entered(matcher, None)

    def _due(self, window: Window) -> bool:
        """Whether a start is tried with the scan that has come."""
        self.waited += 1
        needed = self.needed
        return self.waited >= needed and self.waited % max(1, needed // 2) == 0 and bool(window.images)

    def _search(self, window: Window) -> Search:
        """Over the latest scans, no more than twice as many as are needed: a step's work grows with them."""
        drive, numbers = window.drive()
        scans, numbers = drive.scans[-2 * self.needed :], numbers[-2 * self.needed :]
        motions = tuple(m for m in drive.lidar_motions if m.from_ns >= scans[0].stamp_ns)
        drive = replace(drive, scans=scans, lidar_motions=motions)
        return Search(drive, numbers, self.guess, self.config)

    def _enter(self, window: Window, point: Point, searched: Sequence[int]) -> None:
        """Begin with a graph that goes on from an estimate.

        It is made of the scans that the estimate is: it fits them. Scans that came meanwhile are new to it,
        and enter as new scans do. All are taken at once where no work is saved.

        Args:
            searched: numbers of the scans that the estimate was made of.
        """
        numbers = [number for number, _ in window.scans]
        chosen = [number for number in numbers if number in searched]
        if self.config.start_work == 0:
            chosen = numbers
        elif len(chosen) < min(self.needed, len(searched)):
            # A search was so long that its scans have left.
            chosen = numbers[-self.needed :]
        self.search, self.entering = None, Entering(point, chosen, self.config)

    def _entered(self, matcher: WindowMatcher, work: int | None) -> Started | None:
        """Some work on the graph (None: all that is left); the graph, once it is made."""
        entering, window, config = self.entering, matcher.window, self.config
        assert entering is not None
        while not entering.advance(matcher, work):
            if work is not None:
                return None
        graph, point = config.calibration.joint.graph, entering.point
        prior = prior_belief(point, self.guess, matcher.classes, graph)
        found = {scan: one for scan, one in entering.found.items() if scan >= window.first_scan}
        stamps = window.stamps_ns()
        start_ns = min(stamps[scan] for scan in entering.chosen if scan in stamps)
        smoother = WindowSmoother(prior, start_ns, matcher.classes, graph, config.drift)
        smoother.update(found, set(), window.first_scan, window.objects.live)
        return Started(smoother, Known.of(smoother), len(entering.chosen))

    def catch_up(self) -> None:
        """Come as far with what is being looked for as one that was not stored has."""
        if self.search is not None:
            with suppress(*EXPECTED):
                self.search.go_on(0)

    def failed(self) -> None:
        """An attempt has failed; after some, the search begins anew."""
        self.attempts += 1
        self.search = self.entering = None
        if self.attempts >= self.config.start_attempts:
            # The last estimate leads nowhere: look all around it.
            self.guess = Guess(self.guess.cTl, self.guess.offset_s)

    def succeeded(self) -> None:
        """There is an estimate."""
        self.alarmed, self.attempts, self.waited = False, 0, 0
        self.search = self.entering = None

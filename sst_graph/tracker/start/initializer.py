"""Initialization of the tracker, and after an alarm: some work with each frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from sst_graph.batch.lower_edges import LowerEdgeSupport
from sst_graph.diagnosis import copied
from sst_graph.drive.preparation import Drive
from sst_graph.errors import EstimationError
from sst_graph.stepwise import Stepwise
from sst_graph.tracker.by_edges.kinds import by_edges, by_labels, of_kind
from sst_graph.tracker.by_edges.review import variance_ratio
from sst_graph.tracker.by_edges.start import first_edge_estimate_steps
from sst_graph.tracker.config import TrackerConfig
from sst_graph.tracker.monitor.statistic import ComparedEstimate
from sst_graph.tracker.spread_work import NUMERICAL_ERRORS, SpreadWork
from sst_graph.tracker.start.first_estimate import FirstEstimate, StartGuess
from sst_graph.tracker.start.solution import first_estimate_steps, prior_gaussian
from sst_graph.tracker.uncertainty import Uncertainty
from sst_graph.tracker.window.epochs import MatchedPair
from sst_graph.tracker.window.gaussian import Point
from sst_graph.tracker.window.matcher import WindowMatcher
from sst_graph.tracker.window.smoother import WindowSmoother
from sst_graph.tracker.window.window import Stretch, Window

_WORK_PER_FRAME = 36
"""Work on a start with each frame, in units of 4 ms: the estimate comes when all is done, some frames
later, and no frame takes long for it. Work is counted, not timed, so that equal frames give equal results."""
_PERIOD_S, _MOST_PERIODS = 0.1, 2
"""Time between two scans for which that is meant, and twice of which twice as much is done [s]."""
_RESTART_SCANS = 8
"""Scans that the start after an alarm is made of: fewer than a first one, for it begins near an estimate."""
_MAX_ATTEMPTS = 2
"""Failed attempts near the last estimate after an alarm; then all of the surroundings are searched."""
_MORE_FOR_EDGES = 2
"""So many times the scans for a start where edges are aligned: each shows less than one with labels."""
_SUPPORT_WORK, _MATCH_WORK = 2, 1
"""To check the lower edges of a scan, and to match one, in units of work."""


def searched_scans(config: TrackerConfig) -> int:
    """Latest scans of the window that a start may be made of: half of it, or twice what a start needs."""
    each = max(_needed(config, alarmed) for alarmed in (False, True))
    return max(2 * each, config.window // 2)


def _needed(config: TrackerConfig, alarmed: bool) -> int:
    """Scans that a start is made of, at least."""
    needed = _RESTART_SCANS if alarmed else config.start_scans
    more = _MORE_FOR_EDGES if by_edges(config.calibration.classes) else 1
    return needed if more == 1 else min(more * needed, config.window)


@dataclass(frozen=True)
class Restart:
    """Why, and from where, the calibration is to be estimated again.

    Attributes:
        guess: where the new start begins.
        scans: how many of the latest scans it may use.
        reason: a sentence.
        alarm: the calibration has changed; False: the start so far was wrong.
        chi2: statistic that shows it, if any.
    """

    guess: StartGuess
    scans: int
    reason: str
    alarm: bool = False
    chi2: float | None = None


@dataclass(frozen=True)
class Initialization:
    """A first estimate: the graph of some scans, its uncertainty, how many scans were matched for it, and
    where it comes from."""

    smoother: WindowSmoother
    uncertainty: Uncertainty
    scans: int
    first: FirstEstimate

    def for_comparison(self) -> ComparedEstimate:
        """For the comparison of frames with it."""
        ratio = variance_ratio(self.first.review.spread, self.uncertainty.covariance)
        return self.uncertainty.compared(self.smoother, ratio)


def start_steps(stretch: Stretch, guess: StartGuess, config: TrackerConfig) -> Stepwise[FirstEstimate]:
    """The batch solution of some scans, step by step: by labels where there are any, by edges otherwise.

    Raises:
        EstimationError: none.
    """
    classes, drive, why = config.calibration.classes, stretch.drive, ""
    if not by_edges(classes):
        return FirstEstimate((yield from _by_labels_steps(drive, guess, config)))
    if by_labels(classes) and all(drive.labelled_ns):
        labelled = of_kind(drive, edges=False)
        try:
            return FirstEstimate((yield from _by_labels_steps(labelled, guess, config)))
        except EstimationError as error:
            why = f"by labels: {error}; by edges: "
    try:
        unlabelled = replace(stretch, drive=of_kind(drive, edges=True))
        return (yield from first_edge_estimate_steps(unlabelled, guess, config))
    except EstimationError as error:
        raise EstimationError(f"{why}{error}") from error


def _by_labels_steps(drive: Drive, guess: StartGuess, config: TrackerConfig) -> Stepwise[Point]:
    """The solution by labels; labels that were copied with the guess have none but the guess.

    Raises:
        EstimationError: none, or such labels.
    """
    if (found := copied(drive, guess, config.calibration.classes)) is not None:
        raise EstimationError(found.sentence)
    return (yield from first_estimate_steps(drive, guess, config))


class Search(SpreadWork[FirstEstimate]):
    """A batch solution of some scans that is being computed.

    Attributes:
        stretch: the scans and images that it is made of, as they were when it began.
        numbers: of the scans.
        guess: where it begins.
    """

    def __init__(
        self, stretch: Stretch, numbers: Sequence[int], guess: StartGuess, config: TrackerConfig
    ) -> None:
        super().__init__()
        self.stretch, self.numbers, self.guess, self.config = stretch, tuple(numbers), guess, config

    def steps(self) -> Stepwise[FirstEstimate]:
        return start_steps(self.stretch, self.guess, self.config)


class InitialGraph:
    """Matches of some scans at a first estimate, made some with each frame.

    First the lower edges are checked, then each scan is matched.

    Attributes:
        first: the estimate.
        chosen: numbers of the scans.
        waiting: those whose turn is still to come.
        support: of the lower edges so far; None when it is known.
        found: matches so far, by scan.
    """

    def __init__(self, first: FirstEstimate, chosen: Sequence[int], config: TrackerConfig) -> None:
        self.first, self.chosen, self.waiting = first, tuple(chosen), tuple(chosen)
        self.support = None if config.calibration.lower_edges == "never" else LowerEdgeSupport()
        self.found: dict[int, MatchedPair] = {}

    def advance(self, matcher: WindowMatcher, work: int | None) -> bool:
        """Some of it (None: all of this pass); whether all scans have been matched."""
        support = self.support
        each = _MATCH_WORK if support is None else _SUPPORT_WORK
        count = len(self.waiting) if work is None else max(1, work // each)
        some, self.waiting = self.waiting[:count], self.waiting[count:]
        if support is None:
            self.found |= matcher.match(self.first.point, some)[0]
        else:
            self.support = support.plus(matcher.lower_edge_support(self.first.point, some))
        if self.support is not None and not self.waiting:
            matcher.set_lower_edges(self.support)
            self.support, self.waiting = None, self.chosen
        return not self.waiting


class Initializer:
    """Attempts at a first estimate.

    Attributes:
        guess: where it begins.
        waited: scans since the last attempt, or those kept at the restart.
        attempts: how many have failed.
        alarmed: there was an alarm, and no estimate since.
        search: the batch solution that is under way.
        graph: the graph that is being made at a solution.
        why: the last attempt has failed, or the frames before were given up; empty where neither happened.
        work_per_frame: done with each frame; None: all with one, which takes seconds.
    """

    def __init__(self, guess: StartGuess, config: TrackerConfig) -> None:
        self.guess, self.config = guess, config
        self.waited = self.attempts = 0
        self.alarmed = False
        self.search: Search | None = None
        self.graph: InitialGraph | None = None
        self.why = ""
        self.work_per_frame: int | None = _WORK_PER_FRAME

    def restart(self, guess: StartGuess, scans: int, alarmed: bool) -> None:
        """From a guess, with some scans that are there already."""
        self.guess, self.waited, self.search, self.graph = guess, scans, None, None
        self.alarmed = self.alarmed or alarmed

    @property
    def under_way(self) -> bool:
        """Whether a start is being made."""
        return self.search is not None or self.graph is not None

    @property
    def needed(self) -> int:
        """Scans that a start is made of, at least."""
        return _needed(self.config, self.alarmed)

    def work(self, matcher: WindowMatcher) -> Initialization | None:
        """Do the work of one scan; the first estimate, once it is complete.

        Raises:
            EstimationError: none was found; or another of :data:`NUMERICAL_ERRORS`.
        """
        if not self.under_way and self._due(matcher.window):
            self.search = self._search(matcher.window)
        work = self.work_for(matcher.window)
        if self.search is not None:
            first = self.search.advance(work)
            if first is not None:
                self._begin_graph(matcher.window, first, self.search.numbers)
            if work is not None:
                return None
        return None if self.graph is None else self._made(matcher, work)

    def work_for(self, window: Window) -> int | None:
        """Work to be done with the newest scan: where scans are rarer, there is more time for each."""
        if self.work_per_frame is None:
            return None
        seconds, _ = window.latest_step()
        return self.work_per_frame * min(max(round(seconds / _PERIOD_S), 1), _MOST_PERIODS)

    def finish(self, matcher: WindowMatcher) -> Initialization | None:
        """Complete the initialization at the end of a drive; None where there are too few scans.

        Raises:
            EstimationError: none was found; or another of :data:`NUMERICAL_ERRORS`.
        """
        window = matcher.window
        if self.graph is None:
            if self.search is None and (len(window.scans) < self.needed or not window.images):
                return None
            search = self.search or self._search(window)
            if by_edges(self.config.calibration.classes):
                # There are other optima: the whole window tells them apart better.
                window.dynamics.test_all()
                search = self._search(window, whole=True)
            try:
                first = search.advance(None)
            except NUMERICAL_ERRORS:
                if search.stretch.drive.scans[-1] is window.scans[-1][1]:
                    raise
                search = self._search(window)
                first = search.advance(None)
            assert first is not None
            self._begin_graph(window, first, search.numbers)
        return self._made(matcher, None)

    def _due(self, window: Window) -> bool:
        """Whether a start is tried with the scan that has come."""
        self.waited += 1
        needed = self.needed
        return self.waited >= needed and self.waited % max(1, needed // 2) == 0 and bool(window.images)

    def _search(self, window: Window, whole: bool = False) -> Search:
        """Over the latest scans, no more than twice as many as are needed: a step's work grows with them; or
        over the whole window, as at the end of a drive."""
        stretch, numbers = window.latest(len(window.scans) if whole else 2 * self.needed)
        return Search(replace(stretch, at_end=whole), numbers, self.guess, self.config)

    def _begin_graph(self, window: Window, first: FirstEstimate, searched: Sequence[int]) -> None:
        """Begin with the graph of the scans that an estimate was made of.

        Scans that came meanwhile enter later, as new scans do; all are taken at once where no work is spread.

        Args:
            searched: numbers of the scans that the estimate was made of.
        """
        numbers = [number for number, _ in window.scans]
        chosen = [number for number in numbers if number in searched]
        if self.work_per_frame is None:
            chosen = numbers
        elif len(chosen) < min(self.needed, len(searched)):
            # The search took so long that its scans have left.
            chosen = numbers[-self.needed :]
        self.search, self.graph = None, InitialGraph(first, chosen, self.config)

    def _made(self, matcher: WindowMatcher, work: int | None) -> Initialization | None:
        """Some work on the graph (None: all that is left); the smoother, once the graph is made."""
        initial, window, config = self.graph, matcher.window, self.config
        assert initial is not None
        while not initial.advance(matcher, work):
            if work is not None:
                return None
        graph = config.calibration.noise
        prior = prior_gaussian(initial.first, self.guess, matcher.classes, graph)
        found = {scan: one for scan, one in initial.found.items() if scan >= window.first_scan}
        stamps = window.stamps_ns()
        start_ns = min(stamps[scan] for scan in initial.chosen if scan in stamps)
        # Far from where they were made, edges would have no weight.
        begin = None if initial.first.known is None else initial.first.point
        smoother = WindowSmoother(prior, start_ns, matcher.classes, graph, config.drift, begin)
        smoother.update(found, set(), window.first_scan, window.objects.live)
        return Initialization(smoother, Uncertainty.of(smoother), len(initial.chosen), initial.first)

    def failed(self, why: str) -> None:
        """An attempt has failed; after some, all of the surroundings of the guess are searched."""
        self.attempts, self.why = self.attempts + 1, why
        self.search = self.graph = None
        if self.attempts >= _MAX_ATTEMPTS:
            self.guess = StartGuess(self.guess.cTl, self.guess.time_offset_s)

    def succeeded(self) -> None:
        """There is an estimate."""
        self.alarmed, self.attempts, self.waited, self.why = False, 0, 0, ""
        self.search = self.graph = None

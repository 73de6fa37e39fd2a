"""The running estimate: the window's smoother, its covariance, and quantities derived from them."""

from __future__ import annotations

import dataclasses
import logging
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from sst_graph.assumptions.of_time import SWEEP
from sst_graph.batch.assumption_tests import ParameterTest, contradiction_sentence, with_test_results
from sst_graph.covariance.considered import Considered, considered_by_steps
from sst_graph.covariance.undecided_sweep import SweepEffect
from sst_graph.errors import EstimationError
from sst_graph.odometry.sweep import SweepDecision
from sst_graph.tracker.assumption_tests import EVERY, score_findings
from sst_graph.tracker.by_edges.kinds import by_edges
from sst_graph.tracker.by_edges.review import EdgeReviews, variance_ratio
from sst_graph.tracker.config import TrackerConfig
from sst_graph.tracker.history import MAX_EPOCHS, HistoryEntry, smoothed_epochs
from sst_graph.tracker.monitor.statistic import ComparedEstimate
from sst_graph.tracker.start.first_estimate import StartGuess
from sst_graph.tracker.start.initializer import Initialization
from sst_graph.tracker.storage.snapshot import Snapshot
from sst_graph.tracker.uncertainty import Uncertainty
from sst_graph.tracker.window.epochs import MatchedPair, RetiredEpoch
from sst_graph.tracker.window.gaussian import Point
from sst_graph.tracker.window.information_log import InformationLog
from sst_graph.tracker.window.matcher import WindowMatcher
from sst_graph.tracker.window.relinearization import (
    RelinearizationSchedule,
    WindowRelinearization,
    relinearize_window,
    scans_to_match,
)
from sst_graph.tracker.window.smoother import WindowSmoother
from sst_graph.types import FloatArray

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class FrameMatches:
    """The matches made with a new scan, at the estimate before it.

    Attributes:
        scan: its number.
        chosen: numbers of the scans that were matched: this one, those without a pair yet, and some of the
            window in turn.
        found: their matches.
        missing: those that have none.
        waiting: those that were not in the graph before.
    """

    scan: int
    chosen: frozenset[int]
    found: Mapping[int, MatchedPair]
    missing: frozenset[int]
    waiting: tuple[int, ...]

    @property
    def new(self) -> list[int]:
        """Scans that come into the graph with their first matches."""
        return [scan for scan in self.waiting if scan in self.found]


class OnlineEstimate:
    """Extrinsic and time offset over the window and all that has left it.

    Attributes:
        guess: the calibration while there is no estimate.
        smoother: the graph of the window; None while there is no estimate.
        uncertainty: covariance of the estimate.
        findings: tests of the assumptions, the most contradicted first.
        entered: scans that have had a pair.
        schedule: when the whole window is relinearized.
        relinearization: of the whole window, while one is under way.
        information_log: what each scan contributed.
        past_epochs: those that have left the window since the last alarm, the latest of them (drift mode).
        starts: number of the start that the estimate comes from.
        sweep: what was decided of the sweep of the scans; None: nothing, they are used as they come.
        edges: reviews of the estimate where edges are aligned.
    """

    def __init__(self, matcher: WindowMatcher, config: TrackerConfig, guess: StartGuess) -> None:
        self.matcher, self.config, self.guess = matcher, config, guess
        self.smoother: WindowSmoother | None = None
        self.uncertainty = Uncertainty.nothing()
        self.findings: tuple[ParameterTest, ...] = ()
        self.entered: deque[int] = deque(maxlen=4 * config.window)
        self.schedule = RelinearizationSchedule(0, config.window, config.window)
        self.relinearization: WindowRelinearization | None = None
        self.information_log = InformationLog()
        self.past_epochs: deque[RetiredEpoch] = deque(maxlen=MAX_EPOCHS)
        self.starts = 0
        self.sweep: SweepDecision | None = None
        self.edges = EdgeReviews(config) if by_edges(matcher.classes) else None

    def begin(self, initialization: Initialization) -> None:
        """Go on from a first estimate."""
        smoother, window = initialization.smoother, self.matcher.window
        self.smoother, self.uncertainty = smoother, initialization.uncertainty
        if self.edges is not None:
            self.edges.begin(window.next_scan, initialization.first.review, initialization.first.known)
        self.findings = score_findings(smoother, self.config.calibration.assumptions)
        self.starts += 1
        soon = len(window.scans) + initialization.scans
        self.schedule = RelinearizationSchedule(window.first_scan, soon, self.config.window)
        self.entered.extend(smoother.entries)
        self.information_log.restart()
        newest = max(smoother.entries, default=window.next_scan - 1)
        self.information_log.add(window.frame(newest), self.reported_covariance())
        _LOG.info("tracker: started over %d scans", initialization.scans)

    def restart(self, guess: StartGuess) -> None:
        """Discard the estimate."""
        self.guess = guess
        self.stop_relinearization()
        self.smoother, self.uncertainty = None, Uncertainty.nothing()
        self.findings = ()
        if self.edges is not None:
            self.edges.restart()
        self.entered.clear()
        self.past_epochs.clear()

    # ------------------------------------------------------------------ what is known

    @property
    def exists(self) -> bool:
        """Whether there is an estimate beyond the guess."""
        return self.smoother is not None

    @property
    def point(self) -> Point:
        """The present estimate, or the guess."""
        if self.smoother is not None:
            return self.smoother.point
        return self.guess.point(self.matcher.classes, self._names)

    @property
    def _names(self) -> tuple[str, ...]:
        """Assumptions whose parameters are estimated."""
        return tuple(name for name, _ in self.config.calibration.assumptions.estimated)

    @property
    def guessed_point(self) -> Point | None:
        """The guess as an estimate; None where nothing was known."""
        return None if self.guess.cTl is None else self.guess.point(self.matcher.classes, self._names)

    @property
    def covariance(self) -> FloatArray:
        """(m, m) of extrinsic [rad, m], time offset [s], mask biases [px] and estimated parameters; of the
        first two only, and wide, before the start."""
        return self.uncertainty.covariance

    @property
    def parameters(self) -> dict[str, tuple[float, float]]:
        """Value and deviation of each estimated parameter, by its assumption; none before the start."""
        if self.smoother is None:
            return {}
        sigmas = np.sqrt(np.diag(self.covariance))[self.point.parameter_columns]
        return {
            name: (value, float(sigma))
            for (name, value), sigma in zip(self.point.nuisances.items(), sigmas, strict=True)
        }

    def reported_covariance(self) -> FloatArray:
        """(7, 7) covariance of the present estimate, with the considered assumptions and an undecided
        sweep."""
        return self._without_sweep() + self.by_sweep().covariance

    def _without_sweep(self) -> FloatArray:
        return self.covariance[:7, :7] + self._shared()

    def _shared(self) -> FloatArray:
        """(7, 7) covariance by what no choice of the matches shows: assumptions, and what all edges have in
        common."""
        considered = self.considered().covariance(7)
        if self.edges is None or self.smoother is None:
            return considered
        return considered + self.edges.covariance(self.smoother, self.uncertainty)

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why an estimate by edges may be wrong altogether."""
        return () if self.edges is None else self.edges.reasons_for(self.uncertainty)

    @property
    def contradictions(self) -> tuple[str, ...]:
        """What the data contradict of what is assumed or was said of them, the likely causes first."""
        said = "" if self.sweep is None else self.sweep.contradiction
        return (*filter(None, [said]), *contradiction_sentence(self.findings), *self.reasons)

    def by_sweep(self) -> SweepEffect:
        """The effect of a sweep that the scans leave undecided.

        The changes under its hypotheses are those by the share of the sweep that is left in the clouds: with
        turns that begin outside the camera's view, as in the assumption's column.
        """
        step = self.uncertainty.steps.get(SWEEP.name)
        if self.sweep is None or step is None:
            return SweepEffect(np.zeros((7, 7)))
        steps = {timing.fraction: -timing.fraction * step for timing in self.sweep.others}
        return SweepEffect.of(self.sweep, steps, self._without_sweep())

    def considered(self) -> Considered:
        """The considered assumptions: those whose parameters are not estimated."""
        considered = considered_by_steps(self.uncertainty.steps, self.config.calibration.assumptions)
        return with_test_results(considered, self.findings)

    def for_comparison(self) -> ComparedEstimate:
        """The running estimate, for the comparison of new frames with it."""
        assert self.smoother is not None
        ratio = 1.0
        if self.edges is not None:
            ratio = variance_ratio(self.edges.spread(self.smoother), self.covariance)
        compared = self.uncertainty.compared(self.smoother, ratio)
        return dataclasses.replace(compared, reported=self.reported_covariance())

    def history(self) -> list[HistoryEntry]:
        """The calibration of every epoch, smoothed over all of them, with covariances (drift mode)."""
        if self.smoother is None:
            return []
        entries = smoothed_epochs(self.past_epochs, self.smoother)
        extra = self._shared() + self.by_sweep().covariance
        return [dataclasses.replace(entry, covariance=entry.covariance + extra) for entry in entries]

    # ------------------------------------------------------------------ a frame

    def match(self, scan: int) -> FrameMatches:
        """Match the newest scan, those that wait for an image, those about to leave, and some in turn."""
        smoother = self.smoother
        assert smoother is not None
        chosen = scans_to_match(
            scan, self.matcher, smoother, self.entered, self.covariance, self.relinearization
        )
        found, missing = self.matcher.match(smoother.point, chosen, None, self._share)
        waiting = [n for n in chosen if n not in smoother.entries and n not in self.entered]
        return FrameMatches(scan, frozenset(chosen), found, frozenset(missing), tuple(waiting))

    def update(self, matches: FrameMatches) -> None:
        """Put matches into the graph, and estimate.

        Raises:
            EstimationError: it fails; the estimate is to be rolled back.
        """
        smoother, window, new = self.smoother, self.matcher.window, matches.new
        assert smoother is not None
        # 1. The graph, with scans that have left the window as a linear factor.
        if new or not matches.missing <= {matches.scan}:
            smoother.update(matches.found, set(matches.missing), window.first_scan, window.objects.live)
            window.dynamics.changed_scans -= matches.chosen
        self.entered.extend(new)
        # 2. At times the whole window is matched and linearized again, some scans with each frame.
        self._schedule_relinearization(matches.scan)
        # 3. Covariance, and what the scan contributed to it; the newest, where several enter.
        self.uncertainty = Uncertainty.of(smoother)
        if new:
            self.information_log.add(window.frame(max(new)), self.reported_covariance())
        # 4. Test the assumptions, and whether edges still agree with the pictures.
        if matches.scan % EVERY == 0:
            self.findings = score_findings(smoother, self.config.calibration.assumptions)
        if self.edges is not None:
            self.edges.advance(self.matcher, smoother, self.guess.cTl)
        self._take_over_retired(smoother)

    def _take_over_retired(self, smoother: WindowSmoother) -> None:
        """Keep the epochs that have left the window for the history."""
        self.past_epochs.extend(smoother.retired)
        smoother.retired.clear()

    def begin_relinearization(self) -> None:
        """Match the window again with the frames to come; no scan leaves meanwhile if none has yet."""
        window = self.matcher.window
        window.dynamics.test_all()
        self.relinearization = WindowRelinearization(self.matcher)
        window.growing = window.first_scan == self.schedule.first

    def stop_relinearization(self) -> None:
        """Stop a relinearization of the window, if one is under way."""
        self.relinearization, self.matcher.window.growing = None, False

    def _schedule_relinearization(self, scan: int) -> None:
        if self.relinearization is not None and self.relinearization.ended:
            # What came meanwhile has been matched, too.
            self.schedule.reached(scan)
            self.stop_relinearization()
        elif self.relinearization is None and not self.config.drift.enabled and self.schedule.reached(scan):
            self.begin_relinearization()

    @property
    def _share(self) -> float:
        """Factor on the weights of matches.

        In drift mode the weights are divided by the inflation of the cluster-robust covariance, so that
        matches and random walk are weighted consistently.
        """
        return 1.0 / self.uncertainty.inflation if self.config.drift.enabled else 1.0

    # ------------------------------------------------------------------ the whole window

    def optimize(self, max_iterations: int) -> bool | None:
        """Solve the whole window as the batch does; whether it converged, None where that failed and all is
        as it was.

        It has converged where the last whole step was below 0.02 standard deviations.
        """
        smoother, window = self.smoother, self.matcher.window
        if smoother is None:
            return None
        try:
            with Snapshot(self):
                self.stop_relinearization()
                window.dynamics.test_all()
                self.matcher.check_lower_edges(smoother.point)
                live, inflation = window.objects.live, self.uncertainty.inflation
                converged = relinearize_window(
                    smoother, self.matcher, max_iterations, live, self._share, inflation
                )
                self.uncertainty = Uncertainty.of(smoother)
                self.findings = score_findings(smoother, self.config.calibration.assumptions)
                if self.edges is not None:
                    self.edges.finish(self.matcher, smoother, self.guess.cTl)
        except EstimationError as error:
            _LOG.warning("tracker: the window as a whole could not be solved: %s", error)
            return None
        self.entered.extend(set(smoother.entries) - set(self.entered))
        self._take_over_retired(smoother)
        return converged

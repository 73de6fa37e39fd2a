"""Reviews of a running estimate by edges, one after the other, some of each with each frame."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.batch.by_edges.covariance import FEW_OBJECTS, FLOOR
from sst_graph.batch.by_edges.problem import KnownCalibration
from sst_graph.batch.by_edges.reasons import far_reasons
from sst_graph.graph.matching import Tracks
from sst_graph.graph.outer_loop import JointProblem
from sst_graph.graph.state import State
from sst_graph.stepwise import Stepwise
from sst_graph.tracker.by_edges.kinds import of_kind
from sst_graph.tracker.by_edges.review import EdgeReview, review_steps
from sst_graph.tracker.config import TrackerConfig
from sst_graph.tracker.spread_work import NUMERICAL_ERRORS, SpreadWork
from sst_graph.tracker.start.first_estimate import FirstEstimate, Stretch
from sst_graph.tracker.uncertainty import Uncertainty
from sst_graph.tracker.window.matcher import WindowMatcher
from sst_graph.tracker.window.smoother import WindowSmoother
from sst_graph.types import SemanticClass

FloatArray = NDArray[np.float64]

_EVERY = 20
"""Scans from the end of one review to the next."""
_WORK_PER_FRAME = 18
"""Work on a review with each frame, in units of 4 ms."""
_LEAST_SHARE = 0.1
"""Share of edges in the estimate below which their reasons do not count."""
_UNGUESSED = np.array([*[10.0] * 3, *[0.3] * 3, 1.0])
"""(7,) deviations of the priors of a review where nothing else is known [rad, m, s]."""


class Review(SpreadWork[EdgeReview]):
    """A review that is under way.

    Attributes:
        stretch: the scans, as they were when it began.
        state: the estimate then.
        known: what is known beside the edges.
    """

    def __init__(
        self, stretch: Stretch, state: State, known: KnownCalibration, config: TrackerConfig
    ) -> None:
        super().__init__()
        self.stretch, self.state, self.known, self.config = stretch, state, known, config

    def steps(self) -> Stepwise[EdgeReview]:
        drive, calibration = of_kind(self.stretch.drive, edges=True), self.config.calibration
        tracks = Tracks([drive]).with_objects(self.stretch.tracks, self.stretch.dynamic)
        problem = JointProblem([drive], tracks, calibration.joint, self.known.state, self.known.factor())
        return review_steps(problem, self.state, self.stretch.tracks, calibration.seed)


class EdgeReviews:
    """What edges add to the covariance of a running estimate, and why it may be wrong.

    Attributes:
        found: by the last review that is complete.
        reasons: why the estimate may be wrong altogether.
        known: what was known beside the matches at the start.
        next: number of the scan with which the next review begins.
        review: the one that is under way.
    """

    def __init__(self, config: TrackerConfig) -> None:
        self.config = config
        self.restart()

    def restart(self) -> None:
        """Another estimate begins."""
        self.found = EdgeReview()
        self.reasons: tuple[str, ...] = ()
        self.known: KnownCalibration | None = None
        self.next = 0
        self.review: Review | None = None

    def begin(self, scan: int, first: FirstEstimate) -> None:
        """An estimate begins; the scan of this number comes next."""
        self.restart()
        self.found, self.known, self.next = first.review, first.known, scan + _EVERY
        self.reasons = self.found.reasons

    def advance(self, matcher: WindowMatcher, smoother: WindowSmoother, guess: gtsam.Pose3 | None) -> None:
        """The work of one frame."""
        if self.review is None:
            if matcher.window.next_scan < self.next or not _by_edges(smoother):
                return
            self.review = self._new(matcher, smoother)
        self._done(_WORK_PER_FRAME, matcher, guess)

    def finish(self, matcher: WindowMatcher, smoother: WindowSmoother, guess: gtsam.Pose3 | None) -> None:
        """A whole review at once, as at the end of a drive."""
        if _by_edges(smoother):
            self.review = self._new(matcher, smoother)
            self._done(None, matcher, guess)

    def covariance(self, smoother: WindowSmoother, uncertainty: Uncertainty) -> FloatArray:
        """(7, 7) covariance by what all edges have in common, and by which of them are met.

        The spread over objects is that of an estimate from the scans of a review alone: of all that the
        tracker has seen they are a part.
        """
        window = sum(entry.linear.weight for entry in smoother.entries.values())
        of_all = window / max(window + smoother.sums.weight, 1e-9)
        own = of_all * self.found.spread + self.found.farther + np.diag(FLOOR**2)
        share, steps = uncertainty.edge_share, uncertainty.edge_steps
        return np.asarray(share @ own @ share.T + steps.T @ steps)

    def reasons_for(self, uncertainty: Uncertainty) -> tuple[str, ...]:
        """The reasons, where edges have a share in the estimate."""
        counts = float(np.abs(np.diag(uncertainty.edge_share)).max(initial=0.0)) > _LEAST_SHARE
        return self.reasons if counts else ()

    def _new(self, matcher: WindowMatcher, smoother: WindowSmoother) -> Review:
        window, state = matcher.window, smoother.point.state(matcher.classes)
        drive, numbers = window.latest(len(window.scans))
        known = self.known or KnownCalibration(state, np.diag(_UNGUESSED**2))
        return Review(Stretch(drive, *window.objects_of(numbers)), state, known, self.config)

    def _done(self, work: int | None, matcher: WindowMatcher, guess: gtsam.Pose3 | None) -> None:
        """Some work on the review (None: all); what follows once it is complete."""
        review = self.review
        assert review is not None
        try:
            found = review.advance(work)
        except NUMERICAL_ERRORS:
            found = replace(self.found, reasons=(FEW_OBJECTS,))
        if found is None:
            return
        self.review, self.found = None, found
        self.next = matcher.window.next_scan + _EVERY
        far = far_reasons(review.state.cTl, gtsam.Pose3() if guess is None else guess)
        self.reasons = (*found.reasons, *far)


def _by_edges(smoother: WindowSmoother) -> bool:
    """Whether any pair of the window is matched by edges."""
    return any(SemanticClass.OBJECT in entry.pair.matches for entry in smoother.entries.values())

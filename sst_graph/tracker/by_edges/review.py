"""Reviews of an estimate by edges, from some scans: may it be wrong altogether, and by how much is it off?

A running estimate has one review after the other, some of each with each frame. What they test, and how, is
the batch's: the score of the estimate must stand out from those of random rotations around it
(:mod:`sst_graph.batch.by_edges.reasons`); the scans are solved again with half of their objects, with edges
farther away, and without upper edges that may be no outline (:mod:`sst_graph.batch.by_edges.covariance`).
The lens is not tested (:mod:`sst_graph.batch.by_edges.lens`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np

from sst_graph.batch.by_edges.covariance import (
    FEW_OBJECTS,
    FLOOR,
    few_edges,
    half_sample_steps,
    outline_steps,
)
from sst_graph.batch.by_edges.optimum import farther_edges_steps
from sst_graph.batch.by_edges.reasons import contrast_reasons, edge_contrast_steps, far_reasons
from sst_graph.covariance.shared_errors import spread_covariance
from sst_graph.graph.known import KnownCalibration
from sst_graph.graph.matching import edges_of
from sst_graph.graph.outer_loop import JointProblem
from sst_graph.graph.state import State
from sst_graph.objects.tracks import ObjectId
from sst_graph.sampling import evenly_spread
from sst_graph.stepwise import Stepwise
from sst_graph.tracker.by_edges.kinds import of_kind
from sst_graph.tracker.config import TrackerConfig
from sst_graph.tracker.spread_work import NUMERICAL_ERRORS, SpreadWork
from sst_graph.tracker.uncertainty import Uncertainty
from sst_graph.tracker.window.matcher import WindowMatcher
from sst_graph.tracker.window.smoother import WindowSmoother
from sst_graph.tracker.window.window import Stretch
from sst_graph.types import FloatArray, SemanticClass

_SCANS = 12
"""Scans that scores are compared on."""
_EVERY = 20
"""Scans from the end of one review to the next."""
_WORK_PER_FRAME = 18
"""Work on a review with each frame, in units of 4 ms."""
_LEAST_SHARE = 0.1
"""Share of edges in the estimate below which their reasons do not count."""
_UNGUESSED = np.array([*[10.0] * 3, *[0.3] * 3, 1.0])
"""(7,) deviations of the priors of a review where nothing else is known [rad, m, s]."""


@dataclass(frozen=True)
class EdgeReview:
    """What a review has found.

    Attributes:
        reasons: why the estimate may be wrong altogether; none where nothing says so.
        spread: (7, 7) covariance of an estimate from these scans by what differs from object to object.
        farther: (7, 7) covariance by edges farther away, and by upper edges that may be no outline.
    """

    reasons: tuple[str, ...] = ()
    spread: FloatArray = field(default_factory=lambda: np.zeros((7, 7)))
    farther: FloatArray = field(default_factory=lambda: np.zeros((7, 7)))


def review_steps(
    problem: JointProblem, state: State, objects: Mapping[ObjectId, int], seed: int
) -> Stepwise[EdgeReview]:
    """The review of an estimate, step by step.

    Args:
        problem: of one drive.
        objects: tracks of its objects.
        seed: of the random rotations.

    Raises:
        EstimationError: too few matches.
    """
    drive = problem.drives[0]
    few = evenly_spread(range(len(drive.scans)), _SCANS)
    edges = edges_of([drive.part(few)], [problem.motions[0].part(few)], problem.config.graph)
    contrast = yield from edge_contrast_steps(edges, state, [], seed)
    step, unsettled = yield from farther_edges_steps(problem, state)
    halves, _ = yield from half_sample_steps(problem, state, [dict(objects)])
    outlines = yield from outline_steps(problem, state)
    farther = np.outer(step, step) + (0.0 if outlines is None else np.outer(outlines, outlines))
    reasons = (*contrast_reasons(contrast), *unsettled, *few_edges(halves, outlines))
    return EdgeReview(reasons, spread_covariance(halves), np.asarray(farther))


def variance_ratio(spread: FloatArray, covariance: FloatArray) -> float:
    """How many times the variance of an estimate by edges is that by frozen matches, on average; 1 without
    edges.

    Args:
        spread: (7, 7) covariance of the estimate by what differs from object to object.
        covariance: (m, m) by frozen matches, extrinsic and time offset first.
    """
    if not spread.any():
        return 1.0
    return 1.0 + float(np.trace(np.linalg.solve(covariance[:7, :7], spread))) / 7.0


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
        motion = self.stretch.motion(drive)
        problem = JointProblem([drive], [motion], calibration.joint, self.known.state, self.known)
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

    def begin(self, scan: int, review: EdgeReview, known: KnownCalibration | None) -> None:
        """An estimate begins, with what its start has found and known; the scan of this number comes next."""
        self.restart()
        self.found, self.known, self.next = review, known, scan + _EVERY
        self.reasons = review.reasons

    def advance(self, matcher: WindowMatcher, smoother: WindowSmoother, guess: gtsam.Pose3 | None) -> None:
        """The work of one frame."""
        if self.review is None:
            if matcher.window.next_scan < self.next or not _by_edges(smoother):
                return
            self.review = self._new(matcher, smoother)
        self._advance(_WORK_PER_FRAME, matcher, guess)

    def finish(self, matcher: WindowMatcher, smoother: WindowSmoother, guess: gtsam.Pose3 | None) -> None:
        """A whole review at once, as at the end of a drive."""
        if _by_edges(smoother):
            self.review = self._new(matcher, smoother)
            self._advance(None, matcher, guess)

    def spread(self, smoother: WindowSmoother) -> FloatArray:
        """(7, 7) covariance of the estimate by what differs from object to object.

        A review finds that of an estimate from its scans alone: of all that the tracker has seen they are a
        part.
        """
        window = sum(entry.linear.weight for entry in smoother.entries.values())
        return np.asarray(window / max(window + smoother.sums.weight, 1e-9) * self.found.spread)

    def covariance(self, smoother: WindowSmoother, uncertainty: Uncertainty) -> FloatArray:
        """(7, 7) covariance by what all edges have in common, and by which of them are met."""
        own = self.spread(smoother) + self.found.farther + np.diag(FLOOR**2)
        share, steps = uncertainty.edge_share, uncertainty.edge_steps
        return np.asarray(share @ own @ share.T + steps.T @ steps)

    def reasons_for(self, uncertainty: Uncertainty) -> tuple[str, ...]:
        """The reasons, where edges have a share in the estimate."""
        counts = float(np.abs(np.diag(uncertainty.edge_share)).max(initial=0.0)) > _LEAST_SHARE
        return self.reasons if counts else ()

    def _new(self, matcher: WindowMatcher, smoother: WindowSmoother) -> Review:
        window, state = matcher.window, smoother.point.state(matcher.classes)
        known = self.known or KnownCalibration(state, np.diag(_UNGUESSED**2))
        return Review(window.latest(len(window.scans))[0], state, known, self.config)

    def _advance(self, work: int | None, matcher: WindowMatcher, guess: gtsam.Pose3 | None) -> None:
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

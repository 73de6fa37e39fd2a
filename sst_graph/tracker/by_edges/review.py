"""Whether an estimate by edges may be wrong altogether, looked at again while frames come.

As in the batch (:mod:`sst_graph.batch.by_edges.reasons`), the score of the estimate must stand out from those
of random rotations around it, and the estimate must stay where it is when edges farther away are met. How far
it moves then, and without upper edges that may be no outline, is a deviation of its covariance. Both steps
are one Newton step of the window and all that has left it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.batch.by_edges.covariance import FEW_OUTLINES
from sst_graph.batch.by_edges.method import WIDER_KERNEL_PX
from sst_graph.batch.by_edges.reasons import (
    BLUR_PX,
    contrast_of,
    contrast_reasons,
    far_reasons,
    turned_states,
    wider_kernel_reasons,
)
from sst_graph.drive.preparation import boundaries_of
from sst_graph.edges.agreement import score
from sst_graph.factors.robust import RobustKernel
from sst_graph.features.lidar_edges import Edge
from sst_graph.graph.building import PairMatches
from sst_graph.graph.linear import scaled_inverse
from sst_graph.graph.outer_loop import MIN_MATCHES
from sst_graph.sampling import evenly_spread
from sst_graph.tracker.by_edges.kinds import EDGE_KERNEL_SHARE
from sst_graph.tracker.sums.linearized_pair import LinearizedPair
from sst_graph.types import SemanticClass

if TYPE_CHECKING:
    from sst_graph.tracker.window.matcher import WindowMatcher
    from sst_graph.tracker.window.smoother import WindowSmoother

FloatArray = NDArray[np.float64]

_EVERY = 20
"""Scans from the end of one review to the next."""
_SCANS = 12
"""Scans that scores are compared on."""
_SCORES_A_FRAME, _MATCHED_A_FRAME = 3, 8
"""Scores, and scans that are matched under the wider kernel, with each frame."""
_WIDER = RobustKernel("geman_mcclure", WIDER_KERNEL_PX[-1] / EDGE_KERNEL_SHARE)
"""Under which edges farther away are met; edges have their share of it."""


class EdgeReviews:
    """Reviews of a running estimate, one after the other, some of each with each frame.

    Attributes:
        reasons: why the estimate may be wrong altogether; none where nothing says so.
        covariance: (7, 7) by edges farther away and by upper edges that may be no outline.
        next: number of the scan with which the next review begins.
        review: the one that is under way.
    """

    def __init__(self, seed: int) -> None:
        self.seed = seed
        self.restart()

    def restart(self) -> None:
        """Another estimate begins."""
        self.reasons: tuple[str, ...] = ()
        self.covariance: FloatArray = np.zeros((7, 7))
        self.next = 0
        self.review: _Review | None = None

    def begin(self, scan: int, farther: FloatArray) -> None:
        """An estimate begins whose own scans were reviewed; it is reviewed again at once, with the graph.

        Args:
            scan: number of the next scan.
            farther: (7,) step of the estimate by edges farther away.
        """
        self.restart()
        self.covariance, self.next = np.outer(farther, farther), scan

    def advance(self, matcher: WindowMatcher, smoother: WindowSmoother, guess: gtsam.Pose3 | None) -> None:
        """The work of one frame."""
        if self.review is None:
            if matcher.window.next_scan < self.next:
                return
            self.review = _Review(matcher, smoother, self.seed)
        if self.review.advance(matcher, smoother):
            self._conclude(self.review, matcher, smoother, guess)

    def finish(self, matcher: WindowMatcher, smoother: WindowSmoother, guess: gtsam.Pose3 | None) -> None:
        """A whole review at once, as at the end of a drive."""
        review = _Review(matcher, smoother, self.seed)
        while not review.advance(matcher, smoother):
            pass
        self._conclude(review, matcher, smoother, guess)

    def _conclude(
        self, review: _Review, matcher: WindowMatcher, smoother: WindowSmoother, guess: gtsam.Pose3 | None
    ) -> None:
        self.review, self.next = None, matcher.window.next_scan + _EVERY
        if not review.scores:
            # Labels alone are in view: what was known of the edges stays.
            return
        reasons = contrast_reasons(contrast_of(review.scores[0], review.scores[1:]))
        reasons += far_reasons(review.point.cTl, gtsam.Pose3() if guess is None else guess)
        steps = review.steps(matcher, smoother)
        for step in steps:
            reasons += [FEW_OUTLINES] if step is None else []
        known = [step for step in steps if step is not None]
        reasons += wider_kernel_reasons(known[0]) if steps[0] is not None else ()
        self.reasons = tuple(reasons)
        self.covariance = np.asarray(sum((np.outer(step, step) for step in known), np.zeros((7, 7))))


class _Review:
    """One review, of the estimate at which it began.

    Attributes:
        point: that estimate.
        numbers: scans that scores are compared on.
        scores: of the estimate, then of the random rotations, as far as they are known.
        waiting: scans that are still to be matched under the wider kernel.
        wider: those that are.
    """

    def __init__(self, matcher: WindowMatcher, smoother: WindowSmoother, seed: int) -> None:
        self.point, self.seed = smoother.point, seed
        scans = sorted(scan for scan, entry in smoother.entries.items() if _of_edges(entry.pair))
        half = scans[-max(_SCANS, len(scans) // 2) :]
        self.numbers: tuple[int, ...] = tuple(evenly_spread(half, _SCANS))
        self.waiting: tuple[int, ...] = tuple(scans) if self.numbers else ()
        self.scores: list[float] = []
        self.wider: dict[int, LinearizedPair] = {}

    def advance(self, matcher: WindowMatcher, smoother: WindowSmoother) -> bool:
        """The work of one frame; whether all is done."""
        state = self.point.state(matcher.classes)
        states = [state, *turned_states(state, self.seed)] if self.numbers else []
        if len(self.scores) < len(states):
            edges = matcher.edges_of(self.numbers)
            begun = len(self.scores)
            for each in states[begun : begun + _SCORES_A_FRAME]:
                self.scores.append(score(edges, each, BLUR_PX))
            return False
        some, self.waiting = self.waiting[:_MATCHED_A_FRAME], self.waiting[_MATCHED_A_FRAME:]
        if some:
            pairs = matcher.pairs_at(self.point, some, _WIDER)
            some = tuple(scan for scan, pair in pairs.items() if len(pair))
            linear = matcher.linearized({scan: pairs[scan] for scan in some}, self.point)
            self.wider |= dict(zip(some, linear, strict=True))
        return not self.waiting

    def steps(self, matcher: WindowMatcher, smoother: WindowSmoother) -> list[FloatArray | None]:
        """(7,) steps of the estimate with edges farther away, and without upper edges that may be no outline;
        None where too few are left."""
        entries = {scan: entry for scan, entry in smoother.entries.items() if scan in self.wider}
        others = [entry.linear for scan, entry in smoother.entries.items() if scan not in self.wider]
        scans, without = dict(matcher.window.scans), dict[int, PairMatches]()
        for scan, entry in entries.items():
            pair = _without_shallow(entry.pair, boundaries_of(scans[scan], ())[SemanticClass.OBJECT].edges)
            if pair is not None:
                without[scan] = pair
        here = [entry.linear for entry in entries.values()]
        outlines = matcher.linearized(without, self.point)
        found: list[FloatArray | None] = []
        try:
            whole = self._optimum(smoother, [*here, *others])
            for some in ([self.wider[scan] for scan in entries], outlines):
                enough = sum(pair.matches for pair in some) >= MIN_MATCHES
                found.append(self._optimum(smoother, [*some, *others]) - whole if enough else None)
        except np.linalg.LinAlgError:
            return [None, None]
        return found

    def _optimum(self, smoother: WindowSmoother, pairs: Sequence[LinearizedPair]) -> FloatArray:
        """(7,) step to the optimum of some pairs and all that has left the window, from where that is
        linearized."""
        places = {track: place for pair in pairs for track, place in pair.places.items()}
        past = smoother.past.without_held()
        new = {track: place for track, place in places.items() if track not in past.point.tracks}
        past = past.with_objects(new, smoother.graph.object_bias_sigma_px)
        seen = [pair.information.without_held() for pair in pairs]
        return np.asarray((scaled_inverse(past.information_with(seen)) @ past.vector_with(seen))[:7])


def _of_edges(pair: PairMatches) -> bool:
    return SemanticClass.OBJECT in pair.matches


def _without_shallow(pair: PairMatches, kinds: NDArray[np.uint8]) -> PairMatches | None:
    """A pair matched by edges without upper edges that may be no outline; None where nothing is left."""
    c = SemanticClass.OBJECT
    matches = pair.matches[c]
    kept = np.flatnonzero(kinds[matches.index] != Edge.SHALLOW_TOP)
    return taken(pair, c, kept) if len(kept) else None


def taken(pair: PairMatches, c: SemanticClass, kept: NDArray[np.intp]) -> PairMatches:
    """A pair with some of its matches of a class, by position."""
    m = pair.matches[c]
    part = {name: getattr(m, name)[kept] for name in ("objects", "sides", "index")}
    matches = {**pair.matches, c: replace(m, alignment=m.alignment.take(kept), **part)}
    tracks = {**pair.tracks, c: pair.tracks[c][kept]} if c in pair.tracks else pair.tracks
    terms = dict(pair.terms)
    if c in terms:
        terms[c] = {name: column[kept] for name, column in terms[c].items()}
    return replace(pair, matches=matches, tracks=tracks, terms=terms)

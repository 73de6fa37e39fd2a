"""Where a first estimate begins, and what it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import gtsam

from sst_graph.graph.known import KnownCalibration
from sst_graph.tracker.by_edges.review import EdgeReview
from sst_graph.tracker.window.gaussian import Point
from sst_graph.types import Guess, SemanticClass


@dataclass(frozen=True)
class StartGuess(Guess):
    """Where a start begins.

    Attributes:
        search: search around the guess; False trusts it to within a degree or two.
    """

    search: bool = True

    def point(self, classes: tuple[SemanticClass, ...], names: Sequence[str] = ()) -> Point:
        """With mask biases and parameters (``names``) of 0; the identity where nothing is known."""
        return Point.unbiased(self.cTl or gtsam.Pose3(), self.time_offset_s, classes, names)


@dataclass(frozen=True)
class FirstEstimate:
    """A first estimate.

    Attributes:
        point: of all unknowns.
        known: what is known beside the matches; None: the weak priors around the guess alone.
        review: what a review of edges has found; nothing without edges.
        reviewed: False where it is still to come.
    """

    point: Point
    known: KnownCalibration | None = None
    review: EdgeReview = field(default_factory=EdgeReview)
    reviewed: bool = True

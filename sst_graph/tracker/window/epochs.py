"""What the online graph is made of: pairs, and epochs that share one calibration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from sst_graph.covariance.error_model import ErrorModel
from sst_graph.covariance.jackknife import composed
from sst_graph.graph.building import PairMatches
from sst_graph.tracker.sums.linearized_pair import LinearizedPair
from sst_graph.tracker.sums.running_sums import RunningSums
from sst_graph.tracker.window.ambiguous_pairs import Other
from sst_graph.tracker.window.gaussian import Gaussian, Point
from sst_graph.types import SemanticClass

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Found:
    """New matches of a scan.

    Attributes:
        pair: the matches.
        score: their belief and sums.
        stamp_ns: of the scan.
        image: number of the image; scans that meet the same one share its twist.
        other: what the scan says with its other image, where the pairing is not certain and the scan leaves.
        left_out: objects that were judged to move, with the tenths of their weight that they lost.
    """

    pair: PairMatches
    score: LinearizedPair
    stamp_ns: int
    image: int
    other: Other | None = None
    left_out: frozenset[tuple[SemanticClass, int, int]] = frozenset()


@dataclass(frozen=True)
class Entry:
    """A pair in the graph.

    Attributes:
        pair: its matches.
        score: its belief and sums at the point of the matches.
        epoch: which calibration it sees.
        image: number of its image.
        other: what the scan says with its other image.
        left_out: objects that were judged to move, with the tenths of their weight that they lost.
    """

    stored_apart: ClassVar[bool] = True

    pair: PairMatches
    score: LinearizedPair
    epoch: int
    image: int
    other: Other | None = None
    left_out: frozenset[tuple[SemanticClass, int, int]] = frozenset()


@dataclass(frozen=True)
class Epoch:
    """A stretch of time with one calibration.

    Attributes:
        number: of its keys.
        start_ns: first scan's stamp [ns].
        links: indices of the drift factors (extrinsic, offset) from the epoch before, or None for the oldest.
    """

    number: int
    start_ns: int
    links: tuple[int, int] | None = None


@dataclass(frozen=True)
class RetiredEpoch:
    """An epoch whose pairs have all left the window.

    Attributes:
        start_ns: first scan's stamp [ns].
        belief: of its pairs alone.
        excess: (n, n) variance of its score beyond that of independent matches.
    """

    start_ns: int
    belief: Gaussian
    excess: FloatArray


@dataclass
class EpochSums:
    """Belief and score sums of the oldest epoch's retired pairs, for the history."""

    belief: Gaussian
    sums: RunningSums

    @classmethod
    def empty(cls, point: Point) -> EpochSums:
        """Nothing yet, about [extrinsic, offset, biases] at a point."""
        point = point.core()
        n = point.size
        return cls(Gaussian(point, np.zeros((n, n)), np.zeros(n)), RunningSums.empty(n))

    def copy(self) -> EpochSums:
        return EpochSums(self.belief, self.sums.copy())

    def add(self, score: LinearizedPair, scan: int, sigma_px: float) -> None:
        """Take in a pair; objects that are new to the epoch lie within ``sigma_px`` of their class's bias."""
        known = self.belief.point.tracks
        new = {track: place for track, place in score.places.items() if track not in known}
        if new:
            self.belief = self.belief.with_objects(new, sigma_px)
            self.sums.grow(self.belief.point.size)
        self.belief = self.belief.plus(score.information)
        columns = self.belief.point.columns(score.information.point.tracks)
        self.sums.add(score, columns, scan, by_object=False)

    def retired(self, start_ns: int, model: ErrorModel) -> RetiredEpoch:
        """What stays of the epoch: its objects' biases marginalized out."""
        H = self.belief.information
        excess = composed(H + self.sums.excess([], [], model), None, self.sums.weight_curvature_ratio()) - H
        belief, T = self.belief.without(self.belief.point.tracks)
        return RetiredEpoch(start_ns, belief, T @ excess @ T.T)

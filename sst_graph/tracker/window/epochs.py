"""Parts of the window's graph: matched pairs, and epochs with one calibration each."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from sst_graph.covariance.error_model import ErrorModel
from sst_graph.covariance.jackknife import composed
from sst_graph.graph.matching import PairMatches
from sst_graph.tracker.sums.linearized_pair import LinearizedPair
from sst_graph.tracker.sums.running_sums import RunningSums
from sst_graph.tracker.window.gaussian import Gaussian, Point
from sst_graph.types import FloatArray, SemanticClass

EPOCH_S = 1.0
"""One calibration is estimated for each epoch of this length; shorter ones cost more variables [s]."""


@dataclass(frozen=True)
class MatchedPair:
    """A scan matched with an image, linearized where it was matched.

    Attributes:
        pair: the matches.
        linear: the pair about the point of the matches.
        stamp_ns: of the scan.
        image: number of the image; scans that meet the same one share its twist.
        left_out: dynamic objects, with the tenths of their weight that they lost.
        epoch: number of the calibration it sees, once it is in the graph.
    """

    stored_apart: ClassVar[bool] = True

    pair: PairMatches
    linear: LinearizedPair
    stamp_ns: int
    image: int
    left_out: frozenset[tuple[SemanticClass, int, int]] = frozenset()
    epoch: int = 0


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
        information: of its pairs alone.
        excess: (n, n) variance of its score beyond that of independent matches.
    """

    start_ns: int
    information: Gaussian
    excess: FloatArray


@dataclass
class EpochSums:
    """Information and sums of the oldest epoch's retired pairs, for the history."""

    information: Gaussian
    sums: RunningSums

    @classmethod
    def empty(cls, point: Point) -> EpochSums:
        """Nothing yet, about [extrinsic, offset, biases] at a point."""
        point = point.core()
        n = point.size
        return cls(Gaussian(point, np.zeros((n, n)), np.zeros(n)), RunningSums.empty(n))

    def copy(self) -> EpochSums:
        return EpochSums(self.information, self.sums.copy())

    def add(self, pair: LinearizedPair, scan: int, sigma_px: float) -> None:
        """Add a pair; objects that are new to the epoch lie within ``sigma_px`` of their class's bias."""
        known = self.information.point.tracks
        new = {track: place for track, place in pair.places.items() if track not in known}
        if new:
            self.information = self.information.with_objects(new, sigma_px)
            self.sums.grow(self.information.point.size)
        self.information = self.information.plus(pair.information)
        columns = self.information.point.columns(pair.information.point.tracks)
        self.sums.add(pair, columns, scan, by_object=False)

    def retired(self, start_ns: int, model: ErrorModel, shift_variances: FloatArray) -> RetiredEpoch:
        """The epoch without its objects' biases, which are marginalized out.

        Args:
            shift_variances: (3,) of the shifts of pictures and their stamps, from image to image.
        """
        H = self.information.information
        variance = H + self.sums.excess(model)
        excess = composed(variance, None, self.sums.weight_curvature_ratio) - H
        excess = excess + np.tensordot(shift_variances, self.sums.by_shifts, axes=1)
        information, T = self.information.without(self.information.point.tracks)
        return RetiredEpoch(start_ns, information, T @ excess @ T.T)

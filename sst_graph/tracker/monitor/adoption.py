"""Adoption: a new estimate replaces the calibration in use where held-out frames agree."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence

import numpy as np

from sst_graph.association.edge_matching import GATE
from sst_graph.drive.preparation import Drive, boundary_count
from sst_graph.factors import alignment_cost
from sst_graph.factors.robust import RobustKernel
from sst_graph.graph.matching import GraphConfig, PairMatches, Tracks, associate
from sst_graph.tracker.window.gaussian import Point
from sst_graph.types import SemanticClass

_FRAMES = 10
"""Held-out frames on which the candidate and the calibration in use are compared."""
_MARGIN = 0.02
"""The candidate's held-out cost may exceed that of the one in use by this fraction."""


class Adoption:
    """The calibration in use, and when a candidate replaces it.

    Attributes:
        adopted: the calibration in use; None before the first.
        costs: of the latest held-out frames, under the candidate and under the one in use.
        margin: fraction by which the candidate's cost may exceed that of the one in use.
    """

    def __init__(self, frames: int = _FRAMES, margin: float = _MARGIN) -> None:
        """frames: held-out frames that are compared."""
        self.margin = margin
        self.adopted: Point | None = None
        self.costs: deque[tuple[float, float]] = deque(maxlen=frames)

    def restart(self) -> None:
        """Forget the comparison; the calibration in use stays until another one is adopted."""
        self.costs.clear()

    def add_held_out(
        self, cost: Callable[[Point], float | None], candidate: Point, guess: Point | None
    ) -> None:
        """Compare candidate and calibration in use on new frames, before these are used.

        Args:
            cost: of the frames at a point; None where no boundary point is in view.
            candidate: the estimate before them.
            guess: what is in use while nothing has been adopted.
        """
        in_use = self.adopted or guess
        ours = theirs = cost(candidate)
        if in_use is not None and float(np.abs(candidate.core().local(in_use.core())).max()) > 0.0:
            theirs = cost(in_use)
        self.compare(ours, theirs)

    def compare(self, candidate: float | None, in_use: float | None) -> None:
        """Held-out costs of one frame: of the candidate made before it, and of the one in use."""
        if candidate is not None and in_use is not None:
            self.costs.append((candidate, in_use))

    def propose(self, candidate: Point, trusted: bool) -> bool:
        """Adopt the candidate if it is trusted and explains held-out frames no worse; whether it was."""
        if not trusted or len(self.costs) < (self.costs.maxlen or 0):
            return False
        ours, theirs = np.mean(self.costs, axis=0)
        if ours > (1.0 + self.margin) * theirs:
            return False
        self.adopted = candidate
        return True


def held_out_cost(
    drive: Drive,
    tracks: Tracks,
    point: Point,
    classes: tuple[SemanticClass, ...],
    kernel: RobustKernel,
    config: GraphConfig,
) -> float | None:
    """Mean robust cost of the boundary points of frames that took no part; None where none is in view.

    A point that finds no contour costs as much as the farthest match.
    """
    pairs = associate([drive], tracks, point.state(classes), kernel, config)
    counted = [(pair, boundary_count(drive.scans[pair.pair.scan], config.lower_edges)) for pair in pairs]
    return mean_cost(counted, point, classes, kernel)


def mean_cost(
    pairs: Sequence[tuple[PairMatches, int]],
    point: Point,
    classes: tuple[SemanticClass, ...],
    kernel: RobustKernel,
) -> float | None:
    """Mean robust cost of boundary points, given each pair's matches and number of boundary points."""
    cost, count = 0.0, 0
    for pair, total in pairs:
        own = next((matches.alignment.kernel for matches in pair.matches.values()), kernel)
        count += total
        cost += float(own.loss(GATE * own.scale)) * (total - len(pair))
        for c, matches in pair.matches.items():
            bias = float(point.biases_px[classes.index(c)])
            cost += alignment_cost(
                matches.alignment, point.cTl, point.time_offset_s, pair.motion.c_twist, bias
            )
    return cost / count if count else None

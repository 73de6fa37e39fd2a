"""The fit of a solution: quality, residuals, convergence, profiles."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sst_graph.drive.preparation import Drive
from sst_graph.edges.turns import turned_states
from sst_graph.fit import CLOSE_PX, MOST_POINTS, Fit, FitQuality, OuterIteration, Profile
from sst_graph.graph.drive_motion import DriveMotion
from sst_graph.graph.matching import GraphConfig, edges_of
from sst_graph.graph.state import State
from sst_graph.objects.tracks import ObjectId
from sst_graph.quality.close_points import attainable_share, close_share
from sst_graph.quality.residuals import Measured, measure_points
from sst_graph.sampling import step_for
from sst_graph.types import SemanticClass

_POINTS_OF_SHARE = 10_000
"""Most points of a drive whose share is measured under other states."""
_TURNED = 3
"""Random rotations under which the share of close points is measured: it differs by a percentage point among
them."""


class FitOfDrives:
    """Measures how states fit the labels of some drives, or edges of their pictures."""

    def __init__(
        self,
        drives: Sequence[Drive],
        motions: Sequence[DriveMotion],
        objects: Sequence[dict[ObjectId, int]],
        config: GraphConfig,
        seed: int = 0,
    ) -> None:
        """
        Args:
            objects: tracks of the objects of each drive.
            config: where no mask has a class, points are compared with the strongest edge nearby: matches
                of an estimate follow the pose.
            seed: of the random rotations that edges of pictures are compared under.
        """
        self.objects, self.seed = objects, seed
        self.by_edges = has_edges(drives)
        self.edges = edges_of(drives, motions, replace(config, edge_place="strongest"))

    def measured(self, state: State) -> Measured | None:
        """Boundary points that have a contour or an edge nearby; None without any."""
        return measure_points(self.edges, self.objects, state)

    def quality(self, measured: Measured, start: State | None, others: Sequence[State] = ()) -> FitQuality:
        """Shares of the points under the calibration and under others.

        With contours, those are shares of the same points: one that has no contour nearby is not close. Edges
        of pictures are chosen at each state, and the share is of the points that have one there: any choice
        at the calibration would favour it.

        Args:
            start: where the estimation started, or None.
            others: states for comparison, with edges of pictures.
        """
        points = measured.points
        chance = [self.share(other) for other in others]
        at_start = None
        if start is not None:
            at_start = self.share(start) if others else self._share_at(start, measured)
        return FitQuality(
            len(points),
            close_share(points.residuals_px),
            at_start,
            attainable_share(points.residuals_px, points.J[:, :3], points.frames, measured.side_numbers),
            float(np.mean(chance)) if chance else None,
        )

    def share(self, state: State) -> float:
        """Share of close points under a state, of some of each drive's points."""
        some = [own.thinned(_POINTS_OF_SHARE) for own in self.edges]
        there = measure_points(some, self.objects, state)
        return 0.0 if there is None else close_share(there.points.residuals_px)

    def fit(
        self,
        state: State,
        start: State | None,
        iterations: Sequence[OuterIteration],
        profiles: Sequence[Profile],
    ) -> Fit | None:
        """The fit of a state; None where no boundary point has a contour or an edge.

        Args:
            start: as :meth:`quality` has it.
            iterations: how the state was reached.
            profiles: along the unknowns.
        """
        measured = self.measured(state)
        if measured is None:
            return None
        others = turned_states(state, self.seed)[:_TURNED] if self.by_edges else ()
        quality, points = self.quality(measured, start, others), measured.points
        every = step_for(len(points), MOST_POINTS)
        return Fit(
            measured.frames,
            points.take(slice(None, None, every)),
            quality,
            tuple(iterations),
            tuple(profiles),
        )

    def _share_at(self, state: State, measured: Measured) -> float:
        """Share of the measured points that are close under another state."""
        there = self.measured(state)
        if there is None:
            return 0.0
        close = there.keys[np.abs(there.points.residuals_px) < CLOSE_PX]
        return (_counts(close) & _counts(measured.keys)).total() / len(measured.keys)


def has_edges(drives: Sequence[Drive]) -> bool:
    """Whether objects without a class are compared with edges of the pictures."""
    return any(SemanticClass.OBJECT in image.contours for drive in drives for image in drive.images)


def _counts(keys: NDArray[np.intp]) -> Counter[tuple[int, int]]:
    """How often each point (drive, number) is there: once for each image of its scan."""
    return Counter((drive, point) for drive, point in keys.tolist())

"""The fit of a joint solution: quality, residuals, convergence, profiles."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sst_graph.drive.preparation import Drive
from sst_graph.fit import CLOSE_PX, MOST_POINTS, Fit, FitQuality, OuterIteration
from sst_graph.graph.matching import GraphConfig, Tracks
from sst_graph.graph.outer_loop import JointSolution
from sst_graph.graph.state import State
from sst_graph.objects.tracks import ObjectId
from sst_graph.quality.close_points import attainable_share, close_share
from sst_graph.quality.profiles import profiles
from sst_graph.quality.residuals import Measured, measure_points

FloatArray = NDArray[np.float64]


class FitOfDrives:
    """Measures how states fit the labels of some drives."""

    def __init__(
        self,
        drives: Sequence[Drive],
        tracks: Tracks,
        objects: Sequence[dict[ObjectId, int]],
        config: GraphConfig,
    ) -> None:
        """objects: tracks of the objects of each drive."""
        self.drives, self.tracks, self.objects, self.config = drives, tracks, objects, config

    def measured(self, state: State) -> Measured | None:
        """Boundary points that have a contour nearby; None without any."""
        return measure_points(self.drives, self.tracks, self.objects, state, self.config)

    def quality(self, measured: Measured, start: State | None) -> FitQuality:
        """Shares of the points, the same ones under the start."""
        points = measured.points
        return FitQuality(
            len(points),
            close_share(points.residuals_px),
            None if start is None else self._share_at(start, measured),
            attainable_share(points.residuals_px, points.J[:, :3], points.frames, measured.side_numbers),
        )

    def fit(
        self,
        solution: JointSolution,
        sigmas: FloatArray,
        start: State | None,
        iterations: Sequence[OuterIteration],
    ) -> Fit | None:
        """Of a solution; None where no boundary point has a contour.

        Args:
            sigmas: (7,) of the result [rad, m, s].
            start: where the estimation started, if it did with a guess.
            iterations: how the solution was reached.
        """
        measured = self.measured(solution.state)
        if measured is None:
            return None
        quality, points = self.quality(measured, start), measured.points
        every = -(-len(points) // MOST_POINTS)
        matches = sum(map(len, solution.matches))
        return Fit(
            measured.frames,
            points.take(slice(None, None, every)),
            quality,
            tuple(iterations),
            profiles(solution.frozen, solution.optimum, sigmas, matches),
        )

    def _share_at(self, state: State, measured: Measured) -> float:
        """Share of the measured points that are close under another state."""
        there = self.measured(state)
        if there is None:
            return 0.0
        close = there.keys[np.abs(there.points.residuals_px) < CLOSE_PX]
        return len(_rows(close) & _rows(measured.keys)) / len(measured.keys)


def _rows(keys: NDArray[np.intp]) -> set[tuple[int, int]]:
    return {(drive, point) for drive, point in keys.tolist()}

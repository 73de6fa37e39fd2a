"""How well the labels of both sensors agree."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import gtsam

from sst_graph.drive.preparation import Drive
from sst_graph.types import Guess

WELL = 0.4
"""Quality above which nothing else is tried: right data have 0.2 (hand-drawn labels, crowded street) to 0.6,
wrong ones 0.03 to 0.14, seldom 0.3."""
LEAST_QUALITY = 0.17
"""Least quality of a change that is accepted."""
LEAST_CONCENTRATION = 0.62
"""Least concentration of a change that is accepted: right data have 0.69 to 0.87, overfitted ones up to
0.6."""
LEAST_GAIN, LEAST_EXPLAINED_GAIN = 2.2, 1.4
"""Least ratios of its quality, and of its explained share, to those of the data as given: on
foreign data the best of twenty searches gains something by chance."""
THERE_DEG, THERE_GAIN = 3.0, 2.0
"""A search that ends within this of where a change says that the labels agree [deg] counts its quality this
many times, whatever its concentration. On the KITTI drives right changes end within 0.4 deg with 0.15 to
0.21, wrong ones there have at most 0.02; without it an inverted start is named on neither of them, an x axis
that is flipped on one."""


@dataclass(frozen=True)
class LabelFit:
    """How well the labels of both sensors agree after a search and a short solution.

    Attributes:
        cTl, time_offset_s: where it ended.
        explained: share of the boundary points in view that meet a contour.
        concentration: share of the matches that are close.
    """

    cTl: gtsam.Pose3
    time_offset_s: float
    explained: float
    concentration: float

    @property
    def quality(self) -> float:
        """0 to 1."""
        return self.explained * self.concentration


Fitter = Callable[[Drive, Guess], LabelFit | None]
"""Searches around a guess; None where nothing is found."""

"""A second search around a result: is there a pose nearby that explains the labels better?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sst_graph.baselines.nearest_pixel_frames import MatchFrame
from sst_graph.drive.preparation import Drive
from sst_graph.initialization.global_search import (
    FINE,
    FRAMES,
    POINTS_PER_CLASS,
    SearchConfig,
    SearchProblem,
    search_steps,
)
from sst_graph.initialization.label_agreement import CELLS, LabelledPoints, SearchFrame, States
from sst_graph.sampling import evenly_spread
from sst_graph.stepwise import run_to_end
from sst_graph.types import Calibration, Guess, SemanticClass

_MIN_RATIO = 0.9
"""Least score of a result as a fraction of the best one found around it: below 1, because errors of the
labels move the maximum a little."""


@dataclass(frozen=True)
class SecondSearch:
    """Scores of a start, of a result, and of the best pose that a search finds around the result.

    All in the units of :class:`~sst_graph.initialization.global_search.Candidate`: 0 is chance.
    """

    start: float
    result: float
    best: float

    @property
    def reasons(self) -> list[str]:
        """Why the result may be wrong, in sentences; none for one that scores best."""
        found = []
        if self.result < self.start:
            found.append(
                f"the labels agree less than at the start (score {self.result:.3f} against {self.start:.3f})"
            )
        if self.result < _MIN_RATIO * self.best or self.best <= 0.0:
            found.append(
                f"another pose nearby explains the labels better (score {self.best:.3f} against "
                f"{self.result:.3f}): give a closer start, or use method joint"
            )
        return found


def search_again(
    frames: Sequence[MatchFrame],
    drives: Sequence[Drive],
    classes: Sequence[SemanticClass],
    start: Calibration,
    result: Calibration,
    config: SearchConfig,
) -> SecondSearch:
    """Search the surroundings of a result, on the frames of the drive that has most.

    Points of all classes vote on the masks: a score that no nearest-pixel method maximises.

    Raises:
        EstimationError: no frame has a labelled point.
    """
    numbers = [frame.pair.drive for frame in frames]
    richest = max(set(numbers), key=numbers.count)
    own = evenly_spread([frame for frame in frames if frame.pair.drive == richest], FRAMES)
    chosen = [_search_frame(frame, result) for frame in own]
    camera = drives[richest].camera
    problem = SearchProblem(chosen, camera, classes, Guess(*result), config)
    best = run_to_end(search_steps(problem, FINE))[0]
    rng = np.random.default_rng(config.seed)
    points = LabelledPoints.sampled(chosen, camera, classes, POINTS_PER_CLASS, rng)
    agreement = points.agreement_map(FINE[-1].blur_px, FINE[-1].share)
    scores = run_to_end(agreement.score_steps(_states([start, result])))
    cells = len(chosen) * CELLS[0] * CELLS[1]
    return SecondSearch(float(scores[0]) / cells, float(scores[1]) / cells, best.score)


def _states(calibrations: Sequence[Calibration]) -> States:
    return States(
        np.stack([c.cTl.rotation().matrix() for c in calibrations]),
        np.stack([c.cTl.translation() for c in calibrations]),
        np.array([c.time_offset_s for c in calibrations]),
    )


def _search_frame(frame: MatchFrame, at: Calibration) -> SearchFrame:
    scan, image = frame.pair.scan, frame.pair.image
    l_twist = np.asarray(at.cTl.inverse().AdjointMap()) @ frame.c_twist
    return SearchFrame(scan.lPs, scan.classes, image.mask, frame.pair.base_tau_s, l_twist)

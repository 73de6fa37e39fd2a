"""The problem of the initialization, and candidates from the frames with most labelled points."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from sst_graph.association.time_pairing import pair_by_time
from sst_graph.drive.preparation import Drive
from sst_graph.errors import EstimationError
from sst_graph.factors.camera import PinholeCamera
from sst_graph.graph.drive_motion import DriveMotion
from sst_graph.graph.state import State
from sst_graph.initialization.global_search import (
    COARSE,
    FRAMES,
    POINTS_PER_CLASS,
    Candidate,
    SearchConfig,
    SearchProblem,
    search_steps,
)
from sst_graph.initialization.label_agreement import LabelledPoints, SearchFrame, States
from sst_graph.sampling import evenly_spread
from sst_graph.stepwise import Stepwise
from sst_graph.types import FloatArray, Guess, SemanticClass

_LOG = logging.getLogger(__name__)

_LABEL_BLUR_PX = 10.0
"""Width of the masks' blur when refined candidates are scored by the labels of all points, at an image width
of 1242 [px]: a degree is 13 px, what some of them are still off."""
_MIN_CLASS_POINTS = 30
"""Fewest points of the searched classes that make a frame worth searching."""


@dataclass(frozen=True)
class StartProblem:
    """The problem of the initialization.

    Attributes:
        drives: all of them.
        motions: of the LiDAR in each.
        classes: that are compared.
        guess: what is known beforehand.
    """

    drives: Sequence[Drive]
    motions: Sequence[DriveMotion]
    classes: Sequence[SemanticClass]
    guess: Guess


def prior_centre(guess: Guess, start: State) -> State:
    """What the weak priors are centred on: the guess, or a start's rotation without a translation."""
    cTl = guess.cTl or gtsam.Pose3(start.cTl.rotation(), np.zeros(3))
    return State(cTl, (guess.time_offset_s,) * len(start.time_offsets_s))


def candidate_steps(problem: StartProblem, config: SearchConfig) -> Stepwise[list[Candidate]]:
    """Candidates from the drive that shows most, best first.

    Raises:
        EstimationError: no frame shows a searched class to both sensors, or no guess and no search.
    """
    if not config.enabled:
        if problem.guess.cTl is None:
            raise EstimationError("no guess to start from, and the search is switched off")
        return [Candidate(problem.guess.cTl, problem.guess.time_offset_s)]
    frames, camera = _richest_frames(problem, FRAMES)
    search = SearchProblem(frames, camera, problem.classes, problem.guess, config)
    candidates = yield from search_steps(search, COARSE)
    _LOG.info("start: %d frames, best scores %s", len(frames), [round(c.score, 4) for c in candidates[:5]])
    return candidates


def label_score_steps(problem: StartProblem, states: States, config: SearchConfig) -> Stepwise[FloatArray]:
    """(m,) dependence between the labels of points and of their pixels (G statistic) at each of the states.

    Silhouettes compare only where LiDAR shows an object; this also counts masks without points.

    Raises:
        EstimationError: no frame shows a searched class to both sensors.
    """
    frames, camera = _richest_frames(problem, FRAMES)
    rng = np.random.default_rng(config.seed)
    points = LabelledPoints.sampled(frames, camera, problem.classes, POINTS_PER_CLASS, rng)
    yield 5
    agreement = points.agreement_map(_LABEL_BLUR_PX, 1.0, "dependence")
    yield 5
    return (yield from agreement.score_steps(states))


def _richest_frames(problem: StartProblem, most: int) -> tuple[list[SearchFrame], PinholeCamera]:
    """Frames of the drive that shows most, and its camera.

    Raises:
        EstimationError: there is none.
    """
    frames = [_search_frames(problem, number, most) for number in range(len(problem.drives))]
    richest = max(range(len(frames)), key=lambda number: len(frames[number]))
    if not frames[richest]:
        names = " or ".join(c.name.lower() for c in problem.classes)
        raise EstimationError(f"no frame in which LiDAR and camera both show {names}")
    return frames[richest], problem.drives[richest].camera


def _search_frames(problem: StartProblem, number: int, most: int) -> list[SearchFrame]:
    """Frames spread over a drive that show the classes to both sensors."""
    drive, time_offset_s, usable = problem.drives[number], problem.guess.time_offset_s, []
    for pair in pair_by_time(
        drive.scan_stamps_ns, drive.image_stamps_ns, time_offset_s, drive.image_period_s
    ):
        scan, image = drive.scans[pair.scan], drive.images[pair.image]
        points = int(np.isin(scan.classes, problem.classes).sum())
        if points >= _MIN_CLASS_POINTS and image.contours:
            usable.append(pair)
    frames = []
    for pair in evenly_spread(usable, most):
        scan, image = drive.scans[pair.scan], drive.images[pair.image]
        sample = problem.motions[number].at(image.stamp_ns + round(time_offset_s * 1e9))
        twist = np.zeros(6) if sample is None else sample.twist
        frames.append(SearchFrame(scan.lPs, scan.classes, image.mask, pair.base_tau_s, twist))
    return frames

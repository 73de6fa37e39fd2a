"""From a guess, or none, to a start that the joint solution can be trusted to converge from."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.association.time_pairing import pair_by_time
from sst_graph.config import Settings, setting
from sst_graph.drive.preparation import Drive
from sst_graph.errors import EstimationError
from sst_graph.factors.camera import PinholeCamera
from sst_graph.graph.building import Tracks
from sst_graph.initialization.global_search import Candidate, SearchConfig, searching_start
from sst_graph.initialization.label_agreement import SearchFrame, States, Votes
from sst_graph.stepwise import Stepwise, whole
from sst_graph.types import SemanticClass

FloatArray = NDArray[np.float64]

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class StartConfig(Settings):
    """Whether and how the start is searched.

    Attributes:
        search: the global search.
        enabled: False takes the guess as it is.
        population, rounds: of the search's cross-entropy method before a contest, which takes the search's
            first blur only.
        contenders, free_contenders: most candidates that are compared, with and without a guess.
        contest_scans: scans of each drive that they are compared on.
        heat_points: boundary points, in all, that they are compared on while the kernels are wide.
        survival: share of them that goes on from one heat of the contest to the next ...
        survivors: ... but so many at least, if so many differ.
        settling: steps under the narrowest kernel.
        leads: without a guess, most poses of the first contest that are looked around more closely.
        finalists: most different solutions of the contest that are solved on all frames ...
        finalist_ratio: ... if their score is at least this fraction of the best one's.
        label_blur_px: width of the masks' blur when the labels of all points have their say in the contest,
            at an image width of 1242 [px].
        min_object_share: in the contest, an object of whose boundary in view less than this share finds a
            match is left out.
        rival_ratio: a different solution whose agreement with the labels is at least this fraction of the
            best one's makes the answer ambiguous.
        min_explained: least share of the boundary points in view that must meet a contour ...
        min_explained_vague: ... where the rotation is not observable: with so little in view, a pose that
            leaves more of it unexplained may be a wrong one ...
        min_concentration: ... and of the matches that must be close
            (:func:`~sst_graph.graph.outer_loop.concentration`); an answer with less may be wrong altogether.
        min_class_points: fewest points of the searched classes that make a frame worth looking at.
    """

    search: SearchConfig = field(default_factory=SearchConfig)
    enabled: bool = True
    population: int = setting(16, at_least=1, at_most=1000)
    rounds: int = setting(1, at_least=0, at_most=50)
    contenders: int = setting(320, at_least=1, at_most=2000)
    free_contenders: int = setting(1280, at_least=1, at_most=5000)
    contest_scans: int = setting(10, at_least=1, at_most=100)
    heat_points: int = setting(500, at_least=1, at_most=5000)
    survival: float = setting(0.4, at_least=0.0, at_most=1.0)
    survivors: int = setting(16, at_least=1, at_most=500)
    settling: int = setting(6, at_least=0, at_most=100)
    leads: int = setting(3, at_least=1, at_most=20)
    finalists: int = setting(2, at_least=1, at_most=20)
    finalist_ratio: float = setting(0.7, at_least=0.0, at_most=0.99)
    label_blur_px: float = setting(10.0, at_least=0.5, at_most=500.0)
    min_object_share: float = setting(0.3, at_least=0.0, at_most=1.0)
    rival_ratio: float = setting(0.9, at_least=0.0, at_most=1.0)
    min_explained: float = setting(0.2, at_least=0.0, at_most=1.0)
    min_explained_vague: float = setting(0.45, at_least=0.0, at_most=1.0)
    min_concentration: float = setting(0.6, at_least=0.0, at_most=1.0)
    min_class_points: int = setting(30, at_least=1, at_most=1_000_000)

    def __post_init__(self) -> None:
        # A rival is one of the finalists.
        self.expect_at_least("rival_ratio", self.finalist_ratio, "finalist_ratio")


def find_start(
    drives: Sequence[Drive],
    tracks: Tracks,
    classes: Sequence[SemanticClass],
    guess: gtsam.Pose3 | None,
    offset_s: float,
    config: StartConfig,
) -> list[Candidate]:
    """All steps of :func:`finding_start`."""
    return whole(finding_start(drives, tracks, classes, guess, offset_s, config))


def finding_start(
    drives: Sequence[Drive],
    tracks: Tracks,
    classes: Sequence[SemanticClass],
    guess: gtsam.Pose3 | None,
    offset_s: float,
    config: StartConfig,
) -> Stepwise[list[Candidate]]:
    """Candidates from the drive that shows most, best first.

    Raises:
        EstimationError: no frame shows a searched class to both sensors, or no guess and no search.
    """
    if not config.enabled:
        if guess is None:
            raise EstimationError("no guess to start from, and the search is switched off")
        return [Candidate(guess, offset_s, 0.0)]
    frames, camera = _looked_at(drives, tracks, classes, offset_s, config)
    candidates = yield from searching_start(frames, camera, classes, guess, offset_s, config.search)
    _LOG.info("start: %d frames, best scores %s", len(frames), [round(c.score, 4) for c in candidates[:5]])
    return candidates


def label_scores(
    drives: Sequence[Drive],
    tracks: Tracks,
    classes: Sequence[SemanticClass],
    states: States,
    offset_s: float,
    config: StartConfig,
) -> FloatArray:
    """All steps of :func:`scoring_labels`."""
    return whole(scoring_labels(drives, tracks, classes, states, offset_s, config))


def scoring_labels(
    drives: Sequence[Drive],
    tracks: Tracks,
    classes: Sequence[SemanticClass],
    states: States,
    offset_s: float,
    config: StartConfig,
) -> Stepwise[FloatArray]:
    """(m,) how much the labels of all points depend on those of their pixels, under each of the states.

    Silhouettes compare only where LiDAR shows an object; this also hears of masks without points.

    Raises:
        EstimationError: no frame shows a searched class to both sensors.
    """
    frames, camera = _looked_at(drives, tracks, classes, offset_s, config)
    rng = np.random.default_rng(config.search.seed)
    votes = Votes.gather(frames, camera, classes, config.search.points_per_class, rng)
    yield 5
    level = votes.level(config.label_blur_px, 1.0, "dependence")
    yield 5
    return (yield from level.scoring(states))


def _looked_at(
    drives: Sequence[Drive],
    tracks: Tracks,
    classes: Sequence[SemanticClass],
    offset_s: float,
    config: StartConfig,
) -> tuple[list[SearchFrame], PinholeCamera]:
    """Frames of the drive that shows most, and its camera.

    Raises:
        EstimationError: there is none.
    """
    frames = [
        _search_frames(number, drive, tracks, classes, offset_s, config)
        for number, drive in enumerate(drives)
    ]
    richest = max(range(len(drives)), key=lambda number: len(frames[number]))
    if not frames[richest]:
        raise EstimationError(
            "no frame in which LiDAR and camera both show " + " or ".join(c.name.lower() for c in classes)
        )
    return frames[richest], drives[richest].camera


def _search_frames(
    number: int,
    drive: Drive,
    tracks: Tracks,
    classes: Sequence[SemanticClass],
    offset_s: float,
    config: StartConfig,
) -> list[SearchFrame]:
    """Frames spread over the drive that show the classes to both sensors."""
    usable = []
    for pair in pair_by_time(drive.scan_stamps_ns, drive.image_stamps_ns, offset_s, drive.image_period_s):
        scan, image = drive.scans[pair.scan], drive.images[pair.image]
        points = int(np.isin(scan.classes, classes).sum())
        if points >= config.min_class_points and image.contours:
            usable.append(pair)
    chosen = np.unique(np.linspace(0, len(usable) - 1, config.search.frames).round().astype(int))
    frames = []
    for pair in (usable[i] for i in chosen if usable):
        scan, image = drive.scans[pair.scan], drive.images[pair.image]
        sample = tracks.at(number, image.stamp_ns + round(offset_s * 1e9))
        twist = np.zeros(6) if sample is None else sample.twist
        frames.append(SearchFrame(scan.lPs, scan.classes, image.mask, pair.base_tau_s, twist))
    return frames

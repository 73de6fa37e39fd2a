"""The search for a start, on a small standing drive."""

from __future__ import annotations

from functools import cache

import gtsam
import numpy as np
import pytest
from streets import standing_street

from sst_graph.errors import EstimationError
from sst_graph.factors import PinholeCamera
from sst_graph.initialization.global_search import (
    Candidate,
    SearchConfig,
    SearchProblem,
    SearchStage,
    _peaks,
    rotation_matrices,
    search_steps,
)
from sst_graph.initialization.label_agreement import (
    AgreementMap,
    LabelledPoints,
    LabelScore,
    SearchFrame,
    States,
)
from sst_graph.simulator import SimulatedDrive
from sst_graph.stepwise import run_to_end
from sst_graph.types import Guess, SemanticClass

VEHICLE = SemanticClass.VEHICLE


@cache
def drive() -> tuple[SimulatedDrive, tuple[SearchFrame, ...]]:
    """Three frames of a standing drive, as the search sees them."""
    source = standing_street()
    frames = []
    for frame in source:
        assert frame.scan is not None and frame.image is not None
        distance = np.linalg.norm(frame.scan.points, axis=1)
        usable = (distance > 2.0) & (distance < 60.0)
        frames.append(
            SearchFrame(
                frame.scan.points[usable].astype(np.float64),
                frame.scan.classes[usable],
                frame.image.mask,
                0.0,
                np.zeros(6),
            )
        )
    return source, tuple(frames)


def angle_deg(a: gtsam.Pose3, b: gtsam.Pose3) -> float:
    return float(np.degrees(np.linalg.norm(gtsam.Rot3.Logmap(a.rotation().between(b.rotation())))))


def sampled(
    frames: tuple[SearchFrame, ...] | list[SearchFrame], camera: PinholeCamera, most: int
) -> LabelledPoints:
    return LabelledPoints.sampled(frames, camera, [VEHICLE], most, np.random.default_rng(0))


def scores_of(agreement: AgreementMap, states: States) -> np.ndarray:
    return run_to_end(agreement.score_steps(states))


def search(config: SearchConfig, stages: tuple[SearchStage, ...]) -> tuple[gtsam.Pose3, list[Candidate]]:
    source, frames = drive()
    turn = np.radians(15.0) * np.array([2.0, -1.0, 2.0]) / 3.0
    guess = source.truth.cTl.retract(np.concatenate([turn, [0.05, -0.05, 0.05]]))
    problem = SearchProblem(frames, source.camera, [VEHICLE], Guess(guess), config)
    return guess, run_to_end(search_steps(problem, stages))


SMALL = SearchConfig()
STAGES = (
    SearchStage(45.0, 0.25, 12, samples=32, rounds=3),
    SearchStage(22.0, 0.5, 6, samples=32, rounds=3),
    SearchStage(10.0, 1.0, 4, samples=32, rounds=3),
    SearchStage(4.0, 1.0, 3, samples=32, rounds=3),
)


def test_from_15_degrees_to_below_4() -> None:
    source, _ = drive()
    guess, found = search(SMALL, STAGES)
    assert angle_deg(guess, source.truth.cTl) == pytest.approx(15.0, abs=0.01)
    assert min(angle_deg(c.cTl, source.truth.cTl) for c in found) < 4.0
    # Candidates stay within their boxes, and no time offset is invented while the vehicle stands.
    for candidate in found:
        assert angle_deg(candidate.cTl, guess) <= 1.4 * SMALL.rotation_deg + 1e-3
        shift = np.abs(candidate.cTl.translation() - guess.translation()).max()
        assert shift <= SMALL.translation_m + 1e-9 and candidate.time_offset_s == 0.0
    near = np.abs(found[0].cTl.translation() - guess.translation()).max()
    assert near <= 0.1 + 1e-9


def test_the_same_seed_gives_the_same_answer() -> None:
    stages = (
        SearchStage(45.0, 0.25, 4, samples=16, rounds=2),
        SearchStage(22.0, 0.5, 2, samples=16, rounds=2),
    )
    first, second = (search(SMALL, stages)[1] for _ in range(2))
    assert [c.score for c in first] == [c.score for c in second]
    assert all(a.cTl.equals(b.cTl, 0.0) for a, b in zip(first, second, strict=True))


@pytest.mark.parametrize("kind", ["votes", "dependence"])
@pytest.mark.parametrize("blur_px", [45.0, 10.0, 4.0])
def test_the_truth_scores_above_wrong_poses(blur_px: float, kind: LabelScore) -> None:
    source, frames = drive()
    points = sampled(frames, source.camera, 250)
    assert not points.moving
    truth = source.truth.cTl
    turns = np.concatenate([np.zeros((1, 3)), np.radians(12.0) * np.eye(3), -np.radians(12.0) * np.eye(3)])
    rotations = rotation_matrices(turns) @ truth.rotation().matrix()
    states = States(rotations, np.tile(truth.translation(), (7, 1)), np.zeros(7))
    scores = scores_of(points.agreement_map(blur_px, 1.0, kind), states)
    assert int(scores.argmax()) == 0 and scores[0] > 0.0


def test_rotation_matrices_are_gtsams() -> None:
    vectors = np.random.default_rng(1).normal(0.0, 1.5, (50, 3))
    vectors[0], vectors[1] = 0.0, 1e-9
    expected = [gtsam.Rot3.Expmap(vector).matrix() for vector in vectors]
    np.testing.assert_allclose(rotation_matrices(vectors), expected, atol=1e-12)


def test_moving_points_go_to_their_images_instant() -> None:
    # One vehicle point 10 m ahead of a camera that drives forward; only at 0.5 s does it reach the mask.
    camera = PinholeCamera(100.0, 100.0, 320.0, 100.0, 640, 200)
    mask = np.zeros((200, 640), np.uint8)
    mask[:, 400:480] = VEHICLE
    twist = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 10.0])
    frame = SearchFrame(np.array([[6.0, 0.0, 10.0]]), np.array([VEHICLE], np.uint8), mask, 0.1, twist)
    points = sampled([frame], camera, 5)
    assert points.moving
    states = States(np.tile(np.eye(3), (2, 1, 1)), np.zeros((2, 3)), np.array([0.4, -0.1]))
    # u = 320 + 100 * 6 / 5 = 440 with tau = 0.4 + 0.1 s, and 380 with tau = 0.
    scores = scores_of(points.agreement_map(4.0, 1.0), states)
    assert scores[0] > 0.0 > scores[1]


def test_dependence_by_hand() -> None:
    """Vehicles on the left half, whose mask is the left half: the G statistic of the 2x2 table."""
    camera = PinholeCamera(100.0, 100.0, 320.0, 100.0, 640, 200)
    mask = np.full((200, 640), SemanticClass.OTHER, np.uint8)
    mask[:, :320] = VEHICLE
    x = np.linspace(-2.9, 2.9, 40)  # one point a cell of the score
    lPs = np.stack([x, 0.0 * x, np.ones(40)], axis=1)
    kinds = {"fits": x < 0.0, "opposes": x > 0.0, "says nothing": x < 9.0}
    scores = {}
    for name, vehicles in kinds.items():
        classes = np.where(vehicles, VEHICLE, SemanticClass.OTHER).astype(np.uint8)
        frame = SearchFrame(lPs, classes, mask, 0.0, np.zeros(6))
        points = sampled([frame], camera, 40)
        states = States(np.eye(3)[None], np.zeros((1, 3)), np.zeros(1))
        scores[name] = float(scores_of(points.agreement_map(0.5, 1.0, "dependence"), states)[0])
    assert scores["fits"] == pytest.approx(-scores["opposes"], rel=0.05)
    assert scores["fits"] > 5.0 and abs(scores["says nothing"]) < 1e-6


def test_a_view_of_one_class_only_says_nothing() -> None:
    """All points on one large mask: votes like it, dependence does not."""
    camera = PinholeCamera(100.0, 100.0, 320.0, 100.0, 640, 200)
    mask = np.full((200, 640), SemanticClass.OTHER, np.uint8)
    mask[:, 100:540] = VEHICLE
    x = np.linspace(-1.5, 1.5, 40)
    lPs = np.stack([x, 0.0 * x, np.ones(40)], axis=1)
    frame = SearchFrame(lPs, np.full(40, VEHICLE, np.uint8), mask, 0.0, np.zeros(6))
    points = sampled([frame], camera, 40)
    states = States(np.eye(3)[None], np.zeros((1, 3)), np.zeros(1))
    assert scores_of(points.agreement_map(4.0, 1.0, "votes"), states)[0] > 1.0
    assert scores_of(points.agreement_map(4.0, 1.0, "dependence"), states)[0] < 0.5


def test_nothing_to_search_with() -> None:
    source, frames = drive()
    problem = SearchProblem(frames, source.camera, [SemanticClass.TWO_WHEELER], Guess(None), SMALL)
    with pytest.raises(EstimationError, match="no labelled point"):
        run_to_end(search_steps(problem, STAGES))


@pytest.mark.parametrize("count", [3, 60, 5000])
def test_peaks_are_the_best_that_lie_apart(count: int) -> None:
    rng = np.random.default_rng(count)
    rotations = rotation_matrices(rng.normal(0.0, 0.3, (1500, 3)))
    states = States(rotations, rng.normal(size=(1500, 3)), rng.normal(size=1500))
    scores = np.round(rng.normal(size=1500), 2)  # some alike: the first of them comes first
    chosen: list[int] = []
    for i in np.argsort(-scores, kind="stable").tolist():
        traces = (rotations[chosen] * rotations[i]).sum(axis=(1, 2))
        if len(chosen) < count and (traces < 1.0 + 2.0 * np.cos(0.1)).all():
            chosen.append(i)
    found, best = _peaks(states, scores, count, 0.1)
    np.testing.assert_array_equal(found.offsets, states.offsets[chosen])
    np.testing.assert_array_equal(best, scores[chosen])
    assert len(chosen) == count or count > 1000

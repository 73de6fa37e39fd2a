"""Which start is right, and when no answer is believed, on a small standing drive."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import gtsam
import numpy as np
import pytest
from streets import prepared_street, standing_street

from sst_graph.batch import CalibrationConfig, calibrate_prepared
from sst_graph.errors import EstimationError
from sst_graph.graph.building import Tracks
from sst_graph.graph.outer_loop import (
    JointConfig,
    JointSolution,
    agreement,
    concentration,
    explained,
    solve_joint,
    support,
)
from sst_graph.graph.state import State
from sst_graph.initialization.candidates import StartConfig, label_scores
from sst_graph.initialization.global_search import Candidate
from sst_graph.initialization.label_agreement import States
from sst_graph.initialization.many_poses import Poses
from sst_graph.initialization.selection import (
    _different,
    _far_apart,
    _wide_heats,
    choose_start,
    hold_contest,
    narrowed,
)
from sst_graph.types import SemanticClass

VEHICLE = SemanticClass.VEHICLE
JOINT, START = JointConfig(), StartConfig()


def truth() -> gtsam.Pose3:
    return standing_street().truth.cTl


def turned(*degrees: float) -> gtsam.Pose3:
    return truth().compose(gtsam.Pose3(gtsam.Rot3.Expmap(np.radians(degrees)), np.zeros(3)))


def off_deg(cTl: gtsam.Pose3) -> float:
    return float(np.degrees(np.linalg.norm(gtsam.Rot3.Logmap(truth().between(cTl).rotation()))))


@cache
def solved(degrees: float) -> JointSolution:
    """The solution under narrow kernels from a start that is turned about the vertical."""
    start, joint = State(turned(0.0, 0.0, degrees)), replace(narrowed(JOINT), min_matches=1)
    return solve_joint([prepared_street()], start, joint)


def test_heats_use_every_kernel_once() -> None:
    heats = [*_wide_heats(JOINT), narrowed(JOINT).kernel_px]
    assert tuple(k for kernels in heats for k in kernels) == JOINT.kernel_px
    one = replace(JOINT, kernel_px=(4.0,))
    assert narrowed(one).kernel_px == (4.0,)


def test_poses_that_are_alike_count_once() -> None:
    turns = [turned(0.0, 0.0, a) for a in (0.0, 0.01, 5.0, 10.0, 10.02, 20.0)]
    poses = Poses(
        np.stack([cTl.rotation().matrix() for cTl in turns]),
        np.stack([cTl.translation() for cTl in turns]),
        np.array([0.0, 0.0, 0.0, 0.0, 0.1, 0.0]),
        np.zeros((6, 1)),
    )
    ranks = np.array([3.0, 4.0, 9.0, 1.0, 2.0, 5.0])
    assert _different(poses, ranks).tolist() == [2, 5, 1, 4, 3]  # 0 is 1; 4 has another offset than 3


def test_the_truth_agrees_best() -> None:
    right, wrong = solved(0.0), solved(25.0)
    drive, tracks = [prepared_street()], Tracks([prepared_street()])
    assert agreement(right) == pytest.approx(support(right) * explained(right))
    assert agreement(right) > 2.0 * agreement(wrong) and 0.4 < explained(right) < 1.0
    assert concentration(right, drive, tracks, JOINT) > concentration(wrong, drive, tracks, JOINT)


def test_the_contest_finds_the_right_one_of_three() -> None:
    candidates = [
        Candidate(turned(*a), 0.0, 1.0) for a in ((25.0, 0.0, 0.0), (0.0, 1.0, 2.0), (0.0, -30.0, 0.0))
    ]
    tracks = Tracks([prepared_street()])
    contest = hold_contest([prepared_street()], tracks, [VEHICLE], candidates, truth(), 0.0, JOINT, START)
    assert off_deg(contest.finalists[0][0]) < 1.0
    assert len(contest.finalists) <= START.finalists


def test_a_pose_far_from_the_guess_is_no_answer() -> None:
    tracks, candidates = Tracks([prepared_street()]), [Candidate(turned(0.0, 1.0, 2.0), 0.0, 1.0)]
    far = gtsam.Pose3(truth().rotation(), truth().translation() + np.array([0.0, 0.9, 0.0]))
    with pytest.raises(EstimationError, match="near the guess"):
        hold_contest([prepared_street()], tracks, [VEHICLE], candidates, far, 0.0, JOINT, START)


@pytest.mark.parametrize("guess", [True, False])
def test_a_start_from_a_rough_guess_or_none(guess: bool) -> None:
    tracks = Tracks([prepared_street()])
    rough = turned(8.0, -6.0, 9.0) if guess else None
    contest = choose_start([prepared_street()], tracks, [VEHICLE], rough, 0.0, JOINT, START)
    # It leads where the truth leads, which with the few vehicles of this street is 0.9 deg away.
    finalist = contest.finalists[0][0]
    found, best = (
        solve_joint([prepared_street()], State(cTl), JOINT, tracks=tracks).state.cTl
        for cTl in (finalist, truth())
    )
    assert off_deg(best) < 1.0
    assert np.degrees(np.linalg.norm(gtsam.Rot3.Logmap(best.between(finalist).rotation()))) < 0.6
    assert np.degrees(np.linalg.norm(gtsam.Rot3.Logmap(best.between(found).rotation()))) < 0.15


def test_a_contest_that_is_switched_off_takes_the_guess() -> None:
    off = replace(START, enabled=False)
    contest = choose_start(
        [prepared_street()], Tracks([prepared_street()]), [VEHICLE], turned(1.0, 0.0, 0.0), 0.1, JOINT, off
    )
    assert contest.finalists == ((contest.finalists[0][0], 0.1),)


def test_shortened_steps_lead_to_the_same_answer() -> None:
    start = State(turned(0.3, 0.2, -0.3))
    short = solve_joint([prepared_street()], start, replace(narrowed(JOINT), full_steps=0))
    full = solve_joint([prepared_street()], start, narrowed(JOINT))
    assert short.converged and short.outer_iterations >= full.outer_iterations
    angle = np.linalg.norm(gtsam.Rot3.Logmap(short.state.cTl.between(full.state.cTl).rotation()))
    assert np.degrees(angle) < 0.05


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"min_explained": 0.99}, "boundary points in view meet a contour"),
        ({"min_concentration": 0.999}, "of the matches are close ones"),
    ],
)
def test_an_answer_with_little_behind_it_is_doubted(changes: dict[str, float], reason: str) -> None:
    config = CalibrationConfig(start=replace(START, **changes))
    result = calibrate_prepared([prepared_street()], turned(2.0, -1.0, 2.0), config)
    assert result.status == "not_converged"
    assert any(reason in sentence for sentence in result.reasons)
    assert 0.0 < result.diagnostics["explained"] < 1.0 and 0.0 < result.diagnostics["concentration"] < 1.0


def test_more_must_be_explained_where_the_rotation_is_not_observable() -> None:
    config = CalibrationConfig(start=replace(START, min_explained_vague=0.99))
    clear, doubted = (
        calibrate_prepared(
            [prepared_street()],
            turned(2.0, -1.0, 2.0),
            replace(config, observability=replace(config.observability, rotation_deg=limit)),
        )
        for limit in (90.0, 1e-3)
    )
    reason = "boundary points in view meet a contour"
    assert not any(reason in sentence for sentence in clear.reasons)
    assert doubted.status == "not_converged" and any(reason in sentence for sentence in doubted.reasons)


def test_leads_are_far_apart_and_the_winner_comes_first() -> None:
    starts = [(turned(0.0, 0.0, a), 0.0) for a in (0.0, 10.0, 60.0, 65.0, 120.0)]
    assert [round(off_deg(cTl)) for cTl, _ in _far_apart(starts)] == [0, 60, 120]


def test_labels_tell_a_pose_that_shows_none_of_the_vehicles() -> None:
    drives = [prepared_street()]
    poses = [truth(), turned(0.0, 0.0, 30.0), turned(0.0, 180.0, 0.0)]
    states = States(
        np.stack([cTl.rotation().matrix() for cTl in poses]),
        np.stack([cTl.translation() for cTl in poses]),
        np.zeros(3),
    )
    scores = label_scores(drives, Tracks(drives), [VEHICLE], states, 0.0, START)
    assert scores[0] > 1.5 * scores[1] and scores[0] > 1.5 * scores[2] and scores[0] > 5.0

"""Which start is right, and when no answer is believed, on a small standing drive."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import gtsam
import numpy as np
import pytest
from streets import prepared_street, standing_street

from sst_graph.association.search import Candidate
from sst_graph.estimators import CalibrationConfig, calibrate_prepared
from sst_graph.estimators.contest import _heats, _survivors, choose_start, hold_contest, narrowed
from sst_graph.estimators.joint import (
    JointConfig,
    JointSolution,
    agreement,
    concentration,
    explained,
    solve_joint,
    support,
)
from sst_graph.estimators.start import StartConfig
from sst_graph.problem.graph import Tracks
from sst_graph.problem.state import State
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
    heats = _heats(JOINT)
    assert tuple(k for heat in heats for k in heat.kernel_px) == JOINT.kernel_px
    assert all(heat.max_outer == len(heat.kernel_px) for heat in heats[:-1])
    assert heats[-1].max_outer == JOINT.max_outer and heats[-1] == narrowed(JOINT)
    one = replace(JOINT, kernel_px=(4.0,))
    assert narrowed(one).kernel_px == (4.0,)


def test_survivors_differ_and_are_the_better_half() -> None:
    found = [
        replace(solved(0.0), state=State(turned(0.0, 0.0, a))) for a in (0.0, 0.01, 5.0, 10.0, 15.0, 20.0)
    ]
    kept = [off_deg(state.cTl) for state in _survivors(found, replace(START, survivors=1))]
    np.testing.assert_allclose(kept, [0.0, 5.0, 10.0], atol=1e-6)
    assert len(_survivors(found, replace(START, survivors=4))) == 4


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
    contest = hold_contest([prepared_street()], tracks, candidates, truth(), 0.0, JOINT, START)
    assert off_deg(contest.finalists[0][0]) < 1.0
    assert len(contest.finalists) <= START.finalists


@pytest.mark.parametrize("guess", [True, False])
def test_a_start_from_a_rough_guess_or_none(guess: bool) -> None:
    tracks = Tracks([prepared_street()])
    rough = turned(8.0, -6.0, 9.0) if guess else None
    contest = choose_start([prepared_street()], tracks, [VEHICLE], rough, 0.0, JOINT, START)
    assert off_deg(contest.finalists[0][0]) < 1.0


def test_a_contest_that_is_switched_off_takes_the_guess() -> None:
    off = replace(START, enabled=False)
    contest = choose_start(
        [prepared_street()], Tracks([prepared_street()]), [VEHICLE], turned(1.0, 0.0, 0.0), 0.1, JOINT, off
    )
    assert contest.finalists == ((contest.finalists[0][0], 0.1),) and contest.doubt is None


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

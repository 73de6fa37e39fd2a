"""The fit of a solution on a simulated street."""

from __future__ import annotations

import copy
from dataclasses import replace
from functools import cache

import gtsam
import numpy as np
import pytest
from stored import simulated, stored
from streets import CROWDED_STREET, HALF_SIZE, crowded_street

from sst_graph.batch import CalibrationConfig
from sst_graph.batch.calibrate import prepare_drives
from sst_graph.batch.problem import CalibrationProblem
from sst_graph.data.kept_drive import KeptDrive
from sst_graph.drive.preparation import Drive
from sst_graph.fit import Fit, FitQuality
from sst_graph.graph.outer_loop import NARROW_KERNELS_PX, JointSolution, solve_joint
from sst_graph.graph.state import State
from sst_graph.quality import fit_of_solution
from sst_graph.quality.fit_of_solution import FitOfDrives
from sst_graph.quality.profiles import profiles
from sst_graph.types import Guess

CONFIG = CalibrationConfig(use_motion="never")


@cache
def _drives() -> list[Drive]:
    street = crowded_street()
    return stored((CROWDED_STREET, "drives of the fit"), lambda: prepare_drives([street], CONFIG))


@cache
def _solved() -> tuple[CalibrationProblem, JointSolution]:
    truth = crowded_street().truth
    assert truth is not None and truth.time_offset_s is not None
    problem = CalibrationProblem.of(_drives(), Guess(truth.cTl, truth.time_offset_s), CONFIG)
    start = State(truth.cTl, (truth.time_offset_s,))
    return problem, solve_joint(problem.joint(), start, NARROW_KERNELS_PX, lambda *step: _stages.add(step[0]))


_stages: set[str] = set()
"""Names that the solution above has given its progress."""


def test_progress_names_no_method() -> None:
    """Edges and the parts of a test are solved by the same loop."""
    _solved()
    assert _stages == {"solve"}


def _of_drives() -> FitOfDrives:
    problem, _ = _solved()
    return FitOfDrives(problem.drives, problem.motions, problem.objects, problem.config.joint.graph)


def _quality(state: State) -> FitQuality:
    drives = _of_drives()
    measured = drives.measured(state)
    assert measured is not None
    return drives.quality(measured, None)


def _turned(axis: int, degrees: float) -> State:
    state = _solved()[1].state
    step = np.zeros(6)
    step[axis] = np.radians(degrees)
    return replace(state, cTl=state.cTl.compose(gtsam.Pose3.Expmap(step)))


@cache
def _fit() -> Fit:
    _, solution = _solved()
    sigmas = np.array([5e-4] * 3 + [0.005] * 3 + [0.001])
    along = profiles(solution.frozen, solution.optimum, sigmas, sum(map(len, solution.matches)))
    fit = _of_drives().fit(solution.state, None, solution.iterations, along)
    assert fit is not None
    return fit


def test_what_labels_allow_is_what_the_truth_gives() -> None:
    truth = crowded_street().truth
    assert truth is not None and truth.time_offset_s is not None
    at_truth = replace(_solved()[1].state, cTl=truth.cTl, time_offsets_s=(truth.time_offset_s,))
    assert _quality(_solved()[1].state).attainable == pytest.approx(_quality(at_truth).share, abs=0.03)


@pytest.mark.parametrize("axis", [1, 2])
@pytest.mark.parametrize("degrees", [-0.3, 0.3])
def test_three_tenths_of_a_degree_are_visible(axis: int, degrees: float) -> None:
    """At half the usual size, where they are 1.9 px; what the labels allow stays."""
    right, wrong = _quality(_solved()[1].state), _quality(_turned(axis, degrees))
    assert wrong.share < 0.92 * wrong.attainable
    assert wrong.attainable == pytest.approx(right.attainable, abs=0.05)


def test_share_at_the_start_is_of_the_same_points() -> None:
    drives, state = _of_drives(), _solved()[1].state
    measured = drives.measured(state)
    assert measured is not None
    same = drives.quality(measured, state)
    assert same.share_at_start == same.share
    far = drives.quality(measured, _turned(1, 5.0)).share_at_start
    assert far is not None and far < 0.3 * same.share


def test_profiles_have_their_least_cost_at_the_result_and_its_curvature() -> None:
    for profile in _fit().profiles:
        k = int(np.argmin(profile.costs))
        assert profile.steps[k] == 0.0 and profile.costs[k] == 0.0
        inner = np.abs(profile.steps) <= 1.5 * np.sort(np.abs(profile.steps))[1]
        gauss = 0.5 * (profile.steps[inner] / profile.sigma) ** 2
        assert profile.costs[inner] == pytest.approx(gauss, rel=0.25, abs=0.05)


def test_a_profile_is_below_every_cost_with_the_others_held() -> None:
    """Letting the others follow can only lower the cost."""
    _, solution = _solved()
    frozen, optimum = solution.frozen, solution.optimum
    best = frozen.linearized(optimum).cost
    for profile in profiles(frozen, optimum, np.array([5e-4] * 3 + [0.005] * 3 + [0.001]), 0):
        x = np.zeros(len(optimum.scalars) + 6)
        x[profile.unknown] = profile.steps[-1]
        held = frozen.linearized(frozen.moved(optimum, x, np.zeros_like(optimum.twists))).cost - best
        assert profile.costs[-1] <= held + 1e-6


def test_the_sample_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = _fit()
    assert copy.deepcopy(whole) == whole and hash(whole) == hash(_fit())
    monkeypatch.setattr(fit_of_solution, "MOST_POINTS", 100)
    _, solution = _solved()
    small = _of_drives().fit(solution.state, None, (), ())
    assert small is not None
    assert len(small.points) <= 100 < len(whole.points) and small.quality == whole.quality


def test_quality_is_read_back_and_nonsense_is_not() -> None:
    for quality in (FitQuality(120, 0.8, None, 0.85), FitQuality(120, 0.4, 0.1, 0.42, 0.19)):
        assert FitQuality.from_diagnostics({"fit_quality": quality.to_dict()}) == quality
    older = {name: value for name, value in quality.to_dict().items() if name != "by_chance"}
    assert FitQuality.from_diagnostics({"fit_quality": older}) == replace(quality, by_chance=None)
    for wrong in (
        {"share": 1.2},
        {"points": True},
        {"attainable": "0.8"},
        {"share_at_start": -1.0},
        {"by_chance": "0.2"},
    ):
        assert FitQuality.from_diagnostics({"fit_quality": {**quality.to_dict(), **wrong}}) is None
    assert FitQuality.from_diagnostics({"fit_quality": 3}) is None


def test_the_start_has_its_share_of_points_that_several_images_show() -> None:
    """A camera three times as fast as the LiDAR: at the very start the two shares are one."""
    config = replace(HALF_SIZE, seed=3, frames=6, frame_rate_hz=30.0, time_offset_s=0.03, motion="no_stop")
    kept = KeptDrive.of(simulated(config))
    frames = tuple(one if k % 3 == 0 else replace(one, scan=None) for k, one in enumerate(kept.frames))
    (drive,) = prepare_drives([replace(kept, frames=frames)], CONFIG)
    assert drive.has_dense_images and kept.truth is not None
    problem = CalibrationProblem.of([drive], Guess(kept.truth.cTl, 0.03), CONFIG)
    of_drives = FitOfDrives([drive], problem.motions, problem.objects, problem.config.joint.graph)
    state = State(kept.truth.cTl, (0.03,))
    measured = of_drives.measured(state)
    assert measured is not None and len(np.unique(measured.keys, axis=0)) < 0.6 * len(measured.keys)
    quality = of_drives.quality(measured, state)
    assert quality.share_at_start == quality.share > 0.5

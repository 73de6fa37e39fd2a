"""The lens tested by edges: a wrong one is named with its size where it matters, the right one is not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from stored import simulated
from streets import LENS_STREET as STREET

from sst_graph import CalibrationConfig, calibrate
from sst_graph.assumptions import ASSUMPTIONS
from sst_graph.batch.assumption_tests import ParameterTest
from sst_graph.batch.by_edges import lens
from sst_graph.batch.by_edges.covariance import SAMPLES
from sst_graph.batch.by_edges.lens import MATTERS_SIGMAS, LensTest, lens_steps
from sst_graph.batch.by_edges.optimum import NEAR_KERNELS_PX, START_KERNELS_PX
from sst_graph.batch.by_edges.parts import thinned
from sst_graph.batch.by_edges.problem import LabelEstimate, edges_problem, motion_alone
from sst_graph.batch.calibrate import prepare_drives
from sst_graph.batch.problem import CalibrationProblem
from sst_graph.covariance.considered import AssumptionConfig
from sst_graph.drive.preparation import Drive
from sst_graph.graph.outer_loop import JointProblem, solve_joint
from sst_graph.graph.state import State
from sst_graph.simulator import SimulationConfig
from sst_graph.stepwise import Stepwise, run_to_end
from sst_graph.types import Guess

FloatArray = NDArray[np.float64]

SIGMAS = np.array([*np.radians([0.1] * 3), 0.02, 0.02, 0.02, 0.005])
COVARIANCE = np.diag(SIGMAS**2)


@pytest.fixture(scope="module")
def drive() -> Drive:
    config = CalibrationConfig(method="edges", decide_sweep=False)
    return thinned(prepare_drives([simulated(STREET)], config)[0], 300)


def examined(drive: Drive, estimate: Sequence[str] = ()) -> LensTest:
    """The lens of a drive, from a solution that starts at the truth."""
    truth = simulated(STREET).truth
    config = CalibrationConfig(method="edges", assumptions=AssumptionConfig(estimate=tuple(estimate)))
    problem = CalibrationProblem.of([drive], Guess(truth.cTl, truth.time_offset_s), config)
    start, kernels_px = State(truth.cTl, (truth.time_offset_s,)), (*START_KERNELS_PX, *NEAR_KERNELS_PX)
    solution = solve_joint(problem.joint(), start, kernels_px)
    edges = edges_problem(problem, None, LabelEstimate(solution.state, has_motion=True))
    return run_to_end(lens_steps(edges, solution.state, problem.objects, config.assumptions))


def test_the_right_lens_is_not_contradicted(drive: Drive) -> None:
    found = examined(drive)
    assert {each.assumption.name for each in found.findings} == {"focal", "cx", "cy", "k1"}
    assert not found.contradicted and found.reasons(COVARIANCE) == () == found.remarks(COVARIANCE)
    assert not found.covariance.any()


def test_motion_follows_a_principal_point_that_is_estimated_and_holds_no_skew(drive: Drive) -> None:
    truth = simulated(STREET).truth
    guess = Guess(truth.cTl, truth.time_offset_s)
    for estimate, held in (((), True), (("cy",), True), (("skew",), False)):
        config = CalibrationConfig(method="edges", assumptions=AssumptionConfig(estimate=estimate))
        problem = CalibrationProblem.of([drive], guess, config)
        motion = motion_alone([drive], guess, config, None)
        assert motion is not None
        known = edges_problem(problem, motion, LabelEstimate()).known
        pitch_deg = np.degrees(np.sqrt(known.covariance[1, 1]))
        assert bool(pitch_deg < 5.0) is held and bool(known.steps) is held


def test_a_wrong_principal_point_is_named_with_its_size(drive: Drive) -> None:
    wrong = replace(drive, camera=replace(drive.camera, cx=drive.camera.cx - 8.0))
    found = examined(wrong)
    first = found.contradicted[0]
    assert first.assumption.name == "cx" and first.value == pytest.approx(8.0, abs=2.0)
    (reason,) = found.reasons(COVARIANCE)
    assert reason.startswith("the pictures lie beside the principal point cx: cx = ")
    # What the estimate would move by is in the covariance.
    focal, step = drive.camera.fx, found.step
    assert step is not None and abs(step[2]) == pytest.approx(8.0 / focal, rel=0.4)
    np.testing.assert_allclose(np.diag(found.covariance), step**2)


def test_half_samples_beside_the_estimate_contradict_no_lens(
    drive: Drive, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same wrong principal point; but every half-sample finds the right one again. Then the data have two
    answers, and tell nothing about it."""

    def all_right_again(
        problem: JointProblem, start: State, objects: object, enough: object
    ) -> Stepwise[tuple[FloatArray, dict[str, FloatArray]]]:
        yield 1
        steps = {name: -value + 0.1 * (-1.0) ** np.arange(SAMPLES) for name, value in start.nuisances.items()}
        return np.zeros((SAMPLES, 7)), steps

    wrong = replace(drive, camera=replace(drive.camera, cx=drive.camera.cx - 8.0))
    monkeypatch.setattr(lens, "half_sample_steps", all_right_again)
    found = {each.assumption.name: each for each in examined(wrong).findings}["cx"]
    assert found.value == pytest.approx(8.0, abs=2.0) and found.sigma > 0.9 * found.value
    assert not found.contradicted


@pytest.mark.slow
def test_another_optimum_with_fewer_edges_is_no_wrong_lens() -> None:
    """Here wide kernels lead to cy = 7 px and a pitch that fits it; nine tenths of the edges are met."""
    street = simulated(SimulationConfig(seed=3, frames=30))
    result = calibrate(street, street.nominal, CalibrationConfig(method="edges"))
    found = result.diagnostics["assumptions"]
    assert {name for name, each in found.items() if each.get("contradicted")} == set()
    assert abs(found["cy"]["estimate"]) < 3.5  # half way to the other optimum
    assert result.status != "not_converged", result.reasons


def test_a_lens_parameter_that_is_estimated_is_not_tested(drive: Drive) -> None:
    names = {each.assumption.name for each in examined(drive, ("k1",)).findings}
    assert names == {"focal", "cx", "cy"}


def test_nothing_is_tested_where_no_test_is_asked_for(drive: Drive) -> None:
    truth = simulated(STREET).truth
    config = CalibrationConfig(method="edges")
    problem = CalibrationProblem.of([drive], Guess(truth.cTl, truth.time_offset_s), config)
    state = State(truth.cTl, (truth.time_offset_s,))
    edges = edges_problem(problem, None, LabelEstimate(state))
    untested = lens_steps(edges, state, problem.objects, AssumptionConfig(test=False))
    assert run_to_end(untested) == LensTest()


def test_a_lens_matters_where_the_estimate_moves_by_more_than_it_is_known() -> None:
    k1 = ParameterTest(ASSUMPTIONS["k1"], 0.014, 0.003, True)
    focal = ParameterTest(ASSUMPTIONS["focal"], -0.005, 0.001, True)
    for factor, matters in ((0.9, False), (1.1, True)):
        step = np.zeros(7)
        step[3] = factor * MATTERS_SIGMAS * SIGMAS[3]
        found = LensTest((k1, focal), step)
        assert bool(found.reasons(COVARIANCE)) == matters != bool(found.remarks(COVARIANCE))
        np.testing.assert_allclose(found.covariance, np.outer(step, step))
    (reason,) = found.reasons(COVARIANCE)
    assert "k1 = 0.014 ± 0.003" in reason and reason.endswith("(estimated with it: focal = -0.005 ± 0.001)")
    held = replace(k1, contradicted=False)
    assert LensTest((held,), step).reasons(COVARIANCE) == ()

"""The lens tested by edges: a wrong one is named with its size where it matters, the right one is not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import gtsam
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
from sst_graph.batch.by_edges.optimum import START_KERNELS_PX
from sst_graph.batch.by_edges.parts import thinned
from sst_graph.batch.by_edges.problem import KnownCalibration, LabelEstimate, edges_problem
from sst_graph.batch.by_edges.solution import NEAR_KERNELS_PX
from sst_graph.batch.calibrate import prepare_drives
from sst_graph.batch.problem import CalibrationProblem
from sst_graph.covariance.considered import AssumptionConfig
from sst_graph.drive.preparation import Drive
from sst_graph.factors.camera import PinholeCamera
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


def examined(drive: Drive, estimate: Sequence[str] = (), motion_deg: float | None = None) -> LensTest:
    """The lens of a drive, from a solution that starts at the truth.

    Args:
        motion_deg: sigma of the rotation by motion, that agrees with the edges by the lens as given [deg].
    """
    truth = simulated(STREET).truth
    config = CalibrationConfig(method="edges", assumptions=AssumptionConfig(estimate=tuple(estimate)))
    problem = CalibrationProblem.of([drive], Guess(truth.cTl, truth.time_offset_s), config)
    start, kernels_px = State(truth.cTl, (truth.time_offset_s,)), (*START_KERNELS_PX, *NEAR_KERNELS_PX)
    solution = solve_joint(problem.joint(), start, kernels_px)
    edges = edges_problem(problem, None, LabelEstimate(solution.state, has_motion=True))
    if motion_deg is not None:
        sigmas = np.array([*np.radians([motion_deg] * 3), 0.1, 0.1, 0.1, 0.004])
        known = KnownCalibration(solution.state, np.diag(sigmas**2))
        edges = replace(edges, known=known, whole=replace(edges.whole, prior=known.factor()))
    return run_to_end(lens_steps(edges, solution.state, problem.objects, config.assumptions))


def test_the_right_lens_is_not_contradicted(drive: Drive) -> None:
    found = examined(drive)
    assert {each.assumption.name for each in found.findings} == {"focal", "cx", "cy", "k1"}
    assert not found.contradicted and found.reasons(COVARIANCE) == () == found.remarks(COVARIANCE)
    assert not found.covariance.any()


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


@pytest.mark.parametrize("motion_deg", [None, 0.1])
def test_what_is_not_contradicted_does_not_move_the_estimate(drive: Drive, motion_deg: float | None) -> None:
    """These edges know cy to 5 px, 0.6 deg of pitch; cx alone is wrong, and turns the estimate."""
    wrong = replace(drive, camera=replace(drive.camera, cx=drive.camera.cx - 8.0))
    found = examined(wrong, motion_deg=motion_deg)
    assert [each.assumption.name for each in found.contradicted] == ["cx"]
    assert found.step is not None
    c_turn_deg = np.degrees(simulated(STREET).truth.cTl.rotation().matrix() @ found.step[:3])
    assert abs(c_turn_deg[0]) < 0.3
    assert c_turn_deg[1] == pytest.approx(-np.degrees(8.0 / drive.camera.fx), rel=0.4)


def test_motion_does_not_hold_the_principal_point(drive: Drive) -> None:
    """Motion was measured with the lens as given, and takes a wrong principal point for a turn."""
    wrong = replace(drive, camera=replace(drive.camera, cx=drive.camera.cx - 8.0))
    found = {each.assumption.name: each for each in examined(wrong, motion_deg=0.1).findings}
    assert found["cx"].value == pytest.approx(8.0, abs=2.0)
    # As much as without motion.
    assert found["cx"].sigma > 1.5 and found["cy"].sigma > 2.5


def test_motion_knows_the_pose_less_well_with_a_free_principal_point() -> None:
    """Each pixel to the right, about the camera's y axis, is the LiDAR's z axis; downwards, its y axis."""
    cTl = gtsam.Pose3(gtsam.Rot3(np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])), np.array([0.0, 0.3, 0.1]))
    known = KnownCalibration(State(cTl, (0.0,)), np.diag(np.full(7, 1e-4)))
    camera = PinholeCamera(500.0, 400.0, 320.0, 180.0, 640, 360)
    freed = known.with_free_principal_point(camera, {"cx": 10.0, "cy": 4.0, "k1": 0.3})
    more = np.zeros(7)
    more[2], more[1] = (10.0 / 500.0) ** 2, (4.0 / 400.0) ** 2
    np.testing.assert_allclose(freed.covariance, known.covariance + np.diag(more), atol=1e-15)
    held = known.with_free_principal_point(camera, {"k1": 0.3})
    np.testing.assert_array_equal(held.covariance, known.covariance)


def test_motion_does_not_hold_a_principal_point_that_is_estimated(drive: Drive) -> None:
    truth = simulated(STREET).truth
    guess, state = Guess(truth.cTl, truth.time_offset_s), State(truth.cTl, (truth.time_offset_s,))

    def covariance(*estimate: str) -> FloatArray:
        config = CalibrationConfig(method="edges", assumptions=AssumptionConfig(estimate=estimate))
        problem = CalibrationProblem.of([drive], guess, config)
        return edges_problem(problem, None, LabelEstimate(state)).known.covariance

    more = np.trace(covariance("cy=20") - covariance())
    assert more == pytest.approx((20.0 / drive.camera.fy) ** 2, rel=1e-6)
    assert np.array_equal(covariance("k1"), covariance())


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
    assert abs(found["cy"]["estimate"]) < 2.5
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

"""Half-samples of the objects, and what a calibration by edges claims where a scene tells little."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from stored import simulated

from sst_graph import CalibrationConfig, calibrate
from sst_graph.association.edge_matching import TOP, MatchConfig, match_sigmas, sides_of
from sst_graph.assumptions import OF_LIDAR
from sst_graph.batch.by_edges.covariance import (
    FEW_OBJECTS,
    FEW_OUTLINES,
    SAMPLES,
    edges_covariance,
    half_samples,
)
from sst_graph.batch.by_edges.optimum import best_optimum_steps, farther_edges_steps
from sst_graph.batch.by_edges.parts import thinned, with_objects, without_kind
from sst_graph.batch.by_edges.positions import position_columns
from sst_graph.batch.by_edges.problem import LabelEstimate, edges_problem
from sst_graph.batch.calibrate import prepare_drives
from sst_graph.batch.problem import CalibrationProblem, JointEstimate
from sst_graph.covariance.shared_errors import FEWEST, spread_covariance
from sst_graph.drive.preparation import Drive
from sst_graph.experiments.starts import error_of
from sst_graph.features.lidar_edges import Edge
from sst_graph.graph.outer_loop import solve_joint
from sst_graph.graph.state import State
from sst_graph.objects.tracks import object_tracks
from sst_graph.simulator import SimulationConfig
from sst_graph.stepwise import run_to_end
from sst_graph.types import Guess, SemanticClass
from studies.edges_poor_scenes import SCENES, START, drive_through
from studies.edges_streets import source_of, start_step

STREET = SimulationConfig(seed=504, frames=3, motion="no_stop", azimuth_limit_deg=50.0, width=621, height=188)


def test_half_samples_are_balanced() -> None:
    kept = half_samples()
    groups = 2 * (SAMPLES - 1)
    assert kept.shape == (SAMPLES, groups)
    together = kept.T.astype(int) @ kept.astype(int)
    pair = np.arange(groups) // 2
    same = np.equal.outer(pair, pair)
    assert (np.diag(together) == SAMPLES // 2).all()
    assert (together[same & ~np.eye(groups, dtype=bool)] == 0).all()
    assert (together[~same] == SAMPLES // 4).all()


def test_the_spread_of_half_samples_is_the_variance_of_the_mean() -> None:
    """In closed form: independent pairs of equal variance, of which a mean is taken."""
    rng = np.random.default_rng(4)
    kept = half_samples()
    groups = kept.shape[1]
    values = rng.normal(0.0, 3.0, (2000, groups))
    means = np.stack([values[:, own].mean(axis=1) for own in kept])
    variances = means.var(axis=0, ddof=1)
    exact = ((values[:, ::2] - values[:, 1::2]) ** 2).sum(axis=1) / groups**2
    np.testing.assert_allclose(variances, exact * SAMPLES / (SAMPLES - 1))
    assert variances.mean() == pytest.approx(3.0**2 / groups * SAMPLES / (SAMPLES - 1), rel=0.05)


def test_the_nees_of_a_spread_is_seven_on_average() -> None:
    """Steps and error of one covariance: the factor makes up for the few samples that it is known by."""
    rng = np.random.default_rng(8)
    root = rng.normal(size=(7, 7))
    nees = []
    for _ in range(3000):
        error, *steps = rng.normal(size=(1 + SAMPLES, 7)) @ root
        nees.append(error @ np.linalg.solve(spread_covariance(np.array(steps)), error))
    assert np.mean(nees) == pytest.approx(7.0, rel=0.1)
    assert not spread_covariance(np.ones((FEWEST - 1, 7))).any()


def test_half_samples_beside_the_estimate_are_far_from_it() -> None:
    """All of them 10 sigma to one side: the estimate is another optimum, and as uncertain as that."""
    steps = np.random.default_rng(9).normal(10.0, 1.0, (SAMPLES, 1))
    assert np.sqrt(spread_covariance(steps)[0, 0]) == pytest.approx(10.0, rel=0.1)


@pytest.fixture(scope="module")
def drive() -> Drive:
    config = CalibrationConfig(method="edges", decide_sweep=False)
    return thinned(prepare_drives([simulated(STREET)], config)[0], 200)


def test_the_covariance_has_the_spread_of_the_half_samples(drive: Drive) -> None:
    truth = simulated(STREET).truth
    config = CalibrationConfig(method="edges")
    problem = CalibrationProblem.of([drive], Guess(truth.cTl, truth.time_offset_s), config)
    joint = problem.joint()
    solution = solve_joint(joint, State(truth.cTl, (truth.time_offset_s,)), (3.0, 2.0))
    estimate = JointEstimate.of(solution, problem.objects)
    found = edges_covariance(joint, estimate, problem.objects, config.assumptions)
    covariance, parts = found.matrix, found.sigmas
    assert found.reasons == () and parts["samples"] >= FEWEST
    names = ("matches", "objects", "assumptions", "positions", "shallow", "floor")
    np.testing.assert_allclose(np.diag(covariance), sum(np.square(parts[name]) for name in names))
    assert all((np.array(parts[name]) > 0.0).all() for name in names[:-1])
    # Pitch hangs on upper edges, yaw on the others, and neither does roll.
    roll, pitch, yaw = np.degrees(parts["positions"][:3])
    assert pitch > 0.05 and yaw > 0.03 and roll < 0.5 * yaw
    # A poorer set-up is less sure.
    poorer = replace(config.assumptions, cy=3.0)
    poor = edges_covariance(joint, estimate, problem.objects, poorer).sigmas
    assert np.degrees(poor["assumptions"][1]) == pytest.approx(np.degrees(3.0 / drive.camera.fy), rel=0.1)
    starved = replace(joint, config=replace(joint.config, min_matches=10**6))
    few = edges_covariance(starved, estimate, problem.objects, config.assumptions)
    assert few.sigmas["samples"] == 0 and few.reasons == (FEW_OBJECTS, FEW_OUTLINES)
    # What another camera shares with this one are the objects, and the LiDAR's errors.
    shared = parts["objects"], parts["positions"], parts["shallow"], parts["floor"]
    of_lidar = [found.shared.common[name] for name in OF_LIDAR]
    expected = sum(np.square(part) for part in (*shared, *of_lidar))
    np.testing.assert_allclose(np.diag(found.shared.cross_covariance(found.shared)), expected)


def test_upper_edges_that_may_be_no_outline_are_told_apart(drive: Drive) -> None:
    """Both kinds occur; to leave one out leaves all others as they are, on their side."""
    kept = without_kind(drive, Edge.SHALLOW_TOP)
    for scan, some in zip(drive.scans, kept.scans, strict=True):
        points, others = scan.boundaries[SemanticClass.OBJECT], some.boundaries[SemanticClass.OBJECT]
        shallow = points.edges == Edge.SHALLOW_TOP
        assert 0 < shallow.sum() < (points.edges >= Edge.TOP).sum()
        np.testing.assert_array_equal(others.lPs, points.lPs[~shallow])
        assert (sides_of(points.edges[shallow], np.ones(shallow.sum())) == TOP).all()


def test_an_estimate_that_does_not_come_back_is_not_trusted(drive: Drive) -> None:
    """Solved again with edges farther away, and then with near ones: an optimum is met again, a pose beside
    it is not."""
    truth = simulated(STREET).truth
    guess = Guess(truth.cTl, truth.time_offset_s)
    calibration = CalibrationProblem.of([drive], guess, CalibrationConfig(method="edges"))
    problem = edges_problem(calibration, None, LabelEstimate())
    joint = problem.whole
    start = State(truth.cTl, (truth.time_offset_s,))
    optimum = run_to_end(best_optimum_steps(problem, start, 0)).state
    step, reasons = run_to_end(farther_edges_steps(joint, optimum))
    assert np.degrees(np.linalg.norm(step[:3])) > 0.2 and reasons == ()
    beside = replace(optimum, cTl=optimum.cTl.retract(np.array([0.0, 0.0, np.radians(0.4), 0.0, 0.0, 0.0])))
    step, (reason,) = run_to_end(farther_edges_steps(joint, beside))
    assert np.degrees(np.linalg.norm(step[:3])) > 0.2 and "not settled on one set of edges" in reason


@pytest.mark.slow
def test_an_estimate_that_comes_back_is_trusted() -> None:
    """Edges farther away move it by 0.15 deg; from there it comes back, and it is right."""
    street = source_of("third-932")
    assert street.truth is not None and street.truth.time_offset_s is not None
    start = street.truth.cTl.retract(start_step("third-932"))
    result = calibrate(street, start, CalibrationConfig(method="edges"))
    assert np.degrees(np.linalg.norm(result.diagnostics["spread"]["farther_edges"][:3])) > 0.1
    assert result.status == "ok"
    error = error_of(result.calibration, street.truth)
    assert error @ np.linalg.solve(result.covariance, error) < 7.0


def test_positions_between_beams_in_closed_form() -> None:
    config = MatchConfig(mask_sigma_px=1.0)
    # Beams 2 px apart to either side of the edge, and none: uniform over half of that.
    sigmas = match_sigmas(np.array([4.0, 4.0, 4.0, 0.0]), np.ones(4), config)
    columns = position_columns(np.array([0, 1, 2, 1]), sigmas, config)
    spread = 2.0 / np.sqrt(3.0)
    np.testing.assert_allclose(
        columns, np.array([[0.0, -spread, spread], [0.0, spread, spread], [spread, 0.0, 0.0], [0.0] * 3])
    )


def test_both_halves_of_the_objects_are_the_drive(drive: Drive) -> None:
    tracks = object_tracks(drive)
    for kept in half_samples()[1:3]:
        halves = [with_objects(drive, tracks, own) for own in (kept, ~kept)]
        for k, scan in enumerate(drive.scans):
            whole = scan.boundaries[SemanticClass.OBJECT]
            parts = [half.scans[k].boundaries.get(SemanticClass.OBJECT) for half in halves]
            assert len(whole) <= 200 and sum(len(part) for part in parts if part is not None) == len(whole)
            numbers = [set(part.objects.tolist()) for part in parts if part is not None]
            assert len(numbers) < 2 or not numbers[0] & numbers[1]


@pytest.mark.slow
@pytest.mark.parametrize("scene", SCENES)
def test_a_poor_scene_is_not_ok(scene: str) -> None:
    config = SimulationConfig(
        seed=1, frames=10, motion="no_stop", azimuth_limit_deg=50.0, moving_fraction=0.0
    )
    drive = drive_through(scene, config)
    result = calibrate(drive, drive.truth.cTl.retract(START), CalibrationConfig(method="edges"))
    assert result.status != "ok" and result.reasons

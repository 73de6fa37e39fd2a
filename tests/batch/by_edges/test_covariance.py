"""Half-samples of the objects, and what a calibration by edges claims where a scene tells little."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from stored import simulated

from benchmarks.edges_poor_scenes import SCENES, START, drive_through
from sst_graph import CalibrationConfig, calibrate
from sst_graph.batch.by_edges.covariance import (
    FEW_OBJECTS,
    FEWEST,
    SAMPLES,
    edges_covariance,
    half_samples,
)
from sst_graph.batch.by_edges.parts import thinned, with_objects
from sst_graph.batch.calibrate import prepare_drives
from sst_graph.batch.method_estimate import Guess
from sst_graph.batch.problem import CalibrationProblem, JointEstimate
from sst_graph.drive.preparation import Drive
from sst_graph.graph.outer_loop import solve_joint
from sst_graph.graph.state import State
from sst_graph.objects.tracks import object_tracks
from sst_graph.simulator import SimulationConfig
from sst_graph.types import SemanticClass

STREET = SimulationConfig(seed=504, frames=3, motion="no_stop", azimuth_limit_deg=50.0, width=621, height=188)


def test_half_samples_are_balanced() -> None:
    kept = half_samples()
    assert kept.shape == (SAMPLES, 14)
    together = kept.T.astype(int) @ kept.astype(int)
    pair = np.arange(14) // 2
    same = np.equal.outer(pair, pair)
    assert (np.diag(together) == SAMPLES // 2).all()
    assert (together[same & ~np.eye(14, dtype=bool)] == 0).all()
    assert (together[~same] == SAMPLES // 4).all()


def test_the_spread_of_half_samples_is_the_variance_of_the_mean() -> None:
    """In closed form: independent pairs of equal variance, of which a mean is taken."""
    rng = np.random.default_rng(4)
    values = rng.normal(0.0, 3.0, (2000, 14))
    kept = half_samples()
    means = np.stack([values[:, own].mean(axis=1) for own in kept])
    variances = means.var(axis=0, ddof=1)
    exact = ((values[:, ::2] - values[:, 1::2]) ** 2).sum(axis=1) / 14**2
    np.testing.assert_allclose(variances, exact * SAMPLES / (SAMPLES - 1))
    assert variances.mean() == pytest.approx(3.0**2 / 14 * SAMPLES / (SAMPLES - 1), rel=0.05)


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
    covariance, parts, reasons = edges_covariance(joint, estimate, problem.objects)
    assert reasons == () and parts["samples"] >= FEWEST
    squares = [np.square(parts[name]) for name in ("matches", "objects", "floor")]
    np.testing.assert_allclose(np.diag(covariance), sum(squares))
    assert (np.array(parts["objects"]) > 0.0).all()
    starved = replace(joint, config=replace(joint.config, min_matches=10**6))
    _, parts, reasons = edges_covariance(starved, estimate, problem.objects)
    assert parts["samples"] == 0 and reasons == (FEW_OBJECTS,)


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

"""Assumptions broken on simulated streets: found, named, estimated; clean streets contradict none."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from functools import cache

import gtsam
import numpy as np
import pytest
from streets import crowded_street

from sst_graph.assumptions import ASSUMPTIONS
from sst_graph.batch import CalibrationConfig, calibrate_prepared, prepare_drives
from sst_graph.batch.assumption_tests import (
    LinearProblem,
    ParameterTest,
    SolvedProblem,
    few_objects_factor,
    untested,
    untested_remark,
    with_test_results,
)
from sst_graph.batch.problem import CalibrationProblem
from sst_graph.config import with_overrides
from sst_graph.covariance.cluster_robust import robust_covariance
from sst_graph.covariance.considered import BUDGET, AssumptionConfig, Considered
from sst_graph.data.kept_drive import KeptDrive
from sst_graph.drive.preparation import Drive
from sst_graph.errors import ConfigError
from sst_graph.experiments.assumptions import CLEAN, AssumptionRun, AssumptionTableConfig, table
from sst_graph.experiments.wrong_drives import with_focal, with_principal_point
from sst_graph.graph.outer_loop import solve_joint
from sst_graph.graph.state import State, nuisance_key
from sst_graph.inspect.budget_text import budget_lines
from sst_graph.result import CalibrationResult
from sst_graph.simulator import SimulationConfig, simulate
from sst_graph.types import CameraImage, Guess

CONFIG = with_overrides(
    CalibrationConfig(), ["search.enabled=false", "use_motion=never", "check_contradictions=false"]
)
"""Of what is beside the point here nothing: the global search, the motion, parts of the drive."""


@cache
def prepared(k1: float = 0.0) -> list[Drive]:
    """The street through a lens with radial distortion."""
    return prepare_drives([crowded_street(k1)], CONFIG)


def calibrated(drives: Sequence[Drive], config: CalibrationConfig = CONFIG) -> CalibrationResult:
    return calibrate_prepared(drives, crowded_street().nominal, config)


def difference(a: CalibrationResult, b: CalibrationResult) -> tuple[float, float]:
    """Rotation [deg] and translation [m] between two answers."""
    step = gtsam.Pose3.Logmap(a.T_camera_lidar.between(b.T_camera_lidar))
    return float(np.degrees(np.linalg.norm(step[:3]))), float(np.linalg.norm(step[3:]))


@pytest.fixture(scope="module")
def clean() -> CalibrationResult:
    return calibrated(prepared())


@pytest.mark.slow
def test_a_clean_street_contradicts_nothing(clean: CalibrationResult) -> None:
    report = clean.diagnostics["assumptions"]
    assert list(report) == list(ASSUMPTIONS)
    assert not any(entry.get("contradicted") for entry in report.values())


def test_the_parts_of_the_sigmas_add_up(clean: CalibrationResult) -> None:
    parts = np.array(list(clean.diagnostics[BUDGET].values()))
    np.testing.assert_allclose(np.sqrt((parts**2).sum(axis=0)), np.sqrt(np.diag(clean.covariance)), rtol=1e-4)
    text = "\n".join(budget_lines(clean))
    considered = clean.diagnostics["assumptions"]["cx"]["sigma"]
    assert "matches" in text and "motion" in text and f"cx off by {considered:.2g} px" in text


@pytest.mark.slow
@pytest.mark.parametrize("seed", [9110, 9114])
def test_another_optimum_contradicts_nothing(seed: int) -> None:
    """A vehicle that stands sees few objects, to which a wrong lens can be fitted: those of the first street
    by k2 = -0.2, those of the second by cy = -13 px beside the other parameters."""
    street = simulate(
        SimulationConfig(seed=seed, frames=40, width=621, height=188, azimuth_step_deg=0.3, motion="standing")
    )
    found = calibrate_prepared(prepare_drives([street], CONFIG), street.nominal, CONFIG)
    report = found.diagnostics["assumptions"]
    assert not any(entry.get("contradicted") for entry in report.values())


def test_what_is_not_tested_is_considered_and_said() -> None:
    config = AssumptionConfig(estimate=("k1",))
    cx = ParameterTest.of(ASSUMPTIONS["cx"], 0.0, 0.1, config.threshold)
    names = untested([cx], config)
    assert {"focal", "cy", "k2"} <= set(names) and not {"cx", "k1", "sweep"} & set(names)
    assert untested([], dataclasses.replace(config, test=False)) == () == untested_remark(())
    (remark,) = untested_remark(names)
    assert remark.startswith("no test of focal, cy, k2, ")
    sigmas = {name: config.sigma(name) for name in (*names, "cx")}
    considered = Considered({name: np.ones(7) for name in sigmas}, sigmas)
    found = with_test_results(considered, [cx], names).sigmas
    assert found["cy"] > 10.0 * config.cy and found["cx"] == pytest.approx(config.cx, rel=0.01)


@pytest.mark.slow
def test_an_optimum_far_away_is_not_considered() -> None:
    """With every parameter free, wide kernels lead to another pose from these six frames, at which cx would
    be 130 px: that is no deviation to be covered for."""
    street = simulate(
        SimulationConfig(
            seed=711,
            frames=6,
            frame_rate_hz=3.0,
            width=621,
            height=187,
            azimuth_limit_deg=60.0,
            time_offset_s=0.1,
        )
    )
    found = calibrate_prepared(prepare_drives([street], CONFIG), street.nominal, CONFIG)
    assert found.diagnostics["assumptions"]["cx"]["sigma"] < 3.0
    assert np.sqrt(found.covariance[2, 2]) < np.radians(0.5)


@pytest.mark.slow
@pytest.mark.parametrize("k1", [-0.1])
def test_a_distorted_picture_is_named_and_can_be_estimated(k1: float) -> None:
    distorted = prepared(k1)
    plain = calibrated(distorted)
    assert plain.status == "not_converged"
    assert any("k1 = " in reason for reason in plain.reasons)
    assert plain.diagnostics["assumptions"]["k1"]["estimate"] == pytest.approx(k1, abs=0.02)
    config = dataclasses.replace(CONFIG, assumptions=AssumptionConfig(estimate=("k1",)))
    result = calibrated(distorted, config)
    found = result.diagnostics["estimated"]["k1"]
    assert found["value"] == pytest.approx(k1, abs=5.0 * found["sigma"]) and found["sigma"] < 0.02
    # Points beyond the radius at which the lens would turn back tell nothing of it.
    assert found["sigma"] > 0.002
    # What the labels say of k1 where nothing is distorted is in both.
    rotation_deg, translation_m = difference(result, calibrated(prepared(), config))
    assert rotation_deg < 0.1 and translation_m < 0.015


def with_faster_images(drive: KeptDrive) -> KeptDrive:
    """The images' clock runs 1.5 % too fast, from the first image on."""
    first = next(frame.image.stamp_ns for frame in drive.frames if frame.image is not None)

    def change(image: CameraImage) -> CameraImage:
        return dataclasses.replace(image, stamp_ns=image.stamp_ns + (image.stamp_ns - first) * 15 // 1000)

    return drive.with_images(change)


def with_cropped_images(drive: KeptDrive) -> KeptDrive:
    return with_principal_point(drive, 0.0, 10.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "change", "true"),
    [("cy", with_cropped_images, 10.0), ("skew", with_faster_images, -0.015)],
)
def test_motion_does_not_hold_what_is_estimated(
    name: str, change: Callable[[KeptDrive], KeptDrive], true: float
) -> None:
    config = with_overrides(CalibrationConfig(), ["search.enabled=false", "check_contradictions=false"])
    config = dataclasses.replace(config, assumptions=AssumptionConfig(estimate=(name,)))
    result = calibrated(prepare_drives([change(crowded_street())], config), config)
    found = result.diagnostics["estimated"][name]
    assert found["value"] == pytest.approx(true, abs=3.0 * found["sigma"])
    truth = crowded_street().truth
    assert truth is not None and truth.time_offset_s is not None
    step = gtsam.Pose3.Logmap(result.T_camera_lidar.between(truth.cTl))
    error = np.append(step, truth.time_offset_s - result.time_offset_s)
    assert (np.abs(error) < 3.0 * np.sqrt(np.diag(result.covariance))).all()


def test_with_every_parameter_estimated_nothing_is_left_to_consider() -> None:
    assumptions = AssumptionConfig(estimate=tuple(ASSUMPTIONS), test=False)
    drive = prepared()[0]
    few = dataclasses.replace(drive, scans=drive.scans[:3], lidar_motions=drive.lidar_motions[:2])
    result = calibrated([few], dataclasses.replace(CONFIG, assumptions=assumptions))
    assert set(result.diagnostics["estimated"]) <= set(ASSUMPTIONS) and result.frames_used
    assert not set(result.diagnostics[BUDGET]) & set(ASSUMPTIONS)


@pytest.mark.slow
def test_a_slight_distortion_is_covered_or_named() -> None:
    result = calibrated(prepared(-0.03))
    truth = crowded_street().truth
    assert truth is not None and truth.time_offset_s is not None
    step = gtsam.Pose3.Logmap(result.T_camera_lidar.between(truth.cTl))
    error = np.append(step, truth.time_offset_s - result.time_offset_s)
    covered = (np.abs(error) < 3.0 * np.sqrt(np.diag(result.covariance))).all()
    assert covered or result.status != "ok"
    # The data complain, so that more than the prior deviation is considered.
    entry = result.diagnostics["assumptions"]["k1"]
    assert entry["sigma"] > 0.3 * abs(entry["estimate"])


@pytest.fixture(scope="module")
def problem() -> SolvedProblem:
    """Solved with a distortion that is not known of."""
    drives = prepared(-0.03)
    truth = crowded_street().truth
    assert truth is not None and truth.time_offset_s is not None
    guess = State(truth.cTl, (truth.time_offset_s,))
    problem = CalibrationProblem.of(drives, Guess(truth.cTl, truth.time_offset_s), CONFIG)
    joint = problem.joint()
    short = dataclasses.replace(joint, config=dataclasses.replace(joint.config, max_outer=6), centre=guess)
    return SolvedProblem(problem, solve_joint(short, guess, (5.0, 3.0)))


def test_the_linear_problem_agrees_with_a_solution_for_each_parameter(problem: SolvedProblem) -> None:
    linear = LinearProblem.of(problem, ["k1", "cx", "skew"])
    for name in ("k1", "skew"):
        start = dataclasses.replace(problem.solution.state, nuisances={name: 0.0})
        alone = problem.solve_with((name,), start, (10.0, 5.0, 4.0, 3.0), 12)
        robust = robust_covariance(alone.system, alone.values, alone.pairs, alone.state, problem.objects)
        column = robust.unknowns.column(nuisance_key(name))
        sigma = np.sqrt(robust.matrix[column, column])
        few = few_objects_factor(int(robust.table.objects.max()) + 1, 3.3)
        found = linear.alone(name, CONFIG.assumptions)
        assert found.value == pytest.approx(alone.state.nuisances[name], abs=0.5 * sigma)
        assert found.sigma == pytest.approx(few * sigma, rel=0.4)


def test_the_table_counts_what_was_found() -> None:
    def one(case: str, size: float, status: str, error: float, against: tuple[str, ...]) -> AssumptionRun:
        errors, estimates = np.full(7, error), {"k1": (size, 0.01), "cx": (0.0, 5.0)}
        return AssumptionRun(1, case, size, status, errors, np.eye(7), estimates, against)

    text = table(
        [
            one(CLEAN, 0.0, "ok", 1.0, ()),
            one("k1", 0.1, "not_converged", 5.0, ("k1", "cx")),
            one("k1", -0.1, "ok", 4.0, ()),
            one("cx", 5.0, "ok", 0.0, ()),
        ]
    )
    assert "| k1 | 0.1 | 10.0 | 2 | 1 | 1 | 1 | 1 |" in text
    assert "| cx | 5 | 1.0 | 1 | 0 | 0 | 0 | 0 |" in text
    assert "- sizes above 5 σ: 2 runs, 1 contradicted, 1 not ok, 1 silent" in text
    assert "- clean: 1 run, 0 contradicted, 0 not ok, 0 silent" in text


def test_rows_count_sizes_in_deviations_with_in_sigmas() -> None:
    def one(seed: int, case: str, size: float) -> AssumptionRun:
        estimates = {"k1": (size, 0.01 * seed)}
        return AssumptionRun(seed, case, size, "ok", np.zeros(7), np.eye(7), estimates, ())

    runs = [one(seed, CLEAN, 0.0) for seed in (1, 3)]
    runs += [one(seed, "k1", sign * 0.05 * seed) for seed in (1, 3) for sign in (1.0, -1.0)]
    text = table(runs, in_sigmas=True)
    assert text.startswith("| broken | σ | ± 5 σ |\n") and " of 4; " in text
    assert "| k1 | 0.05 | 5.0 | 2 |" in table(runs) and "| k1 | 0.15 | 5.0 | 2 |" in table(runs)


def test_sizes_in_deviations_need_sizes_and_a_clean_street() -> None:
    with pytest.raises(ConfigError, match="found no sizes"):
        AssumptionTableConfig(in_sigmas=True)
    with pytest.raises(ConfigError, match="cases leave out clean"):
        AssumptionTableConfig(in_sigmas=True, sizes=(2.0,), cases=("k1",))


@pytest.mark.slow
def test_a_wrong_focal_length_is_contradicted() -> None:
    result = calibrated(prepare_drives([with_focal(crowded_street(), 0.03)], CONFIG))
    assert result.status != "ok"
    assert result.diagnostics["assumptions"]["focal"]["contradicted"]


def test_a_wider_assumption_gives_a_wider_covariance(clean: CalibrationResult) -> None:
    wide = with_overrides(CONFIG, ["assumptions.focal=0.01", "assumptions.test=false"])
    result = calibrated(prepared(), wide)
    report, estimates = result.diagnostics["assumptions"], clean.diagnostics["assumptions"]
    assert "estimate" not in report["focal"]
    # Untested, all other assumptions keep their prior deviations.
    for name, entry in report.items():
        assert entry["sigma"] == CONFIG.assumptions.sigma(name) or name == "focal"
    sensitivities = {name: np.array(estimates[name]["sensitivity"]) for name in ASSUMPTIONS}
    gained = np.diag(result.covariance - clean.covariance)
    expected = sum(
        (report[name]["sigma"] ** 2 - estimates[name]["sigma"] ** 2) * sensitivities[name] ** 2
        for name in ASSUMPTIONS
    )
    np.testing.assert_allclose(gained, expected, rtol=2e-3, atol=1e-9)


def test_few_objects_raise_the_deviation() -> None:
    assert few_objects_factor(1000, 3.3) == pytest.approx(1.0, abs=0.01)
    assert few_objects_factor(9, 3.3) == few_objects_factor(3, 3.3) > few_objects_factor(20, 3.3) > 1.1
    # Up to the highest threshold that the settings allow.
    for objects in (3, 20, 1000):
        factors = [few_objects_factor(objects, each) for each in (1.0, 3.3, 10.0, 20.0, 37.0, 100.0)]
        assert np.isfinite(factors).all() and factors == sorted(factors) and factors[0] >= 1.0


@pytest.mark.parametrize(
    ("estimate", "message"),
    [
        (("k3",), "expected one of focal"),
        (("k1", "k1=0.2"), "each name once"),
        (("k1=-1",), "k1: found '-1', expected"),
        (("k1=x",), "k1: found 'x', expected"),
    ],
)
def test_what_cannot_be_estimated_is_refused(estimate: tuple[str, ...], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        AssumptionConfig(estimate=estimate)

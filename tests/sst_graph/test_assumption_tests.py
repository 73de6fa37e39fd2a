"""Assumptions broken on simulated streets: found, named, estimated; clean streets contradict none."""

from __future__ import annotations

import dataclasses

import gtsam
import numpy as np
import pytest

from sst_graph.assumptions import ASSUMPTIONS
from sst_graph.config import with_overrides
from sst_graph.data.simulator import SimulationConfig, simulate
from sst_graph.errors import ConfigError
from sst_graph.estimators import CalibrationConfig, calibrate_prepared, prepare_drives
from sst_graph.estimators.assumption_tests import few_objects
from sst_graph.experiments.wrong_drives import KeptDrive, with_distortion, with_focal
from sst_graph.result import CalibrationResult
from sst_graph.uncertainty.assumptions import BUDGET, AssumptionConfig
from sst_graph.uncertainty.budget_words import budget_lines

CONFIG = CalibrationConfig()


@pytest.fixture(scope="module")
def street() -> KeptDrive:
    return KeptDrive.of(simulate(SimulationConfig(seed=32, frames=18, time_offset_s=0.1)))


def calibrated(drive: KeptDrive, config: CalibrationConfig = CONFIG) -> CalibrationResult:
    return calibrate_prepared(prepare_drives([drive], config), drive.nominal, config)


def difference(a: CalibrationResult, b: CalibrationResult) -> tuple[float, float]:
    """Rotation [deg] and translation [m] between two answers."""
    step = gtsam.Pose3.Logmap(a.T_camera_lidar.between(b.T_camera_lidar))
    return float(np.degrees(np.linalg.norm(step[:3]))), float(np.linalg.norm(step[3:]))


@pytest.fixture(scope="module")
def clean(street: KeptDrive) -> CalibrationResult:
    return calibrated(street)


def test_a_clean_street_contradicts_nothing(clean: CalibrationResult) -> None:
    report = clean.diagnostics["assumptions"]
    assert list(report) == list(ASSUMPTIONS)
    assert not any(entry.get("contradicted") for entry in report.values())


def test_the_parts_of_the_sigmas_add_up(clean: CalibrationResult) -> None:
    parts = np.array(list(clean.diagnostics[BUDGET].values()))
    np.testing.assert_allclose(np.sqrt((parts**2).sum(axis=0)), np.sqrt(np.diag(clean.covariance)), rtol=1e-4)
    text = "\n".join(budget_lines(clean))
    assert "matches" in text and "motion" in text and "cx off by 0.3 px" in text


@pytest.mark.parametrize("k1", [-0.1])
def test_a_distorted_picture_is_named_and_can_be_estimated(
    street: KeptDrive, clean: CalibrationResult, k1: float
) -> None:
    bent = with_distortion(street, k1)
    plain = calibrated(bent)
    assert plain.status == "not_converged"
    assert any("k1 = " in reason for reason in plain.reasons)
    assert plain.diagnostics["assumptions"]["k1"]["estimate"] == pytest.approx(k1, abs=0.02)
    config = dataclasses.replace(CONFIG, assumptions=AssumptionConfig(estimate=("k1",)))
    result = calibrated(bent, config)
    found = result.diagnostics["estimated"]["k1"]
    assert found["value"] == pytest.approx(k1, abs=5.0 * found["sigma"]) and found["sigma"] < 0.02
    # Points beyond the radius at which the lens would turn back tell nothing of it.
    assert found["sigma"] > 0.002
    rotation_deg, translation_m = difference(result, clean)
    assert rotation_deg < 0.1 and translation_m < 0.015


def test_a_wrong_focal_length_is_contradicted(street: KeptDrive) -> None:
    result = calibrated(with_focal(street, 0.03))
    assert result.status != "ok"
    assert result.diagnostics["assumptions"]["focal"]["contradicted"]


def test_a_wider_assumption_gives_a_wider_covariance(street: KeptDrive, clean: CalibrationResult) -> None:
    wide = with_overrides(CONFIG, ["assumptions.sigmas.focal=0.01", "assumptions.test=false"])
    result = calibrated(street, wide)
    assert "estimate" not in result.diagnostics["assumptions"]["focal"]
    step = 0.01 * np.array(clean.diagnostics["assumptions"]["focal"]["sensitivity"])
    gained = np.diag(result.covariance - clean.covariance)
    small = 5e-4 * np.array(clean.diagnostics["assumptions"]["focal"]["sensitivity"])
    np.testing.assert_allclose(gained, step**2 - small**2, rtol=1e-3, atol=1e-9)


def test_few_objects_ask_for_more() -> None:
    assert few_objects(1000, 3.3) == pytest.approx(1.0, abs=0.01)
    assert few_objects(9, 3.3) == few_objects(3, 3.3) > few_objects(20, 3.3) > 1.1


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

"""The accuracy experiment and the one on real drives: their settings, rows and a small run."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any

import gtsam
import numpy as np
import pytest

from sst_graph.batch import CalibrationConfig
from sst_graph.errors import ConfigError
from sst_graph.experiments import accuracy, drives
from sst_graph.experiments.accuracy import SCENARIOS, AccuracyConfig, AccuracyRun
from sst_graph.experiments.drives import DrivesConfig
from sst_graph.experiments.markdown import median
from sst_graph.experiments.starts import start_near
from sst_graph.metrics import CalibrationErrors, Nees


def outcome(qad_deg: float, atd_m: float, time_s: float, status: str, failed: bool = False) -> AccuracyRun:
    nees = Nees(8.0 * qad_deg, 2.0 * qad_deg, qad_deg, 0.5)
    return AccuracyRun(CalibrationErrors(qad_deg, 0.5 * qad_deg, atd_m, time_s, nees), status, failed)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"scenarios": ("standng",)},
            r"scenarios\[0\]: found 'standng', expected one of standing, standing-none",
        ),
        ({"scenarios": ()}, "scenarios: found .* expected a list of 1 to 100 values"),
        ({"streets": 0}, "streets: found 0, expected at least 1"),
    ],
)
def test_bad_settings(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        AccuracyConfig(**changes)


def test_another_method_is_refused() -> None:
    config = AccuracyConfig(calibration=dataclasses.replace(CalibrationConfig(), method="static"))
    with pytest.raises(ConfigError, match="joint"):
        accuracy.run(config)


def test_a_row_by_hand() -> None:
    outcomes = [outcome(1.0, 0.01, 0.001, "ok"), outcome(2.0, 0.02, -0.002, "unobservable")]
    outcomes += [outcome(6.0, 0.06, 0.006, "ok", True), outcome(3.0, 0.03, 0.0, "not_converged", True)]
    cells = accuracy._row(SCENARIOS["stop-100"], outcomes)
    assert len(cells) == accuracy._HEADER.count("|") - 1
    assert cells[1:3] == ["4", "2 (1)"]
    assert cells[3] == "2.500 / 5.550" and cells[4] == "2.50 / 5.55"
    # The delay's size counts, not its sign.
    assert cells[5] == "1.50 / 5.40"
    assert cells[6] == "6.0, 3.0, 24.0" and cells[7] == "2 / 1 / 1"
    assert accuracy._row(SCENARIOS["standing"], outcomes)[5] == "–"


def test_starts_are_within_their_limits() -> None:
    config, rng = AccuracyConfig(), np.random.default_rng(0)
    cTl = gtsam.Pose3(gtsam.Rot3.Ypr(0.1, 0.2, 0.3), np.array([0.1, 0.2, 0.3]))
    steps = np.array(
        [
            cTl.between(start_near(cTl, config.start_deg, config.start_m, rng)).translation()
            for _ in range(200)
        ]
    )
    assert 0.08 < np.linalg.norm(steps, axis=1).max() < 0.1 * np.sqrt(3.0) * 1.3
    turns = [
        np.degrees(
            np.linalg.norm(
                gtsam.Rot3.Logmap(
                    cTl.between(start_near(cTl, config.start_deg, config.start_m, rng)).rotation()
                )
            )
        )
        for _ in range(200)
    ]
    assert 20.0 < max(turns) <= 20.0 * np.sqrt(3.0)


@pytest.mark.slow
def test_one_small_run() -> None:
    search = dataclasses.replace(CalibrationConfig().search, enabled=False)
    config = AccuracyConfig(
        streets=1,
        scenarios=("standing",),
        start_deg=0.5,
        start_m=0.02,
        calibration=dataclasses.replace(CalibrationConfig(), search=search),
    )
    seen: list[tuple[str, int, int]] = []
    header, rule, row = accuracy.run(config, lambda *step: seen.append(step)).splitlines()
    assert header == accuracy._HEADER and set(rule) == {"|", "-"} and seen == [("standing", 1, 1)]
    cells = [cell.strip() for cell in row.split("|")[1:-1]]
    assert cells[:3] == ["standing, 3 frames", "10", "0 (0)"]
    assert float(cells[3].split(" / ")[0]) < 0.5


def test_drives_without_data_are_refused() -> None:
    with pytest.raises(ConfigError, match="data: found none"):
        drives.run(DrivesConfig())


def test_spread_and_median_of_results() -> None:
    turned = [gtsam.Pose3(gtsam.Rot3.Rz(np.radians(a)), np.zeros(3)) for a in (0.0, 0.5, -0.25)]
    answers = [SimpleNamespace(T_camera_lidar=pose) for pose in turned]
    assert drives._spread_deg(answers) == pytest.approx(0.75)
    assert drives._spread_deg(answers[:1]) == 0.0
    assert median([3.0, 1.0, 2.0], 1) == "2.0" and median([], 1) == "–"

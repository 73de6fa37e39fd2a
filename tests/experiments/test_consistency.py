"""The consistency experiment: its settings, a row by hand, and a small run."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from sst_graph.batch import CalibrationConfig
from sst_graph.errors import ConfigError
from sst_graph.experiments import consistency
from sst_graph.experiments.consistency import ConsistencyConfig, ConsistencyRun


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"drives": ("sitting",)}, "drives: found sitting, expected some of standing, stop"),
        ({"drives": ()}, "drives: found .* expected a list of 1 to 100 values"),
        ({"runs": 1}, "runs: found 1, expected at least 2"),
    ],
)
def test_bad_settings(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        ConsistencyConfig(**changes)


def test_errors_drawn_from_the_covariance_are_consistent() -> None:
    rng = np.random.default_rng(0)
    A = rng.normal(size=(7, 7)) * 0.01
    covariance = A @ A.T + 1e-6 * np.eye(7)
    errors = rng.multivariate_normal(np.zeros(7), covariance, 4000)
    cells = consistency.row("drawn", [ConsistencyRun(e, covariance, False) for e in errors], 90.0)
    np.testing.assert_allclose([float(cell) for cell in cells[2:6]], 1.0, atol=0.05)
    shares = [float(cell.strip(" %")) for cell in cells[6].split(",")]
    np.testing.assert_allclose(shares, 95.0, atol=1.5)


def test_what_did_not_converge_or_is_wrong_is_counted_and_left_out() -> None:
    fine = ConsistencyRun(np.full(7, 0.01), np.eye(7) * 1e-4, False)
    lost = dataclasses.replace(fine, error=np.full(7, 1.0))
    not_converged = dataclasses.replace(lost, not_converged=True)
    cells = consistency.row("mixed", [fine, fine, lost, not_converged], 2.0)
    assert cells[1] == "4 (1, 1)" and float(cells[2]) == pytest.approx(1.0)
    assert float(cells[4]) == pytest.approx(1.0) and cells[6].count("%") == 3


def test_the_offset_of_a_drive_at_standstill_is_left_out() -> None:
    moving = ConsistencyRun(np.full(7, 0.01), np.eye(7) * 1e-4, False)
    error = np.append(np.full(6, 0.01), 0.0)
    standing = ConsistencyRun(error, np.eye(7) * 1e-4, False, offset_observable=False)
    cells = consistency.row("standing", [standing], 2.0)
    assert cells[4] == "–" and cells[6].count("%") == 2
    assert float(cells[5]) == pytest.approx(1.0)
    cells = consistency.row("all", [moving, standing], 2.0)
    assert [float(cell) for cell in cells[2:6]] == pytest.approx([1.0] * 4) and cells[6].count("%") == 3


@pytest.mark.slow
def test_a_small_run() -> None:
    drive = {"motion": "standing", "frames": 2, "time_offset_s": 0.0, "width": 621, "height": 188}
    small = {"standing": ("tiny", {**drive, "azimuth_step_deg": 0.35})}
    config = ConsistencyConfig(runs=2, drives=("standing",), seed=3, calibration=CalibrationConfig())
    table = consistency.run(config, drives=small)
    assert table.count("\n") == 3 and "| tiny | 2 (" in table

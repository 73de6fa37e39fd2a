"""The experiment on windows of real drives: its statistics, its refusals and a small run."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from streets import standing_street

from sst_graph.batch import CalibrationConfig
from sst_graph.errors import ConfigError
from sst_graph.experiments import windows
from sst_graph.experiments.windows import (
    WindowsConfig,
    deviations_of,
    error_cell,
    spread_cells,
    spread_in_sigmas,
)
from sst_graph.initialization.global_search import SearchConfig
from sst_graph.metrics import CalibrationErrors
from sst_graph.result import CalibrationResult
from sst_graph.simulator import SimulationConfig, simulate, write_drive


def drawn_results(template: CalibrationResult, count: int, claimed: float) -> list[CalibrationResult]:
    """Answers drawn from a covariance, claiming ``claimed`` times its sigmas."""
    rng = np.random.default_rng(3)
    root = np.diag([1e-3] * 3 + [0.01] * 3 + [0.002]) @ (np.eye(7) + 0.3 * rng.normal(size=(7, 7)))
    results = []
    for _ in range(count):
        error = root @ rng.normal(size=7)
        results.append(
            replace(
                template,
                T_camera_lidar=template.T_camera_lidar.compose(gtsam.Pose3.Expmap(error[:6])),
                time_offset_s=float(error[6]),
                covariance=claimed**2 * root @ root.T,
            )
        )
    return results


@pytest.mark.parametrize("claimed", [1.0, 0.5])
def test_the_spread_of_drawn_results_is_that_of_the_draws(claimed: float) -> None:
    template = CalibrationResult(gtsam.Pose3(), 0.0, np.eye(7), "ok", standing_street().camera)
    deviations, covariances = deviations_of(drawn_results(template, 200, claimed))
    assert spread_in_sigmas(deviations, covariances) == pytest.approx([1.0 / claimed] * 3, rel=0.08)


def test_results_that_are_not_converged_are_left_out() -> None:
    template = CalibrationResult(gtsam.Pose3(), 0.0, np.eye(7), "ok", standing_street().camera)
    results = drawn_results(template, 4, 1.0)
    far = replace(results[0], time_offset_s=5.0, status="not_converged")
    assert spread_cells([*results, far]) == spread_cells(results)
    assert set(spread_cells([results[0], far])) == {"–"}


def test_no_data_and_one_window_are_refused() -> None:
    with pytest.raises(ConfigError, match="data"):
        windows.run(WindowsConfig())
    with pytest.raises(ValueError, match="windows"):
        WindowsConfig(windows=(1,))


@pytest.mark.slow
def test_a_row_for_each_number_of_windows(tmp_path: Path) -> None:
    folder = tmp_path / "street"
    small = SimulationConfig(
        seed=3, frames=4, width=621, height=188, motion="no_stop", azimuth_step_deg=0.35, time_offset_s=0.0
    )
    write_drive(simulate(small), folder)
    # The simulated clouds have no sweep, which scans of so short windows cannot tell.
    known = replace(CalibrationConfig(), search=SearchConfig(enabled=False), decide_sweep=False)
    table = windows.run(WindowsConfig((str(folder),), (2,), calibration=known))
    cells = [cell.strip() for cell in table.splitlines()[-1].strip("|").split("|")]
    assert cells[:2] == ["street/00", "2"] and len(table.splitlines()) == 3
    spread, claimed = (float(part) for part in cells[2].split(" / "))
    assert spread > 0.0 and claimed > 0.0
    assert all(float(ratio) > 0.0 for ratio in cells[5].split(", ")[:2])
    assert all(0.0 < float(error) < 2.0 for error in cells[6].split(", ")[:1])


@pytest.mark.slow
def test_several_drives_have_rows_of_their_own_and_one_together(tmp_path: Path) -> None:
    folders = []
    for motion in ("no_stop", "mixed"):
        folders.append(str(tmp_path / motion))
        small = SimulationConfig(
            seed=4, frames=4, width=621, height=188, motion=motion, azimuth_step_deg=0.35
        )
        write_drive(simulate(small), Path(folders[-1]))
    # The simulated clouds have no sweep, which scans of so short windows cannot tell.
    known = replace(CalibrationConfig(), search=SearchConfig(enabled=False), decide_sweep=False)
    table = windows.run(WindowsConfig(tuple(folders), (2,), calibration=known))
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()[2:]]
    assert [row[0] for row in rows] == ["no_stop/00", "mixed/00", "no_stop/00 + mixed/00"]
    claims = [float(row[2].split(" / ")[1]) for row in rows]
    assert claims[2] < min(claims[:2])


def test_errors_are_roots_of_mean_squares() -> None:
    made = ((3.0, 0.001), (4.0, None))
    errors = [CalibrationErrors(qad, 0.0, 0.01 * qad, seconds, None) for qad, seconds in made]
    assert error_cell(errors) == "3.54, 3.54, 1.00"
    assert error_cell([errors[1]]) == "4.00, 4.00, –"
    assert error_cell([]) == "–"

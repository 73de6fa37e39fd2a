"""The notebooks run, hold no outputs, show labelled plots, and reach what they say."""

from __future__ import annotations

import runpy
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jupytext
import matplotlib
import numpy as np
import pytest
from matplotlib import pyplot

from sst_graph.export import marginal_of_result
from sst_graph.marginal import separated
from sst_graph.result import CalibrationResult

NOTEBOOKS = Path(__file__).resolve().parent.parent / "notebooks"
NAMES = (
    "01_first_calibration",
    "02_time_offset_and_motion",
    "03_a_factor_by_hand",
    "04_covariance_and_weak_directions",
    "05_isam2_drift_and_an_alarm",
    "06_in_a_slam_graph",
    "07_your_own_data",
)


@pytest.fixture(autouse=True)
def figures() -> Iterator[None]:
    """Figures go nowhere but into memory, and are gone after the test."""
    matplotlib.use("Agg")
    yield
    pyplot.close("all")


def run(name: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> dict[str, Any]:
    """The variables of a notebook at its end; what it writes goes to ``tmp_path``. Its plots are checked."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    found = runpy.run_path(str(NOTEBOOKS / f"{name}.py"))
    drawn = [pyplot.figure(number) for number in pyplot.get_fignums()]
    assert 2 <= len(drawn) <= 5
    for figure in drawn:
        for ax in figure.axes:
            if ax.get_label() == "<colorbar>":
                continue
            together = ax.get_shared_x_axes().get_siblings(ax)
            assert ax.get_ylabel() and any(each.get_xlabel() for each in together), f"{name}: no label"
        figure.canvas.draw()
    return found


def error_in_sigmas(result: CalibrationResult, truth: Any) -> float:
    """Squared error in units of the covariance."""
    step = truth.cTl.localCoordinates(result.T_camera_lidar)
    error = np.append(step, result.time_offset_s - truth.time_offset_s)
    return float(error @ np.linalg.solve(result.covariance, error))


def test_every_notebook_is_a_percent_script_that_jupytext_reads() -> None:
    assert sorted(path.stem for path in NOTEBOOKS.glob("*.*")) == list(NAMES)
    for name in NAMES:
        cells = jupytext.read(NOTEBOOKS / f"{name}.py", fmt="py:percent").cells
        assert cells[0].cell_type == "markdown" and cells[0].source.startswith("# ")
        assert sum(cell.source.startswith("# ") for cell in cells if cell.cell_type == "markdown") == 1
        assert sum(cell.cell_type == "code" for cell in cells) >= 3


@pytest.mark.slow
def test_a_first_calibration(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    found = run("01_first_calibration", monkeypatch, tmp_path)
    assert found["result"].status == "ok"
    assert found["errors"].qad_deg < 0.15 and found["errors"].atd_m < 0.015
    assert abs(found["errors"].time_offset_s) < 0.006
    assert found["fit"].quality.share > 0.95 * found["fit"].quality.attainable


def test_motion_tells_the_offset_from_a_translation(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    found = run("02_time_offset_and_motion", monkeypatch, tmp_path)
    assert found["sigma_cm"] < 1.0 and found["sigma_ms"] < 2.0  # of the last motion, which turns


def test_a_factor_by_hand_is_the_packages_own(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    found = run("03_a_factor_by_hand", monkeypatch, tmp_path)
    assert np.min(found["difference"], axis=0).max() < 1e-8
    values, linear = found["values"], found["checked"].linearize(found["values"])
    np.testing.assert_allclose(found["by_hand"].linearize(values).information(), linear.information())
    turned = [found["truth"].cTl.localCoordinates(cTl)[:3] for cTl, _ in found["found"].values()]
    by_hand, robust = np.degrees(np.linalg.norm(turned, axis=1))
    assert robust < by_hand < 1.0


@pytest.mark.slow
def test_a_stop_settles_the_weak_direction(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    found = run("04_covariance_and_weak_directions", monkeypatch, tmp_path)
    result, second, fused = found["result"], found["second"], found["fused"].covariance()
    assert result.status == "unobservable" and result.weak_directions
    assert error_in_sigmas(result, found["truth"]) < 18.5  # 99 % of chi^2 with 7 degrees of freedom
    own, *parts = (
        separated(marginal).own.covariance()
        for marginal in (found["fused"], marginal_of_result(result), marginal_of_result(second))
    )
    for part, whole in zip(parts, (result, second), strict=True):
        assert (np.diag(own) < np.diag(part)).all()
        assert fused[3, 3] < whole.covariance[3, 3] and fused[6, 6] < whole.covariance[6, 6]
    assert fused[6, 6] < 0.3**2 * result.covariance[6, 6]
    assert (np.diag(found["independent"]) < np.diag(result.covariance)).all()


@pytest.mark.slow
def test_a_knock_is_noticed_and_a_drift_followed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    found = run("05_isam2_drift_and_an_alarm", monkeypatch, tmp_path)
    (alarm,) = found["alarms"]
    assert found["KNOCK"] <= alarm <= found["KNOCK"] + 4
    yaw_deg, knock_deg = found["yaw_deg"], found["KNOCK_DEG"]
    assert abs(yaw_deg(found["updates"][-1]) - knock_deg) < 0.4
    truth_deg = found["DRIFT_DEG"] * (len(found["drive"]) - 1)
    constant, walk = (abs(yaw_deg(updates[-1]) - truth_deg) for updates in found["tracked"].values())
    assert walk < 0.5 * constant


@pytest.mark.slow
def test_calibration_in_a_slam_graph(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    found = run("06_in_a_slam_graph", monkeypatch, tmp_path)
    assert len(found["closures"]) >= 10 and found["solution"].converged
    error, covariance = found["error"], found["solution"].covariance
    assert error @ np.linalg.solve(covariance, error) < 18.5  # 99 % of chi^2 with 7 degrees of freedom
    assert np.degrees(np.linalg.norm(error[:3])) < 0.3 and abs(error[6]) < 0.02
    off = {name: np.linalg.norm(at - found["true"], axis=1).mean() for name, at in found["position"].items()}
    assert off["with loops"] < 0.5 * off["odometry"] and off["with the camera"] < 0.5 * off["odometry"]
    first = next(update for update in found["history"] if update.converged)
    last = found["history"][-1]
    assert last.converged and (np.diag(last.covariance) < np.diag(first.covariance)).all()


@pytest.mark.slow
def test_a_bag_from_info_to_inspection(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    found = run("07_your_own_data", monkeypatch, tmp_path)
    assert found["code"] == 0
    assert error_in_sigmas(found["calibration"], found["drive"].truth) < 18.5
    names = {path.name for path in Path(found["result"]).iterdir()}
    assert {"calibration.json", "report.html", "report.md"} < names

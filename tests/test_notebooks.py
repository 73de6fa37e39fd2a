"""The worked examples run, hold no outputs, and show what they say."""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any

import jupytext
import numpy as np
import pytest

NOTEBOOKS = Path(__file__).resolve().parent.parent / "notebooks"


def run(name: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> dict[str, Any]:
    """The variables of a notebook at its end; what it writes goes to ``tmp_path``."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    return runpy.run_path(str(NOTEBOOKS / name))


def test_every_notebook_is_a_percent_script_that_jupytext_reads() -> None:
    paths = sorted(NOTEBOOKS.iterdir())
    assert len(paths) >= 3 and all(path.suffix == ".py" for path in paths if path.is_file())
    for path in paths:
        if path.is_file():
            cells = jupytext.read(path, fmt="py:percent").cells
            assert cells[0].cell_type == "markdown" and cells[0].source.startswith("# ")
            assert sum(cell.cell_type == "code" for cell in cells) >= 3


def test_calibrate_in_five_lines(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    found = run("01_calibrate_in_five_lines.py", monkeypatch, tmp_path)
    assert found["errors"].qad_deg < 0.12 and found["errors"].atd_m < 0.01
    assert abs(found["errors"].time_offset_s) < 0.005


def test_slam_and_calibration_are_better_together(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    found = run("02_slam_fusion.py", monkeypatch, tmp_path)
    table, both = found["table"], found["table"]["both"]
    assert len(found["closures"]) >= 10
    assert table["SLAM alone"]["position_cm"] < 0.6 * table["odometry"]["position_cm"]
    for name, share in (("position_cm", 0.85), ("step_deg", 0.95), ("step_cm", 0.8)):
        assert both[name] < share * table["SLAM alone"][name]
    for name in ("rotation_deg", "translation_cm"):
        assert both[name] < table["calibration alone"][name]
    assert both["rotation_deg"] < 0.25 and both["offset_ms"] < 3.0


def test_two_drives_determine_more_than_one(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    found = run("03_covariance_and_fusion_of_drives.py", monkeypatch, tmp_path)
    fused, both = found["fused"], found["both"]
    for result in found["alone"]:
        assert (np.diag(fused.covariance()) < np.diag(result.covariance)).all()
    cTl, time_offset_s = fused.best()
    d = np.append(both.T_camera_lidar.localCoordinates(cTl), time_offset_s - both.time_offset_s)
    assert d @ np.linalg.solve(both.covariance, d) < 14.1  # 95 % of chi^2 with 7 degrees of freedom

"""The experiments by name, and the command's refusals."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from sst_graph.cli import main
from sst_graph.config import read_config
from sst_graph.errors import ConfigError
from sst_graph.experiments.registry import EXPERIMENTS, experiment


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["magic"], "expected one of accuracy"),
        (["table1", "--methods", "papre"], "papre"),
        (["table1", "--streets", "0"], "streets: found 0, expected at least 1"),
        (["table1", "--set", "strets=3"], "did you mean 'streets'"),
        (["table3", "--jobs", "0"], "jobs: found 0, expected at least 1"),
        (["table3", "--data", "/nowhere"], "/nowhere"),
        (["table3", "--set", "kitti_frames=[5,5]"], "kitti_frames: found 5, 5"),
        (["fit", "--data", "/nowhere"], "data"),
    ],
)
def test_bad_options(capsys: pytest.CaptureFixture[str], options: list[str], message: str) -> None:
    assert main(["experiment", *options]) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1 and message in captured.err


def test_registry() -> None:
    for name, entry in EXPERIMENTS.items():
        assert experiment(name) is entry and dataclasses.is_dataclass(entry.config) and entry.summary
    with pytest.raises(ConfigError, match="table4"):
        experiment("nothing")


def test_a_file_of_settings_changes_what_it_names_alone(tmp_path: Path) -> None:
    path = tmp_path / "table.toml"
    path.write_text("streets = 3\n[calibration]\nseed = 7\n")
    default = experiment("table1").config
    found = read_config(type(default), path, default)
    calibration = dataclasses.replace(default.calibration, seed=7)
    assert default.standing and not default.calibration.find_causes
    assert found == dataclasses.replace(default, streets=3, calibration=calibration)

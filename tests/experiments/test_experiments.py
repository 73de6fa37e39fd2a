"""The experiments by name, and the command's refusals."""

from __future__ import annotations

import dataclasses
import subprocess
from pathlib import Path

import pytest

import sst_graph
from sst_graph.cli import main
from sst_graph.config import read_config
from sst_graph.experiments.registry import EXPERIMENTS, experiment
from sst_graph.experiments.tasks.code_version import code_version, recorded_version


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


def test_the_version_is_the_commit_in_a_checkout_and_the_package_elsewhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = tmp_path / "sst_graph"
    package.mkdir()
    (package / "code.py").write_text("A = 1\n")
    monkeypatch.setattr(sst_graph, "__file__", str(package / "__init__.py"))
    assert code_version() == sst_graph.__version__
    git = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@b"]
    for words in (["init", "-q"], ["add", "-A"], ["commit", "-qm", "a"], ["tag", "v9"]):
        subprocess.run([*git, *words], check=True)
    assert code_version() == recorded_version() == "commit v9"
    (package / "code.py").write_text("A = 2\n")
    assert code_version() == "commit v9-dirty"
    second = recorded_version()
    (package / "code.py").write_text("A = 3\n")
    assert code_version() == "commit v9-dirty" and second != recorded_version()
    assert second.startswith("commit v9-dirty ")


def test_registry() -> None:
    for name, entry in EXPERIMENTS.items():
        assert experiment(name) is entry and dataclasses.is_dataclass(entry.config) and entry.summary


def test_another_name_tells_all_experiments_and_what_they_show(capsys: pytest.CaptureFixture[str]) -> None:
    """An error message has a longest length: what does not fit is cut out of its middle."""
    assert main(["experiment", "nothing"]) == 2
    told = capsys.readouterr().err
    for name, entry in EXPERIMENTS.items():
        assert f"{name} ({entry.summary})" in told


def test_a_file_of_settings_changes_what_it_names_alone(tmp_path: Path) -> None:
    path = tmp_path / "table.toml"
    path.write_text("streets = 3\n[calibration]\nseed = 7\n")
    default = experiment("table1").config
    found = read_config(type(default), path, default)
    calibration = dataclasses.replace(default.calibration, seed=7)
    assert default.standing and not default.calibration.find_causes
    assert found == dataclasses.replace(default, streets=3, calibration=calibration)

"""The experiments by name, and the command's refusals."""

from __future__ import annotations

import dataclasses

import pytest

from sst_graph.cli import main
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

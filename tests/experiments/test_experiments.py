"""The paper's table: its starts, its statistics, and the command."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import gtsam
import numpy as np
import pytest

from sst_graph.cli import main
from sst_graph.errors import ConfigError
from sst_graph.experiments.paper_table import PaperTableConfig, Run, failed, markdown, wrong_start
from sst_graph.experiments.registry import EXPERIMENTS, experiment
from sst_graph.metrics import CalibrationErrors

CONFIG = PaperTableConfig(streets=3, methods=("paper", "joint"))


def errors(qad_deg: float, atd_m: float, time_s: float = 0.0) -> CalibrationErrors:
    return CalibrationErrors(qad_deg, 0.5 * qad_deg, atd_m, time_s, None)


def test_starts_are_uniform_and_seeded() -> None:
    cTl = gtsam.Pose3(gtsam.Rot3.Ypr(0.1, 0.2, 0.3), np.array([0.1, 0.2, 0.3]))
    starts = [wrong_start(cTl, CONFIG, number) for number in range(300)]
    turns = np.degrees([gtsam.Rot3.Logmap(s.rotation() * cTl.rotation().inverse()) for s in starts])
    shifts = np.array([s.translation() - cTl.translation() for s in starts])
    for values, limit in ((turns, 10.0), (shifts, 0.1)):
        assert 0.97 * limit < np.abs(values).max() <= limit
        assert np.std(values) == pytest.approx(limit / np.sqrt(3.0), rel=0.05)
    assert wrong_start(cTl, CONFIG, 7).equals(starts[7], 0.0)
    shifted = dataclasses.replace(CONFIG, seed=7)
    assert wrong_start(cTl, shifted, 0).equals(starts[7], 0.0)


def test_images_are_one_frame_late() -> None:
    street = CONFIG.street(2)
    assert street.seed == 2 and street.time_offset_s == pytest.approx(1.0 / street.frame_rate_hz)


def test_failures_are_counted_and_left_out_of_the_means() -> None:
    assert failed(errors(5.1, 0.0), CONFIG) and failed(errors(0.0, 0.51), CONFIG)
    assert not failed(errors(5.0, 0.5), CONFIG)
    runs = [Run("start", errors(9.0, 0.1), None) for _ in range(3)]
    runs += [Run("joint", errors(0.1 * k, 0.01 * k, 0.001 * k), "ok") for k in (1, 2, 6)]
    runs += [Run("paper", errors(1.0, 0.1, -0.02), "ok"), Run("paper", errors(20.0, 3.0), "not_converged")]
    runs.append(Run("paper", errors(30.0, 3.0), "ok"))
    rows = {line.split(" | ")[0].strip("| "): line for line in markdown(CONFIG, runs).splitlines()}
    assert rows["joint"] == "| joint | 0.20 | 0 of 3 | – | 0.30 / 0.20 | 0.15 / 0.10 | 3.0 / 2.0 | 2.0 |"
    assert (
        rows["paper"]
        == "| paper | 20.00 | 2 of 3 | 1 of 2 | 1.00 / 1.00 | 0.50 / 0.50 | 10.0 / 10.0 | 20.0 |"
    )
    assert rows["start"].startswith("| start | 9.00 | 3 of 3 | – | – ")


def test_the_command_writes_a_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "table.md"
    options = ["--streets", "1", "--seed", "5", "--methods", "static", "--set", "frames=1"]
    command = ["experiment", "paper-table", *options, "--out", str(out)]
    assert main(command) == 0
    table = out.read_text()
    assert "seeds 5 to 5" in table and table.count("\n| ") == 6 and "| static | " in table
    assert main(command) == 2 and "--overwrite" in capsys.readouterr().err
    assert out.read_text() == table


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["magic"], "expected one of accuracy"),
        (["paper-table", "--methods", "papre"], "papre"),
        (["paper-table", "--streets", "0"], "streets: found 0, expected at least 1"),
        (["paper-table", "--set", "strets=3"], "did you mean 'streets'"),
    ],
)
def test_bad_options(capsys: pytest.CaptureFixture[str], options: list[str], message: str) -> None:
    assert main(["experiment", *options]) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1 and message in captured.err


def test_registry() -> None:
    for name, entry in EXPERIMENTS.items():
        assert experiment(name) is entry and dataclasses.is_dataclass(entry.config) and entry.summary
    with pytest.raises(ConfigError, match="paper-table"):
        experiment("nothing")

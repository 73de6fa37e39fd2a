"""Starts over the whole sphere, exact bounds, and the counts of the table."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path

import gtsam
import numpy as np
import pytest
from scipy.stats import binom

from sst_graph.cli import main
from sst_graph.errors import ConfigError
from sst_graph.experiments.basin import BasinConfig, BasinRun, binomial_bounds, markdown, start_anywhere
from sst_graph.initialization.global_search import SearchConfig, SearchProblem
from sst_graph.types import Guess

CTL = gtsam.Pose3(gtsam.Rot3.Ypr(0.1, 0.2, 0.3), np.array([0.1, 0.2, 0.3]))


def test_rotations_are_uniform_over_the_sphere() -> None:
    """Of a uniform rotation the angle has the density (1 - cos) / pi, and each column is uniform."""
    rng = np.random.default_rng(0)
    starts = [start_anywhere(CTL, 180.0, 1.0, rng) for _ in range(2000)]
    turns = [start.rotation() * CTL.rotation().inverse() for start in starts]
    angles = np.array([np.linalg.norm(gtsam.Rot3.Logmap(turn)) for turn in turns])
    for angle in (0.5, 1.0, 2.0, 3.0):
        expected = (angle - np.sin(angle)) / np.pi
        assert np.mean(angles < angle) == pytest.approx(expected, abs=0.035)
    columns = np.array([turn.matrix() @ [0.6, 0.0, 0.8] for turn in turns])
    np.testing.assert_allclose(columns.mean(axis=0), 0.0, atol=0.05)
    np.testing.assert_allclose(columns.T @ columns / len(columns), np.eye(3) / 3.0, atol=0.03)


def test_starts_stay_within_their_bounds() -> None:
    rng = np.random.default_rng(1)
    starts = [start_anywhere(CTL, 30.0, 0.5, rng) for _ in range(300)]
    angles = [np.linalg.norm(gtsam.Rot3.Logmap(CTL.rotation().between(s.rotation()))) for s in starts]
    shifts = np.array([s.translation() - CTL.translation() for s in starts])
    assert np.radians(28.0) < max(angles) <= np.radians(30.0)
    assert 0.48 < np.abs(shifts).max() <= 0.5
    assert np.median(angles) == pytest.approx(np.radians(30.0) * 0.5 ** (1.0 / 3.0), rel=0.04)


@pytest.mark.parametrize(("count", "of"), [(0, 1000), (1, 20), (7, 20), (20, 20)])
def test_bounds_are_those_whose_tails_hold_a_fortieth(count: int, of: int) -> None:
    low, high = binomial_bounds(count, of)
    assert low <= count / of <= high
    if count:
        assert binom.sf(count - 1, of, low) == pytest.approx(0.025)
    else:
        assert low == 0.0
        assert high == pytest.approx(1.0 - 0.025 ** (1.0 / of))
    if count < of:
        assert binom.cdf(count, of, high) == pytest.approx(0.025)
    else:
        assert high == 1.0


def test_failures_and_silent_ones_are_counted() -> None:
    config = BasinConfig()
    base = BasinRun("a", 180.0, 1.0, 90.0, 0.1, 0.01, "ok", 2.0)
    runs = [
        base,
        dataclasses.replace(base, qad_deg=1.1),
        dataclasses.replace(base, atd_m=0.3, status="not_converged", drive="b"),
        dataclasses.replace(base, search_deg=30.0, search_m=0.6, qad_deg=50.0, status="unobservable"),
    ]
    rows = [line.split(" | ") for line in markdown(config, runs).splitlines() if line.startswith("| ±")]
    assert rows[0][2:4] == ["1", "1 (2.50–100.00 %)"] and rows[0][4].startswith("0 ")
    assert rows[1][2] == "3" and rows[1][3].startswith("2 ") and rows[1][4].startswith("1 ")
    assert rows[1][5] == "2 / 0 / 1" and rows[1][6] == "0.100 / 0.100"
    total = markdown(config, runs).splitlines()[-1]
    assert total.startswith("| all | all | 4 | 3 (") and "| 1 (" in total


def test_searches_that_differ_in_the_translation_have_rows_of_their_own() -> None:
    config = BasinConfig(searches_deg=(30.0, 30.0), searches_m=(0.6, 2.0), starts=(1, 1))
    near = BasinRun("a", 30.0, 0.6, 20.0, 0.1, 0.01, "ok", 2.0)
    runs = [near, dataclasses.replace(near, search_m=2.0, qad_deg=50.0)]
    rows = [line.split(" | ") for line in markdown(config, runs).splitlines() if line.startswith("| ±")]
    assert [(row[0], row[2], row[3][0]) for row in rows] == [
        ("| ±30°, ±0.6 m", "1", "0"),
        ("| ±30°, ±2 m", "1", "1"),
    ]


def test_a_number_is_needed_for_every_search() -> None:
    with pytest.raises(ConfigError, match="as many of each"):
        BasinConfig(starts=(3,))


def test_the_grid_of_a_search_everywhere_repeats_no_rotation_beyond_half_a_turn() -> None:
    problem = SearchProblem([], None, (), Guess(CTL), SearchConfig(rotation_deg=180.0))  # type: ignore[arg-type]
    rotations = problem.grid().rotations @ CTL.rotation().matrix().T
    axes = np.array([gtsam.Rot3.Logmap(gtsam.Rot3(R)) for R in rotations[:: len(rotations) // 500]])
    assert np.linalg.norm(axes, axis=1).max() <= np.pi + 1e-9
    # All of the ball of half a turn, at 5 degrees: 4/3 pi 36^3 rotation vectors.
    assert len(rotations) == pytest.approx(4.0 / 3.0 * np.pi * 36.0**3, rel=0.01)


@pytest.mark.slow
def test_the_command_resumes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    small = ["--set", "street.frames=2", "--set", "starts=[1]", "--set", "searches_deg=[30]"]
    small += ["--set", "searches_m=[0.6]", "--set", "street.motion=standing"]
    small += ["--set", f'records="{tmp_path / "records"}"']
    assert main(["experiment", "basin", "--streets", "1", *small]) == 0
    first = capsys.readouterr().out
    assert "| ±30°, ±0.6 m | all | 1 |" in first
    written = (tmp_path / "records").read_bytes()
    assert main(["experiment", "basin", "--streets", "1", *small]) == 0
    assert capsys.readouterr().out == first
    assert (tmp_path / "records").read_bytes() == written


@pytest.mark.slow
def test_what_is_done_is_kept_beside_the_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    small = ["--set", "street.frames=2", "--set", "starts=[1]", "--set", "searches_deg=[30]"]
    small += ["--set", "searches_m=[0.6]", "--set", "street.motion=standing", "--out"]
    command = ["experiment", "basin", "--streets", "1", *small, str(tmp_path / "basin.md")]
    assert main(command) == 0
    table, records = (tmp_path / "basin.md").read_text(), tmp_path / "basin.runs.jsonl"
    written = records.read_bytes()
    assert written.count(b"\n") == 2 and str(records) not in table
    assert main([*command, "--overwrite"]) == 0
    assert (tmp_path / "basin.md").read_text() == table and records.read_bytes() == written
    assert main([*command[:-1], str(records)]) == 2
    assert "found the same file" in capsys.readouterr().err and records.read_bytes() == written


def test_a_drive_without_labels_is_no_failure(kitti_drive: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.rmtree(kitti_drive / "labels")
    assert main(["experiment", "basin", "--data", str(kitti_drive.parents[1])]) == 2
    assert "found no labels of points, expected both for method joint" in capsys.readouterr().err


def test_records_of_another_kind_are_a_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other = tmp_path / "other.txt"
    other.write_text("mine")
    assert main(["experiment", "basin", "--set", f'records="{other}"']) == 2
    assert "other.txt" in capsys.readouterr().err and other.read_text() == "mine"

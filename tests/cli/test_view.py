"""``sst-graph view`` and ``track --view-save`` as a user calls them."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from pathlib import Path

import pytest
from rerun.chunk import RrdReader

from sst_graph.cli import main
from sst_graph.cli.progress import PREFIX

FEW = ["--frames", "0:5"]


def _entities(path: Path) -> set[str]:
    return {chunk.entity_path for chunk in RrdReader(path).stream()}


def test_view_writes_a_file(
    street: Path, result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "new" / "drive.rrd"
    command = ["view", str(result), str(street), *FEW, "--save", str(out)]
    assert main(command) == 0
    assert "5 frames" in capsys.readouterr().out
    assert {"/world/lidar/cloud", "/world/lidar/camera/image/matches/residuals"} <= _entities(out)
    assert main(command) == 2 and "--overwrite" in capsys.readouterr().err
    assert main([*command, "--overwrite"]) == 0
    assert [path.name for path in out.parent.iterdir()] == ["drive.rrd"]


def test_track_writes_one_beside_its_lines(
    street: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = ("start_scans=3", "calibration.search.enabled=false", "calibration.decide_sweep=false")
    command = ["track", str(street), *FEW, *(word for one in settings for word in ("--set", one))]
    code = main(command)
    lines = capsys.readouterr().out
    out = tmp_path / "track.rrd"
    assert main([*command, "--view-save", str(out)]) == code
    assert capsys.readouterr().out == lines
    assert {"/estimate/time_offset/offset", "/tracker/log", "/sigma/rotation/x"} <= _entities(out)


@pytest.mark.parametrize("command", ["view", "track"])
def test_nothing_of_another_kind_is_replaced(
    street: Path, result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    out = tmp_path / "a.rrd"
    out.write_text("mine")
    options = [str(result), str(street), "--save"] if command == "view" else [str(street), "--view-save"]
    assert main([command, *options, str(out), "--overwrite"]) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1 and out.read_text() == "mine"
    assert "another kind of file, expected a recording of rerun" in captured.err


@pytest.mark.parametrize("command", ["view", pytest.param("track", marks=pytest.mark.slow)])
def test_without_the_extra_the_message_names_it(
    street: Path, result: Path, tmp_path: Path, command: str
) -> None:
    (tmp_path / "rerun.py").write_text("raise ImportError('not here')")
    arguments = {"view": ["view", result, street], "track": ["track", street, "--view"]}[command]
    done = subprocess.run(
        [sys.executable, "-m", "sst_graph", *arguments],
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr.count("\n") == 1 and "pip install 'sst-graph[rerun]'" in done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("most_bytes", [3000, 60_000])
@pytest.mark.parametrize("command", ["view", "track"])
def test_a_full_disk_is_told_and_nothing_waits(
    street: Path, result: Path, tmp_path: Path, command: str, most_bytes: int
) -> None:
    """At once, and where some of the file is written; rerun's own writer waits for ever, or says little."""
    out = tmp_path / "a.rrd"
    arguments = ["view", str(result), str(street), "--save"]
    if command == "track":
        arguments = ["track", str(street), "--set", "calibration.decide_sweep=false", "--view-save"]
    done = subprocess.run(
        [sys.executable, "-m", "sst_graph", *arguments, str(out), *FEW],
        capture_output=True,
        text=True,
        timeout=100,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (most_bytes, most_bytes)),
    )
    (line,) = [one for one in done.stderr.splitlines() if PREFIX not in one]
    assert (done.returncode, line) == (2, f"sst-graph: error: {out}: File too large")
    assert list(tmp_path.iterdir()) == []

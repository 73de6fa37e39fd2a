"""The tables as a user makes them: on a KITTI layout, in processes, killed and resumed, on tiny streets."""

from __future__ import annotations

import csv
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from sst_graph.cli import main
from sst_graph.experiments.paper.tables import STATE
from sst_graph.experiments.tasks.code_version import code_version
from sst_graph.files.output import OutputFile

PROGRAM = [sys.executable, "-m", "sst_graph", "experiment"]
DRIVES = Path(__file__).resolve().parents[4] / "shared" / "data"


@pytest.fixture
def kitti(kitti_drive: Path) -> Path:
    """A KITTI odometry root with two sequences of five frames of a few pixels, which show too little."""
    shutil.copytree(kitti_drive, kitti_drive.parent / "05")
    return kitti_drive.parents[1]


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as stream:
        return list(csv.DictReader(stream))


@pytest.mark.slow
def test_a_kitti_root_gives_the_stretch_of_sequence_00(
    kitti: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out" / "table4.md"
    options = ["--data", str(kitti), "--set", "kitti_frames=[1,4]", "--methods", "joint"]
    command = ["experiment", "table4", *options, "--set", "images_late=[0,1]", "--out", str(out)]
    assert main(command) == 0
    table, rows = out.read_text(), rows_of(out.with_suffix(".csv"))
    assert "\nkitti/00, frames 1 to 3\n" in table and "ours" in table
    # stamps 0.1, 0.2, 0.31, 0.41 s
    assert "| 0: 0.0 / 0 | 1 of 1 (3–100 %; 1 without an estimate) |" in table
    assert "| joint | 1: 103.3 / 100 | 1 of 1 (3–100 %; 1 without an estimate) | 1 of 1 |" in table
    assert [(row["images_late"], row["method"]) for row in rows] == [
        *(("0", "start"), ("0", "joint"), ("1", "start"), ("1", "joint"))
    ]
    assert out.with_suffix(".svg").read_text().startswith("<?xml")
    # the last line tells what made it, without outputs
    made = ["Made by `sst-graph experiment table4", "--data", str(kitti), "--methods", "joint", "--set"]
    last = table.splitlines()[-1]
    assert last.startswith(" ".join(made)) and last.endswith(f"sst-graph {code_version()}.")
    assert str(out) not in last
    # outputs are not replaced unasked; runs that are done are not run again
    state = (out.parent / STATE).read_bytes()
    assert main(command) == 2 and "--overwrite" in capsys.readouterr().err
    assert main([*command, "--overwrite"]) == 0
    assert out.read_text() == table and (out.parent / STATE).read_bytes() == state
    # a further start runs only what is new
    assert main([*command, "--overwrite", "--set", "starts=2"]) == 0
    assert (out.parent / STATE).read_bytes().startswith(state)
    assert len((out.parent / STATE).read_bytes().splitlines()) == 2 * len(state.splitlines()) - 1


@pytest.mark.slow
def test_a_kill_among_the_outputs_needs_no_overwrite(
    kitti: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """After any number of the three files is written, the same command finishes."""
    command = ["experiment", "table3", "--data", str(kitti), "--methods", "joint", "--out"]
    assert main([*command, str(tmp_path / "whole/table3.md")]) == 0
    for written in (0, 1, 2):
        out, puts = tmp_path / str(written) / "table3.md", []
        write = OutputFile.write_bytes

        def killed(
            self: OutputFile, data: bytes, after: int = written, puts: list[int] = puts, write: Any = write
        ) -> None:
            if len(puts) == after:
                raise KeyboardInterrupt
            puts.append(len(data))
            write(self, data)

        with monkeypatch.context() as patched:
            patched.setattr(OutputFile, "write_bytes", killed)
            assert main([*command, str(out)]) == 130
        assert len(list(out.parent.glob("table3.*"))) == written and not out.exists()
        assert main([*command, str(out)]) == 0
        for ending in ("md", "csv", "svg"):
            whole = tmp_path / f"whole/table3.{ending}"
            assert out.with_suffix(f".{ending}").read_bytes() == whole.read_bytes()
    # what somebody else put there is not replaced
    out = tmp_path / "whole/table3.md"
    out.unlink()
    out.with_suffix(".csv").write_text("mine")
    capsys.readouterr()
    assert main([*command, str(out)]) == 2
    assert "table3.csv: found a file, expected none (or --overwrite)" in capsys.readouterr().err
    assert out.with_suffix(".csv").read_text() == "mine" and not out.exists()
    assert main([*command, str(out), "--overwrite"]) == 0
    assert out.with_suffix(".csv").read_text() != "mine"


def test_outputs_stay_apart(kitti: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["experiment", "table3", "--data", str(kitti), "--out"]
    assert main([*command, str(tmp_path / "table.csv")]) == 2
    assert "found the same file" in capsys.readouterr().err
    assert main([*command, str(tmp_path / STATE)]) == 2
    assert "found the same file" in capsys.readouterr().err
    assert list(tmp_path.glob("*.*")) == []


def test_a_drive_without_a_reference_is_refused(kitti: Path, capsys: pytest.CaptureFixture[str]) -> None:
    calib = kitti / "sequences/00/calib.txt"
    calib.write_text("".join(line for line in calib.open() if not line.startswith("Tr")))
    assert main(["experiment", "table2", "--data", str(kitti)]) == 2
    assert "found no reference calibration" in capsys.readouterr().err


def test_a_drive_without_labels_is_no_failure_of_the_methods(
    kitti: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Only the frames that are used count; a method that needs no labels is run."""
    for k in (1, 2):
        (kitti / f"sequences/00/semantic_2/{k:06d}.png").unlink()
    command = ["experiment", "table1", "--data", str(kitti), "--set", "kitti_frames=[1,3]"]
    out = tmp_path / "out"
    assert main([*command, "--methods", "motion,static", "--out", str(out / "table1.md")]) == 2
    told = "kitti/00: found no semantic masks of images, expected both for method static, beside the drive"
    assert told in capsys.readouterr().err and not list(out.glob("table1*"))
    assert main([*command, "--methods", "motion"]) == 0


def wait_for(condition: Callable[[], object]) -> None:
    deadline = time.monotonic() + 60.0
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def workers(pid: int) -> list[int]:
    """Processes that another one started, but for that which tracks the resources of them all."""
    found = []
    for task in Path(f"/proc/{pid}/task").glob("*/children"):
        found += [int(one) for one in task.read_text().split()]
    return [one for one in found if b"spawn_main" in Path(f"/proc/{one}/cmdline").read_bytes()]


def lines(path: Path) -> int:
    return path.read_bytes().count(b"\n") if path.exists() else 0


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="finds processes by /proc")
def test_a_kill_costs_the_runs_under_way(kitti: Path, tmp_path: Path) -> None:
    other = shutil.copytree(kitti, tmp_path / "other")
    options = ["table3", "--data", str(kitti), str(other), "--set", "starts=100", "--set", "plot=false"]
    command = [*PROGRAM, *options, "--jobs", "2", "--out"]
    state = tmp_path / "a" / STATE
    # 1. the command is killed: its processes end with it
    program = subprocess.Popen([*command, str(tmp_path / "a/table3.md")], stderr=subprocess.PIPE)
    wait_for(lambda: lines(state) > 5 and len(workers(program.pid)) == 2)
    left = workers(program.pid)
    program.kill()
    program.communicate()
    wait_for(lambda: not any(Path(f"/proc/{one}").exists() for one in left))
    done = state.read_bytes()
    assert 6 <= done.count(b"\n") < 601 and not (tmp_path / "a/table3.md").exists()
    # 2. a process is killed: the other drive is done, and a line says what is missing
    program = subprocess.Popen([*command, str(tmp_path / "a/table3.md")], stderr=subprocess.PIPE, text=True)
    before = lines(state)
    wait_for(lambda: lines(state) > before and workers(program.pid))
    os.kill(workers(program.pid)[0], signal.SIGKILL)
    said = program.communicate()[1].splitlines()[-1]
    assert program.returncode == 2 and "its process ended (signal 9)" in said
    assert before < lines(state) < 601 and state.read_bytes().startswith(done[: done.rfind(b"\n") + 1])
    # 3. the same command does the rest, and its files are those of one that was never killed
    assert subprocess.run([*command, str(tmp_path / "a/table3.md")], check=False).returncode == 0
    assert main(["experiment", *options, "--out", str(tmp_path / "b/table3.md")]) == 0
    for name in ("table3.md", "table3.csv"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    assert lines(state) == 601


@pytest.mark.slow
def test_bad_frames_in_a_process_are_one_line(
    kitti: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (kitti / "sequences/00/velodyne/000002.bin").write_bytes(b"123")
    command = ["experiment", "table3", "--data", str(kitti), "--jobs", "2", "--out", str(tmp_path / "t.md")]
    assert main(command) == 2
    said = capfd.readouterr().err.splitlines()
    assert len(said) == 1 and "000002.bin" in said[0]


@pytest.mark.slow
def test_the_static_stage_on_a_tiny_street(tmp_path: Path) -> None:
    out = tmp_path / "table1.md"
    options = ["--streets", "1", "--seed", "5", "--set", "frames=2", "--set", "start_deg=2"]
    assert main(["experiment", "table1", *options, "--jobs", "2", "--out", str(out)]) == 0
    assert "seeds 5 to 5" in out.read_text()
    rows = {row["method"]: row for row in rows_of(out.with_suffix(".csv"))}
    assert list(rows) == ["start", "static", "static-single", "joint"]
    errors = {name: float(row["qad_deg"]) for name, row in rows.items()}
    assert errors["joint"] < 1.0 and len(set(errors.values())) == 4
    assert rows["static"]["time_offset_s"] == "" and rows["joint"]["estimated"] == "True"


@pytest.mark.drives
@pytest.mark.slow
def test_the_joint_stage_on_a_real_drive(tmp_path: Path) -> None:
    name = "kitti_2011_09_26_stop"
    if not (DRIVES / name).is_dir():
        pytest.skip(f"no drive {name} beside the checkout")
    out = tmp_path / "table3.md"
    command = ["experiment", "table3", "--data", str(DRIVES / name), "--methods", "joint", "--out", str(out)]
    assert main(command) == 0
    row = rows_of(out.with_suffix(".csv"))[-1]
    assert float(row["qad_deg"]) < 0.5 and float(row["atd_m"]) < 0.05
    assert float(row["true_offset_s"]) == pytest.approx(0.1036, abs=1e-6)
    assert abs(float(row["true_error_ms"])) < 10.0

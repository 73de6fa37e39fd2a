"""``sst-graph simulate`` as a user calls it."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from sst_graph.cli import main
from sst_graph.data import open_source

SMALL = ["--frames", "2", "--set", "width=160", "--set", "height=64", "--set", "azimuth_step_deg=2"]


def test_writes_a_drive_that_can_be_opened(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "drive"
    options = ["--seed", "5", "--time-offset", "-0.12", "--motion", "constant", *SMALL]
    assert main(["simulate", str(out), *options]) == 0
    assert "2 frames, true time offset -120.0 ms" in capsys.readouterr().out
    source = open_source(out)
    assert len(source) == 2 and (source.camera.width, source.camera.height) == (160, 64)
    assert source.truth is not None and source.truth.time_offset_s == -0.12
    made_with = json.loads((out / "sequences/00/groundtruth.json").read_text())["config"]
    assert made_with["seed"] == 5 and made_with["motion"] == "constant"


def test_settings_come_from_a_file_then_flags_then_set(tmp_path: Path) -> None:
    config = tmp_path / "street.toml"
    config.write_text("seed = 1\nframes = 9\nlabel_noise = 0\n")
    out = tmp_path / "drive"
    command = [
        "simulate",
        str(out),
        "--config",
        str(config),
        *SMALL,
        "--seed",
        "2",
        "--set",
        "seed=3",
        "--rolling",
    ]
    assert main(command) == 0
    made_with = json.loads((out / "sequences/00/groundtruth.json").read_text())["config"]
    assert (made_with["seed"], made_with["frames"], made_with["label_noise"]) == (3, 2, 0.0)
    assert made_with["rolling"] is True


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--frames", "0"], "frames: found 0, expected at least 1 and at most 100000"),
        (["--time-offset", "2"], "time_offset_s: found 2.0, expected at least -0.5 and at most 0.5 s"),
        (["--time-offset", "nan"], "time_offset_s"),
        (["--motion", "flying"], "motion: found 'flying', expected one of mixed, standing"),
        (["--label-noise", "3"], "label_noise: found 3.0, expected at least 0 and at most 2"),
        (["--set", "speed=3"], "unknown setting 'speed'; did you mean 'speed_mps'?"),
        (["--set", "speed_mps"], "expected name=value"),
        (["--config", "none.toml"], "none.toml: found no such file"),
    ],
)
def test_bad_settings(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], message: str
) -> None:
    assert main(["simulate", str(tmp_path / "drive"), *SMALL, *options]) == 2
    captured = capsys.readouterr()
    assert message in captured.err and captured.err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_nothing_is_replaced_without_overwrite(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "drive"
    assert main(["simulate", str(out), "--seed", "1", *SMALL]) == 0
    before = (
        (out / "sequences/00/times.txt").read_bytes(),
        (out / "sequences/00/calib.txt").stat().st_mtime_ns,
    )
    assert main(["simulate", str(out), "--seed", "2", *SMALL]) == 2
    assert "--overwrite" in capsys.readouterr().err
    after = (out / "sequences/00/times.txt").read_bytes(), (out / "sequences/00/calib.txt").stat().st_mtime_ns
    assert before == after
    assert main(["simulate", str(out), "--seed", "2", "--overwrite", *SMALL]) == 0
    assert json.loads((out / "sequences/00/groundtruth.json").read_text())["config"]["seed"] == 2


def test_overwrite_spares_folders_of_others(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "precious").write_text("mine")
    assert main(["simulate", str(tmp_path), "--overwrite", *SMALL]) == 2
    assert "expected one to overwrite" in capsys.readouterr().err
    assert (tmp_path / "precious").read_text() == "mine"


@pytest.mark.slow
def test_a_killed_run_leaves_nothing_under_the_name(tmp_path: Path) -> None:
    out = tmp_path / "drive"
    arguments = ["simulate", str(out), *SMALL, "--set", "frames=150"]
    process = subprocess.Popen([sys.executable, "-m", "sst_graph", *arguments], stderr=subprocess.DEVNULL)
    try:
        deadline = time.monotonic() + 60
        while not list(tmp_path.glob(".drive.sst-graph-partial/new/sequences/00/velodyne/000001.bin")):
            assert process.poll() is None and time.monotonic() < deadline
            time.sleep(0.02)
    finally:
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
    assert not out.exists()


@pytest.mark.slow
def test_an_interrupted_run_leaves_nothing_at_all(tmp_path: Path) -> None:
    arguments = ["simulate", str(tmp_path / "drive"), *SMALL, "--set", "frames=150"]
    process = subprocess.Popen(
        [sys.executable, "-m", "sst_graph", *arguments],
        stderr=subprocess.PIPE,
        text=True,
        # Shells start jobs in the background with this signal ignored.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    deadline = time.monotonic() + 60
    while not list(tmp_path.glob(".drive.sst-graph-partial/new/sequences/00/velodyne/000001.bin")):
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    # A slow machine is told how far it is.
    said = [line for line in err.splitlines() if "progress" not in line]
    assert (process.returncode, said) == (130, ["sst-graph: error: interrupted"])
    assert list(tmp_path.iterdir()) == []

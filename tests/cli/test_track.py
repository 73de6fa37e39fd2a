"""``sst-graph track`` as a user calls it: lines of JSON, exit codes, kill and resume."""

from __future__ import annotations

import fcntl
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import streets
from stored import written

from sst_graph.cli import main
from sst_graph.result import read_result

AT_ONCE = ["--set", "calibration.decide_sweep=false"]
"""Where the sweep does not matter: deciding it takes longer than what is tested."""
SOON = [word for setting in streets.SOON for word in ("--set", setting)]


@pytest.fixture(scope="module")
def street() -> Path:
    """A short drive on disk."""
    return written(streets.SHORT_STREET)


def _lines(text: str) -> list[dict[str, Any]]:
    refuse = lambda name: pytest.fail(f"{name} in the output")  # noqa: E731
    return [json.loads(line, parse_constant=refuse) for line in text.splitlines()]


@pytest.mark.slow
def test_one_line_a_frame(street: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "calibration.json"
    code = main(["track", str(street), *SOON, "--out", str(out)])
    captured = capsys.readouterr()
    lines = _lines(captured.out)
    assert [line["frame"] for line in lines] == list(range(20))
    assert lines[0]["status"] == "starting" and not lines[0]["accepted"]
    assert lines[-1]["accepted"] and lines[-1]["matches"] > 100
    assert lines[-1]["sigma_time_offset_s"] < lines[0]["sigma_time_offset_s"]
    result = read_result(out)
    assert result.method == "track" and result.frames_used
    # The file says what the last line says.
    last = lines[-1]
    assert last["converged"] is not None and all(line["converged"] is None for line in lines[:-1])
    np.testing.assert_array_equal(last["T_camera_lidar"], result.T_camera_lidar.matrix())
    assert last["time_offset_s"] == result.time_offset_s
    np.testing.assert_array_equal(last["covariance"], result.covariance)
    assert {"unconfirmed": "not_converged"}.get(last["status"], last["status"]) == result.status
    np.testing.assert_allclose(np.sqrt(np.diag(last["covariance"]))[6], last["sigma_time_offset_s"])
    assert lines[0]["covariance"] is None and "no estimate yet" in lines[0]["covariance_reason"]
    assert code == {"ok": 0}.get(result.status, 3)
    assert (captured.err == "") == (code == 0)
    assert main(["track", str(street), "--out", str(out)]) == 2
    assert "--overwrite" in capsys.readouterr().err


@pytest.mark.slow
def test_a_parameter_is_estimated(street: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "calibration.json"
    main(["track", str(street), *SOON, *AT_ONCE, "--estimate", "focal=0.01", "--out", str(out)])
    lines, result = _lines(capsys.readouterr().out), read_result(out)
    assert lines[0]["estimated"] == {} and lines[-1]["estimated"] == result.diagnostics["estimated"]
    focal = lines[-1]["estimated"]["focal"]
    assert 0.0 < focal["sigma"] < 0.01 and abs(focal["value"]) < 4.0 * focal["sigma"]
    assert "focal" not in result.diagnostics["assumptions"] and "k1" in result.diagnostics["assumptions"]
    assert main(["track", str(street), "--estimate", "k3"]) == 2
    assert "'k3'" in capsys.readouterr().err


@pytest.mark.slow
def test_killed_and_resumed(street: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """SIGKILL at some frame after a checkpoint; what is resumed does what an unbroken run does."""
    whole, rest, checkpoint = tmp_path / "whole.json", tmp_path / "rest.json", tmp_path / "tracker.npz"
    other = ["--checkpoint", str(tmp_path / "other.npz"), "--checkpoint-every", "3"]
    main(["track", str(street), *SOON, *other, "--out", str(whole)])
    unbroken = _lines(capsys.readouterr().out)
    command = [sys.executable, "-m", "sst_graph", "track", str(street), *SOON]
    command += ["--checkpoint", str(checkpoint), "--checkpoint-every", "3"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, bufsize=0, env={**os.environ})
    assert process.stdout is not None
    if hasattr(fcntl, "F_SETPIPE_SZ"):  # a full pipe keeps it from running far ahead of what is read here
        fcntl.fcntl(process.stdout.fileno(), fcntl.F_SETPIPE_SZ, 4096)
    for line in process.stdout:
        if json.loads(line)["frame"] >= 7:
            break
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert checkpoint.exists()
    time.sleep(0.01)
    command = ["track", str(street), *SOON, "--checkpoint", str(checkpoint), "--checkpoint-every", "3"]
    main([*command, "--resume", "--out", str(rest)])
    resumed = _lines(capsys.readouterr().out)
    assert resumed[0]["frame"] in (6, 9, 12, 15, 18) and resumed[-1]["frame"] == 19
    for line, own in zip(unbroken[-len(resumed) :], resumed, strict=True):
        assert own.keys() == line.keys()
        for name, value in line.items():
            if isinstance(value, float | list) and name not in ("weak", "refused", "contradictions"):
                np.testing.assert_allclose(own[name], value, rtol=1e-4, atol=1e-7)
            elif name != "weak":
                assert own[name] == value
    a, b = read_result(whole), read_result(rest)
    step = a.calibration.local_coordinates(b.calibration)
    assert np.abs(step / np.sqrt(np.diag(a.covariance))).max() < 1e-4


@pytest.fixture(scope="module")
def saved(street: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkpoint after eight frames of the street."""
    path = tmp_path_factory.mktemp("saved") / "tracker.npz"
    main(["track", str(street), "--frames", "0:8", *SOON, *AT_ONCE, "--checkpoint", str(path)])
    return path


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--set", "bogus=1"], "unknown setting 'bogus'"),
        (
            ["--set", "window=40"],
            "found a tracker with setting window = 60, not 40, expected what it was made with",
        ),
        (
            ["--classes", "vehicle,pole"],
            "setting calibration.classes = ['vehicle'], not ['vehicle', 'pole']",
        ),
        (["--init", "none"], "a start from T_camera_lidar"),
        (["--init", "none"], ", not from --init none"),
        (["--frames", "1:20"], "another drive (no image of 0 ns in"),
        (["--image-shift", "1"], "a tracker with --image-shift 0, not 1, expected what it was made with"),
        (["--image-shift", "-1"], "a tracker with --image-shift 0, not -1"),
    ],
)
def test_resumed_on_other_frames_or_settings(
    street: Path, saved: Path, capsys: pytest.CaptureFixture[str], options: list[str], message: str
) -> None:
    """Refused in one line before a frame is taken; the checkpoint stays as it is."""
    before = saved.read_bytes()
    command = ["track", str(street), *AT_ONCE, "--checkpoint", str(saved), "--resume"]
    assert main([*command, *options]) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1 and message in captured.err
    assert saved.read_bytes() == before


def _other_scan(drive: Path, number: int) -> None:
    path = sorted(drive.rglob("velodyne/*.bin"))[number]
    points = np.fromfile(path, "<f4")
    points[0] += 0.01
    points.tofile(path)


def _other_picture(drive: Path, number: int) -> None:
    path = sorted(drive.rglob("image_2/*.png"))[number]
    pixels = cv2.imread(str(path))
    pixels[5, 5] ^= 1
    cv2.imwrite(str(path), pixels)


def _other_mask(drive: Path, number: int) -> None:
    path = sorted(drive.rglob("semantic_2/*.png"))[number]
    mask = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    cv2.imwrite(str(path), mask[:, ::-1])


@pytest.mark.parametrize("frame", [0, 4, 7], ids=["first", "middle", "newest"])
@pytest.mark.parametrize("change", [_other_scan, _other_picture, _other_mask])
def test_resumed_on_another_drive(
    street: Path,
    saved: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    change: Callable[[Path, int], None],
    frame: int,
) -> None:
    """The same sensors and stamps; one point, pixel or mask of one frame that was used is another."""
    other = tmp_path / "other"
    shutil.copytree(street, other)
    change(other, frame)
    assert main(["track", str(other), *AT_ONCE, "--checkpoint", str(saved), "--resume"]) == 2
    captured = capsys.readouterr()
    sensor = "scan" if change is _other_scan else "image"
    stamp_ns = round(1e9 * np.loadtxt(next(street.rglob("times.txt")))[frame])
    assert captured.out == "" and f"another drive (another {sensor} of {stamp_ns} ns" in captured.err


@pytest.mark.slow
def test_resumed_without_options_or_with_the_same(
    street: Path, saved: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Settings that are not named are the checkpoint's; those that are, are its own."""
    for options in ([], [*SOON, *AT_ONCE, "--init", "dataset"]):
        copy = tmp_path / "tracker.npz"
        shutil.copy(saved, copy)
        command = ["track", str(street), "--frames", "0:9", "--checkpoint", str(copy), "--resume"]
        assert main([*command, *options]) == 3
        assert [line["frame"] for line in _lines(capsys.readouterr().out)] == [8]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--resume"], "--resume needs --checkpoint"),
        (["--checkpoint-every", "3"], "--checkpoint-every needs --checkpoint"),
        (["--method", "edges", "--classes", "vehicle"], "--classes vehicle: means nothing for method edges"),
        (["--checkpoint", "x.npz", "--checkpoint-every", "0"], "expected 1 or more"),
        (["--set", "windw=3"], "unknown setting 'windw'; did you mean 'window'?"),
        (["--set", "drift.rotation_deg=-1"], "rotation_deg"),
        (["--init", "none.json"], "none.json: found no such file"),
    ],
)
def test_bad_options(
    street: Path, capsys: pytest.CaptureFixture[str], options: list[str], message: str
) -> None:
    assert main(["track", str(street), *options]) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1 and message in captured.err


@pytest.fixture(scope="module")
def unlabelled(street: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same drive without its labels."""
    bare = tmp_path_factory.mktemp("bare") / "sequences" / "00"
    bare.mkdir(parents=True)
    stored = street / "sequences" / "00"
    for part in stored.iterdir():
        if not any(word in part.name for word in ("label", "semantic", "instance")):
            (bare / part.name).symlink_to(part)
    return bare.parents[1]


@pytest.mark.parametrize(
    "options",
    [
        [],
        ["--method", "auto", *AT_ONCE],
        ["--method", "edges", *AT_ONCE],
    ],
)
@pytest.mark.slow
def test_a_drive_without_labels_is_tracked_by_edges(
    unlabelled: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str]
) -> None:
    """Four frames make no start: the last line and the file say so alike."""
    out, checkpoint = tmp_path / "calibration.json", tmp_path / "tracker.npz"
    command = ["track", str(unlabelled), *options, "--checkpoint", str(checkpoint)]
    assert main([*command, "--frames", "0:4", "--out", str(out)]) == 3
    lines = _lines(capsys.readouterr().out)
    assert [line["status"] for line in lines] == ["starting"] * 4
    result = read_result(out)
    assert result.config["calibration"]["method"] == "edges" and result.status == "not_converged"
    np.testing.assert_array_equal(lines[-1]["T_camera_lidar"], result.T_camera_lidar.matrix())
    # Resumed without the option, the method is the checkpoint's.
    assert main([*command, "--frames", "0:5", "--resume"]) == 3
    assert [line["frame"] for line in _lines(capsys.readouterr().out)] == [4]
    assert main(["track", str(unlabelled), "--method", "joint", *command[-2:], "--resume"]) == 2
    assert "method" in capsys.readouterr().err


def test_where_there_are_labels_auto_stays_as_it_is(
    street: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "calibration.json"
    main(["track", str(street), *AT_ONCE, "--frames", "0:2", "--out", str(out)])
    assert read_result(out).config["calibration"]["method"] == "auto"
    assert main(["track", str(street), "--method", "paper"]) == 2
    assert "invalid choice" in capsys.readouterr().err

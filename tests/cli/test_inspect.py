"""``sst-graph inspect`` as a user calls it, and its plots."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import gtsam
import numpy as np
import pytest

from sst_graph.cli import main
from sst_graph.data import open_source
from sst_graph.factors.camera import PinholeCamera
from sst_graph.inspect.frame_information import KEY, FrameInformation, to_document
from sst_graph.result import CalibrationResult, DriveOffset, FrameId

OF_COVARIANCE = {"ellipses.png", "correlation.png", "graph.png"}
OF_FRAMES = {"sigma_over_frames.png", "gain_by_frame.png", "record_next.png"}


def frames_of_two_drives(count: int = 9) -> list[FrameInformation]:
    rng = np.random.default_rng(0)
    found = []
    for k in range(count):
        root = rng.normal(size=(9, 6)) / np.array([0.01] * 3 + [0.1] * 3)
        twist = np.array([0.0, 0.0, 0.2 * (k % 2), 4.0 * (k % 3), 0.0, 0.0])
        drive = "a/00" if k < 6 else "b/00"
        found.append(
            FrameInformation(
                FrameId(drive, k),
                rng.uniform(),
                rng.uniform(0.99, 1.1, 7),
                np.full(7, 1.0 + count - k),
                root.T @ root,
                twist,
                50,
                3,
                8.0,
                0.5,
            )
        )
    return found


@pytest.fixture
def result() -> CalibrationResult:
    frames = frames_of_two_drives()
    rng = np.random.default_rng(1)
    root = 0.3 * rng.normal(size=(7, 7)) * np.array([*np.radians([0.1] * 3), 0.02, 0.02, 0.3, 0.04])[:, None]
    return CalibrationResult(
        gtsam.Pose3(),
        0.01,
        root @ root.T,
        "unobservable",
        PinholeCamera(700.0, 700.0, 600.0, 180.0, 1200, 360),
        reasons=("forward against delay",),
        frames_used=tuple(frame.frame for frame in frames),
        drive_offsets=(DriveOffset("a/00", 0.01, 0.04), DriveOffset("b/00", 0.02, 0.03)),
        diagnostics={KEY: to_document(frames), "mask_bias_px": {"a/00:vehicle": 0.4, "b/00:vehicle": -0.2}},
    )


def written(folder: Path, result: CalibrationResult) -> str:
    (folder / "calibration.json").write_text(result.to_json())
    return str(folder / "calibration.json")


def test_a_result_that_is_not_ok_is_inspected_all_the_same(
    tmp_path: Path, result: CalibrationResult, capsys: pytest.CaptureFixture[str]
) -> None:
    written(tmp_path, result)
    assert main(["inspect", str(tmp_path)]) == 0
    captured = capsys.readouterr()
    assert captured.err == ""
    for words in ("unobservable", "forward against delay", "correlation", "what each frame brings", "b/00:7"):
        assert words in captured.out
    assert "standing" in captured.out and "the offset here is that of a/00" in captured.out


def test_json_is_one_strict_object(
    tmp_path: Path, result: CalibrationResult, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["inspect", written(tmp_path, result), "--json", "--next", "3"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["status"] == "unobservable" and document["plan"]["count"] == 3
    assert len(document["frames"]) == 9


def test_how_the_drives_were_read_is_checked_before_it_is_said(
    tmp_path: Path, result: CalibrationResult, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["inspect", written(tmp_path, replace(result, read_as={"cloud": "a b"}))]) == 0
    assert "The drives were read with --cloud 'a b'." in capsys.readouterr().out
    assert main(["inspect", written(tmp_path, replace(result, read_as={"image_shift": "../x"}))]) == 2
    assert "read_as.image_shift: found '../x', expected a number" in capsys.readouterr().err


@pytest.fixture
def true_result(street: Path) -> CalibrationResult:
    """Of the street."""
    source = open_source(street)
    assert source.truth is not None and source.truth.time_offset_s is not None
    truth = source.truth
    return CalibrationResult(truth.cTl, truth.time_offset_s, 1e-6 * np.eye(7), "ok", source.camera)


def shown_in(folder: Path) -> set[str]:
    """Names in a folder that are not hidden."""
    return {path.name for path in folder.iterdir() if not path.name.startswith(".")}


@pytest.mark.slow
def test_plots(tmp_path: Path, result: CalibrationResult, capsys: pytest.CaptureFixture[str]) -> None:
    plots = tmp_path / "plots"
    assert main(["inspect", written(tmp_path, result), "--plots", str(plots)]) == 0
    assert shown_in(plots) == OF_COVARIANCE | OF_FRAMES
    assert f"wrote {plots}: ellipses.png, " in capsys.readouterr().out
    for path in plots.glob("[!.]*"):
        picture = cv2.imread(str(path))
        assert min(picture.shape[:2]) > 400 and len(np.unique(picture[::4, ::4].reshape(-1, 3), axis=0)) > 20
    (plots / "mine.txt").write_text("mine")
    assert main(["inspect", str(tmp_path), "--plots", str(plots)]) == 2
    assert (plots / "mine.txt").exists()
    assert main(["inspect", str(tmp_path), "--plots", str(plots), "--overwrite"]) == 0
    assert (plots / "mine.txt").read_text() == "mine"


def test_another_folder_is_not_replaced(
    tmp_path: Path, result: CalibrationResult, capsys: pytest.CaptureFixture[str]
) -> None:
    written(tmp_path, result)
    assert main(["inspect", str(tmp_path), "--plots", str(tmp_path), "--overwrite"]) == 2
    assert "is read as RESULT and would be replaced" in capsys.readouterr().err
    other = tmp_path.with_name("other")
    other.mkdir()
    (other / "thesis.tex").write_text("dear")
    assert main(["inspect", str(tmp_path), "--plots", str(other), "--overwrite"]) == 2
    assert "not from sst-graph" in capsys.readouterr().err and (tmp_path / "calibration.json").exists()


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.slow
def test_plots_of_few_frames(tmp_path: Path, result: CalibrationResult, count: int) -> None:
    frames = frames_of_two_drives(count)
    few = replace(
        result,
        frames_used=tuple(frame.frame for frame in frames),
        drive_offsets=(),
        diagnostics={KEY: to_document(frames)},
    )
    assert main(["inspect", written(tmp_path, few), "--plots", str(tmp_path / "plots")]) == 0
    expected = OF_FRAMES if count > 1 else {"record_next.png"}
    assert shown_in(tmp_path / "plots") == OF_COVARIANCE | expected


@pytest.mark.slow
def test_a_result_of_another_method(
    tmp_path: Path, result: CalibrationResult, capsys: pytest.CaptureFixture[str]
) -> None:
    foreign = replace(result, method="paper", diagnostics={}, drive_offsets=(), frames_used=())
    assert main(["inspect", written(tmp_path, foreign), "--plots", str(tmp_path / "plots")]) == 0
    out = capsys.readouterr().out
    assert "what each frame brought is not known" in out and "what to record next:" not in out
    assert shown_in(tmp_path / "plots") == OF_COVARIANCE


def test_without_matplotlib(
    tmp_path: Path,
    result: CalibrationResult,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    path = written(tmp_path, result)
    assert main(["inspect", path]) == 0
    capsys.readouterr()
    assert main(["inspect", path, "--plots", str(tmp_path / "plots")]) == 2
    captured = capsys.readouterr()
    assert "pip install matplotlib" in captured.err and captured.err.count("\n") == 1
    assert captured.out == "" and not (tmp_path / "plots").exists()


@pytest.mark.slow
def test_where_matplotlib_does_not_start(tmp_path: Path, result: CalibrationResult) -> None:
    """matplotlib refuses an MPLBACKEND that it does not know when it is imported."""
    program = "import sys; from sst_graph.cli import main; sys.exit(main())"
    command = [sys.executable, "-c", program, "inspect", written(tmp_path, result)]
    environment = {**os.environ, "MPLBACKEND": "nonsense"}
    done = subprocess.run(
        [*command, "--plots", str(tmp_path / "plots")], capture_output=True, text=True, env=environment
    )
    assert done.returncode == 2 and "matplotlib does not start" in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("change", "options", "message"),
    [
        (None, [], "no such file"),
        ({}, ["--next", "0"], "--next 0: expected 1 or more"),
        ({KEY: 3}, [], "calibration.json: diagnostics.frame_information: found int"),
        ({KEY: {"drive": ["a"], "frame": [1]}}, [], "frame_information.bits"),
    ],
)
def test_bad_input(
    tmp_path: Path,
    result: CalibrationResult,
    capsys: pytest.CaptureFixture[str],
    change: dict[str, Any] | None,
    options: list[str],
    message: str,
) -> None:
    if change is not None:
        written(tmp_path, replace(result, diagnostics=change))
    assert main(["inspect", str(tmp_path), *options]) == 2
    captured = capsys.readouterr()
    assert message in captured.err and captured.err.count("\n") == 1 and captured.out == ""


@pytest.mark.slow
def test_a_calibration_is_measured_on_its_drive(
    tmp_path: Path, street: Path, true_result: CalibrationResult, capsys: pytest.CaptureFixture[str]
) -> None:
    """A turn by 0.3 degrees, which the stored figures do not show, does."""
    turn = gtsam.Pose3.Expmap(np.radians([0.0, 0.3, 0.0, 0.0, 0.0, 0.0]))
    turned = replace(true_result, T_camera_lidar=true_result.T_camera_lidar.compose(turn))
    options = [str(street), "--frames", "0:12"]
    shares = []
    for one in (true_result, turned):
        assert main(["inspect", written(tmp_path, one), *options, "--json"]) == 0
        now = json.loads(capsys.readouterr().out)["fit_now"]
        assert now["drive"] == open_source(street).name
        assert now["edges"]["by_chance"] < now["edges"]["share"]
        shares.append(now["labels"]["attainable"] - now["labels"]["share"])
    assert shares[0] < 0.04 < 0.08 < shares[1]
    assert main(["inspect", written(tmp_path, turned), *options]) == 0
    assert "fit now      measured with this calibration on " in capsys.readouterr().out


def test_without_a_drive_nothing_says_how_to_read_one(
    tmp_path: Path, result: CalibrationResult, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["inspect", written(tmp_path, result), "--image-shift", "1"]) == 2
    assert "--image-shift: says how DATA is read, expected RESULT DATA" in capsys.readouterr().err
    assert main(["inspect", written(tmp_path, result), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["fit_now"] is None

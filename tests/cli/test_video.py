"""Videos of a drive, as a user asks for them."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from videos import read_video

from sst_graph.cli import main

FRAMES = 6


@pytest.mark.slow
def test_the_video_has_the_picture_of_each_frame(
    street: Path, result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["overlay", str(result), str(street), "--frames", f"0:{FRAMES}"]
    video, picture = tmp_path / "drive.mp4", tmp_path / "3.png"
    assert main([*command, "--video", str(video)]) == 0
    said = capsys.readouterr().out
    assert f"{FRAMES} frames" in said and "within 1.5 px of the contour (before: " in said
    assert main([*command, "--frame", "3", "--out", str(picture)]) == 0
    pictures, rate_hz = read_video(video)
    expected = cv2.imread(str(picture))
    assert len(pictures) == FRAMES and rate_hz == pytest.approx(10.0, rel=0.05)
    # The same picture, to what is lost by compression; another frame's is another.
    shown = pictures[3][: expected.shape[0], : expected.shape[1]].astype(int)
    other = pictures[0][: expected.shape[0], : expected.shape[1]].astype(int)
    assert np.abs(shown - expected).mean() < 6.0 < np.abs(other - expected).mean()


def test_it_is_whole_or_not_there(
    street: Path, result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    drive = tmp_path / "drive"
    shutil.copytree(street, drive)
    scan = sorted(drive.rglob("velodyne/*.bin"))[4]
    scan.write_bytes(scan.read_bytes()[:7])
    video = tmp_path / "videos" / "a.gif"
    command = ["overlay", str(result), str(drive), "--video", str(video), "--frames"]
    assert main([*command, f"0:{FRAMES}"]) == 2
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1 and scan.name in captured.err
    assert not video.parent.exists()
    assert main([*command, "0:2"]) == 0 and len(read_video(video)[0]) == 2
    assert main([*command, "0:2"]) == 2 and "--overwrite" in capsys.readouterr().err
    assert main([*command, "0:3", "--overwrite"]) == 0 and len(read_video(video)[0]) == 3


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--video", "a.avi"], "expected a name that ends in .mp4 or .gif"),
        (["--video", "a.mp4", "--out", "b.png"], "not allowed with"),
        (["--video", "a.mp4", "--frame", "1"], "--frame: expected with --out"),
        (["--video", "/proc/a.mp4"], "nothing can be made in /proc"),
        (["--video", "note.mp4", "--overwrite"], "another kind of file, expected a video"),
    ],
)
def test_bad_names(
    street: Path,
    result: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    options: list[str],
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("note.mp4").write_text("mine")
    assert main(["overlay", str(result), str(street), *options]) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1 and message in captured.err
    assert Path("note.mp4").read_text() == "mine" and len(list(tmp_path.iterdir())) == 1


@pytest.mark.slow
def test_calibrate_writes_one_into_its_folder_or_beside_it(street: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    command = [
        "calibrate",
        str(street),
        "--frames",
        "0:3",
        "--set",
        "search.enabled=false",
        "--no-report",
    ]
    assert main([*command, "--out", str(out), "--video", str(out / "drive.mp4")]) == 3
    names = json.loads((out / ".sst-graph-manifest.json").read_text())
    assert len(read_video(out / "drive.mp4")[0]) == 3 and "drive.mp4" in json.dumps(names)
    beside = tmp_path / "drive.gif"
    # What was written inside is replaced with the folder; the video beside it is a file of its own.
    assert main([*command, "--out", str(out), "--overwrite", "--video", str(beside)]) == 3
    assert len(read_video(beside)[0]) == 3 and not (out / "drive.mp4").exists()


def test_calibrate_refuses_before_it_works(
    street: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    for video, message in (
        (out / "videos" / "a.mp4", f"expected a name in {out} itself, or elsewhere"),
        (tmp_path / "a.webm", "ends in .mp4 or .gif"),
        (out, "found the same file"),
    ):
        assert main(["calibrate", str(street), "--out", str(out), "--video", str(video)]) == 2
        captured = capsys.readouterr()
        assert captured.err.count("\n") == 1 and message in captured.err
    assert list(tmp_path.iterdir()) == []


def test_without_the_extra_the_message_names_it(street: Path, result: Path, tmp_path: Path) -> None:
    (tmp_path / "imageio_ffmpeg.py").write_text("raise ImportError('not here')")
    path = os.pathsep.join([str(tmp_path), *sys.path])
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "sst_graph",
            "overlay",
            result,
            street,
            "--video",
            tmp_path / "a.mp4",
        ],
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1 and "pip install 'sst-graph[video]'" in done.stderr

"""``sst-graph calibrate`` and ``demo`` as a user calls them."""

from __future__ import annotations

import html
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from stored import written

from sst_graph.cli import main
from sst_graph.cli.commands.demo import MAX_ROTATION_DEG, over_bounds
from sst_graph.cli.inputs import starting_point
from sst_graph.data import open_source
from sst_graph.data.kept_drive import KeptDrive
from sst_graph.errors import ConfigError
from sst_graph.inspect.reasons import MOST_REASONS, short_reasons
from sst_graph.metrics import CalibrationErrors
from sst_graph.result import read_result
from sst_graph.simulator import SimulationConfig

ONE_FRAME = ["--frames", "0:1"]
"""Enough for a pose, and not for a time offset."""


@pytest.fixture(scope="module")
def stop_and_turn() -> Path:
    """A street on disk, seen in small pictures: a stop, an acceleration and a turn."""
    config = SimulationConfig(
        seed=2,
        frames=24,
        width=621,
        height=188,
        azimuth_limit_deg=50.0,
        time_offset_s=0.05,
        vehicle_density=0.3,
    )
    return written(config)


def _calibrate(data: Path, out: Path, *options: str) -> int:
    return main(["calibrate", str(data), "--out", str(out), *options])


def _strict_json(path: Path) -> Any:
    return json.loads(path.read_text(), parse_constant=lambda name: pytest.fail(f"{name} in {path.name}"))


@pytest.mark.slow
def test_from_disk_to_a_calibration(
    stop_and_turn: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    street, out = stop_and_turn, tmp_path / "result"
    code = _calibrate(street, out, "--set", "observability.time_offset_s=0.05")
    captured = capsys.readouterr()
    assert (code, captured.err) == (0, "")
    assert "against the truth" in captured.out and "deg (QAD: the whole angle)" in captured.out
    document = _strict_json(out / "calibration.json")
    assert document["config"]["observability"]["time_offset_s"] == 0.05
    assert document["camera"]["name"] == "image_2"
    assert {frame["drive"] for frame in document["frames_used"]} == {"street/00"}
    assert sorted(path.suffix for path in out.glob("[!.]*")) == [".html", ".json", ".md", *[".png"] * 3]

    truth = street / "sequences" / "00" / "groundtruth.json"
    assert main(["evaluate", str(out), "--truth", str(truth), "--json"]) == 0
    errors = json.loads(capsys.readouterr().out)
    assert errors["qad_deg"] < 0.1 and errors["atd_m"] < 0.006
    # Ten such streets are 2.1 ms off, root mean square; the sigma of this one is 3.0 ms.
    sigma_s = 1e-3 * read_result(out / "calibration.json").sigmas().time_offset_ms
    assert abs(errors["time_offset_s"]) < 2.0 * sigma_s < 0.0065

    assert main(["inspect", str(out), "--json"]) == 0
    inspection = json.loads(capsys.readouterr().out)
    inspected = [(frame["drive"], frame["frame"]) for frame in inspection["frames"]]
    used = [(frame["drive"], frame["frame"]) for frame in document["frames_used"]]
    assert set(inspected) <= set(used) and len(inspected) >= 0.9 * len(used)
    assert inspection["frames"][-1]["sigma_ratio_so_far"] == [1.0] * 7


def test_an_unobservable_direction_is_reported(
    street: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "result"
    assert _calibrate(street, out, *ONE_FRAME) == 3
    captured = capsys.readouterr()
    result = read_result(out / "calibration.json")
    assert result.status == "unobservable" and result.reasons
    assert captured.err.startswith("sst-graph: unobservable: ") and captured.err.count("\n") == 1
    assert short_reasons(result)[0] in captured.err
    assert any("time offset" in reason for reason in result.reasons)
    printed = " ".join(captured.out.split())
    assert all(reason in printed for reason in short_reasons(result)[:MOST_REASONS])
    page = " ".join((out / "report.html").read_text(encoding="utf-8").split())
    assert "Not finished: " in page
    assert all(html.escape(" ".join(reason.split())) in page for reason in result.reasons)
    assert result.sigmas().time_offset_ms > 100.0
    assert (out / "report.md").is_file()


def test_the_fit_is_on_the_terminal_and_in_inspect(
    street: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "result"
    assert _calibrate(street, out, *ONE_FRAME, "--no-report") == 3
    line = r"fit +\d+ % of \d+ boundary points within 1.5 px of the contour \(at the start \d+ %\); labels"
    assert re.search(line, capsys.readouterr().out)
    assert main(["inspect", str(out)]) == 0
    assert re.search(line, capsys.readouterr().out)
    assert not (out / "report.html").exists() and (out / "report.md").is_file()


def test_a_method_without_a_fit_has_a_report_too(street: Path, tmp_path: Path) -> None:
    _calibrate(street, tmp_path / "result", *ONE_FRAME, "--method", "static")
    page = (tmp_path / "result" / "report.html").read_text(encoding="utf-8")
    assert 'class="overlay"' in page and 'id="residuals"' not in page


def test_a_result_is_a_start(street: Path, tmp_path: Path) -> None:
    for name, start in (("first", "dataset"), ("second", str(tmp_path / "first" / "calibration.json"))):
        options = [*ONE_FRAME, "--set", "search.enabled=false", "--init", start, "--no-report"]
        assert _calibrate(street, tmp_path / name, *options) == 3
    first, second = (read_result(tmp_path / name / "calibration.json") for name in ("first", "second"))
    assert second.initial is not None and second.initial.equals(first.T_camera_lidar, 1e-9)
    assert second.initial_time_offset_s == first.time_offset_s


@pytest.mark.slow
def test_no_guess_at_all(street: Path, tmp_path: Path) -> None:
    assert _calibrate(street, tmp_path / "result", *ONE_FRAME, "--init", "none") == 3
    assert read_result(tmp_path / "result" / "calibration.json").initial is None
    assert list((tmp_path / "result").glob("*.png"))


def test_nothing_is_replaced_without_overwrite(
    street: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "result"
    out.mkdir()
    (out / "calibration.json").write_text("mine")
    assert _calibrate(street, out) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert (out / "calibration.json").read_text() == "mine"
    assert _calibrate(street, out, "--overwrite", *ONE_FRAME) == 2
    assert "(not from sst-graph), expected one to overwrite" in capsys.readouterr().err
    assert (out / "calibration.json").read_text() == "mine"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--init", "none.json"], "none.json: found no such file"),
        (["--init", "none.txt"], "none.txt"),
        (["--classes", "vehicle,ufo"], "--classes 'vehicle,ufo': expected all, or some of vehicle"),
        (["--classes", ""], "--classes ''"),
        (["--frames", "5"], "expected A:B"),
        (["--frames", "50:60"], "frames"),
        (["--sequence", "07"], "07"),
        (["--loader", "rosbag"], "expected one of auto, kitti"),
        (["--camera", "image_3"], "image_3"),
        (["--image-shift", "40"], "no scan is left with an image"),
        (["--set", "metod=paper"], "unknown setting 'metod'; did you mean 'method'?"),
        (["--set", "method=magic"], "found 'magic', expected one of"),
        (["--config", "none.toml"], "none.toml: found no such file"),
        (["--sweep-start-deg", "90"], "sweep start 90.0 deg: found sweep auto, expected clockwise"),
        (["--sweep", "instant", "--sweep-stamp", "end"], "whose points are all at the stamp"),
        (["--method", "edges", "--classes", "vehicle"], "--classes vehicle: means nothing for method edges"),
        (["--set", "method=motion", "--classes", "all"], "means nothing for method motion"),
        (["--method", "motion", "--estimate", "focal"], "needs method joint, edges or both, found motion"),
        (["--method", "paper", "--estimate", "k1=0.05,cy"], "assumptions.estimate=k1=0.05,cy needs"),
    ],
)
def test_bad_options(
    street: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], message: str
) -> None:
    assert _calibrate(street, tmp_path / "result", *options) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1
    assert message in captured.err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("command", ["calibrate", "track"])
def test_a_start_in_milliseconds_is_refused(
    street: Path, result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    document = json.loads(result.read_text())
    start = tmp_path / "start.json"
    start.write_text(json.dumps({"T_camera_lidar": document["T_camera_lidar"], "time_offset_s": 50.6}))
    arguments = [command, str(street), "--init", str(start), "--out", str(tmp_path / "out")]
    assert main(arguments) == 2
    assert re.search(
        r"start's time offset, 50\.6 s, is longer than the drive \(\d\.\d\d s\): is it in milliseconds\?",
        capsys.readouterr().err,
    )


def test_an_offset_of_a_single_frame_or_between_two_clocks_is_taken(
    street: Path, result: Path, tmp_path: Path
) -> None:
    document = json.loads(result.read_text())
    start = tmp_path / "start.json"
    start.write_text(json.dumps({"T_camera_lidar": document["T_camera_lidar"], "time_offset_s": 3600.0}))
    drive = KeptDrive.of(open_source(street, frames="0:3"))
    assert starting_point(str(start), drive[:1], "image_2")[1] == 3600.0
    an_hour_behind = drive.with_images(lambda one: replace(one, stamp_ns=one.stamp_ns - 3600 * 10**9))
    assert starting_point(str(start), an_hour_behind, "image_2")[1] == 3600.0
    with pytest.raises(ConfigError, match="longer than the drive"):
        starting_point(str(start), drive, "image_2")


def _without(street: Path, root: Path, *names: str) -> None:
    """The drive without some of its folders."""
    bare = root / "sequences/00"
    bare.mkdir(parents=True)
    for entry in (street / "sequences/00").iterdir():
        if entry.name not in names:
            (bare / entry.name).symlink_to(entry)


@pytest.mark.parametrize(
    ("folder", "method", "missing"),
    [("labels", "joint", "labels of points"), ("semantic_2", "paper", "semantic masks of images")],
)
def test_a_method_by_labels_is_refused_where_there_are_none(
    street: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    folder: str,
    method: str,
    missing: str,
) -> None:
    _without(street, tmp_path / "drive", folder)
    assert _calibrate(tmp_path / "drive", tmp_path / "result", "--method", method) == 2
    said = f"drive/00: found no {missing}, expected both for method {method}: say where they are"
    assert said in capsys.readouterr().err
    assert not (tmp_path / "result").exists()


def test_classes_of_a_drive_without_labels_are_reported(
    street: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _without(street, tmp_path / "drive", "labels", "semantic_2")
    options = ["--classes", "vehicle", "--init", "none", "--frames", "0:2", "--no-report"]
    assert _calibrate(tmp_path / "drive", tmp_path / "result", *options) == 3
    assert "note: --classes vehicle: without labels method edges is used" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        ("calib.txt", "calib.txt"),
        ("times.txt", "times.txt"),
        ("velodyne/000003.bin", "000003.bin"),
        ("labels/000003.label", "000003.label"),
        ("semantic_2/000003.png", "000003.png"),
        ("image_2/000003.png", "000003.png"),
    ],
)
def test_a_damaged_drive_is_named(
    street: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], damage: str, message: str
) -> None:
    shutil.copytree(street, tmp_path / "drive")
    path = tmp_path / "drive" / "sequences" / "00" / damage
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2 - 1])
    # To decide the sweep, all scans are read first, but no image.
    options = ["--set", "decide_sweep=false"] if path.suffix == ".png" else []
    assert _calibrate(tmp_path / "drive", tmp_path / "result", *options) == 2
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1 and message in captured.err
    assert [found.name for found in tmp_path.iterdir()] == ["drive"]


def test_a_drive_counts_once(street: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["calibrate", str(street), str(street / "../street"), "--out", str(tmp_path / "r")]) == 2
    assert "given twice" in capsys.readouterr().err


def test_each_drive_has_pictures_of_its_own(street: Path, tmp_path: Path) -> None:
    """Names that differ in a letter of another script, or in a sign only."""
    drives = [tmp_path / name for name in ("东", "西", "run-1", "run_1")]
    for drive in drives:
        shutil.copytree(street, drive)
    out = tmp_path / "out"
    options = [*ONE_FRAME, "--set", "search.enabled=false", "--no-report"]
    assert main(["calibrate", *map(str, drives), "--out", str(out), *options]) == 3
    listed = re.findall(r"\((overlay_.*?)\)", (out / "report.md").read_text())
    assert len(listed) == len({*listed}) == len(drives)
    assert {path.name for path in out.glob("overlay_*")} == {*listed}


@pytest.mark.parametrize("command", ["calibrate", "info"])
def test_a_result_is_no_drive(
    street: Path, result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    document = json.loads(result.read_text()) | {"frames_used": [{"drive": "street/00", "frame": 3}]}
    folder = tmp_path / "result"
    folder.mkdir()
    (folder / "calibration.json").write_text(json.dumps(document))
    options = ["--out", str(tmp_path / "out")] if command == "calibrate" else []
    for place in (folder, folder / "calibration.json"):
        assert main([command, str(place), *options]) == 2
        said = f"{place}: found a result of sst-graph (made of street/00), expected a drive"
        assert said in capsys.readouterr().err


@pytest.mark.parametrize("command", ["inspect", "evaluate", "export"])
def test_a_drive_is_no_result(street: Path, capsys: pytest.CaptureFixture[str], command: str) -> None:
    options = {
        "inspect": [],
        "evaluate": ["--truth", str(street / "sequences/00/groundtruth.json")],
        "export": ["--to", "kitti"],
    }
    assert main([command, str(street), *options[command]]) == 2
    said = f"{street}: found a drive (kitti), expected a result: calibrate it first"
    assert said in capsys.readouterr().err


def test_no_data(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert _calibrate(tmp_path / "nothing", tmp_path / "result") == 2
    assert "nothing: found no file or folder" in capsys.readouterr().err


def test_the_demo_measures_itself() -> None:
    assert over_bounds(CalibrationErrors(0.1, 0.1, 0.01, 0.001, None)) == []
    assert len(over_bounds(CalibrationErrors(MAX_ROTATION_DEG + 0.01, 0.1, 0.5, -0.2, None))) == 3

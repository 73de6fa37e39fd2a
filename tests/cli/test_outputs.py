"""What the commands may replace, refuse before the work, and keep."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from calibrations import turned

from sst_graph.cli import main
from sst_graph.cli.messages import complain, loudness
from sst_graph.cli.outputs import why_not_ok
from sst_graph.result import read_result
from sst_graph.simulator import SimulationConfig, simulate, write_drive

SMALL = ["--frames", "2", "--set", "width=160", "--set", "height=64", "--set", "azimuth_step_deg=2"]
PARSED = ["--frames", "0:2", "--set", "search.enabled=false", "--set", "find_causes=false"]
"""A result of some kind, soon."""


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short drive on disk, in small pictures."""
    folder = tmp_path_factory.mktemp("data") / "street"
    config = SimulationConfig(
        seed=4,
        frames=4,
        width=276,
        height=84,
        azimuth_limit_deg=50.0,
        azimuth_step_deg=0.5,
        vehicle_density=0.3,
        motion="no_stop",
        speed_mps=6.0,
    )
    write_drive(simulate(config), folder)
    return folder


@pytest.fixture(scope="module")
def shifted(street: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A result of the street's first frames, each paired with the image after its own."""
    out = tmp_path_factory.mktemp("result") / "out"
    assert main(["calibrate", str(street), "--out", str(out), "--image-shift", "1", *PARSED]) == 3
    return out


def _refused(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> str:
    """The one line that a refused command says."""
    assert main([str(argument) for argument in arguments]) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1
    return captured.err


def test_a_result_says_how_its_drives_were_read(shifted: Path, capsys: pytest.CaptureFixture[str]) -> None:
    result = read_result(shifted / "calibration.json")
    assert result.read_as["image_shift"] == 1 and result.read_as["frames"] == "0:2"
    assert main(["inspect", str(shifted)]) == 0
    assert "The drives were read with --frames 0:2 --image-shift 1." in capsys.readouterr().out
    assert main(["inspect", str(shifted), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["read_as"]["image_shift"] == 1


def test_an_overlay_pairs_as_the_calibration_did(
    street: Path, shifted: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["overlay", str(shifted), str(street), "--frame", "1", "--out"]
    assert main([*command, str(tmp_path / "a.png")]) == 0
    notes = capsys.readouterr().err
    assert f"read with --image-shift 1, as {shifted} was made" in notes and "--frames 0:2" in notes
    assert main([*command, str(tmp_path / "b.png"), "--image-shift", "1"]) == 0
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    shown = cv2.imread(str(tmp_path / "a.png"))
    result = read_result(shifted / "calibration.json")
    plain = {**result.read_as, "image_shift": 0}
    document = json.loads((shifted / "calibration.json").read_text()) | {"read_as": plain}
    (tmp_path / "unshifted.json").write_text(json.dumps(document))
    assert main(["overlay", str(tmp_path / "unshifted.json"), *command[2:], str(tmp_path / "c.png")]) == 0
    assert np.abs(shown.astype(int) - cv2.imread(str(tmp_path / "c.png"))).max() > 50


def test_other_pairs_are_refused_and_other_measurements_reported(
    street: Path, shifted: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["overlay", str(shifted), str(street), "--out", str(tmp_path / "a.png")]
    error = _refused(capsys, *command, "--image-shift", "0")
    assert f"--image-shift 0: {shifted} was made with --image-shift 1, expected the same" in error
    assert "--camera image_3" in _refused(capsys, *command, "--camera", "image_3")
    assert list(tmp_path.iterdir()) == []
    assert main([*command, "--sweep", "instant"]) == 0
    assert "was made with --sweep auto, found --sweep instant" in capsys.readouterr().err


def test_a_turn_is_read_as_the_calibration_read_it(
    street: Path, shifted: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """With start and stamp of the turn; another sweep is read without them."""
    document = json.loads((shifted / "calibration.json").read_text())
    document["read_as"] |= {"sweep": "clockwise", "sweep_start_deg": 90.0, "sweep_stamp": "end"}
    turned_result = tmp_path / "calibration.json"
    turned_result.write_text(json.dumps(document))

    def shown(name: str, *options: str) -> bytes:
        out = tmp_path / f"{name}.png"
        assert (
            main(["overlay", str(turned_result), str(street), "--frame", "1", "--out", str(out), *options])
            == 0
        )
        return out.read_bytes()

    kept = shown("kept")
    notes = capsys.readouterr().err
    assert "read with --sweep-start-deg 90.0" in notes and "read with --sweep-stamp end" in notes
    turn = ["--sweep", "clockwise", "--sweep-start-deg", "90", "--sweep-stamp", "end"]
    assert kept == shown("said", *turn) != shown("from behind", "--sweep", "counterclockwise")
    capsys.readouterr()
    shown("compensated", "--sweep", "compensated")
    assert "sweep-start" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("frames", 0, "a text"),
        ("cloud", [[]], "a text"),
        ("sequence", -1, "a text"),
        ("loader", {}, "a text"),
        ("camera", None, "a text"),
        ("image_shift", "1", "a number"),
        ("sweep_start_deg", True, "a number"),
    ],
)
def test_options_of_another_kind_in_a_result_are_refused(
    street: Path,
    shifted: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    name: str,
    value: object,
    expected: str,
) -> None:
    document = json.loads((shifted / "calibration.json").read_text())
    document["read_as"][name] = value
    changed = tmp_path / "changed.json"
    changed.write_text(json.dumps(document))
    error = _refused(capsys, "overlay", changed, street, "--out", tmp_path / "a.png")
    assert f"{changed}: read_as.{name}: found {value!r}, expected {expected}" in error


def test_a_start_of_other_pairs_is_reported(
    street: Path, shifted: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["track", str(street), "--init", str(shifted), "--set", "calibration.search.enabled=false"]
    command += ["--set", "calibration.decide_sweep=false"]
    assert main(command) == 3
    assert "was made with --image-shift 1, found --image-shift 0" in capsys.readouterr().err
    assert main([*command, "--image-shift", "1"]) == 3
    assert "warning" not in capsys.readouterr().err


def test_a_truth_of_other_pairs_is_reported(
    street: Path, shifted: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    truth = street / "sequences" / "00" / "groundtruth.json"
    assert main(["evaluate", str(shifted), "--truth", str(truth)]) == 0
    assert "the truth's time offset must be that of the same pairs" in capsys.readouterr().err


def test_a_result_without_pairs_is_read_as_the_command_line_says(
    street: Path, shifted: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    document = json.loads((shifted / "calibration.json").read_text())
    del document["read_as"]
    (tmp_path / "old.json").write_text(json.dumps(document))
    command = ["overlay", str(tmp_path / "old.json"), str(street), "--out", str(tmp_path / "a.png")]
    assert main([*command, "--image-shift", "1"]) == 0
    assert capsys.readouterr().err == ""


def test_outputs_that_are_inputs_or_each_other_are_refused(
    street: Path, shifted: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, result = tmp_path / "f", shifted / "calibration.json"
    before = result.read_bytes()
    same = _refused(capsys, "track", street, "--checkpoint", file, "--out", tmp_path / "." / "f")
    assert f"--out and --checkpoint: found the same file {file}" in same
    for arguments in (
        ["export", shifted, "--to", "kitti", "--force", "--out", result, "--overwrite"],
        ["track", street, "--init", result, "--out", result, "--overwrite"],
        ["calibrate", street, "--init", result, "--out", shifted, "--overwrite"],
        ["calibrate", street, "--out", street, "--overwrite"],
        ["calibrate", street / "sequences" / "00", "--out", street, "--overwrite"],
    ):
        assert "would be replaced, expected another name" in _refused(capsys, *arguments)
    os.link(result, tmp_path / "linked.json")
    arguments = [
        "export",
        shifted,
        "--to",
        "kitti",
        "--force",
        "--out",
        tmp_path / "linked.json",
        "--overwrite",
    ]
    assert "would be replaced" in _refused(capsys, *arguments)
    assert result.read_bytes() == before


def test_drives_of_one_name_are_refused_before_the_work(
    street: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(street, tmp_path / "other" / "street")
    error = _refused(capsys, "calibrate", street, tmp_path / "other" / "street", "--out", tmp_path / "out")
    assert "found two drives named street/00" in error and not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_folder_whose_name_is_not_utf8_is_no_obstacle(
    street: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    drive = tmp_path / os.fsdecode(b"stra\xdfe")
    shutil.copytree(street, drive)
    out = tmp_path / os.fsdecode(b"gr\xf6n")
    assert main(["calibrate", str(drive), "--out", str(out), *PARSED]) == 3
    assert read_result(out / "calibration.json").frames_used[0].drive == "stra\\xdfe/00"


@pytest.mark.slow
def test_notes_beside_a_result_survive(street: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    command = ["calibrate", str(street), "--out", str(out), *PARSED]
    assert main(command) == 3
    (out / "notes.txt").write_text("dear")
    with open(out / "report.md", "a") as report:
        report.write("my remark\n")
    assert main([*command, "--overwrite"]) == 3
    assert (out / "notes.txt").read_text() == "dear"
    assert "my remark" in (out / "report.md.kept").read_text()
    assert "my remark" not in (out / "report.md").read_text()


def test_a_real_data_set_is_never_simulated_over(
    kitti_drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = kitti_drive.parents[1]
    before = {path: path.read_bytes() for path in root.rglob("*") if path.is_file()}
    assert "not from sst-graph" in _refused(capsys, "simulate", root, "--overwrite", *SMALL)
    assert {path: path.read_bytes() for path in root.rglob("*") if path.is_file()} == before


def test_a_simulated_drive_that_was_worked_on_is_not_simulated_over(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "drive"
    assert main(["simulate", str(out), *SMALL]) == 0
    capsys.readouterr()
    labels = out / "sequences" / "00" / "labels" / "000001.label"
    labels.write_bytes(labels.read_bytes()[::-1])
    error = _refused(capsys, "simulate", out, "--overwrite", *SMALL)
    assert "found sequences/00/labels/000001.label, which is not as sst-graph wrote it" in error


@pytest.mark.parametrize("out", ["/proc/x", "/dev/null/x"])
def test_a_place_where_nothing_can_be_made(
    street: Path, capsys: pytest.CaptureFixture[str], out: str
) -> None:
    assert out in _refused(capsys, "calibrate", street, "--out", out)
    assert out in _refused(capsys, "export", street, "--to", "kitti", "--out", out)
    assert out in _refused(capsys, "experiment", "windows", "--out", out)


@pytest.mark.parametrize(("name", "option"), [("fit", "--data"), ("fit", "--methods"), ("rigs", "--jobs")])
def test_an_option_of_another_experiment_is_named(
    capsys: pytest.CaptureFixture[str], name: str, option: str
) -> None:
    said = _refused(capsys, "experiment", name, option, "1")
    assert f"{option}: means nothing for experiment {name}" in said


@pytest.mark.parametrize("frames", ["0", "-1", "100001", str(10**18), str(10**400)])
def test_frames_of_a_prediction_are_bounded(capsys: pytest.CaptureFixture[str], frames: str) -> None:
    assert "expected 1 or more, at most 100000" in _refused(capsys, "inspect", "none", "--next", frames)


def test_where_further_reasons_stand(monkeypatch: pytest.MonkeyPatch) -> None:
    """With --quiet there is no summary."""
    result = dataclasses.replace(turned(3), status="not_converged", reasons=("one", "two"))
    assert why_not_ok(result) == "not_converged: one (1 more in the summary; in full in the report)"
    many = dataclasses.replace(result, reasons=tuple(f"reason {k}" for k in range(8)))
    assert why_not_ok(many) == "not_converged: reason 0 (7 more in the report)"
    monkeypatch.setattr(loudness, "quiet", True)
    assert why_not_ok(result) == "not_converged: one (1 more in the report)"


def test_remarks_are_one_printable_line(capsys: pytest.CaptureFixture[str]) -> None:
    """What a calibration.json holds is repeated in them."""
    complain("note: read with --cloud \x1b[31m\nx, as é was made")
    assert capsys.readouterr().err == "sst-graph: note: read with --cloud \\x1b[31m x, as é was made\n"

"""``sst-graph evaluate`` and ``sst-graph overlay`` as a user calls them."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import gtsam
import numpy as np
import pytest
from layouts import as_folder

from sst_graph.cli import main
from sst_graph.factors.camera import PinholeCamera
from sst_graph.reference import read_reference
from sst_graph.result import CalibrationResult, FrameId


@pytest.fixture
def result_file(tmp_path: Path, kitti_drive: Path) -> Path:
    """A result of the tiny drive: turned by 1 deg about the LiDAR's z, 3 cm along its x, 4 ms late."""
    true = read_reference(kitti_drive / "calib.txt").cTl
    estimate = true * gtsam.Pose3(gtsam.Rot3.Rz(np.radians(1.0)), [0.03, 0.0, 0.0])
    result = CalibrationResult(
        estimate,
        0.104,
        np.diag([np.radians(0.5)] * 3 + [0.01] * 3 + [0.002]) ** 2,
        "ok",
        PinholeCamera(700.0, 700.0, 4.0, 3.0, 8, 6),
        "image_2",
        frames_used=(FrameId("kitti/00", 2),),
        initial=true,
    )
    folder = tmp_path / "calibration"
    folder.mkdir()
    (folder / "calibration.json").write_text(result.to_json())
    (folder / "truth.json").write_text(
        json.dumps({"T_camera_lidar": true.matrix().tolist(), "time_offset_s": 0.1})
    )
    return folder / "calibration.json"


def test_evaluate_prints_every_metric(result_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", str(result_file), "--truth", str(result_file.parent / "truth.json")]) == 0
    out = capsys.readouterr().out
    assert "1.000 deg (QAD: the whole angle), 0.333 deg (AEAD: mean of roll, pitch and yaw)" in out
    assert "1.00 cm (ATD: mean of x, y and z)" in out and "+4.00 ms" in out
    assert "NEES" in out and "of 7" in out


def test_evaluate_as_json(result_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    truth = str(result_file.parent / "truth.json")
    assert main(["evaluate", str(result_file.parent), "--truth", truth, "--json"]) == 0
    values = json.loads(capsys.readouterr().out)
    assert values["qad_deg"] == pytest.approx(1.0)
    assert values["time_offset_s"] == pytest.approx(0.004)
    assert values["nees"]["rotation"] == pytest.approx(4.0)
    assert values["nees"]["time_offset"] == pytest.approx(4.0)
    assert values["status"] == "ok"


def test_evaluate_counts_the_truths_own_error(result_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    truth = ["--truth", str(result_file.parent / "truth.json")]
    assert main(["evaluate", str(result_file), *truth, "--json", "--truth-sigma", "0.5,1,2"]) == 0
    values = json.loads(capsys.readouterr().out)
    assert values["qad_deg"] == pytest.approx(1.0)
    assert values["nees"]["rotation"] == pytest.approx(4.0 / 2.0)
    assert values["nees"]["time_offset"] == pytest.approx(4.0 / 2.0)
    assert main(["evaluate", str(result_file), *truth, "--truth-sigma", "1,2"]) == 2
    assert "expected three numbers" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"version": 2}, "version 2"),
        ({"covariance": np.zeros((7, 7)).tolist()}, "covariance: found a sigma of 0"),
        ({"covariance": (np.eye(7) + 0.1 * np.eye(7, k=1)).tolist()}, "not symmetric"),
        ({"covariance": (1.5 * np.eye(7) - 0.5 * np.ones((7, 7))).tolist()}, "eigenvalue -2"),
        ({"camera": {"name": "image_2", "fx": 7, "fy": 7, "cx": 4, "cy": 3, "width": 0, "height": 6}}, "0x6"),
    ],
)
def test_a_damaged_result_is_no_truth(
    change: dict[str, object], words: str, result_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    damaged = result_file.with_name("damaged.json")
    damaged.write_text(json.dumps({**json.loads(result_file.read_text()), **change}))
    for command in (["evaluate", str(result_file), "--truth", str(damaged)], ["import", str(damaged)]):
        assert main(command) == 2
        said = capsys.readouterr().err
        assert "damaged.json" in said and words in said


@pytest.mark.parametrize("command", ["evaluate", "inspect", "export"])
def test_a_singular_covariance_is_named_with_its_file(
    command: str, result_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    values = json.loads(result_file.read_text())
    values["covariance"][0][1] = values["covariance"][1][0] = values["covariance"][0][0]
    result_file.write_text(json.dumps(values))
    truth = str(result_file.with_name("truth.json"))
    options = {"evaluate": ["--truth", truth], "inspect": [], "export": ["--to", "gtsam"]}[command]
    assert main([command, str(result_file.parent), *options]) == 2
    said = capsys.readouterr().err
    assert str(result_file) in said and ("singular" in said or "not positive definite" in said)


def test_evaluate_against_a_kitti_calibration(
    result_file: Path, kitti_drive: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["evaluate", str(result_file), "--truth", str(kitti_drive / "calib.txt"), "--json"]) == 0
    values = json.loads(capsys.readouterr().out)
    assert values["atd_m"] == pytest.approx(0.01) and values["time_offset_s"] is None


def test_evaluate_against_the_data_set(
    result_file: Path, kitti_drive: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Read as the result was: one image late, 0.1025 s in the mean."""
    stored = json.loads(result_file.read_text())
    result_file.write_text(json.dumps({**stored, "read_as": {"image_shift": 1}}))
    data = kitti_drive.parents[1]
    assert main(["evaluate", str(result_file), "--truth", str(data), "--json"]) == 0
    captured = capsys.readouterr()
    values = json.loads(captured.out)
    assert values["atd_m"] == pytest.approx(0.01)
    assert values["time_offset_s"] == pytest.approx(0.104 - 0.1025, abs=1e-6)
    assert "--image-shift 1, as" in captured.err and "a reference, not the truth" in captured.err
    truth = {"T_camera_lidar": stored["T_camera_lidar"], "time_offset_s": 0.0}
    (kitti_drive / "groundtruth.json").write_text(json.dumps(truth))
    assert main(["evaluate", str(result_file), "--truth", str(data), "--json"]) == 0
    captured = capsys.readouterr()
    assert json.loads(captured.out)["atd_m"] == pytest.approx(0.0) and "reference" not in captured.err


def test_evaluate_against_data_with_no_more_than_a_start(
    result_file: Path, kitti_drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = as_folder(kitti_drive, tmp_path / "street")
    assert main(["evaluate", str(result_file), "--truth", str(folder), "--json"]) == 0
    captured = capsys.readouterr()
    values = json.loads(captured.out)
    assert values["atd_m"] == pytest.approx(0.01) and values["time_offset_s"] is None
    assert "the start that the data bring, not with a reference" in captured.err
    (folder / "extrinsic.yaml").unlink()
    assert main(["evaluate", str(result_file), "--truth", str(folder)]) == 2
    assert "found data without a calibration" in capsys.readouterr().err


def test_evaluate_against_a_folder_that_holds_no_data(
    result_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "empty").mkdir()
    assert main(["evaluate", str(result_file), "--truth", str(tmp_path / "empty")]) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and "found no layout that is known" in captured.err


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "no such file"),
        (b"", "no JSON"),
        (b'{"format": "sst-graph/calibration", "version": 1}', "no entry 'camera'"),
        (b'{"format": "other"}', "found format 'other'"),
    ],
)
def test_evaluate_bad_result(
    result_file: Path, capsys: pytest.CaptureFixture[str], content: bytes | None, message: str
) -> None:
    truth = str(result_file.parent / "truth.json")
    result_file.unlink()
    if content is not None:
        result_file.write_bytes(content)
    assert main(["evaluate", str(result_file), "--truth", truth]) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1
    assert message in captured.err and "calibration.json" in captured.err


def test_overlay_writes_a_picture(result_file: Path, kitti_drive: Path, tmp_path: Path) -> None:
    out = tmp_path / "new" / "picture.png"
    assert main(["overlay", str(result_file), str(kitti_drive), "--frame", "3", "--out", str(out)]) == 0
    picture = cv2.imread(str(out))
    assert picture.shape[1] >= 720 and picture.shape[0] > 2 * 6 * (720 // 8)


def test_overlay_replaces_only_with_overwrite(
    result_file: Path, kitti_drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "picture.png"
    out.write_bytes(b"mine")
    command = ["overlay", str(result_file), str(kitti_drive), "--out", str(out)]
    assert main(command) == 2
    assert "--overwrite" in capsys.readouterr().err and out.read_bytes() == b"mine"
    assert main([*command, "--overwrite"]) == 2
    assert "expected a PNG that sst-graph wrote to overwrite" in capsys.readouterr().err
    assert out.read_bytes() == b"mine"
    # Nor a picture of the drive.
    out.write_bytes(picture := next(kitti_drive.rglob("image_2/*.png")).read_bytes())
    assert main([*command, "--overwrite"]) == 2
    assert "another kind of file" in capsys.readouterr().err and out.read_bytes() == picture
    out.unlink()
    assert main(command) == 0
    assert main([*command, "--overwrite", "--before", "dataset"]) == 0
    assert out.read_bytes() != b"mine"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--frame", "9"], "kitti/00: found no frame 9, expected one of its 5 frames"),
        (["--out", "picture.jpg"], "expected a name that ends in .png"),
        (["--before", "nothing.json"], "nothing.json: found no such file"),
        (["--frame", "x"], "argument --frame: invalid int value: 'x'"),
        (["--camera", "image_3"], "image_3"),
    ],
)
def test_overlay_bad_input(
    result_file: Path,
    kitti_drive: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    options: list[str],
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["overlay", str(result_file), str(kitti_drive), *options]) == 2
    captured = capsys.readouterr()
    assert message in captured.err and captured.err.count("\n") == 1
    assert not list(tmp_path.glob("*.png")) and not list(tmp_path.glob(".*partial"))

"""``sst-graph export`` as a user calls it."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import gtsam
import numpy as np
import pytest

from sst_graph.cli import main
from sst_graph.factors.camera import PinholeCamera
from sst_graph.reference import read_reference
from sst_graph.result import CalibrationResult

FORWARD = gtsam.Rot3(np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]))
RESULT = CalibrationResult(
    gtsam.Pose3(FORWARD, np.array([0.06, -0.08, -0.27])),
    0.1,
    np.diag([0.001] * 3 + [0.01] * 3 + [0.002]) ** 2,
    "ok",
    PinholeCamera(700.0, 700.0, 4.0, 3.0, 8, 6),
    "image_2",
)


@pytest.fixture
def result_file(tmp_path: Path) -> Path:
    path = tmp_path / "calibration" / "calibration.json"
    path.parent.mkdir()
    path.write_text(RESULT.to_json())
    return path


@pytest.mark.parametrize("target", ["kitti", "ros-tf", "urdf", "kalibr", "autoware", "opencv", "gtsam"])
def test_to_stdout_and_to_a_file(
    target: str, result_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["export", str(result_file.parent), "--to", target]) == 0
    printed = capsys.readouterr()
    assert printed.err == "" and len(printed.out) > 100
    out = tmp_path / "new" / "file"
    assert main(["export", str(result_file), "--to", target, "--out", str(out)]) == 0
    assert capsys.readouterr().out == f"wrote {out}\n"
    assert out.read_text() == printed.out


def test_kitti_with_the_data_calib_reads_back(result_file: Path, kitti_drive: Path, tmp_path: Path) -> None:
    out = tmp_path / "calib.txt"
    command = ["export", str(result_file), "--to", "kitti", "--calib", str(kitti_drive / "calib.txt")]
    assert main([*command, "--out", str(out)]) == 0
    again = read_reference(out).cTl
    assert np.allclose(again.matrix(), RESULT.T_camera_lidar.matrix(), atol=1e-12)
    assert "P3: 700.0 0.0 4.0 -350.0" in out.read_text()


def test_a_result_that_is_not_ok_needs_force(result_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bad = dataclasses.replace(RESULT, status="unobservable", reasons=("no motion\nat all",))
    result_file.write_text(bad.to_json())
    assert main(["export", str(result_file), "--to", "kalibr"]) == 2
    refused = capsys.readouterr()
    assert refused.out == "" and "status unobservable" in refused.err and "--force" in refused.err
    assert main(["export", str(result_file), "--to", "kalibr", "--force"]) == 0
    forced = capsys.readouterr()
    assert forced.err == "sst-graph: warning: unobservable, exported all the same: no motion at all\n"
    assert "STATUS unobservable" in forced.out and "timeshift_cam_imu: 0.1" in forced.out


def test_replaces_only_with_overwrite(
    result_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "tf.yaml"
    out.write_text("mine")
    command = ["export", str(result_file), "--to", "ros-tf", "--out", str(out)]
    assert main(command) == 2
    assert "--overwrite" in capsys.readouterr().err and out.read_text() == "mine"
    assert main([*command, "--overwrite", "--camera-frame", "cam", "--lidar-frame", "lid"]) == 0
    assert "child_frame_id: lid" in out.read_text()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--to", "autocad"], "invalid choice: 'autocad'"),
        ([], "--to"),
        (["--to", "urdf", "--calib", "calib.txt"], "--calib goes with --to kitti"),
        (["--to", "kitti", "--calib", "nowhere.txt"], "nowhere.txt: found no such file"),
        (["--to", "urdf", "--camera-frame", "a b"], "frame name 'a b'"),
    ],
)
def test_bad_usage(
    result_file: Path, capsys: pytest.CaptureFixture[str], options: list[str], message: str
) -> None:
    assert main(["export", str(result_file), *options]) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1 and message in captured.err


def test_the_gtsam_export_is_the_results_covariance(
    result_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["export", str(result_file), "--to", "gtsam"]) == 0
    document = json.loads(capsys.readouterr().out)
    found = np.linalg.inv(np.array(document["information"]))
    np.testing.assert_allclose(found, RESULT.covariance, rtol=1e-9, atol=1e-15)

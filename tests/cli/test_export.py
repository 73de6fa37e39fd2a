"""``sst-graph export`` as a user calls it."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import gtsam
import numpy as np
import pytest
from rigs import marginal_of
from rigs import result_of as rig_of

from sst_graph.cli import main
from sst_graph.cli.options import EXPORTS
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


@pytest.mark.parametrize("target", EXPORTS)
def test_to_stdout_and_to_a_file(
    target: str, result_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["export", str(result_file.parent), "--to", target]) == 0
    printed = capsys.readouterr()
    # What the format has no place for is said.
    offset = "time offset of image_2: t_lidar = t_camera_stamp + time_offset_s, time_offset_s = 0.1"
    expected = f"sst-graph: note: calib.txt has no place for the time offset: {offset}\n"
    assert printed.err == (expected if target == "kitti" else "") and len(printed.out) > 100
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
        (["--to", "kitti", "--parent", "lidar"], "--parent goes with --to ros-tf, ros1-launch"),
        (["--to", "opencv", "--child", "lidar"], "--child goes with --to ros-tf, ros1-launch"),
        (["--to", "urdf", "--parent", "base_link"], "expected a pose of 'lidar' in it, by --tree FILE"),
        (["--to", "urdf", "--tree", "nowhere.urdf"], "nowhere.urdf: found no such file"),
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


VEHICLE = """<robot name="v"><joint name="j" type="fixed"><parent link="base_link"/><child link="velodyne"/>
<origin xyz="1 0 2" rpy="0 0 0"/></joint></robot>"""


def test_into_the_tree_of_a_vehicle(
    result_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "robot.urdf").write_text(VEHICLE)
    tree = ["--tree", str(tmp_path / "robot.urdf"), "--lidar-frame", "velodyne"]
    assert main(["export", str(result_file), "--to", "ros2-launch-xml", *tree]) == 0
    printed = capsys.readouterr()
    assert printed.err == "" and "--frame-id base_link --child-frame-id camera_optical_frame" in printed.out
    # 1 m ahead and 2 m up, and by T_camera_lidar 27 cm ahead, 6 cm left, 8 cm down
    words = printed.out.split('args="')[1].split()
    assert [float(word) for word in words[1:6:2]] == pytest.approx([1.27, 0.06, 1.92])
    assert main(["export", str(result_file), "--to", "urdf", *tree[:2]]) == 2
    assert "found no frame 'lidar' among base_link, velodyne" in capsys.readouterr().err


ROOFED = """<robot name="v">
<joint name="a" type="fixed"><parent link="base_link"/><child link="roof"/></joint>
<joint name="b" type="fixed"><parent link="roof"/><child link="velodyne"/></joint>
<joint name="c" type="fixed"><parent link="base_link"/><child link="imu"/></joint>
<joint name="d" type="fixed"><parent link="roof"/><child link="camera_link"/></joint></robot>"""


@pytest.mark.parametrize("form", ["ros-tf", "ros1-launch", "ros2-launch", "ros2-launch-xml", "urdf", "xacro"])
def test_a_joint_of_the_vehicle_that_is_replaced_is_named(
    result_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], form: str
) -> None:
    (tmp_path / "robot.urdf").write_text(ROOFED)
    command = ["export", str(result_file), "--to", form, "--tree", str(tmp_path / "robot.urdf")]
    command += ["--lidar-frame", "velodyne", "--parent"]
    assert main([*command, "camera_link", "--child", "roof"]) == 0
    assert capsys.readouterr().err == (
        "sst-graph: warning: roof has a parent in the tree already, base_link: the file replaces that joint, "
        "which cuts base_link, imu off from roof\n"
    )
    assert main([*command, "camera_link", "--child", "velodyne"]) == 0
    assert "velodyne has a parent in the tree already, roof" in capsys.readouterr().err
    # The root has no parent, and the camera's own place is what is calibrated.
    for ends in (["camera_link", "--child", "base_link"], ["roof", "--child", "camera_link"]):
        assert main([*command, *ends]) == 0
        assert capsys.readouterr().err == ""


def test_a_rig_by_its_folder_and_by_its_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig = rig_of(marginal_of(2))
    for name, result in rig.cameras.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "calibration.json").write_text(result.to_json())
    (tmp_path / "rig.json").write_text(rig.to_json())
    assert main(["export", str(tmp_path), "--to", "urdf"]) == 0
    by_folder = capsys.readouterr().out
    assert 'child link="cam1_optical_frame"' in by_folder
    assert main(["export", str(tmp_path / "rig.json"), "--to", "urdf"]) == 0
    assert capsys.readouterr().out == by_folder
    assert main(["export", str(tmp_path), "--to", "kitti"]) == 2
    assert "expected the folder of one of its cameras" in capsys.readouterr().err
    wrong = dataclasses.replace(rig, status="not_converged")
    (tmp_path / "rig.json").write_text(wrong.to_json())
    for reasons, said in (((), ""), (("too dark",), ": cam1: too dark")):
        camera = dataclasses.replace(rig.cameras["cam1"], status="not_converged", reasons=reasons)
        (tmp_path / "cam1" / "calibration.json").write_text(camera.to_json())
        assert main(["export", str(tmp_path), "--to", "urdf", "--force"]) == 0
        warning = "sst-graph: warning: not_converged, exported all the same"
        assert capsys.readouterr().err == f"{warning}{said}\n"
    (tmp_path / "rig.json").write_text(rig.to_json())
    (tmp_path / "cam1" / "calibration.json").write_text(rig.cameras["cam1"].to_json())
    assert main(["export", str(tmp_path / "cam0"), "--to", "kitti"]) == 0

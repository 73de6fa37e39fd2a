"""``sst-graph import`` and ``--init FILE`` as a user calls them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from calibrations import TIME_OFFSET_S, turned

from sst_graph.cli import main
from sst_graph.cli.inputs import starting_point
from sst_graph.cli.options import EXPORTS
from sst_graph.data import open_source
from sst_graph.reference import load_initial

RESULT = turned(3)
CHAINS = ("kalibr", "openvins", "mins")
MINS = """
cam0: {T_imu_cam: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1], timeoffset: 0}
lidar0: {T_imu_lidar: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}
"""
NUSCENES = """[
{"channel": "CAM_FRONT", "translation": [0, 0, 0], "rotation": [1, 0, 0, 0], "camera_intrinsic": [[1]]},
{"channel": "LIDAR_TOP", "translation": [0, 0, 0], "rotation": [1, 0, 0, 0], "camera_intrinsic": []}]"""


@pytest.fixture
def result_file(tmp_path: Path) -> Path:
    path = tmp_path / "calibration.json"
    path.write_text(RESULT.to_json())
    return path


@pytest.mark.parametrize("target", EXPORTS)
def test_a_start_from_every_format(
    target: str, result_file: Path, tmp_path: Path, kitti_drive: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    exported, start = tmp_path / "exported", tmp_path / "start.json"
    assert main(["export", str(result_file), "--to", target, "--out", str(exported)]) == 0
    capsys.readouterr()
    assert main(["import", str(exported), "--out", str(start)]) == 0
    said = capsys.readouterr()
    assert said.out == f"wrote {start}\n"
    assert said.err.startswith(f"sst-graph: note: {exported}: {target}, ") and said.err.count("\n") == 1
    drive = open_source(kitti_drive)
    offset_s = 0.0 if target == "kitti" else TIME_OFFSET_S
    for path in (start, exported):
        cTl, time_offset_s = starting_point(str(path), drive, "image_2")
        assert cTl is not None and cTl.equals(RESULT.T_camera_lidar, 1e-9)
        assert time_offset_s == offset_s
    note = capsys.readouterr().err
    silent = target in ("kitti", "gtsam")
    assert note == "" if silent else note.startswith(f"sst-graph: note: --init {exported}: {target}, ")


def test_to_stdout(result_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["import", str(result_file), "--camera", "image_2"]) == 0
    said = capsys.readouterr()
    document = json.loads(said.out)
    np.testing.assert_array_equal(document["T_camera_lidar"], RESULT.T_camera_lidar.matrix())
    assert document["camera"] == "image_2" and document["time_offset_s"] == TIME_OFFSET_S
    assert document["read_from"]["format"] == "calibration"
    assert said.err.endswith("as it is; time offset -37.500 ms\n")


def test_names_of_frames(result_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    exported = tmp_path / "robot.urdf"
    names = ["--camera-frame", "eye", "--lidar-frame", "top"]
    assert main(["export", str(result_file), "--to", "urdf", *names, "--out", str(exported)]) == 0
    capsys.readouterr()
    assert main(["import", str(exported)]) == 2
    said = capsys.readouterr()
    assert (
        said.out == "" and said.err.count("\n") == 1 and "the LiDAR's frame: --lidar-frame NAME" in said.err
    )
    out = tmp_path / "start.json"
    assert main(["import", str(exported), *names, "--out", str(out)]) == 0
    assert load_initial(out).cTl.equals(RESULT.T_camera_lidar, 1e-9)
    assert main(["import", str(exported), *names, "--out", str(out)]) == 2
    assert "--overwrite" in capsys.readouterr().err


def test_a_calibration_starts_from_a_file_of_another_program(
    result_file: Path, kitti_drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    exported = tmp_path / "camchain.yaml"
    assert main(["export", str(result_file), "--to", "kalibr", "--out", str(exported)]) == 0
    capsys.readouterr()
    out = tmp_path / "out"
    # The tiny drive holds nothing to calibrate by: what counts is where it starts.
    code = main(["calibrate", str(kitti_drive), "--init", str(exported), "--out", str(out), "--no-report"])
    said = capsys.readouterr()
    assert code == 3
    note = f"note: --init {exported}: kalibr, T_cam_imu of cam0: the LiDAR in the IMU's place; "
    assert f"{note}time offset -37.500 ms" in said.err
    initial = json.loads((out / "calibration.json").read_text())["initial"]
    np.testing.assert_allclose(initial["T_camera_lidar"], RESULT.T_camera_lidar.matrix(), atol=1e-12)
    assert initial["time_offset_s"] == TIME_OFFSET_S


@pytest.mark.parametrize(
    ("text", "options", "message"),
    [
        (None, [], "found no such file, expected a calibration in a format of docs/how-to/imports.md"),
        ("a: 1", [], "found a file of no known format, expected one of calibration, kitti"),
        ("a: 1", ["--from", "urdf"], "found a file of no known format, expected one of the format urdf"),
        ("a: 1", ["--from", "autocad"], "invalid choice: 'autocad'"),
        ("cam0: {T_cam_imu: 1, T_imu_cam: 1}", [], "import --from FORMAT chooses"),
        ("cam0: {T_cam_imu: 1}", ["--camera-frame", "a", "--camera-link", "b"], "found both"),
        ("cam0: {T_cam_imu: 1}", ["--tree", "nowhere"], "nowhere: found no such file"),
        ("\x00", [], "no known format"),
        (MINS, ["--parent", "imu"], "--parent would change nothing: {path} has the pose of lidar0"),
        (NUSCENES, ["--lidar-frame", "LIDAR_REAR"], "found the LiDARs LIDAR_TOP, expected one named"),
    ],
)
def test_bad_usage(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str | None, options: list[str], message: str
) -> None:
    path = tmp_path / "file"
    if text is not None:
        path.write_text(text)
    assert main(["import", str(path), *options]) == 2
    said = capsys.readouterr()
    assert said.out == "" and said.err.count("\n") == 1 and message.format(path=path) in said.err


OPTIONS = {
    "--camera-frame": "camera_optical_frame",
    "--camera-link": "camera_link",
    "--lidar-frame": "lidar",
    "--parent": "lidar",
    "--tree": "{tree}",
}
OF_TREES = ("--camera-frame", "--camera-link", "--lidar-frame", "--tree")
WITH_EFFECT = {
    **dict.fromkeys(("ros-tf", "ros1-launch", "ros2-launch", "ros2-launch-xml", "urdf", "xacro"), OF_TREES),
    "autoware": OF_TREES,
    "nuscenes": ("--lidar-frame",),
}


@pytest.mark.parametrize("target", ["calibration", *EXPORTS])
def test_frames_that_change_nothing_are_refused(
    target: str, result_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of camera chains --lidar-frame and --tree have an effect beside --parent alone."""
    exported, tree = tmp_path / "exported", tmp_path / "robot.urdf"
    assert main(["export", str(result_file), "--to", "urdf", "--out", str(tree)]) == 0
    if target == "calibration":
        exported = result_file
    else:
        assert main(["export", str(result_file), "--to", target, "--out", str(exported)]) == 0
    for option, value in OPTIONS.items():
        capsys.readouterr()
        if option in WITH_EFFECT.get(target, ()) or (option == "--parent" and target in CHAINS):
            continue
        assert main(["import", str(exported), option, value.format(tree=tree)]) == 2
        said = capsys.readouterr()
        assert said.out == "" and said.err.count("\n") == 1
        assert said.err.startswith(f"sst-graph: error: {option} would change nothing: ")

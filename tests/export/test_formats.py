"""Every export format read back by its own reader, and by hand."""

from __future__ import annotations

import dataclasses
import xml.etree.ElementTree as ET
from pathlib import Path

import cv2
import gtsam
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from sst_graph.data.kitti.calib import read_calibration
from sst_graph.errors import ConfigError
from sst_graph.export import FORMATS, ExportOptions, export_text
from sst_graph.export.formats import fixed_axis_rpy, quaternion_xyzw
from sst_graph.factors.camera import PinholeCamera
from sst_graph.result import CalibrationResult, DriveOffset

FORWARD = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
CAMERA = PinholeCamera(700.0, 710.0, 600.0, 180.0, 1242, 375)


def result_of(R: np.ndarray, t: list[float], **changes: object) -> CalibrationResult:
    sigmas = np.array([0.002, 0.002, 0.002, 0.01, 0.02, 0.03, 0.004])
    result = CalibrationResult(
        gtsam.Pose3(gtsam.Rot3(R), np.array(t)), -0.0375, np.diag(sigmas**2), "ok", CAMERA, "image_2"
    )
    return dataclasses.replace(result, **changes)


@pytest.fixture(params=range(8))
def result(request: pytest.FixtureRequest) -> CalibrationResult:
    """By hand, near the gimbal lock that a LiDAR in an optical frame has, and anywhere."""
    rng = np.random.default_rng(request.param)
    sizes = [0.0, 1e-9, 1e-5, 0.02, 0.02, 1.0, 1.0, 3.0]
    R = FORWARD @ Rotation.from_rotvec(sizes[request.param] * rng.normal(size=3)).as_matrix()
    return result_of(R, [0.06, -0.08, -1e-5])


def test_kitti_reads_back_through_the_shift_of_p2(result: CalibrationResult, tmp_path: Path) -> None:
    original = tmp_path / "original.txt"
    original.write_text(
        "P0: 700 0 600 0 0 710 180 0 0 0 1 0\nP2: 700 0 600 35 0 710 180 -7.1 0 0 1 0.002\n"
        "Tr: 1 0 0 0 0 1 0 0 0 0 1 0\n"
    )
    calibration = read_calibration(original)
    exported = tmp_path / "calib.txt"
    exported.write_text(export_text(result, "kitti", ExportOptions(kitti=calibration)))
    again = read_calibration(exported)
    assert np.allclose(again.cTl("image_2").matrix(), result.T_camera_lidar.matrix(), atol=1e-12)
    for number in (0, 2):
        np.testing.assert_array_equal(again.projections[number], calibration.projections[number])


def test_kitti_by_hand(tmp_path: Path) -> None:
    # P2's fourth column 35 at fx = 700 puts camera 0 at x = +5 cm in camera 2
    original = tmp_path / "calib.txt"
    original.write_text("P2: 700 0 600 35 0 710 180 0 0 0 1 0\nTr: 1 0 0 0 0 1 0 0 0 0 1 0\n")
    options = ExportOptions(kitti=read_calibration(original))
    text = export_text(result_of(FORWARD, [0.06, -0.08, -0.27]), "kitti", options)
    Tr = np.array(text.splitlines()[-1].removeprefix("Tr: ").split(), dtype=float).reshape(3, 4)
    np.testing.assert_allclose(Tr, np.column_stack([FORWARD, [0.01, -0.08, -0.27]]), atol=1e-12)


def test_kitti_without_calib_takes_the_camera_for_camera_0(result: CalibrationResult, tmp_path: Path) -> None:
    path = tmp_path / "calib.txt"
    path.write_text(export_text(result, "kitti"))
    again = read_calibration(path)
    for name in ("image_0", "image_2"):
        assert np.allclose(again.cTl(name).matrix(), result.T_camera_lidar.matrix(), atol=1e-12)
        assert again.camera(name, 1242, 375) == CAMERA


def test_ros_transform(result: CalibrationResult) -> None:
    text = export_text(result, "ros-tf", ExportOptions("cam_optical", "velodyne"))
    message = yaml.safe_load(text)
    assert message["header"]["frame_id"] == "cam_optical" and message["child_frame_id"] == "velodyne"
    t, q = (message["transform"][name] for name in ("translation", "rotation"))
    R = Rotation.from_quat([q["x"], q["y"], q["z"], q["w"]]).as_matrix()
    T = result.T_camera_lidar.matrix()
    np.testing.assert_allclose(R, T[:3, :3], atol=1e-9)
    np.testing.assert_array_equal([t["x"], t["y"], t["z"]], T[:3, 3])
    words = next(line for line in text.splitlines() if "static_transform_publisher" in line).split()
    flags = {name: words[words.index(f"--{name}") + 1] for name in ("x", "qw", "frame-id", "child-frame-id")}
    assert float(flags["x"]) == t["x"] and float(flags["qw"]) == q["w"]
    assert (flags["frame-id"], flags["child-frame-id"]) == ("cam_optical", "velodyne")


def test_quaternion_by_hand() -> None:
    assert quaternion_xyzw(gtsam.Rot3.Rz(np.pi / 2)) == pytest.approx([0, 0, np.sqrt(0.5), np.sqrt(0.5)])
    assert quaternion_xyzw(gtsam.Rot3.Rx(-1.5 * np.pi))[3] >= 0.0


def test_urdf(result: CalibrationResult) -> None:
    root = ET.fromstring(export_text(result, "urdf", ExportOptions("cam", "front/lidar")))
    joint = root.find("joint")
    assert joint is not None and joint.get("type") == "fixed"
    assert joint.find("parent").get("link") == "cam" and joint.find("child").get("link") == "front/lidar"
    assert {link.get("name") for link in root.findall("link")} == {"cam", "front/lidar"}
    origin = joint.find("origin")
    rpy = [float(x) for x in origin.get("rpy").split()]
    T = result.T_camera_lidar.matrix()
    # scipy's lower-case xyz: fixed axes
    np.testing.assert_allclose(Rotation.from_euler("xyz", rpy).as_matrix(), T[:3, :3], atol=1e-9)
    np.testing.assert_array_equal([float(x) for x in origin.get("xyz").split()], T[:3, 3])


def test_fixed_axes_by_hand() -> None:
    # roll 90 deg about x, then yaw 90 deg about the fixed z: y -> z -> z, x -> y, z -> -y -> x
    R = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    assert fixed_axis_rpy(gtsam.Rot3(R)) == pytest.approx([np.pi / 2, 0.0, np.pi / 2])


def test_kalibr(result: CalibrationResult) -> None:
    cam = yaml.safe_load(export_text(result, "kalibr"))["cam0"]
    np.testing.assert_allclose(np.array(cam["T_cam_imu"]), result.T_camera_lidar.matrix(), atol=1e-15)
    assert cam["intrinsics"] == [700.0, 710.0, 600.0, 180.0] and cam["resolution"] == [1242, 375]
    # Kalibr: t_imu = t_cam + timeshift_cam_imu; ours: t_lidar = t_camera_stamp + time_offset_s
    assert cam["timeshift_cam_imu"] == result.time_offset_s


def test_autoware(result: CalibrationResult) -> None:
    kit = yaml.safe_load(export_text(result, "autoware"))["sensor_kit_base_link"]
    assert kit["lidar"] == dict.fromkeys(("x", "y", "z", "roll", "pitch", "yaw"), 0.0)
    pose = kit["camera0/camera_link"]
    link = np.eye(4)
    angles = [pose["roll"], pose["pitch"], pose["yaw"]]
    link[:3, :3] = Rotation.from_euler("xyz", angles).as_matrix()
    link[:3, 3] = pose["x"], pose["y"], pose["z"]
    optical = np.eye(4)  # as Autoware's camera xacro has it
    optical[:3, :3] = Rotation.from_euler("xyz", [-np.pi / 2, 0.0, -np.pi / 2]).as_matrix()
    found = np.linalg.inv(link @ optical)
    np.testing.assert_allclose(found, result.T_camera_lidar.matrix(), atol=1e-9)


def test_autoware_by_hand() -> None:
    # the camera 30 cm in front of the LiDAR, 20 cm below it and 10 cm to its left, looking ahead
    text = export_text(result_of(FORWARD, [0.1, -0.2, -0.3]), "autoware")
    pose = yaml.safe_load(text)["sensor_kit_base_link"]["camera0/camera_link"]
    expected = {"x": 0.3, "y": 0.1, "z": -0.2, "roll": 0.0, "pitch": 0.0, "yaw": 0.0}
    assert pose == pytest.approx(expected, abs=1e-12)


def test_opencv(result: CalibrationResult) -> None:
    text = export_text(result, "opencv")
    storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    values = {name: storage.getNode(name).mat() for name in ("rvec", "tvec", "camera_matrix", "covariance")}
    assert storage.getNode("time_offset_s").real() == result.time_offset_s
    lPs = np.array([[10.0, 1.0, -1.0], [20.0, -3.0, 0.5]])
    cPs = np.array([result.T_camera_lidar.transformFrom(lP) for lP in lPs])
    uvs, _ = cv2.projectPoints(lPs, values["rvec"], values["tvec"], values["camera_matrix"], None)
    if (cPs[:, 2] > 0.1).all():
        np.testing.assert_allclose(uvs.reshape(-1, 2), CAMERA.project(cPs), atol=1e-6)
    T = storage.getNode("T_camera_lidar").mat()
    np.testing.assert_allclose(T, result.T_camera_lidar.matrix(), atol=1e-15)
    np.testing.assert_allclose(values["covariance"], result.covariance)


@pytest.mark.parametrize("target", ["ros-tf", "urdf", "kalibr", "autoware", "opencv"])
def test_every_commented_format_states_frames_and_sign(target: str) -> None:
    result = result_of(
        FORWARD,
        [0.0, 0.0, 0.0],
        status="unobservable",
        drive_offsets=(DriveOffset("a--b", 0.1, 0.01),),
    )
    text = export_text(result, target, ExportOptions("cam", "lid"))
    assert "parent cam" in text and "child lid" in text
    assert "t_lidar = t_camera_stamp + time_offset_s, time_offset_s = -0.0375" in text
    assert "STATUS unobservable" in text and "+0.100000 s" in text
    if target == "urdf":
        assert ET.fromstring(text).tag == "robot"


def test_refuses_what_it_cannot_write() -> None:
    result = result_of(FORWARD, [0.0, 0.0, 0.0])
    with pytest.raises(ConfigError, match="expected one of kitti"):
        export_text(result, "autocad")
    for name in ("", "a b", 'a"b', "a--b", "a:b"):
        with pytest.raises(ConfigError, match="frame name"):
            ExportOptions(camera_frame=name)
    assert set(FORMATS) == {"kitti", "ros-tf", "urdf", "kalibr", "autoware", "opencv", "gtsam"}

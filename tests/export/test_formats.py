"""Every export format read back by its own reader, and by hand."""

from __future__ import annotations

import dataclasses
import json
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pykitti
import pytest
import yaml
from calibrations import CAMERA, FORWARD, OPTICAL_FROM_LINK, matrix_of, result_of, turned
from pyquaternion import Quaternion
from scipy.spatial.transform import Rotation

from sst_graph.assumptions import ASSUMPTIONS
from sst_graph.assumptions.model import Scene
from sst_graph.cameras.estimated_camera import EstimatedCamera
from sst_graph.cli.options import EXPORTS
from sst_graph.data.kitti.calib import read_calibration
from sst_graph.errors import ConfigError
from sst_graph.export import FORMATS, ExportOptions, export_text
from sst_graph.result import CalibrationResult, DriveOffset
from sst_graph.types import FloatArray


@pytest.fixture(params=range(8))
def result(request: pytest.FixtureRequest) -> CalibrationResult:
    return turned(request.param)


def test_kitti_reads_back_through_the_shift_of_p2(result: CalibrationResult, tmp_path: Path) -> None:
    original = tmp_path / "original.txt"
    original.write_text(
        "P0: 700 0 600 0 0 710 180 0 0 0 1 0\nP2: 700 0 600 35 0 710 180 -7.1 0 0 1 0.002\n"
        "Tr: 1 0 0 0 0 1 0 0 0 0 1 0\n"
    )
    calibration = read_calibration(original)
    exported = tmp_path / "calib.txt"
    exported.write_text(export_text(result, "kitti", ExportOptions(kitti=calibration)))
    # pykitti, as its odometry class does: T_cam2_velo is Tr shifted by K^-1 P2's fourth column
    by_pykitti = pykitti.utils.read_calib_file(exported)
    P2, Tr = by_pykitti["P2"].reshape(3, 4), by_pykitti["Tr"].reshape(3, 4)
    shifted = Tr + np.outer(np.linalg.solve(P2[:, :3], P2[:, 3]), [0.0, 0.0, 0.0, 1.0])
    np.testing.assert_allclose(shifted, result.T_camera_lidar.matrix()[:3], atol=1e-12)
    again = read_calibration(exported)
    for number in (0, 2):
        np.testing.assert_array_equal(again.projections[number], calibration.projections[number])


def test_kitti_by_the_odometry_class_of_pykitti(kitti_drive: Path) -> None:
    """A whole data set with our calib.txt; the class wants P0 to P3 and the shift along x alone."""
    calib = kitti_drive / "calib.txt"
    calib.write_text(calib.read_text() + "P1: 700 0 4 -200 0 700 3 0 0 0 1 0\n")
    result = result_of(FORWARD, [0.01, -0.08, -0.27])
    text = export_text(result, "kitti", ExportOptions(kitti=read_calibration(calib)))
    calib.write_text(text)
    found = pykitti.odometry(str(kitti_drive.parents[1]), "00").calib
    np.testing.assert_allclose(found.T_cam2_velo, result.T_camera_lidar.matrix(), atol=1e-12)


def test_kitti_of_one_camera_by_the_odometry_class_of_pykitti(kitti_drive: Path) -> None:
    result = result_of(FORWARD, [0.01, -0.08, -0.27])
    (kitti_drive / "calib.txt").write_text(export_text(result, "kitti"))
    found = pykitti.odometry(str(kitti_drive.parents[1]), "00").calib
    np.testing.assert_allclose(found.T_cam2_velo, result.T_camera_lidar.matrix(), atol=1e-12)


def test_every_format_but_kitti_states_the_sign_of_the_time_offset() -> None:
    """Readers of calib.txt take every line for numbers; the command says it on stderr."""
    result = result_of(FORWARD, [0.01, -0.08, -0.27])
    for name in set(FORMATS) - {"kitti"}:
        text = export_text(result, name)
        assert "t_lidar = t_camera_stamp + time_offset_s" in text, name


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


def test_the_pinhole_of_rectified_pictures_is_not_said_of_the_raw_topic(result: CalibrationResult) -> None:
    raw = {"image_topic": "/front/image_raw"}
    for lens, topic in (("", "/front/image_raw"), ("plumb_bob", "/front/image_raw_rectified")):
        text = export_text(dataclasses.replace(result, read_as={**raw, "lens": lens or None}), "kalibr")
        assert yaml.safe_load(text)["cam0"]["rostopic"] == topic
        assert ("rectified the pictures of a plumb_bob lens" in text) == bool(lens)


def test_kalibr(result: CalibrationResult) -> None:
    cam = yaml.safe_load(export_text(result, "kalibr"))["cam0"]
    np.testing.assert_allclose(np.array(cam["T_cam_imu"]), result.T_camera_lidar.matrix(), atol=1e-15)
    assert cam["intrinsics"] == [700.0, 710.0, 600.0, 180.0] and cam["resolution"] == [1242, 375]
    # Kalibr: t_imu = t_cam + timeshift_cam_imu; ours: t_lidar = t_camera_stamp + time_offset_s
    assert cam["timeshift_cam_imu"] == result.time_offset_s


def _nodes(node: Any) -> list[list[float]]:
    """Rows of a matrix in a file of OpenCV's, read as OpenVINS and MINS do it: entry by entry."""
    return [[node.at(r).at(c).real() for c in range(node.at(r).size())] for r in range(node.size())]


@pytest.mark.parametrize(("target", "shift"), [("openvins", "timeshift_cam_imu"), ("mins", "timeoffset")])
def test_openvins_and_mins_by_the_storage_that_they_read(
    result: CalibrationResult, tmp_path: Path, target: str, shift: str
) -> None:
    path = tmp_path / "chain.yaml"
    path.write_text(export_text(result, target))
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    cam = storage.getNode("cam0")
    iTc = np.array(_nodes(cam.getNode("T_imu_cam")))
    np.testing.assert_allclose(np.linalg.inv(iTc), result.T_camera_lidar.matrix(), atol=1e-12)
    assert cam.getNode(shift).real() == result.time_offset_s  # both: t_imu = t_cam + shift
    values = [cam.getNode("intrinsics").at(k).real() for k in range(4)]
    assert values == [700.0, 710.0, 600.0, 180.0]
    assert cam.getNode("distortion_model").string() == "radtan"
    if target == "mins":
        lidar = storage.getNode("lidar0")
        np.testing.assert_array_equal(_nodes(lidar.getNode("T_imu_lidar")), np.eye(4))
        assert lidar.getNode("timeoffset").real() == 0.0 and lidar.getNode("topic").string() == "/lidar"


def test_autoware(result: CalibrationResult) -> None:
    kit = yaml.safe_load(export_text(result, "autoware"))["sensor_kit_base_link"]
    assert kit["lidar"] == dict.fromkeys(("x", "y", "z", "roll", "pitch", "yaw"), 0.0)
    pose = kit["camera0/camera_link"]
    angles = [pose["roll"], pose["pitch"], pose["yaw"]]
    link = matrix_of([pose["x"], pose["y"], pose["z"]], Rotation.from_euler("xyz", angles))
    # as Autoware's camera xacro has it
    optical = matrix_of(np.zeros(3), Rotation.from_euler("xyz", [-np.pi / 2, 0.0, -np.pi / 2]))
    found = np.linalg.inv(link @ optical)
    np.testing.assert_allclose(found, result.T_camera_lidar.matrix(), atol=1e-9)


def test_autoware_by_hand() -> None:
    # the camera 30 cm in front of the LiDAR, 20 cm below it and 10 cm to its left, looking ahead
    options = ExportOptions(lidar_frame="velodyne_top", camera_link="front/camera_link", parent=None)
    text = export_text(result_of(FORWARD, [0.1, -0.2, -0.3]), "autoware", options)
    kit = yaml.safe_load(text)["sensor_kit_base_link"]
    expected = {"x": 0.3, "y": 0.1, "z": -0.2, "roll": 0.0, "pitch": 0.0, "yaw": 0.0}
    assert kit["front/camera_link"] == pytest.approx(expected, abs=1e-12)
    assert set(kit) == {"velodyne_top", "front/camera_link"}


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


ESTIMATED = {"focal": -0.0056, "cx": 1.5, "k1": 0.016, "k2": -0.004}


def with_lens(values: dict[str, float]) -> CalibrationResult:
    """A result with parameters of the lens that were estimated with it."""
    found = {name: {"value": value, "sigma": 1e-3} for name, value in values.items()}
    return dataclasses.replace(result_of(FORWARD, [0.01, -0.08, -0.27]), diagnostics={"estimated": found})


def _opencv_lens(result: CalibrationResult) -> tuple[FloatArray, FloatArray]:
    storage = cv2.FileStorage(export_text(result, "opencv"), cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    return storage.getNode("camera_matrix").mat(), storage.getNode("distortion_coefficients").mat()


def test_an_estimated_lens_is_that_of_the_graph() -> None:
    """Points projected by OpenCV fall where the assumptions' columns move them."""
    result = with_lens(ESTIMATED)
    K, distortion = _opencv_lens(result)
    points = np.random.default_rng(3).uniform([-0.8, -0.25, 1.0], [0.8, 0.25, 1.0], (50, 3))
    by_opencv = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, distortion)[0].reshape(-1, 2)
    uvs = CAMERA.project(points)
    view = Scene(CAMERA, np.zeros(6), 0.0, 0.1).view(points, np.zeros(50), uvs)
    for name, value in ESTIMATED.items():
        shift = ASSUMPTIONS[name].effect(view).pixel_shift
        assert shift is not None
        uvs = uvs + value * shift
    np.testing.assert_allclose(by_opencv, uvs, atol=1e-9)
    np.testing.assert_allclose(EstimatedCamera.of(result).project(points), uvs, atol=1e-9)
    # Points far beside the image stay there.
    beside = EstimatedCamera.of(with_lens({"k1": -0.3})).project(np.array([[3.0, 0.0, 1.0]]))
    assert beside[0, 0] > CAMERA.width
    assert np.abs(by_opencv - CAMERA.project(points)).max() > 2.0


def test_every_format_says_or_holds_the_estimated_lens(caplog: pytest.LogCaptureFixture) -> None:
    result = with_lens(ESTIMATED)
    K, distortion = _opencv_lens(result)
    said = "the pose belongs to the lens estimated with it (focal, cx, k1, k2): fx 696.08"
    for name in FORMATS.keys() - {"kitti", "gtsam"}:
        assert said in export_text(result, name), name
        assert said not in export_text(with_lens({}), name), name
    cam = yaml.safe_load(export_text(result, "kalibr"))["cam0"]
    np.testing.assert_allclose(cam["intrinsics"], [K[0, 0], K[1, 1], K[0, 2], K[1, 2]])
    np.testing.assert_allclose(cam["distortion_coeffs"], distortion.reshape(-1)[:4])
    assert "no distortion" not in export_text(result, "kalibr")
    sensors = json.loads(export_text(result, "nuscenes"))
    np.testing.assert_allclose(sensors[1]["camera_intrinsic"], K)
    # KITTI's P lines hold the pinhole, and no comment.
    caplog.clear()
    P2 = export_text(with_lens({"focal": 0.01}), "kitti").splitlines()[2]
    assert not caplog.records
    np.testing.assert_allclose(float(P2.split()[1]), 707.0)
    export_text(result, "kitti")
    assert said in caplog.text


@pytest.mark.parametrize("odd", [3, {"focal": 3}, {"focal": {"value": "x"}}, {"focal": {"value": -1.5}}])
def test_a_lens_that_is_none_is_not_exported(odd: Any) -> None:
    result = dataclasses.replace(with_lens({}), diagnostics={"estimated": odd})
    assert export_text(result, "opencv") == export_text(with_lens({}), "opencv")


def _transform_matrix(record: dict[str, Any]) -> np.ndarray:
    """nuscenes-devkit's ``transform_matrix`` from sensor to ego (the devkit asks for NumPy 1)."""
    T = np.eye(4)
    T[:3, :3] = Quaternion(record["rotation"]).rotation_matrix
    T[:3, 3] = np.transpose(np.array(record["translation"]))
    return T


def test_nuscenes(result: CalibrationResult) -> None:
    records = {one["channel"]: one for one in json.loads(export_text(result, "nuscenes"))}
    camera, lidar = (_transform_matrix(records[name]) for name in ("image_2", "lidar"))
    found = np.linalg.inv(camera) @ lidar
    np.testing.assert_allclose(found, result.T_camera_lidar.matrix(), atol=1e-12)
    np.testing.assert_array_equal(records["image_2"]["camera_intrinsic"], CAMERA.matrix)
    assert records["lidar"]["camera_intrinsic"] == []
    assert records["image_2"]["time_offset_s"] == result.time_offset_s
    tokens = [one[key] for one in records.values() for key in ("token", "sensor_token")]
    assert len(set(tokens)) == 4 and all(len(token) == 32 for token in tokens)


@pytest.mark.parametrize("target", sorted(set(FORMATS) - {"kitti", "gtsam"}))
def test_every_format_with_comments_states_axes_direction_and_sign(target: str) -> None:
    result = result_of(
        FORWARD,
        [0.0, 0.0, 0.0],
        status="unobservable",
        drive_offsets=(DriveOffset("a--b", 0.1, 0.01),),
    )
    camera_frame = None if target == "nuscenes" else "cam"
    text = export_text(result, target, ExportOptions(camera_frame, None, "lid"))
    assert "t_lidar = t_camera_stamp + time_offset_s, time_offset_s = -0.0375" in text
    assert "STATUS unobservable" in text and "+0.100000 s" in text
    assert "z forward" in text or "x forward" in text
    direction = {
        "kalibr": "T_cam_imu: p_camera = T_cam_imu * p_imu",
        "openvins": "T_imu_cam: p_imu = T_imu_cam * p_camera",
        "mins": "T_imu_cam: p_imu = T_imu_cam * p_camera; T_imu_lidar: p_imu = T_imu_lidar * p_lidar",
        "opencv": "p_camera = T_camera_lidar * p_lidar",
        "nuscenes": "p_lid = T * p_sensor",
    }
    assert direction.get(target, "p_parent = T * p_child") in text
    if text.startswith("<"):
        assert ET.fromstring(text).tag in ("robot", "launch")


def test_the_axes_of_the_optical_frame() -> None:
    """By hand: in an optical frame forward is z, left is -x, up is -y."""
    link = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])  # forward, left, up
    optical = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    np.testing.assert_array_equal(link @ OPTICAL_FROM_LINK.T, optical)


def test_the_command_line_offers_every_format() -> None:
    assert set(EXPORTS) == set(FORMATS)


def test_refuses_what_it_cannot_write() -> None:
    result = result_of(FORWARD, [0.0, 0.0, 0.0])
    with pytest.raises(ConfigError, match="expected one of kitti"):
        export_text(result, "autocad")
    for name in ("", "a b", 'a"b', "a--b", "a:b", "--x", "${x}", "a\n"):
        with pytest.raises(ConfigError, match="frame name"):
            ExportOptions(camera_frame=name)
    with pytest.raises(ConfigError, match="both sensors"):
        ExportOptions(camera_frame="lidar")
    for target, options in (
        ("kitti", ExportOptions(parent="lidar")),
        ("opencv", ExportOptions(child="lidar")),
        ("autoware", ExportOptions(child="lidar")),
        ("nuscenes", ExportOptions(camera_frame="eye")),
        ("gtsam", ExportOptions(camera_frame="eye")),
        ("kalibr", ExportOptions(camera_link="eye_link")),
        ("kitti", ExportOptions(lidar_frame="top")),
    ):
        with pytest.raises(ConfigError, match="goes with --to ros-tf"):
            export_text(result, target, options)
    link = ExportOptions(camera_link="eye_link", child="lidar")
    with pytest.raises(ConfigError, match="--camera-link eye_link would change nothing"):
        export_text(result, "urdf", link)
    assert "eye_link" in export_text(result, "urdf", dataclasses.replace(link, parent="eye_link"))


@pytest.mark.parametrize("name", ["1e5", "yes", "null", "2", "0.5", "_", "/lidar"])
def test_names_that_yaml_would_take_for_something_else(name: str) -> None:
    text = export_text(result_of(FORWARD, [0.0, 0.0, 0.0]), "ros-tf", ExportOptions("cam", None, name))
    assert yaml.safe_load(text)["child_frame_id"] == name

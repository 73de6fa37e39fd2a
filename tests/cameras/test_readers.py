"""Camera models from the tables and files of ROS, Kalibr, OpenCV, KITTI raw and nuScenes."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import gtsam
import numpy as np
import pytest

from sst_graph.cameras import BrownConradyCamera, DoubleSphereCamera, FisheyeCamera
from sst_graph.cameras.readers import (
    camera_from_camera_info,
    camera_from_kitti_raw,
    camera_from_nuscenes,
    camera_from_opencv,
    cameras_from_kalibr,
    kitti_rectifying_rotation,
)
from sst_graph.data.kitti.raw_calib import parse_kitti_raw, read_kitti_raw
from sst_graph.errors import DataError
from sst_graph.factors.camera import PinholeCamera
from sst_graph.files.yaml_file import parse_yaml, read_yaml

INTRINSICS = PinholeCamera(700.0, 710.0, 640.0, 360.0, 1280, 720)
K = INTRINSICS.matrix
PLUMB_BOB = (-0.3, 0.1, 0.001, -0.002, 0.01)


def camera_info(**changes: Any) -> dict[str, Any]:
    """Fields of a ROS 2 message, as rosbags gives them."""
    roi = SimpleNamespace(x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    fields = {
        "height": 720,
        "width": 1280,
        "distortion_model": "plumb_bob",
        "d": np.array(PLUMB_BOB),
        "k": K.ravel(),
        "r": np.eye(3).ravel(),
        "p": np.column_stack([K * [[0.9], [0.9], [1.0]], np.zeros(3)]).ravel(),
        "binning_x": 0,
        "binning_y": 0,
        "roi": roi,
    }
    return {**fields, **changes}


def test_camera_info_of_both_ros() -> None:
    assert camera_from_camera_info(camera_info()) == BrownConradyCamera(INTRINSICS, PLUMB_BOB)
    fields = camera_info()
    ros1 = {key.upper() if len(key) == 1 else key: value for key, value in fields.items()}
    assert camera_from_camera_info(ros1) == BrownConradyCamera(INTRINSICS, PLUMB_BOB)
    rectified = camera_from_camera_info(fields, rectified=True)
    assert rectified.is_pinhole and rectified.intrinsics.fx == pytest.approx(630.0)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"d": []}, BrownConradyCamera(INTRINSICS)),
        ({"d": [], "distortion_model": ""}, BrownConradyCamera(INTRINSICS)),
        (
            {"d": (0.1,) * 8, "distortion_model": "rational_polynomial"},
            BrownConradyCamera(INTRINSICS, (0.1,) * 8),
        ),
        (
            {"d": (0.01,) * 12 + (0.0, 0.0), "distortion_model": "rational_polynomial"},
            BrownConradyCamera(INTRINSICS, (0.01,) * 12),
        ),
        (
            {"d": (0.01, 0.02, 0.0, 0.0), "distortion_model": "equidistant"},
            FisheyeCamera(INTRINSICS, (0.01, 0.02, 0.0, 0.0)),
        ),
        (
            {"d": (0.0,) * 4, "distortion_model": "equidistant"},
            FisheyeCamera(INTRINSICS, (0.0,) * 4),
        ),
        # Arrays of one length, whatever the model.
        (
            {"d": (0.01, 0.02, 0.0, 0.0, 0.0), "distortion_model": "equidistant"},
            FisheyeCamera(INTRINSICS, (0.01, 0.02, 0.0, 0.0)),
        ),
        (
            {"d": (-0.1, 0.02, 0.0, 0.0, 0.01, 0.0, 0.0, 0.0)},
            BrownConradyCamera(INTRINSICS, (-0.1, 0.02, 0.0, 0.0, 0.01)),
        ),
    ],
)
def test_distortion_models_of_ros(changes: dict[str, Any], expected: object) -> None:
    assert camera_from_camera_info(camera_info(**changes)) == expected


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"k": np.zeros(9)}, "K = 0, an uncalibrated camera"),
        ({"binning_x": 2}, "binning or a region of interest"),
        ({"roi": {"x_offset": 0, "y_offset": 100, "width": 1280, "height": 500}}, "region of interest"),
        ({"distortion_model": "mei"}, "found distortion model 'mei', expected one of plumb_bob"),
        ({"distortion_model": ""}, "5 distortion coefficients without the name of a model"),
        ({"d": (0.1,) * 8}, "found 8 coefficients of plumb_bob, expected 4 or 5"),
        ({"d": (0.1,) * 7}, "found 7 coefficients of plumb_bob, expected 4 or 5"),
        ({"d": (0.1,) * 14, "distortion_model": "rational_polynomial"}, "tilted sensor"),
        ({"d": (np.nan,) * 5}, "NaN or inf"),
        ({"d": (1e300,) * 5}, "finite numbers of at most 1e\\+06"),
        ({"k": np.eye(3).ravel()}, "fx = 1 px"),
        ({"width": 0}, "whole numbers of pixels"),
        ({"k": K.ravel()[:8]}, "K: found 8 numbers, expected 9"),
    ],
)
def test_camera_info_that_cannot_be_used(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(DataError, match=message):
        camera_from_camera_info(camera_info(**changes))


CAMCHAIN = """
cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.3, 0.1, 0.001, -0.002]
  distortion_model: radtan
  intrinsics: [700.0, 710.0, 640.0, 360.0]
  resolution: [1280, 720]
  rostopic: /cam0/image_raw
cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.11]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.02]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  distortion_coeffs: [0.01, 0.02, 0.0, 0.0]
  distortion_model: equidistant
  intrinsics: [700.0, 710.0, 640.0, 360.0]
  resolution: [1280, 720]
  rostopic: /cam1/image_raw
cam2:
  camera_model: ds
  distortion_coeffs: []
  distortion_model: none
  intrinsics: [-0.2, 0.6, 700.0, 710.0, 640.0, 360.0]
  resolution: [1280, 720]
"""


def test_a_kalibr_chain(tmp_path: Path) -> None:
    (tmp_path / "camchain.yaml").write_text(CAMCHAIN)
    cameras = cameras_from_kalibr(read_yaml(tmp_path / "camchain.yaml"))
    assert list(cameras) == ["cam0", "cam1", "cam2"]
    assert cameras["cam0"].model == BrownConradyCamera(INTRINSICS, PLUMB_BOB[:4])
    assert cameras["cam1"].model == FisheyeCamera(INTRINSICS, (0.01, 0.02, 0.0, 0.0))
    assert cameras["cam2"].model == DoubleSphereCamera(INTRINSICS, -0.2, 0.6)
    assert cameras["cam1"].topic == "/cam1/image_raw" and cameras["cam2"].topic == ""
    assert cameras["cam0"].cTb is None
    assert cameras["cam1"].cTb is not None
    assert cameras["cam1"].cTb.equals(gtsam.Pose3(gtsam.Rot3(), [-0.11, 0.0, 0.02]), 1e-12)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("camera_model: ds", "camera_model: omni", "cam2: found camera model 'omni', expected pinhole with"),
        ("camera_model: ds", "camera_model: eucm", "found camera model 'eucm'"),
        (
            "distortion_model: radtan",
            "distortion_model: fov",
            "cam0: found pinhole with the distortion 'fov'",
        ),
        ("[-0.2, 0.6, 700.0,", "[0.6, 700.0,", r"5 intrinsics of ds, expected \[xi, alpha, fu, fv, pu, pv\]"),
        ("[-0.2, 0.6,", "[-2.0, 0.6,", "cam2: found .* xi = -2"),
        ("resolution: [1280, 720]\n  rostopic: /cam0", "rostopic: /cam0", "no resolution"),
        ("0.0, -0.11]", "0.5, -0.11]", "T_cn_cnm1: found a 3x3 block"),
        ("cam_overlaps: [1]", "cam_overlaps: [1", "no YAML"),
        ("cam0:\n", "- cam0\n", "no YAML"),
    ],
)
def test_kalibr_chains_that_cannot_be_used(old: str, new: str, message: str) -> None:
    assert old in CAMCHAIN
    with pytest.raises(DataError, match=message):
        cameras_from_kalibr(parse_yaml(CAMCHAIN.replace(old, new), "camchain"))
    with pytest.raises(DataError, match="found the keys image_width, expected cam0"):
        cameras_from_kalibr({"image_width": 3})


@pytest.mark.parametrize("fisheye", [False, True])
def test_what_opencv_wrote(tmp_path: Path, fisheye: bool) -> None:
    path = tmp_path / "camera.yml"
    D = (0.01, 0.02, -0.01, 0.0) if fisheye else PLUMB_BOB
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("calibration_time", "Mon 23 Nov 2026 14:00:00")
    storage.write("image_width", 1280)
    storage.write("image_height", 720)
    storage.write("fisheye_model", int(fisheye))
    storage.write("camera_matrix", K)
    storage.write("distortion_coefficients", np.array(D).reshape(-1, 1))
    storage.release()
    model = camera_from_opencv(read_yaml(path), path)
    assert model == (FisheyeCamera(INTRINSICS, D) if fisheye else BrownConradyCamera(INTRINSICS, D))


def test_the_file_of_ros_camera_info_manager() -> None:
    text = """
image_width: 1280
image_height: 720
camera_name: front
camera_matrix: {rows: 3, cols: 3, data: [700, 0, 640, 0, 710, 360, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [-0.3, 0.1, 0.001, -0.002, 0.01]}
"""
    assert camera_from_opencv(parse_yaml(text, "front")) == BrownConradyCamera(INTRINSICS, PLUMB_BOB)
    with pytest.raises(DataError, match="found no camera_matrix, expected camera_matrix beside image_width"):
        camera_from_opencv({"image_width": 3})


KITTI_RAW = """calib_time: 09-Jan-2012 13:57:47
corner_dist: 9.950000e-02
S_02: 1.392000e+03 5.120000e+02
K_02: 9.597910e+02 0.000000e+00 6.960217e+02 0.000000e+00 9.569251e+02 2.241806e+02 0.000000e+00 0.000000e+00 1.0
D_02: -3.691481e-01 1.968681e-01 1.353473e-03 5.677587e-04 -6.770705e-02
R_rect_02: 9.998817e-01 1.511453e-02 -2.841595e-03 -1.511724e-02 9.998853e-01 -9.338510e-04 2.827154e-03 9.766976e-04 9.999955e-01
S_rect_02: 1.242000e+03 3.750000e+02
P_rect_02: 7.215377e+02 0.000000e+00 6.095593e+02 4.485728e+01 0.000000e+00 7.215377e+02 1.728540e+02 2.163791e-01 0.000000e+00 0.000000e+00 1.000000e+00 2.745884e-03
"""  # noqa: E501


def test_kitti_raw(tmp_path: Path) -> None:
    (tmp_path / "calib_cam_to_cam.txt").write_text(KITTI_RAW)
    table = read_kitti_raw(tmp_path / "calib_cam_to_cam.txt")
    raw = camera_from_kitti_raw(table, 2, rectified=False)
    assert (raw.name, raw.width, raw.height) == ("plumb_bob", 1392, 512)
    rectified = camera_from_kitti_raw(table, 2, rectified=True)
    assert rectified.intrinsics == PinholeCamera(721.5377, 721.5377, 609.5593, 172.854, 1242, 375)
    R = np.asarray(kitti_rectifying_rotation(table, 2).matrix())
    np.testing.assert_allclose(R, table["R_rect_02"].reshape(3, 3), atol=1e-6)
    with pytest.raises(DataError, match="found no S_03, expected S_03 beside"):
        camera_from_kitti_raw(table, 3, rectified=False)
    assert "calib_time" not in parse_kitti_raw(KITTI_RAW)


def test_nuscenes() -> None:
    record = {"camera_intrinsic": [[1266.4, 0.0, 816.3], [0.0, 1266.4, 491.5], [0.0, 0.0, 1.0]]}
    assert camera_from_nuscenes(record).intrinsics == PinholeCamera(1266.4, 1266.4, 816.3, 491.5, 1600, 900)
    nuimages = {**record, "camera_distortion": [-0.1, 0.01, 0.0, 0.0, 0.001]}
    assert camera_from_nuscenes(nuimages).name == "plumb_bob"
    with pytest.raises(DataError, match="no camera_intrinsic"):
        camera_from_nuscenes({"camera_intrinsic": []})
    with pytest.raises(DataError, match="6 coefficients"):
        camera_from_nuscenes({**record, "camera_distortion": [0.1] * 6})

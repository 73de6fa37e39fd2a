"""Images that are stamped with the camera's link in the place of its optical frame."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest

pytest.importorskip("rosbags")

from bags import CLOUD, EPOCH_NS, IMAGE, INFO, LIDAR_FRAME, writing

from sst_graph.cameras import BrownConradyCamera
from sst_graph.cameras.fisheye import FisheyeCamera
from sst_graph.data import open_source
from sst_graph.data.ros.link_frame import is_link
from sst_graph.data.two_clocks import TwoClockSource
from sst_graph.factors.camera import PinholeCamera
from sst_graph.metrics import FORWARD_R_OPTICAL
from sst_graph.types import Source

CAMERA = PinholeCamera(300.0, 300.0, 320.0, 180.0, 640, 360)
LENS = BrownConradyCamera(CAMERA)
LINK_T_LIDAR = gtsam.Pose3(gtsam.Rot3.Ypr(0.05, -0.03, 0.02), np.array([-0.3, 0.1, 0.4]))
OPTICAL_T_LIDAR = gtsam.Pose3(FORWARD_R_OPTICAL.inverse(), np.zeros(3)) * LINK_T_LIDAR


def ground_and_wall() -> np.ndarray:
    """(n, 3) float32 of a full turn: the ground 1.7 m below, and a wall 20 m ahead, up to 4 m."""
    azimuth, radius = np.meshgrid(np.radians(np.arange(360.0)), np.arange(4.0, 40.0, 2.0))
    ground = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), np.full(radius.shape, -1.7)], -1)
    y, z = np.meshgrid(np.arange(-15.0, 15.0, 0.3), np.arange(-1.5, 4.0, 0.3))
    wall = np.stack([np.full(y.shape, 20.0), y, z], -1)
    return np.concatenate([ground.reshape(-1, 3), wall.reshape(-1, 3)]).astype(np.float32)


POINTS = ground_and_wall()


def bag_with(path: Path, frame: str, frameTl: gtsam.Pose3, empty: int = 0) -> Path:
    """A drive of two scans, of which so many are all but empty."""
    table = np.zeros(len(POINTS), [(axis, "<f4") for axis in "xyz"])
    for axis, values in zip("xyz", POINTS.T, strict=True):
        table[axis] = values
    with writing(path, "mcap") as bag:
        make = bag.messages
        bag.add("/tf_static", make.transforms({(frame, LIDAR_FRAME): frameTl}), EPOCH_NS)
        bag.add(INFO, make.info(CAMERA), EPOCH_NS)
        for k in range(2):
            stamp_ns = EPOCH_NS + k * 100_000_000
            image = make.image(stamp_ns, np.full((360, 640, 3), 60, np.uint8))
            bag.add(IMAGE, replace(image, header=make.header(stamp_ns, frame)), stamp_ns)
            bag.add(CLOUD, make.cloud(stamp_ns, table[:10] if k < empty else table), stamp_ns)
    return path


def reason_of(source: Source) -> str:
    assert isinstance(source, TwoClockSource)
    return source.properties.nominal_reason


@pytest.mark.parametrize("frame", ["camera_link", "usb_cam"])
def test_the_pose_in_the_link_becomes_that_in_the_optical_axes(frame: str, tmp_path: Path) -> None:
    source = open_source(bag_with(tmp_path / "drive", frame, LINK_T_LIDAR))
    assert source.nominal is not None and source.nominal.equals(OPTICAL_T_LIDAR, 1e-9)
    assert f"{frame!r} shows to be the camera's link (x forward" in reason_of(source)


def test_a_first_cloud_that_is_all_but_empty_decides_nothing(tmp_path: Path) -> None:
    """As of a LiDAR that starts up."""
    source = open_source(bag_with(tmp_path / "drive", "camera_link", LINK_T_LIDAR, empty=1))
    assert source.nominal is not None and source.nominal.equals(OPTICAL_T_LIDAR, 1e-9)


def test_optical_axes_stay_whatever_their_frame_is_called(tmp_path: Path) -> None:
    source = open_source(bag_with(tmp_path / "drive", "camera_link", OPTICAL_T_LIDAR))
    assert source.nominal is not None and source.nominal.equals(OPTICAL_T_LIDAR, 1e-9)
    assert "link (" not in reason_of(source)


def test_only_what_shows_to_be_a_link_is_one() -> None:
    assert is_link("camera", LINK_T_LIDAR, POINTS, LENS)
    assert not is_link("camera_optical", LINK_T_LIDAR, POINTS, LENS)
    # A camera that looks down at the ground, and one that looks where the LiDAR measures nothing.
    down = gtsam.Pose3(gtsam.Rot3.Rx(np.pi), np.zeros(3))
    nearer = POINTS * np.float32([0.1, 0.1, 1.0])
    assert not is_link("camera", down, np.concatenate([POINTS, nearer]), LENS)
    # The same where the LiDAR has no point in its picture.
    far = POINTS[np.linalg.norm(POINTS[:, :2], axis=1) > 10.0]
    assert not is_link("camera", down, far, LENS)
    ahead = POINTS[POINTS[:, 0] > 3.0]
    behind = gtsam.Pose3(gtsam.Rot3.Rz(np.pi), np.zeros(3)) * LINK_T_LIDAR
    assert not is_link("camera", behind, ahead, LENS)
    # By either axes a fisheye of 190 deg sees much.
    fisheye = FisheyeCamera(replace(CAMERA, fx=115.0, fy=115.0), (0.0, 0.0, 0.0, 0.0))
    assert not is_link("camera", LINK_T_LIDAR, POINTS, fisheye)
    assert not is_link("camera", LINK_T_LIDAR, POINTS[:0], LENS)

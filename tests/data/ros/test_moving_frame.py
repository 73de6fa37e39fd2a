"""Clouds of odometry and mapping nodes, in a frame that stays in the world."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest

pytest.importorskip("rosbags")

from bags import CAMERA_FRAME, CLOUD, EPOCH_NS, IMAGE, INFO, writing

from sst_graph.batch.causes import with_causes
from sst_graph.batch.config import CalibrationConfig
from sst_graph.cli import main
from sst_graph.data import open_source
from sst_graph.data.info.facts import facts_of
from sst_graph.data.ros.transforms import Transforms
from sst_graph.drive.preparation import prepare_drive
from sst_graph.factors.camera import PinholeCamera
from sst_graph.result import CalibrationResult, FrameId
from sst_graph.types import Guess

CAMERA = PinholeCamera(30.0, 30.0, 16.0, 12.0, 32, 24)
FIXED = gtsam.Pose3(gtsam.Rot3.Rz(0.3), np.array([1.0, 0.0, 0.5]))


def bag(path: Path, cloud_frame: str, moving: tuple[str, str] | None, fixed: tuple[str, str] | None) -> Path:
    """Clouds in a frame; one transform of /tf that advances, one that does not."""
    points = np.zeros(200, [("x", "<f4"), ("y", "<f4"), ("z", "<f4")])
    points["x"], points["y"] = np.arange(200) % 20 + 2.0, np.arange(200) // 20 - 5.0
    with writing(path, "mcap") as out:
        make = out.messages
        out.add(INFO, make.info(CAMERA), EPOCH_NS)
        for k in range(4):
            stamp_ns = EPOCH_NS + k * 100_000_000
            poses = {fixed: FIXED} if fixed else {}
            if moving:
                poses[moving] = gtsam.Pose3(gtsam.Rot3(), np.array([0.5 * k, 0.0, 0.0]))
            out.add("/tf", make.transforms(poses, stamp_ns), stamp_ns)
            pixels = np.random.default_rng(k).integers(0, 255, (24, 32, 3), np.uint8)
            out.add(IMAGE, make.image(stamp_ns, pixels), stamp_ns)
            points["z"] = np.random.default_rng(k).normal(0.0, 0.02, 200)
            cloud = replace(make.cloud(stamp_ns, points), header=make.header(stamp_ns, cloud_frame))
            out.add(CLOUD, cloud, stamp_ns)
    return path


def doubts(path: Path) -> str:
    facts = facts_of(open_source(path))
    assert facts is not None
    return " ".join(facts.doubts)


@pytest.mark.parametrize(
    ("frame", "moving", "fixed"),
    [
        ("odom", ("odom", "base_link"), ("base_link", CAMERA_FRAME)),
        ("map", ("map", "base_link"), ("base_link", CAMERA_FRAME)),
        ("camera_init", ("camera_init", "body"), ("base_link", CAMERA_FRAME)),
        ("/car/odom_frame", ("car/odom_frame", CAMERA_FRAME), None),
    ],
)
def test_they_are_refused_where_transforms_show_it(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    frame: str,
    moving: tuple[str, str],
    fixed: tuple[str, str] | None,
) -> None:
    path = bag(tmp_path / "drive", frame, moving, fixed)
    assert main(["info", str(path)]) == 2
    error = capsys.readouterr().err
    assert f"{CLOUD}: found clouds in the frame {frame.lstrip('/')!r}, which moves against" in error
    assert "the topic of the LiDAR's driver (--cloud-topic)" in error


def test_a_name_alone_or_transforms_alone_are_named(tmp_path: Path) -> None:
    by_name = bag(tmp_path / "name", "world", None, None)
    assert doubts(by_name).startswith("the clouds' frame 'world' is called as one that stays in the world")
    by_transforms = bag(tmp_path / "transforms", "start", ("start", "base"), ("base", CAMERA_FRAME))
    assert doubts(by_transforms).startswith("by transforms the clouds' frame 'start' moves against")
    # Objects that are tracked move against the LiDAR, and the vehicle in the world.
    assert doubts(bag(tmp_path / "object", "lidar", ("lidar", "car_1"), ("lidar", CAMERA_FRAME))) == ""
    assert doubts(bag(tmp_path / "vehicle", "lidar", ("odom", "lidar"), ("lidar", CAMERA_FRAME))) == ""
    # Images and clouds in one frame, which moves in the world.
    assert doubts(bag(tmp_path / "one", CAMERA_FRAME, ("odom", CAMERA_FRAME), None)) == ""
    # A vehicle that stands still.
    assert doubts(bag(tmp_path / "still", "camera_link", None, ("camera_link", CAMERA_FRAME))) == ""


def test_a_doubt_is_a_reason_of_a_result_that_is_not_ok(tmp_path: Path) -> None:
    source = open_source(bag(tmp_path / "drive", "world", None, None))
    drive, config = prepare_drive(source, []), CalibrationConfig(method="edges", find_causes=False)
    result = CalibrationResult(
        status="unobservable",
        reasons=("no match",),
        T_camera_lidar=gtsam.Pose3(),
        time_offset_s=0.0,
        covariance=np.eye(7),
        frames_used=(),
        camera=CAMERA,
    )
    reasons = with_causes(result, [drive], Guess(None, 0.0), config).reasons
    assert reasons[0] == f"drive: {doubts(tmp_path / 'drive')}" and "no match" in reasons
    # It is no measurement: a status stays, and a cause that is found stands before it.
    estimated = replace(result, frames_used=(FrameId("drive", 0),))
    assert with_causes(estimated, [drive], Guess(None, 0.0), config).status == "unobservable"
    far = Guess(gtsam.Pose3(gtsam.Rot3(), np.array([0.0, 0.0, 3000.0])), 0.0)
    found = with_causes(estimated, [drive], far, config)
    where = [k for k, reason in enumerate(found.reasons) if "called as one that stays" in reason]
    assert where == [1] and found.status == "not_converged"
    fine = with_causes(replace(result, status="ok"), [drive], Guess(None, 0.0), config).reasons
    assert not any("called as one that stays" in reason for reason in fine)


def test_a_frame_moves_against_another_by_the_chain_between_them() -> None:
    found = Transforms()
    for k in range(2):
        found.add_pose("odom", "base", gtsam.Pose3(gtsam.Rot3(), np.array([k, 0.0, 0.0])))
        found.add_pose("base", "lidar", FIXED)
        found.add_pose("base", "camera", FIXED)
    assert found.moves("odom", "camera") and found.moves("camera", "odom") and found.moves("odom", "none")
    assert not found.moves("lidar", "camera") and not found.moves("lidar", "none")

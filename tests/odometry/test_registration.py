"""Scan to scan and loop closures, on a small drive there and back."""

from __future__ import annotations

from functools import cache

import gtsam
import numpy as np
import pytest
from stored import simulated

from sst_graph.errors import DataError
from sst_graph.odometry import RegisteredScan, loop_closures, scan_to_scan
from sst_graph.simulator import SimulatedDrive, SimulationConfig
from sst_graph.types import Scan


@cache
def drive() -> tuple[SimulatedDrive, list[RegisteredScan], list[gtsam.Pose3]]:
    """Every third frame of a drive of 4 s: its scans, ready, and their true poses."""
    source = simulated(
        SimulationConfig(
            seed=3,
            frames=13,
            width=64,
            height=32,
            frame_rate_hz=3.2,
            motion="there_and_back",
            azimuth_step_deg=1.0,
            moving_fraction=0.0,
        )
    )
    scans = [RegisteredScan(frame.scan) for frame in source if frame.scan is not None]
    return source, scans, [source.wTl(stamp * 1e-9) for stamp in source.stamps_ns]


def test_the_drive_goes_there_and_back() -> None:
    source, _, poses = drive()
    s = source.street.ego.s
    speed = np.gradient(s, source.street.ego.t)
    assert speed.max() > 1.0 and speed.min() < -1.0
    away = [np.linalg.norm(pose.translation() - poses[0].translation()) for pose in poses]
    assert max(away) > 2.0 and away[-1] < 0.3
    # it faces the same way throughout
    turn = gtsam.Rot3.Logmap(poses[0].between(poses[-1]).rotation())
    assert np.degrees(np.linalg.norm(turn)) < 2.0


def test_scan_to_scan_is_odometry() -> None:
    _, scans, poses = drive()
    motions = scan_to_scan(scans)
    assert len(motions) == len(scans) - 1 and all(motion.ok for motion in motions)
    errors = np.array(
        [
            gtsam.Pose3.Logmap(poses[k].between(poses[k + 1]).between(motion.aTb))
            for k, motion in enumerate(motions)
        ]
    )
    assert np.degrees(np.abs(errors[:, :3]).max()) < 0.1 and np.abs(errors[:, 3:]).max() < 0.04
    sigmas = np.array([np.sqrt(np.diag(motion.covariance)) for motion in motions])
    normalized = np.mean((errors / sigmas) ** 2, axis=0)
    assert (normalized < 4.0).all()


def test_loops_close_between_scans_of_one_place() -> None:
    source, scans, poses = drive()
    # poses that have drifted by half a metre and a degree
    drifted = [
        pose * gtsam.Pose3.Expmap(0.04 * k * np.array([0, 0, 0.03, 1, 1, 0])) for k, pose in enumerate(poses)
    ]
    closures = loop_closures(scans, drifted, every=2, min_seconds=1.5, max_distance_m=2.0)
    assert len(closures) >= 3
    for closure in closures:
        seconds = (source.stamps_ns[closure.second] - source.stamps_ns[closure.first]) * 1e-9
        assert seconds >= 1.5 and closure.motion.ok
        true = poses[closure.first].between(poses[closure.second])
        assert np.linalg.norm(true.translation()) < 3.0
        off = true.localCoordinates(closure.motion.aTb)
        assert np.degrees(np.linalg.norm(off[:3])) < 0.1 and np.linalg.norm(off[3:]) < 0.05


def test_what_does_not_overlap_closes_no_loop() -> None:
    _, scans, poses = drive()
    far = gtsam.Pose3(gtsam.Rot3.Yaw(1.5), np.array([60.0, 60.0, 20.0]))
    motion = scans[0].motion_to(scans[-1], far)
    assert not motion.ok and motion.aTb.equals(far, 1e-9)
    assert np.sqrt(motion.covariance[3, 3]) > 1.0
    assert not loop_closures(scans, poses, every=2, min_seconds=100.0)


def test_refuses_what_is_no_pair() -> None:
    _, scans, _ = drive()
    with pytest.raises(DataError, match="rising stamps"):
        scans[1].motion_to(scans[0], gtsam.Pose3())
    empty = Scan(0, np.zeros((3, 3), np.float32), np.zeros(3, np.uint8))
    with pytest.raises(DataError, match="0 points in range"):
        RegisteredScan(empty)

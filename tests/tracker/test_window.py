"""The tracker's window: dynamic objects are those of the batch, and what is forgotten."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from sst_graph.drive.preparation import Drive, ScanFeatures
from sst_graph.factors.camera import PinholeCamera
from sst_graph.features.lidar_edges import Boundaries
from sst_graph.objects.dynamic_objects import find_dynamic_objects
from sst_graph.objects.tracks import object_tracks, scan_poses
from sst_graph.objects.velocity import ObjectVelocity
from sst_graph.tracker.window.window import OBJECT_MEMORY, Window
from sst_graph.types import RelativeMotion, SemanticClass

CAMERA = PinholeCamera(100.0, 100.0, 50.0, 40.0, 101, 81)
VEHICLE, PERIOD_NS = SemanticClass.VEHICLE, 103_000_000
STEP = gtsam.Pose3(gtsam.Rot3.Rz(0.01), np.array([0.6, 0.0, 0.0]))


def _objects(k: int) -> dict[int, np.ndarray]:
    """Centres in the world: of objects parked, moving, parting, arriving, and of one that leaves."""
    t = k * PERIOD_NS * 1e-9
    found = {
        0: np.array([20.0, 5.0, 0.0]),
        1: np.array([15.0 + 6.0 * t, -6.0, 0.0]),
        2: np.array([30.0 + 4.0 * max(0.0, t - 1.0), 12.0, 0.0]),
        3: np.array([40.0 - 5.0 * min(t, 1.2), -14.0, 0.0]),
    }
    if k < 14:
        found[4] = np.array([60.0 - 8.0 * t, 20.0, 0.0])
    return found


def _scan(k: int, wTl: gtsam.Pose3) -> ScanFeatures:
    centres = {n: wTl.transformTo(centre) for n, centre in _objects(k).items()}
    lPs = np.stack(list(centres.values()))
    m, nothing = len(lPs), np.zeros(0)
    edges = Boundaries(
        lPs, lPs, np.ones(m, np.intp), np.zeros(m), np.zeros(m, np.uint8), np.array(list(centres))
    )
    empty = np.zeros((0, 3))
    return ScanFeatures(
        k,
        k * PERIOD_NS,
        {VEHICLE: edges},
        empty,
        np.zeros(0, np.uint8),
        nothing,
        empty.astype(np.float32),
        nothing.astype(np.float32),
    )


def _drive(scans: int) -> Drive:
    poses = [gtsam.Pose3()]
    for _ in range(scans - 1):
        poses.append(poses[-1] * STEP)
    motions = tuple(
        RelativeMotion(k * PERIOD_NS, (k + 1) * PERIOD_NS, STEP, np.eye(6)) for k in range(scans - 1)
    )
    return Drive("made", CAMERA, tuple(_scan(k, pose) for k, pose in enumerate(poses)), (), motions, ())


def _window(drive: Drive, scans: int) -> Window:
    window = Window(CAMERA, scans)
    for k, scan in enumerate(drive.scans):
        window.add_scan(scan, drive.lidar_motions[k - 1] if k else None)
    return window


def test_dynamic_objects_are_those_of_the_batch() -> None:
    drive = _drive(30)
    tracks = object_tracks(drive)
    speeds = find_dynamic_objects(drive, tracks)
    window = _window(drive, 40)
    window.dynamics.test_all()
    found, moving = window.objects_of(range(30))
    assert found == tracks
    assert {number for _, _, number in speeds} == {1, 2, 3, 4}
    assert set(moving) == set(speeds)
    for name, mover in speeds.items():
        assert moving[name].speed_mps == pytest.approx(mover.speed_mps)
        assert moving[name].unknown_mps == pytest.approx(mover.unknown_mps)


def test_poses_are_kept_as_long_as_their_scans() -> None:
    drive = _drive(20)
    window, poses = _window(drive, 8), scan_poses(drive)
    numbers = [number for number, _ in window.scans]
    assert 0 < len(numbers) <= 8 and sorted(window.poses) == numbers
    assert all(window.poses[number].equals(poses[number], 1e-9) for number in numbers)


def test_an_object_that_starts_to_move_changes_past_scans() -> None:
    drive = _drive(30)
    window = Window(CAMERA, 40)
    noticed, later = None, set[int]()
    for k, scan in enumerate(drive.scans):
        window.dynamics.changed_scans.clear()
        window.add_scan(scan, drive.lidar_motions[k - 1] if k else None)
        if noticed is not None:
            later |= window.dynamics.changed_scans
        elif (VEHICLE, 2) in window.dynamics.path_speeds.get(k, {}):
            noticed = k
    assert noticed is not None and 10 < noticed < 18
    moving = {n for n, speeds in window.dynamics.path_speeds.items() if (VEHICLE, 2) in speeds}
    before = {n for n in moving if n < noticed}
    assert before and before <= later


def test_an_object_that_moved_lately_is_recently_moving() -> None:
    """Number 3 stops at 1.2 s: it may pass for one that stands, and is recently_moving for a while."""
    drive = _drive(40)
    window, recently_moving = Window(CAMERA, 50), {}
    for k, scan in enumerate(drive.scans):
        window.add_scan(scan, drive.lidar_motions[k - 1] if k else None)
        names = {track: number for (_, number), track in window.tracks[k].items()}
        recently_moving[k] = {names[track] for track in window.dynamics.recently_moving() if track in names}
        assert {n for _, n in window.dynamics.path_speeds.get(k, {})} <= recently_moving[k]
    assert 3 not in {n for _, n in window.dynamics.path_speeds.get(20, {})} and 3 in recently_moving[20]
    assert 3 not in recently_moving[39] and {1, 2} <= recently_moving[39]
    assert all(0 not in names for names in recently_moving.values())
    # One whose velocity is known at its newest sighting may be asked.
    (one,) = [track for (_, number), track in window.tracks[39].items() if number == 1]
    assert one in window.dynamics.recently_moving()
    window.dynamics.velocities.found[one] = {39: ObjectVelocity(np.array([6.0, 0.0, 0.0]), 0.2)}
    assert one not in window.dynamics.recently_moving()


def test_nothing_grows_with_the_drive() -> None:
    short, long = _window(_drive(70), 10), _window(_drive(140), 10)
    for window in (short, long):
        first = window.first_scan
        assert len(window.scans) == 10
        assert min([*window.tracks, *window.dynamics.path_speeds]) >= first
        kept = [s for seen in window.dynamics.detections.values() for s in seen]
        assert window.last_stamp_ns is not None
        assert min(s.stamp_ns for s in kept) >= window.last_stamp_ns - 1_600_000_000
    assert len(long.objects.live) == len(short.objects.live) == 4
    assert max(long.objects.last_seen.values()) - min(long.objects.last_seen.values()) <= OBJECT_MEMORY


def test_scans_that_are_cut_off_leave_nothing_behind() -> None:
    """A checkpoint made right after an alarm holds the scans that are left, and what is known of these."""
    window = _window(_drive(12), 40)
    window.keep_scans(4)
    assert (
        [number for number, _ in window.scans] == sorted(window.dynamics.occupancy.shares) == [8, 9, 10, 11]
    )

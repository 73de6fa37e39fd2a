"""Clouds in the vehicle's axes, moved to those of the LiDAR as they are read."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from stored import simulated, written

from sst_graph import open_source
from sst_graph.data.lidar_pose import (
    LidarFrameSource,
    TimingFromCloud,
    in_lidar_axes,
    lidar_pose_text,
    parse_lidar_pose,
)
from sst_graph.data.scan_order import rings_from_order
from sst_graph.data.source_view import ChangedSource
from sst_graph.diagnosis.lasers import other_axes
from sst_graph.drive.input_statistics import StatisticsCollector
from sst_graph.drive.preparation import Drive
from sst_graph.errors import ConfigError
from sst_graph.simulator import SimulationConfig
from sst_graph.sweep_timing import SweepTiming
from sst_graph.types import Scan, Source

POSE = "1.4,0.1,1.6,0,2,17"
STREET = SimulationConfig(seed=2, frames=3, width=207, height=62)


class _InVehicleAxes(ChangedSource):
    """The clouds of a source as a vehicle's driver would publish them."""

    def __init__(self, source: Source, pose: gtsam.Pose3) -> None:
        self.source, self.pose = source, pose

    def changed_scan(self, scan: Scan) -> Scan:
        points = np.array([self.pose.transformFrom(p) for p in scan.points.astype(np.float64)])
        return replace(scan, points=points.astype(np.float32), rings=None)


def test_a_pose_is_read_as_urdf_writes_it() -> None:
    pose = parse_lidar_pose(" 1, -2, 0.5, 0, 0, 90 ")
    np.testing.assert_allclose(pose.transformFrom(np.array([3.0, 0.0, 0.0])), [1.0, 1.0, 0.5], atol=1e-12)
    assert parse_lidar_pose("1,2,3").equals(gtsam.Pose3(gtsam.Rot3(), np.array([1.0, 2.0, 3.0])), 1e-12)
    again = parse_lidar_pose(lidar_pose_text(parse_lidar_pose(POSE)))
    assert again.equals(parse_lidar_pose(POSE), 1e-9)
    assert lidar_pose_text(parse_lidar_pose("1,2,3")) == "1.00,2.00,3.00"


@pytest.mark.parametrize("text", ["", "1,2", "1,2,x", "1,2,3,4", "nan,0,0", "1400,0,1600", "0,0,0,0,0,700"])
def test_what_is_no_pose_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="lidar pose"):
        open_source("none", lidar_pose=text)


def test_times_by_azimuth_are_those_about_the_lidar() -> None:
    """Points as the vehicle's driver publishes them get the times that they have in the LiDAR's own axes."""
    drive, pose = simulated(STREET), parse_lidar_pose(POSE)
    scan = drive[1].scan
    assert scan is not None
    timing = SweepTiming(-1.0, np.pi, 0.1)
    in_vehicle = np.array([pose.transformFrom(p) for p in scan.points.astype(np.float64)], np.float32)
    own, seen = timing.offsets_s(scan.points), TimingFromCloud.of(timing, pose).offsets_s(in_vehicle)
    np.testing.assert_allclose(seen, own, atol=1e-6)
    assert np.ptp(own) > 0.02 and np.abs(timing.offsets_s(in_vehicle) - own).max() > 1e-3


def test_a_named_sweep_and_a_pose_go_together() -> None:
    options: dict[str, Any] = {"lidar_pose": "0.5,0,0", "sweep": "counterclockwise"}
    first, scan, last = (frame.scan for frame in open_source(written(STREET), **options))
    assert first is not None and last is not None and scan is not None and scan.offsets_s is not None
    # The scan is in the LiDAR's axes by now, and so are its azimuths.
    turn = np.arctan2(scan.points[:, 1], scan.points[:, 0]) / (2.0 * np.pi)
    period_s = 0.5e-9 * (last.stamp_ns - first.stamp_ns)
    np.testing.assert_allclose(scan.offsets_s, period_s * turn, atol=1e-6)


def test_the_drive_is_as_in_the_axes_of_the_lidar() -> None:
    drive, pose = simulated(STREET), parse_lidar_pose(POSE)
    seen = LidarFrameSource(_InVehicleAxes(drive, pose), pose)
    for own, moved in zip(drive, seen, strict=True):
        assert own.scan is not None and moved.scan is not None
        np.testing.assert_allclose(moved.scan.points, own.scan.points, atol=1e-4)
        # Lasers that nobody numbered are those that the order shows from there.
        assert moved.scan.rings is not None and own.scan.rings is not None
        assert len(np.unique(moved.scan.rings)) == len(np.unique(own.scan.rings))
    given = drive.nominal * pose.inverse()
    assert drive.nominal is not None and seen.nominal is not None and seen.truth is not None
    in_vehicle = LidarFrameSource(drive, pose)
    assert (in_vehicle.nominal or gtsam.Pose3()).equals(drive.nominal * pose, 1e-9)
    assert (given * pose).equals(drive.nominal, 1e-9)
    assert drive.truth is not None and seen.truth.cTl.equals(drive.truth.cTl * pose, 1e-9)


def test_lasers_that_the_data_number_keep_their_numbers() -> None:
    """A driver that counts from below, and whose upper lasers have no return in this scan."""
    azimuth, elevation = np.meshgrid(np.linspace(-3.1, 3.1, 200), np.radians([-2.0, -5.0, -9.0, -14.0]))
    directions = [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)]
    points = (10.0 * np.stack(directions, -1)).reshape(-1, 3).astype(np.float32)
    lasers = np.repeat(np.array([5, 4, 3, 2], np.uint16), 200)
    pose = parse_lidar_pose("0.5,0,1")
    in_vehicle = points + pose.translation().astype(np.float32)
    scan = Scan(0, in_vehicle, np.zeros(len(points), np.uint8), rings=lasers)
    moved = in_lidar_axes(scan, pose)
    assert moved.rings is not None and np.array_equal(moved.rings, lasers)
    unnumbered = in_lidar_axes(replace(scan, rings=rings_from_order(in_vehicle)), pose)
    assert unnumbered.rings is not None and np.array_equal(unnumbered.rings, np.repeat(np.arange(4), 200))


def test_every_loader_takes_the_pose() -> None:
    plain, moved = open_source(written(STREET)), open_source(written(STREET), lidar_pose="1,0,0")
    assert isinstance(moved, LidarFrameSource)
    one, other = plain[1].scan, moved[1].scan
    assert one is not None and other is not None
    np.testing.assert_allclose(other.points, one.points - np.array([1.0, 0.0, 0.0]), atol=1e-5)


def _prepared(source: Source) -> Drive:
    statistics = StatisticsCollector(len(source))
    for frame in source:
        statistics.add(frame)
    frames: Any = tuple(source)
    return Drive("a", source.camera, frames, (), (), (), statistics=statistics.statistics())


@pytest.mark.slow
def test_clouds_in_other_axes_are_told_by_where_their_rings_stand_out() -> None:
    drive, pose = simulated(STREET), parse_lidar_pose(POSE)
    found = other_axes([_prepared(_InVehicleAxes(drive, pose))])
    assert found is not None and "not in the axes of the LiDAR" in found.cause
    said = found.sentence.split("--lidar-pose=")[1].split(" ")[0]
    apart = parse_lidar_pose(said).between(pose)
    assert np.linalg.norm(apart.translation()) < 0.1
    # Its turn about its own axis is free.
    assert np.degrees(np.arccos(apart.rotation().matrix()[2, 2])) < 0.3
    assert other_axes([_prepared(drive)]) is None


def test_clouds_without_rings_have_no_other_origin() -> None:
    rng = np.random.default_rng(3)

    class Shapeless(_InVehicleAxes):
        def changed_scan(self, scan: Scan) -> Scan:
            away = rng.normal(size=(5000, 3)) * [20.0, 20.0, 2.0]
            return Scan(scan.stamp_ns, away.astype(np.float32), np.zeros(5000, np.uint8))

    assert other_axes([_prepared(Shapeless(simulated(STREET), gtsam.Pose3()))]) is None


DATA = Path(__file__).resolve().parents[3] / "shared" / "data"


@pytest.mark.skipif(not DATA.is_dir(), reason="no real drives here")
@pytest.mark.parametrize("name", ["stop", "parked"])
@pytest.mark.slow
def test_the_origin_of_a_real_lidar_is_found(name: str) -> None:
    drive = open_source(DATA / f"kitti_2011_09_26_{name}", frames="0:3")
    assert other_axes([_prepared(drive)]) is None
    pose = gtsam.Pose3(gtsam.Rot3.Ry(0.02), np.array([0.8, 0.0, 1.73]))
    found = other_axes([_prepared(_InVehicleAxes(drive, pose))])
    assert found is not None
    said = parse_lidar_pose(found.sentence.split("--lidar-pose=")[1].split(" ")[0])
    assert np.linalg.norm((said.translation() - pose.translation())[:2]) < 0.25

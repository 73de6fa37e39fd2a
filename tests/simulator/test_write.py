"""A simulated drive on disk: layout, poses, truth, all or nothing."""

from __future__ import annotations

import json
from pathlib import Path

import gtsam
import numpy as np
import pytest

from sst_graph.data import open_source
from sst_graph.errors import ConfigError
from sst_graph.simulator import SimulatedDrive, SimulationConfig, simulate, write_drive


@pytest.fixture(scope="module")
def drive() -> SimulatedDrive:
    return simulate(
        SimulationConfig(
            seed=6, frames=3, width=320, height=96, rolling=True, motion="turning", azimuth_step_deg=1.0
        )
    )


@pytest.fixture(scope="module")
def folder(drive: SimulatedDrive, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_drive(drive, tmp_path_factory.mktemp("simulated") / "street")


def test_layout(folder: Path) -> None:
    assert (folder.parent.name, folder.name) == ("sequences", "00")
    assert sorted(p.name for p in folder.iterdir()) == [
        "calib.txt",
        "groundtruth.json",
        "image_2",
        "labels",
        "poses.txt",
        "semantic_2",
        "times.txt",
        "velodyne",
        "velodyne_times",
    ]
    for name, suffix in (("image_2", "png"), ("semantic_2", "png"), ("velodyne", "bin"), ("labels", "label")):
        assert sorted(p.name for p in (folder / name).iterdir()) == [f"{k:06d}.{suffix}" for k in range(3)]


def test_what_is_read_is_what_was_simulated(drive: SimulatedDrive, folder: Path) -> None:
    source = open_source(folder.parent.parent)
    assert source.nominal is not None and source.truth is not None
    assert source.nominal.equals(drive.nominal, 1e-9) and source.truth.cTl.equals(drive.truth.cTl, 1e-12)
    assert source.truth.time_offset_s == drive.truth.time_offset_s
    assert source.camera.fx == pytest.approx(drive.camera.fx) and source.camera.width == 320
    for read, made in zip(source, drive, strict=True):
        assert read.scan is not None and made.scan is not None
        assert read.image is not None and made.image is not None
        assert read.scan.stamp_ns == made.scan.stamp_ns
        np.testing.assert_array_equal(read.scan.points, made.scan.points)
        np.testing.assert_array_equal(read.scan.offsets_s, made.scan.offsets_s)
        np.testing.assert_array_equal(read.scan.classes, made.scan.classes)
        np.testing.assert_array_equal(read.scan.instances, made.scan.instances)
        np.testing.assert_array_equal(read.scan.rings, made.scan.rings)
        np.testing.assert_array_equal(read.image.mask, made.image.mask)
        np.testing.assert_array_equal(read.image.pixels, made.image.pixels)


def test_poses_give_the_lidars_motion_with_tr(drive: SimulatedDrive, folder: Path) -> None:
    lines = (folder / "calib.txt").read_text().splitlines()
    numbers = next(line for line in lines if line.startswith("Tr:")).split()[1:]
    Tr = np.vstack([np.array(numbers, float).reshape(3, 4), [0, 0, 0, 1]])
    poses = np.loadtxt(folder / "poses.txt").reshape(-1, 3, 4)
    truth = json.loads((folder / "groundtruth.json").read_text())
    for k in range(3):
        pose = np.vstack([poses[k], [0, 0, 0, 1]])
        moved = np.linalg.inv(Tr) @ pose @ Tr
        expected = drive.wTl(drive.stamps_ns[0] * 1e-9).between(drive.wTl(drive.stamps_ns[k] * 1e-9))
        np.testing.assert_allclose(moved, expected.matrix(), atol=1e-9)
        camera = gtsam.Pose3(np.array(truth["T_world_camera"][k]))
        lidar = drive.wTl(drive.stamps_ns[k] * 1e-9 + truth["time_offset_s"])
        assert camera.between(lidar).equals(gtsam.Pose3(np.array(truth["T_camera_lidar"])), 1e-9)


def test_an_existing_folder_is_kept_without_overwrite(drive: SimulatedDrive, folder: Path) -> None:
    before = (folder / "times.txt").read_bytes()
    with pytest.raises(ConfigError, match="not empty"):
        write_drive(drive, folder.parent.parent)
    assert (folder / "times.txt").read_bytes() == before


def test_progress_is_reported_and_a_failure_leaves_nothing(drive: SimulatedDrive, tmp_path: Path) -> None:
    calls: list[tuple[int, int]] = []

    def progress(done: int, total: int) -> None:
        calls.append((done, total))
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_drive(drive, tmp_path / "street", progress=progress)
    assert calls == [(1, 3), (2, 3)]
    assert list(tmp_path.iterdir()) == []

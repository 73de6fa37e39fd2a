"""One drive in every layout: the same frames, and from them the same calibration."""

from __future__ import annotations

import dataclasses
import re
import shutil
from dataclasses import asdict
from pathlib import Path

import gtsam
import numpy as np
import pytest
from layouts import EPOCH_NS, as_folder, as_kitti_raw, as_nuscenes, row, write_raw_calibration
from stored import written
from streets import CROWDED_STREET

from sst_graph import CalibrationConfig, calibrate
from sst_graph.cameras import BrownConradyCamera, Rectification
from sst_graph.cli import main
from sst_graph.data import open_source
from sst_graph.data.info import drive_info, info_text
from sst_graph.data.kept_drive import KeptDrive
from sst_graph.errors import DataError
from sst_graph.types import Frame, SemanticClass, Source, intensities_of


def stamped_before(frame: Frame, seconds_ns: int) -> Frame:
    """The frame, its stamps earlier."""
    scan, image = frame.scan, frame.image
    return dataclasses.replace(
        frame,
        scan=scan and dataclasses.replace(scan, stamp_ns=scan.stamp_ns - seconds_ns),
        image=image and dataclasses.replace(image, stamp_ns=image.stamp_ns - seconds_ns),
    )


def assert_same_drive(found: Source, wanted: Source, later_ns: int = 0) -> None:
    assert [stamped_before(frame, later_ns) for frame in found] == list(wanted)
    assert found.nominal is not None and wanted.nominal is not None
    assert found.nominal.equals(wanted.nominal, 1e-10)
    np.testing.assert_allclose(found.camera.matrix, wanted.camera.matrix, atol=1e-9)
    assert (found.camera.width, found.camera.height) == (wanted.camera.width, wanted.camera.height)


def test_kitti_raw_brings_the_frames_of_kitti_odometry(kitti_drive: Path, tmp_path: Path) -> None:
    drive = as_kitti_raw(kitti_drive, tmp_path / "raw")
    for path in (drive, drive.parent, drive.parent.parent):
        source = open_source(path)
        assert source.name == "2011_09_26_drive_0005_sync"
        assert_same_drive(source, open_source(kitti_drive), EPOCH_NS)


@pytest.mark.parametrize("cloud", [".bin", ".npz"])
def test_a_folder_brings_the_frames_of_kitti_odometry(kitti_drive: Path, tmp_path: Path, cloud: str) -> None:
    source = open_source(as_folder(kitti_drive, tmp_path / "street", cloud))
    assert source.name == "street"
    assert_same_drive(source, open_source(kitti_drive))


def test_every_layout_says_where_its_start_comes_from(kitti_drive: Path, tmp_path: Path) -> None:
    folder = as_folder(kitti_drive, tmp_path / "street")
    for drive, reason in {
        kitti_drive: "by calib.txt",
        as_kitti_raw(kitti_drive, tmp_path / "raw"): "by calib_velo_to_cam.txt and calib_cam_to_cam.txt",
        as_nuscenes(kitti_drive, tmp_path / "nuscenes"): "by calibrated_sensor.json",
        folder: "by extrinsic.yaml",
    }.items():
        sequence = "61" if reason == "by calibrated_sensor.json" else None
        assert drive_info(open_source(drive, sequence=sequence)).nominal_reason == reason
    (folder / "extrinsic.yaml").unlink()
    info = drive_info(open_source(folder))
    assert not info.nominal and info.nominal_reason == "no extrinsic.yaml"


def test_points_at_the_origin_are_left_out_in_every_layout(kitti_drive: Path, tmp_path: Path) -> None:
    """With their labels; drivers give NaN or the origin for beams without a return."""
    path = kitti_drive / "velodyne/000002.bin"
    whole = np.fromfile(path, "<f4").reshape(-1, 4)
    values = whole.copy()
    values[1, :3], values[7, 1] = 0.0, np.nan
    values.tofile(path)
    kept = np.delete(np.arange(len(values)), [1, 7])
    for drive in (
        kitti_drive,
        as_kitti_raw(kitti_drive, tmp_path / "raw"),
        as_folder(kitti_drive, tmp_path / "bin"),
        as_folder(kitti_drive, tmp_path / "npz", ".npz"),
        as_nuscenes(kitti_drive, tmp_path / "nuscenes"),
    ):
        scan = open_source(drive, sequence="61" if drive.name == "nuscenes" else None)[2].scan
        assert scan is not None and scan.left_out == 2 and np.array_equal(scan.points, whole[kept, :3])
        assert (scan.classes == SemanticClass.VEHICLE).tolist() == [k < 3 for k in kept]


def test_clouds_of_x_y_z_alone_have_no_intensities(kitti_drive: Path, tmp_path: Path) -> None:
    azimuth = np.linspace(-3.1, 3.1, 240)
    points = np.column_stack([10.0 * np.cos(azimuth), 10.0 * np.sin(azimuth), np.linspace(-1.0, 1.0, 240)])
    for path in (kitti_drive / "velodyne").iterdir():
        points.astype("<f4").tofile(path)
    for path in (kitti_drive / "labels").iterdir():
        np.full(240, 40, "<u4").tofile(path)
    raw = as_kitti_raw(kitti_drive, tmp_path / "raw")
    for drive in (kitti_drive, raw):
        scan = open_source(drive)[1].scan
        assert scan is not None and len(scan.points) == 240 and intensities_of(scan) is None


def test_lasers_are_found_beside_points_at_the_origin(kitti_drive: Path) -> None:
    azimuth, elevation = np.meshgrid(np.linspace(-3.1, 3.1, 60), np.radians([-2.0, -5.0, -9.0, -14.0]))
    directions = [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)]
    points = 10.0 * np.stack(directions, -1).reshape(-1, 3)
    points[::7] = 0.0
    values = np.column_stack([points, np.ones(len(points))]).astype("<f4")
    values.tofile(kitti_drive / "velodyne/000002.bin")
    (kitti_drive / "labels/000002.label").unlink()
    scan = open_source(kitti_drive)[2].scan
    lasers = np.repeat(np.arange(4), 60)[(points != 0.0).any(axis=1)]
    assert scan is not None and scan.rings is not None and np.array_equal(scan.rings, lasers)


def test_files_that_macos_leaves_are_no_frames(kitti_drive: Path, tmp_path: Path) -> None:
    folder = as_folder(kitti_drive, tmp_path / "folder")
    count = len(open_source(folder))
    for name in ("images", "clouds", "masks", "labels"):
        for path in list((folder / name).iterdir()):
            path.with_name(f"._{path.name}").write_bytes(b"\0\5\x16\7")
    assert len(open_source(folder)) == count


@pytest.mark.slow
def test_a_folder_of_a_lens_that_distorts_is_rectified(tmp_path: Path) -> None:
    folder = as_folder(written(CROWDED_STREET) / "sequences" / "00", tmp_path / "street")
    plain = open_source(folder)
    text = (folder / "camera.yaml").read_text()
    (folder / "camera.yaml").write_text(text + "distortion_model: plumb_bob\ndistortion: [-0.1, 0, 0, 0]\n")
    drive = open_source(folder)
    model = BrownConradyCamera(plain.camera, (-0.1, 0.0, 0.0, 0.0))
    rectification = Rectification.of(model)
    assert drive.camera == rectification.camera and len(drive) == len(plain)
    for found, raw in zip(drive[1:3], plain[1:3], strict=True):  # type: ignore[misc]
        assert found.image == rectification.image(raw.image) and found.scan == raw.scan
        assert found.image.mask.shape == (drive.camera.height, drive.camera.width)
    info = drive_info(drive)
    lens = {
        "model": "plumb_bob",
        **asdict(plain.camera),
        "distortion": {"coefficients": (-0.1, 0.0, 0.0, 0.0)},
        "used_share": round(rectification.used_share, 3),
    }
    assert info.camera["lens"] == lens and info.image_sensor == drive_info(plain).image_sensor
    lines = info_text(info).splitlines()
    assert lines[2].strip().startswith("rectified from plumb_bob") and lines[2].endswith("-0.1 0 0 0")
    assert re.fullmatch(r" +uses about 9\d % of its pictures", lines[3])
    assert "lens" not in drive_info(plain).camera


@pytest.mark.slow
def test_motion_needs_neither_labels_nor_tr(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """KITTI odometry with clouds, pictures, stamps and intrinsics alone."""
    street = written(CROWDED_STREET) / "sequences" / "00"
    bare = tmp_path / "bare"
    for name in ("velodyne", "image_2"):
        shutil.copytree(street / name, bare / name)
    shutil.copy(street / "times.txt", bare)
    lines = (street / "calib.txt").read_text().splitlines()
    results = []
    for kept in (lines, [line for line in lines if not line.startswith("Tr")]):
        (bare / "calib.txt").write_text("".join(f"{line}\n" for line in kept))
        source = open_source(bare)
        assert (source.nominal is None) == (source.truth is None) == (kept is not lines)
        results.append(calibrate(source, None, CalibrationConfig(method="motion")))
    step = gtsam.Pose3.Logmap(results[0].T_camera_lidar.between(results[1].T_camera_lidar))
    assert np.abs(step).max() < 1e-12 and results[0].time_offset_s == results[1].time_offset_s
    assert results[1].frames_used
    assert main(["calibrate", str(bare), "--method", "motion", "--out", str(tmp_path / "out")]) == 2
    assert (
        "brings no nominal calibration (calib.txt has no line Tr): give --init none"
        in capsys.readouterr().err
    )


@pytest.mark.slow
def test_raw_pictures_as_recorded_are_rectified(tmp_path: Path) -> None:
    raw = as_kitti_raw(written(CROWDED_STREET) / "sequences" / "00", tmp_path / "raw")
    plain = open_source(raw)
    camera, size = plain.camera, (plain.camera.width, plain.camera.height)
    P2 = np.column_stack([camera.matrix, [30.0, 0.0, 0.0]])
    c0Tl = gtsam.Pose3(gtsam.Rot3.RzRyRx(-1.5, 0.1, -1.6), np.array([0.1, -0.2, -0.3]))
    turn = gtsam.Rot3.RzRyRx(0.01, 0.02, 0.03)
    write_raw_calibration(
        raw.parent,
        P2,
        c0Tl,
        size,
        S_02=row(size),
        S_rect_02=row((size[0] - 9, size[1] - 7)),
        D_02=row((-0.37, 0.2, 1e-3, 2e-3, -0.07)),
        R_02=row(turn.matrix()),
        R_rect_00=row(np.eye(3)),
    )
    source = open_source(raw)
    rectification = Rectification.of(BrownConradyCamera(camera, (-0.37, 0.2, 1e-3, 2e-3, -0.07)))
    assert source.camera == rectification.camera and len(source) == len(plain)
    for found, raw_frame in zip(source[1:3], plain[1:3], strict=True):  # type: ignore[misc]
        assert found.image == rectification.image(raw_frame.image) and found.scan == raw_frame.scan
    # Undistorted pixels are those of K after R_02, T_02: the rectification of the stereo pair plays no part.
    velo = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.004, -0.007, 0.009).inverse(), np.zeros(3)) * c0Tl
    wanted = gtsam.Pose3(turn, np.array([30.0 / camera.fx, 0.0, 0.0])) * velo
    assert source.nominal is not None and source.nominal.equals(wanted, 1e-9)
    assert source.truth is not None and source.truth.cTl.equals(wanted, 1e-9)


def test_nuscenes_brings_the_points_and_pictures_of_kitti_odometry(kitti_drive: Path, tmp_path: Path) -> None:
    root = as_nuscenes(kitti_drive, tmp_path / "nuscenes")
    source, wanted = open_source(root, sequence="61"), open_source(kitti_drive)
    assert (source.name, len(source)) == ("nuscenes/scene-0061", len(wanted))
    for k, (found, frame) in enumerate(zip(source, wanted, strict=True)):
        assert found.scan is not None and found.image is not None
        assert frame.scan is not None and frame.image is not None
        assert found.scan.stamp_ns - EPOCH_NS == frame.scan.stamp_ns == found.image.stamp_ns - EPOCH_NS
        np.testing.assert_array_equal(found.scan.points, frame.scan.points)
        np.testing.assert_array_equal(found.scan.rings, np.arange(12))
        np.testing.assert_array_equal(found.image.pixels, frame.image.pixels)
        assert found.scan.has_labels == (k % 2 == 0) and not found.image.has_mask
        if k % 2 == 0:
            np.testing.assert_array_equal(found.scan.classes, frame.scan.classes)
    assert source.nominal is not None and wanted.nominal is not None
    assert source.nominal.equals(wanted.nominal, 1e-9)
    assert source.camera == wanted.camera


@pytest.mark.slow
def test_every_layout_gives_the_same_calibration(tmp_path: Path) -> None:
    """Raw stamps count from 1970: nine digits more than those of the odometry layout."""
    odometry = written(CROWDED_STREET) / "sequences" / "00"
    wanted_source = open_source(odometry)
    # So short a drive does not show whether its scans are compensated.
    config = CalibrationConfig(decide_sweep=False)
    wanted = calibrate(KeptDrive.of(wanted_source), wanted_source.nominal, config)
    assert wanted.status == "ok"
    for folder in (as_kitti_raw(odometry, tmp_path / "raw"), as_folder(odometry, tmp_path / "folder")):
        source = open_source(folder)
        result = calibrate(source, source.nominal, config)
        step = gtsam.Pose3.Logmap(wanted.T_camera_lidar.between(result.T_camera_lidar))
        assert np.abs(step).max() < 1e-6 and abs(result.time_offset_s - wanted.time_offset_s) < 1e-6


def test_nuscenes_without_its_sweeps_and_some_labels(kitti_drive: Path, tmp_path: Path) -> None:
    """Sweeps are downloads of their own."""
    root = as_nuscenes(kitti_drive, tmp_path / "nuscenes")
    whole = list(open_source(root, sequence="61"))
    shutil.rmtree(root / "sweeps")
    next((root / "lidarseg" / "v1.0-mini").iterdir()).unlink()
    source = open_source(root, sequence="61")
    frames = list(source)
    assert [frame.scan.stamp_ns for frame in frames if frame.scan] == [
        frame.scan.stamp_ns for frame in whole if frame.scan and frame.index % 2 == 0
    ]
    assert sum(frame.scan.has_labels for frame in frames if frame.scan) == len(frames) - 1
    assert drive_info(source).notes == tuple(
        f"2 files of {name} missing and left out" for name in ("LIDAR_TOP", "CAM_FRONT")
    )
    shutil.rmtree(root / "samples")
    with pytest.raises(DataError, match="no such file, expected the files of LIDAR_TOP"):
        open_source(root, sequence="61")

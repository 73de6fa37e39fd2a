"""A camera and a LiDAR at rates of their own."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import cast

import cv2
import gtsam
import numpy as np
import pytest
from stored import simulated
from streets import CROWDED_STREET

from sst_graph import calibrate
from sst_graph.cli.pictures import ShownFrame, telling_positions
from sst_graph.data import SourceOptions, open_source
from sst_graph.data.frame_parts import RecentReader
from sst_graph.data.info import drive_info
from sst_graph.data.source import Sweep
from sst_graph.data.two_clocks import DriveProperties, Sensor, TwoClockSource, merged
from sst_graph.errors import ConfigError, DataError
from sst_graph.factors import PinholeCamera
from sst_graph.result import CalibrationResult
from sst_graph.simulator import SimulatedDrive
from sst_graph.types import NO_PICTURE, CameraImage, Frame, Scan

PROPERTIES = DriveProperties("two", PinholeCamera(700.0, 700.0, 4.0, 3.0, 8, 6))


def scans_of(stamps: list[int]) -> Sensor[Scan]:
    return Sensor(
        np.array(stamps, np.int64),
        lambda k: Scan(stamps[k], np.full((1, 3), k, np.float32), np.zeros(1, np.uint8)),
    )


def images_of(stamps: list[int]) -> Sensor[CameraImage]:
    """Image k has the instances k, so that it is known again under another stamp."""
    return Sensor(
        np.array(stamps, np.int64),
        lambda k: CameraImage(
            stamps[k], np.zeros((1, 1), np.uint8), NO_PICTURE, np.full((1, 1), k, np.uint16)
        ),
    )


def stamps_of(frame: Frame) -> tuple[int | None, int | None]:
    return frame.scan and frame.scan.stamp_ns, frame.image and frame.image.stamp_ns


def test_frames_come_in_the_order_of_stamps_and_equal_stamps_share_one() -> None:
    source = merged(PROPERTIES, scans_of([10, 40]), images_of([0, 10, 20]), SourceOptions(), Path("d"))
    assert [stamps_of(frame) for frame in source] == [(None, 0), (10, 10), (None, 20), (40, None)]
    assert [frame.index for frame in source] == [0, 1, 2, 3]
    part = source[1:3]
    assert isinstance(part, TwoClockSource)
    assert ([frame.index for frame in part], part.frame_number(1)) == ([1, 2], 2)
    assert part.read_scan(1) is None and part.read_image(1) is not None


def test_frames_are_chosen_in_the_order_of_stamps() -> None:
    options = SourceOptions(frames=slice(1, 4))
    source = merged(PROPERTIES, scans_of([10, 40]), images_of([0, 10, 20]), options, Path("d"))
    assert [frame.index for frame in source] == [1, 2, 3]
    for frames, found in ((slice(0, 5), "0:4"), (slice(2, 3), "no scan"), (slice(3, 4), "no image")):
        with pytest.raises(ConfigError, match=found):
            merged(
                PROPERTIES,
                scans_of([10, 40]),
                images_of([0, 10, 20]),
                SourceOptions(frames=frames),
                Path("d"),
            )


def test_scans_get_what_their_reader_leaves_to_the_options() -> None:
    """Laser numbers by the order of the points, times by azimuth or none; a complete reader keeps its own."""
    street = simulated(CROWDED_STREET)
    given = [scan for k in range(3) if (scan := street[k].scan) is not None]
    own_s = np.full(len(given[0].points), 0.01, np.float32)
    bare = [dataclasses.replace(scan, rings=None, offsets_s=own_s[: len(scan.points)]) for scan in given[:1]]
    bare += [dataclasses.replace(scan, rings=None, offsets_s=None) for scan in given[1:]]
    stamps = np.array([scan.stamp_ns for scan in given])
    scans, images = Sensor(stamps, lambda k: bare[k]), images_of(stamps.tolist())

    def read(sweep: Sweep, complete: bool = False) -> list[Scan]:
        source = merged(PROPERTIES, scans, images, SourceOptions(sweep=sweep), Path("d"), complete)
        return [frame.scan for frame in source if frame.scan is not None]

    for scan, expected in zip(read("auto"), given, strict=True):
        assert scan.rings is not None and expected.rings is not None
        assert len(np.unique(scan.rings)) == len(np.unique(expected.rings))
    assert [scan.offsets_s is not None for scan in read("auto")] == [True, False, False]
    assert [scan.offsets_s for scan in read("compensated")] == [None, None, None]
    for sweep, sense in (("clockwise", -1.0), ("counterclockwise", 1.0)):
        for scan in read(cast(Sweep, sweep)):
            turn = np.arctan2(scan.points[:, 1], scan.points[:, 0]) / (2.0 * np.pi)
            expected_s = sense * turn * float(np.median(np.diff(stamps))) * 1e-9
            assert scan.offsets_s is not None
            np.testing.assert_allclose(scan.offsets_s, expected_s, atol=1e-6)
    kept = read("clockwise", complete=True)
    np.testing.assert_array_equal(kept[0].offsets_s, own_s)
    assert kept[1].offsets_s is None and kept[0].rings is None


@pytest.mark.parametrize(("shift", "shown"), [(1, [1, 2]), (-1, [0, 1])])
def test_shifted_images_take_the_stamps_of_others(shift: int, shown: list[int]) -> None:
    options = SourceOptions(image_shift=shift)
    source = merged(PROPERTIES, scans_of([0, 10, 20]), images_of([0, 10, 20]), options, Path("d"))
    images = [frame.image for frame in source if frame.image is not None]
    stamps = [0, 10] if shift > 0 else [10, 20]
    assert [image.stamp_ns for image in images] == stamps
    assert [int(image.instances[0, 0]) for image in images if image.instances is not None] == shown


@pytest.mark.parametrize(
    ("scans", "images", "found"),
    [
        ([], [0], "no scan"),
        ([0], [], "no image"),
        ([0, 20, 10], [0], r"\(scans\): found falling stamps 1 and 2"),
        ([0], [5, 5], r"\(images\): found equal stamps 0 and 1"),
    ],
)
def test_a_sensor_without_data_or_with_stamps_that_do_not_rise(
    scans: list[int], images: list[int], found: str
) -> None:
    with pytest.raises(DataError, match=found):
        merged(PROPERTIES, scans_of(scans), images_of(images), SourceOptions(), Path("d"))


def test_kitti_odometry_with_image_stamps_of_its_own(kitti_drive: Path) -> None:
    (kitti_drive / "times_2.txt").write_text("".join(f"{t}\n" for t in (0.05, 0.15, 0.2, 0.36, 0.46)))
    (kitti_drive / "velodyne/000001.bin").unlink()
    source = open_source(kitti_drive)
    stamps = [stamps_of(frame) for frame in source]
    ms = 10**6
    assert stamps[:4] == [(0, None), (None, 50 * ms), (None, 150 * ms), (200 * ms, 200 * ms)]
    third = source[3]
    assert third.scan is not None and third.image is not None
    assert (third.image.pixels == 20).all()
    info = drive_info(source)
    assert info.scan_sensor.place == str(kitti_drive / "velodyne")
    assert (info.image_sensor.place, info.image_sensor.count) == (str(kitti_drive / "image_2"), 5)
    assert info.nominal_reason == "by calib.txt" and "label without a scan" in info.notes[0]
    plain = open_source(kitti_drive, frames="3:4")
    assert plain[0].image is not None
    (kitti_drive / "times_2.txt").write_text("0.1\n0.2\n")
    with pytest.raises(DataError, match=r"times_2\.txt: found 2 stamps for 5 images, expected 5"):
        open_source(kitti_drive)


def test_kitti_odometry_with_image_stamps_of_its_own_and_instances(kitti_drive: Path) -> None:
    (kitti_drive / "times_2.txt").write_text("".join(f"{t}\n" for t in (0.05, 0.15, 0.2, 0.36, 0.46)))
    (kitti_drive / "instance_2").mkdir()
    for k in range(5):
        cv2.imwrite(str(kitti_drive / f"instance_2/{k:06d}.png"), np.full((6, 8), 26 * 256 + k, np.uint16))
    for shift in (0, 1):
        images = [frame.image for frame in open_source(kitti_drive, image_shift=shift)]
        numbers = [(image.instances == k).all() for k, image in enumerate(filter(None, images), shift)]
        assert numbers == [True] * (5 - shift)


# --- calibration ------------------------------------------------------------------------------------------

FAST_STREET = dataclasses.replace(CROWDED_STREET, frames=75, frame_rate_hz=30.0)
DROPPED_IMAGES, DROPPED_SCAN = (7, 23, 24, 41), 4


def street(drive: SimulatedDrive) -> TwoClockSource:
    """A LiDAR at 10 Hz that starts late and drops a scan; a camera at 30 Hz with drops."""
    scans = [k for k in range(1, len(drive), 3) if k != 1 and k != 1 + 3 * DROPPED_SCAN]
    images = [k for k in range(len(drive)) if k not in DROPPED_IMAGES]
    stamps = drive.stamps_ns
    properties = DriveProperties("street", drive.camera, drive.nominal, drive.truth)
    return merged(
        properties,
        Sensor(stamps[scans], lambda k: drive.scan(scans[k])),
        Sensor(stamps[images], lambda k: drive.image(images[k])),
        SourceOptions(sweep="compensated"),
        Path("street"),
    )


def errors(result: CalibrationResult, drive: SimulatedDrive) -> tuple[float, float, float]:
    """Rotation [deg], translation [m], time offset [s]."""
    step = np.asarray(gtsam.Pose3.Logmap(drive.truth.cTl.between(result.T_camera_lidar)))
    time_offset_s = result.time_offset_s - drive.config.time_offset_s
    return float(np.degrees(np.linalg.norm(step[:3]))), float(np.linalg.norm(step[3:])), abs(time_offset_s)


@pytest.mark.slow
def test_a_camera_of_30_hz_with_a_lidar_of_10_hz() -> None:
    drive = simulated(FAST_STREET)
    result = calibrate(street(drive), drive.nominal)
    assert result.status == "ok"
    rotation_deg, translation_m, time_offset_s = errors(result, drive)
    assert rotation_deg < 0.08 and translation_m < 0.017 and time_offset_s < 0.004
    # Every image is matched, a scan is named once, and pictures show a scan with the image of its instant.
    assert result.diagnostics["pairs"] > 2 * len(result.frames_used)
    assert len(set(result.frames_used)) == len(result.frames_used)
    reader = RecentReader(street(drive))
    positions = telling_positions(reader, result, 3)
    assert len(positions) == 3
    for position in positions:
        shown = ShownFrame.of(reader, position, result).frame
        assert shown.image is not None and shown.scan is not None
        apart_s = (shown.image.stamp_ns - shown.scan.stamp_ns) * 1e-9 + result.time_offset_s
        assert abs(apart_s) < 0.5 / 30.0 + 0.002

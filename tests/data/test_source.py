"""KITTI drives: what is read, how frames are chosen and shifted; on a tiny real tree and on real drives."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import gtsam
import numpy as np
import pytest

from sst_graph import Tracker, read_result, read_rig
from sst_graph.data import KittiSource, open_source
from sst_graph.errors import ConfigError, DataError
from sst_graph.marginal import read_marginal
from sst_graph.types import CameraImage, Frame, Scan, SemanticClass, Source, intensities_of

FRAMES, POINTS, WIDTH, HEIGHT = 5, 12, 8, 6
TIMES_S = [0.0, 0.1, 0.2, 0.31, 0.41]
DRIVES = Path(__file__).resolve().parents[2].parent / "shared" / "data"


@pytest.fixture
def drive(kitti_drive: Path) -> Path:
    return kitti_drive


def scan_of(frame: Frame) -> Scan:
    assert frame.scan is not None
    return frame.scan


def image_of(frame: Frame) -> CameraImage:
    assert frame.image is not None
    return frame.image


def nominal_of(source: Source) -> gtsam.Pose3:
    assert source.nominal is not None
    return source.nominal


def offset_of(source: Source) -> float:
    assert source.truth is not None
    assert source.truth.time_offset_s is not None
    return source.truth.time_offset_s


def stored_points(drive: Path, k: int) -> np.ndarray:
    return np.fromfile(drive / f"velodyne/{k:06d}.bin", "<f4").reshape(-1, 4)


def vehicles(classes: np.ndarray) -> int:
    return int((classes == SemanticClass.VEHICLE).sum())


# --- what is read ---------------------------------------------------------------------------------------


def test_frames_hold_what_the_files_hold(drive: Path) -> None:
    source = open_source(drive.parents[1])
    assert (source.name, len(source)) == ("kitti/00", FRAMES)
    assert (source.camera.width, source.camera.height, source.camera.fx) == (WIDTH, HEIGHT, 700.0)
    assert [frame.index for frame in source] == list(range(FRAMES))
    for k, frame in enumerate(source):
        scan, image = scan_of(frame), image_of(frame)
        assert scan.stamp_ns == image.stamp_ns == round(TIMES_S[k] * 1e9)
        np.testing.assert_array_equal(scan.points, stored_points(drive, k)[:, :3])
        assert vehicles(scan.classes) == np.count_nonzero(scan.instances == 3) == k + 1
        assert np.count_nonzero(scan.classes == SemanticClass.GROUND) == POINTS - k - 1
        assert scan.offsets_s is None
        assert vehicles(image.mask) == k + 1
        assert np.count_nonzero(image.mask == SemanticClass.IGNORE) == 1
        assert image.pixels.shape == (HEIGHT, WIDTH, 3)
        assert (image.pixels == 10 * k).all()
        assert image.instances is None


def test_nominal_pose_is_that_of_the_chosen_camera(drive: Path) -> None:
    np.testing.assert_allclose(nominal_of(open_source(drive)).translation(), [35 / 700, -0.08, -0.27])
    shutil.copytree(drive / "image_2", drive / "image_3")
    shutil.copytree(drive / "semantic_2", drive / "semantic_3")
    right = open_source(drive, camera="image_3")
    np.testing.assert_allclose(nominal_of(right).translation(), [-350 / 700, -0.08, -0.27])


def test_instance_masks(drive: Path) -> None:
    (drive / "instance_2").mkdir()
    for k in range(FRAMES):
        instances = np.zeros((HEIGHT, WIDTH), np.uint16)
        instances[0, 0], instances[0, 1], instances[1, 0] = 26 * 256 + 7, 26 * 256, 255
        cv2.imwrite(str(drive / f"instance_2/{k:06d}.png"), instances)
    image = image_of(open_source(drive)[2])
    assert image.instances is not None
    assert image.instances.dtype == np.uint16
    assert (image.instances[0, 0], int(image.instances.sum())) == (7, 7)  # 255: ignored area, no instance


def test_train_ids_are_recognized_and_can_be_forced(drive: Path) -> None:
    for path in (drive / "semantic_2").iterdir():
        mask = np.asarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED))
        cv2.imwrite(str(path), np.where(mask == 26, 13, mask).astype(np.uint8))
    assert vehicles(image_of(open_source(drive)[1]).mask) == 2
    forced = image_of(open_source(drive, label_encoding="ids")[1]).mask
    assert np.count_nonzero(forced == SemanticClass.FENCE) == 2


@pytest.mark.parametrize("convert", [np.uint16, lambda mask: np.repeat(mask[:, :, None], 3, axis=2)])
def test_lossless_masks_of_other_types_are_read(drive: Path, convert: Callable[[Any], Any]) -> None:
    path = drive / "semantic_2/000001.png"
    cv2.imwrite(str(path), convert(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)))
    assert vehicles(image_of(open_source(drive)[1]).mask) == 2


def test_empty_scan_is_legal(drive: Path) -> None:
    (drive / "velodyne/000002.bin").write_bytes(b"")
    (drive / "labels/000002.label").write_bytes(b"")
    scan = scan_of(open_source(drive)[2])
    assert scan.points.shape == (0, 3)
    assert scan.rings is None


def test_jpeg_pictures_are_read(drive: Path) -> None:
    for path in list((drive / "image_2").iterdir()):
        cv2.imwrite(str(path.with_suffix(".jpg")), np.asarray(cv2.imread(str(path))))
        path.unlink()
    assert np.abs(image_of(open_source(drive)[3]).pixels.astype(int) - 30).max() <= 2
    cut = drive / "image_2/000003.jpg"
    cut.write_bytes(cut.read_bytes()[:-80])
    with pytest.raises(DataError, match=r"000003\.jpg: found a truncated JPEG"):
        open_source(drive)[3]


# --- point times ----------------------------------------------------------------------------------------


def test_point_times_are_used_unless_refused(drive: Path) -> None:
    (drive / "velodyne_times").mkdir()
    offsets = np.linspace(-0.05, 0.05, POINTS).astype("<f4")
    for k in range(FRAMES):
        offsets.tofile(drive / f"velodyne_times/{k:06d}.bin")
    np.testing.assert_array_equal(scan_of(open_source(drive)[0]).offsets_s, offsets)
    assert scan_of(open_source(drive, sweep="instant")[0]).offsets_s is None


@pytest.mark.parametrize("value", [0.0, 0.05])
def test_point_times_that_are_all_the_same_are_none(drive: Path, value: float) -> None:
    (drive / "velodyne_times").mkdir()
    for k in range(FRAMES):
        np.full(POINTS, value, "<f4").tofile(drive / f"velodyne_times/{k:06d}.bin")
    assert scan_of(open_source(drive)[0]).offsets_s is None


def test_point_times_from_azimuth(drive: Path) -> None:
    scan = scan_of(open_source(drive, sweep="azimuth")[1])
    assert scan.offsets_s is not None
    points = scan.points.astype(float)
    expected = -np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi) * 0.1  # median spacing of TIMES_S
    np.testing.assert_allclose(scan.offsets_s, expected, atol=1e-8)


# --- choice of sequence and frames ----------------------------------------------------------------------


def test_sequence_folder_itself_can_be_opened(drive: Path) -> None:
    assert open_source(drive).name == "kitti/00"
    assert len(open_source(drive, sequence="00")) == FRAMES
    with pytest.raises(ConfigError, match="is itself the folder of a sequence"):
        open_source(drive, sequence="07")


def test_one_of_several_sequences_must_be_named(drive: Path) -> None:
    shutil.copytree(drive, drive.parent / "07")
    root = drive.parents[1]
    with pytest.raises(ConfigError, match=r"several sequences \(00, 07\)"):
        open_source(root)
    assert open_source(root, sequence="07").name == open_source(root, sequence="7").name == "kitti/07"
    with pytest.raises(ConfigError, match=r"sequence '11': .* has 00, 07"):
        open_source(root, sequence="11")


@pytest.mark.parametrize(
    ("frames", "indices"),
    [("1:3", [1, 2]), (":2", [0, 1]), ("3:", [3, 4]), (":", [0, 1, 2, 3, 4]), (slice(2, 5), [2, 3, 4])],
)
def test_frames_are_scan_indices(drive: Path, frames: str | slice, indices: list[int]) -> None:
    assert [frame.index for frame in open_source(drive, frames=frames)] == indices


@pytest.mark.parametrize(
    ("options", "found"),
    [
        ({"frames": slice(0, 10**5000)}, "more than 40 digits"),
        ({"frames": slice("a", 5)}, "the text 'a'"),
        ({"frames": slice(0.5, 5)}, "0.5"),
        ({"frames": "0:" + "9" * 5000}, "frames '0:999"),
        ({"image_shift": 10**5000}, "more than 40 digits"),
        ({"cloud": "a\0"}, "a NUL character"),
        ({"colour": 1}, "option 'colour'"),
    ],
)
def test_an_option_is_refused_by_its_name(drive: Path, options: dict[str, Any], found: str) -> None:
    with pytest.raises(ConfigError, match=found):
        open_source(drive, **options)


@pytest.mark.parametrize("path", [7, None, b"street", "a\0"])
def test_what_is_no_path_is_refused(path: Any) -> None:
    for read in (open_source, read_result, read_rig, read_marginal, Tracker.load):
        with pytest.raises(DataError, match=r"path: found|a NUL character"):
            read(path)


def test_slices_are_drives(drive: Path) -> None:
    source = open_source(drive)
    assert isinstance(source, KittiSource)
    part = source[1:4]
    assert [frame.index for frame in part] == [1, 2, 3]
    assert [frame.index for frame in part[::-2]] == [3, 1]
    assert part[-1].index == 3
    with pytest.raises(IndexError):
        part[3]


# --- image shift and truth ------------------------------------------------------------------------------


def test_shifted_images_keep_the_scans_stamp(drive: Path) -> None:
    source = open_source(drive, image_shift=2)
    scan, image = scan_of(source[1]), image_of(source[1])
    assert (image.pixels == 30).all()
    assert vehicles(image.mask) == 4
    assert image.stamp_ns == scan.stamp_ns == 100_000_000
    assert [frame.image is None for frame in source] == [False, False, False, True, True]
    # an image stamped t[k] shows the world at t[k + 2]: later, so positive
    assert offset_of(source) == pytest.approx((0.2 + 0.21 + 0.21) / 3, abs=1e-12)


def test_negative_shift(drive: Path) -> None:
    source = open_source(drive, image_shift=-1, frames="0:3")
    assert [frame.image is None for frame in source] == [True, False, False]
    assert (image_of(source[1]).pixels == 0).all()
    assert offset_of(source) == pytest.approx(-0.1)


def test_shift_beyond_the_drive_is_refused(drive: Path) -> None:
    with pytest.raises(ConfigError, match="no scan is left with an image"):
        open_source(drive, image_shift=5)


def test_published_calibration_is_flagged_as_reference(drive: Path) -> None:
    source = open_source(drive)
    assert isinstance(source, KittiSource)
    assert source.truth_is_reference
    assert source.truth.cTl.equals(source.nominal, 1e-12)
    assert source.truth.time_offset_s == 0.0


def test_ground_truth_file(drive: Path) -> None:
    matrix = np.array([[0, -1, 0, 0.1], [0, 0, -1, 0.2], [1, 0, 0, 0.3], [0, 0, 0, 1]], float)
    truth = {"T_camera_lidar": matrix.tolist(), "time_offset_s": 0.05, "seed": 1}
    (drive / "groundtruth.json").write_text(json.dumps(truth))
    source = open_source(drive, image_shift=1, frames="0:2")
    assert isinstance(source, KittiSource)
    assert not source.truth_is_reference
    np.testing.assert_allclose(source.truth.cTl.matrix(), matrix, atol=1e-12)
    assert offset_of(source) == pytest.approx(0.15)
    shutil.copytree(drive / "image_2", drive / "image_0")
    shutil.copytree(drive / "semantic_2", drive / "semantic_0")
    grey = open_source(drive, camera="image_0")
    assert grey.truth is not None
    np.testing.assert_allclose(grey.truth.cTl.translation(), [0.05, 0.2, 0.3])


# --- gaps -----------------------------------------------------------------------------------------------


def test_gap_on_one_side_carries_none(drive: Path) -> None:
    for name in ("velodyne/000001.bin", "labels/000001.label", "image_2/000003.png", "semantic_2/000003.png"):
        (drive / name).unlink()
    frames = list(open_source(drive))
    assert [f.scan is None for f in frames] == [False, True, False, False, False]
    assert [f.image is None for f in frames] == [False, False, False, True, False]


def test_another_cloud_may_be_shorter(drive: Path) -> None:
    (drive / "velodyne_raw").mkdir()
    for k in range(2):
        (stored_points(drive, k) + np.float32(1)).tofile(drive / f"velodyne_raw/{k:06d}.bin")
    frames = list(open_source(drive, cloud="velodyne_raw"))
    assert [f.scan is None for f in frames] == [False, False, True, True, True]
    np.testing.assert_array_equal(scan_of(frames[1]).points, stored_points(drive, 1)[:, :3] + np.float32(1))


# --- real drives ----------------------------------------------------------------------------------------


@pytest.mark.drives
@pytest.mark.parametrize(("name", "count"), [("kitti_2011_09_26_stop", 60), ("kitti_2011_09_26_parked", 45)])
def test_real_drives(name: str, count: int) -> None:
    if not (DRIVES / name).is_dir():
        pytest.skip(f"no drive {name} beside the checkout")
    source = open_source(DRIVES / name)
    assert len(source) == count
    for frame in (source[0], source[count // 2]):
        scan, image = scan_of(frame), image_of(frame)
        assert scan.rings is not None
        assert abs(int(scan.rings.max()) + 1 - 64) <= 4
        lPs = scan.points[scan.classes == SemanticClass.VEHICLE].astype(np.float64)
        uvs = source.camera.project(nominal_of(source).transformFrom(lPs.T).T)
        uvs = uvs[source.camera.in_image(uvs)].round().astype(int)
        # NOTES: 98.9 % of the vehicle points (hand labels) and 93.6 % (networks), over all frames
        assert (image.mask[uvs[:, 1], uvs[:, 0]] == SemanticClass.VEHICLE).mean() > 0.85


@pytest.mark.drives
def test_shift_of_a_real_drive() -> None:
    name = "kitti_2011_09_26_stop"
    if not (DRIVES / name).is_dir():
        pytest.skip(f"no drive {name} beside the checkout")
    source = open_source(DRIVES / name, image_shift=3)
    assert offset_of(source) == pytest.approx(3 * 0.1036, abs=1e-6)
    assert [frame.image is None for frame in (source[56], source[57], source[59])] == [False, True, True]


def test_strengths_of_returns_are_those_of_the_points_that_are_used(drive: Path) -> None:
    path = drive / "velodyne/000001.bin"
    values = np.fromfile(path, "<f4").reshape(-1, 4)
    values[3, 0] = np.nan
    values.tofile(path)
    scan = open_source(drive)[1].scan
    assert scan is not None
    assert np.array_equal(intensities_of(scan), np.delete(values[:, 3], 3))

"""KITTI drives that cannot be used: each defect is named on one line with what was found and expected."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from layouts import as_folder, as_kitti_raw

from sst_graph.data import Loader, SourceOptions, loader_names, open_source, register_loader
from sst_graph.data.kept_drive import KeptDrive
from sst_graph.drive.input_statistics import image_statistics
from sst_graph.drive.preparation import prepare_drive
from sst_graph.errors import ConfigError, DataError
from sst_graph.types import NO_PICTURE, CameraImage, SemanticClass

FRAMES, POINTS, WIDTH, HEIGHT = 5, 12, 8, 6
Damage = Callable[[Path], object]


def read_all(path: Path, **options: Any) -> list[Any]:
    return list(open_source(path, **options))


@pytest.fixture
def drive(kitti_drive: Path) -> Path:
    return kitti_drive


def cut(name: str, size: int) -> Damage:
    return lambda drive: (drive / name).write_bytes((drive / name).read_bytes()[:size])


def unlink(name: str) -> Damage:
    return lambda drive: (drive / name).unlink()


def remove(name: str) -> Damage:
    return lambda drive: shutil.rmtree(drive / name)


def emptied(name: str) -> Damage:
    def damage(drive: Path) -> None:
        for path in (drive / name).iterdir():
            path.unlink()

    return damage


def text(name: str, content: str) -> Damage:
    return lambda drive: (drive / name).write_text(content)


def edited(name: str, old: str, new: str) -> Damage:
    return lambda drive: (drive / name).write_text((drive / name).read_text().replace(old, new))


def image(name: str, pixels: np.ndarray) -> Damage:
    return lambda drive: cv2.imwrite(str(drive / name), pixels)


def labels(values: np.ndarray) -> Damage:
    return lambda drive: values.tofile(drive / "labels/000002.label")


def coordinate(k: int, value: float) -> Damage:
    def damage(drive: Path) -> None:
        path = drive / "velodyne/000002.bin"
        points = np.fromfile(path, "<f4").reshape(-1, 4)
        points[k, 1] = value
        points.tofile(path)

    return damage


def points_in_doubles(drive: Path) -> None:
    path = drive / "velodyne/000002.bin"
    np.fromfile(path, "<f4").astype("<f8").tofile(path)


def flip_a_byte_of_the_image(drive: Path) -> None:
    path = drive / "image_2/000002.png"
    data = bytearray(path.read_bytes())
    data[data.index(b"IDAT") + 8] ^= 0xFF
    path.write_bytes(data)


SCAN, MASK, PICTURE = "velodyne/000002.bin", "semantic_2/000002.png", "image_2/000002.png"
BAD = [
    (unlink("calib.txt"), r"calib\.txt: found no such file"),
    (unlink("times.txt"), r"times\.txt: found no such file"),
    (remove("velodyne"), r"velodyne: found no folder"),
    (remove("image_2"), r"image_2: found no folder"),
    (emptied("labels"), r"labels: found no file that is named by its number"),
    (emptied("velodyne"), r"velodyne: found no file that is named by its number"),
    (emptied("image_2"), r"image_2: found no file that is named"),
    (
        text("times.txt", "0\n0.1\n0.2\n0.3\n"),
        r"times\.txt: found 4 stamps for 5 frames, expected 5, one for each number from 0: none for 000004$",
    ),
    (
        text("times.txt", "0\n0.1\n"),
        r"found 2 stamps for 5 frames, expected 5, .* none for 3 frames, 000002 to 000004$",
    ),
    (
        text("times.txt", "0\n1\n2\n3\n4\n5\n"),
        r"times\.txt: found 6 stamps for 5 frames, expected 5: the last file's number is 000004$",
    ),
    (text("times.txt", "0\n0.1\n0.1\n0.3\n0.4\n"), r"times\.txt: found equal stamps 1 and 2"),
    (text("times.txt", "0\n0.1\n0.2\n0.15\n0.4\n"), r"times\.txt: found falling stamps 2 and 3"),
    (edited("calib.txt", "P2", "Q2"), r"calib\.txt: found no line P2"),
    (edited("calib.txt", "P2: ", "P2: 1 0 0 0 0 1 0 0 0 0 1 0\nP2: "), "found another P2 than above"),
    (cut(SCAN, 100), r"000002\.bin: found 100 bytes, expected a multiple of 16"),
    (cut(SCAN, 96), r"000002\.label: found 12 labels, expected 6"),
    (cut("labels/000002.label", 46), r"000002\.label: found 46 bytes, expected a multiple of 4"),
    (cut("labels/000002.label", 44), r"000002\.label: found 11 labels, expected 12"),
    (labels(np.full(POINTS, 10, "<u2")), r"found 6 labels, expected 12"),
    (labels(np.full(POINTS, 7, "<u4")), r"000002\.label: found label 7 \(12 times\)"),
    (coordinate(3, 1e20), r"a coordinate of 1e\+20 m at index 3"),
    (points_in_doubles, r"000002\.(bin|label): found"),
    (cut("image_2/000002.png", 60), r"000002\.png: found a PNG file truncated at byte 60"),
    (cut("image_2/000000.png", 0), r"000000\.png: found first bytes b'' of 0, expected a PNG, JPEG"),
    (cut("semantic_2/000002.png", -4), r"semantic_2/000002\.png: found a PNG file truncated"),
    (text("image_2/000002.png", "<html>"), r"000002\.png: found first bytes b'<htm' of 6"),
    (flip_a_byte_of_the_image, r"000002\.png: found a damaged PNG chunk at byte \d+"),
    (image(MASK, np.zeros((6, 9), np.uint8)), r"000002\.png: found 9x6 px, expected 8x6 px"),
    (image(PICTURE, np.zeros((5, 8, 3), np.uint8)), r"000002\.png: found 8x5 px, expected 8x6 px"),
    (
        image(MASK, np.full((HEIGHT, WIDTH), 26 * 256, np.uint16)),
        r"000002\.png: found uint16 values up to 6656, expected 8-bit",
    ),
    (
        image(MASK, np.full((HEIGHT, WIDTH, 3), (142, 0, 0), np.uint8)),
        r"000002\.png: found 3 channels that differ",
    ),
    (image(MASK, np.full((HEIGHT, WIDTH), 99, np.uint8)), r"semantic_2.*: found label 99"),
]


@pytest.mark.parametrize(("damage", "message"), BAD)
def test_bad_input_is_named_on_one_line(drive: Path, damage: Damage, message: str) -> None:
    damage(drive)
    with pytest.raises(DataError, match=message) as caught:
        read_all(drive)
    assert "\n" not in str(caught.value)
    assert "expected" in str(caught.value)


@pytest.mark.parametrize(("factor", "odd"), [(0.5, PICTURE), (0.75, PICTURE), (2.0, PICTURE), (0.5, MASK)])
def test_of_pictures_and_masks_the_scaled_ones_are_named(factor: float, odd: str, drive: Path) -> None:
    """The principal point tells: it is near the middle of those that it was made for."""
    calibration = drive / "calib.txt"
    lines = calibration.read_text().splitlines()
    lines = ["P2: 700 0 41 0 0 700 29 0 0 0 1 0" if line.startswith("P2") else line for line in lines]
    calibration.write_text("\n".join(lines) + "\n")
    for folder, channels in ((PICTURE, (3,)), (MASK, ())):
        width, height = (round(side * (factor if folder == odd else 1.0)) for side in (80, 60))
        for path in (drive / folder).parent.glob("*.png"):
            cv2.imwrite(str(path), np.zeros((height, width, *channels), np.uint8))
    with pytest.raises(DataError) as caught:
        read_all(drive)
    said, scaled = str(caught.value), f"{80 * factor:.0f}x{60 * factor:.0f} px"
    assert f"{Path(odd).parent}/0" in said and scaled in said.partition("expected")[0]
    assert "80x60 px" in said.partition("expected")[2] and len(said) < 390
    if odd == PICTURE:
        assert f"if the pictures were scaled, scale fx and cx by {factor:g}, fy and cy by {factor:g}" in said


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (np.zeros(POINTS - 1, "<f4"), "found 11 times, expected 12"),
        (np.full(POINTS, np.nan, "<f4"), "found 12 times that are NaN or beyond 1 s, first at index 0"),
        (np.full(POINTS, 1.3e9, "<f4"), "12 times that are NaN or beyond 1 s"),
    ],
)
def test_bad_point_times_are_refused(drive: Path, values: np.ndarray, message: str) -> None:
    (drive / "velodyne_times").mkdir()
    for k in range(FRAMES):
        values.tofile(drive / f"velodyne_times/{k:06d}.bin")
    with pytest.raises(DataError, match=message):
        read_all(drive)
    (drive / "velodyne_times/000001.bin").unlink()
    with pytest.raises(DataError, match="velodyne_times: found no file for frame 1"):
        open_source(drive)


@pytest.mark.parametrize("layout", ["KITTI", "KITTI raw", "folder"])
def test_a_cloud_without_points_is_named_and_not_its_labels(layout: str, drive: Path, tmp_path: Path) -> None:
    if layout != "KITTI":
        drive = (as_folder if layout == "folder" else as_kitti_raw)(drive, tmp_path / "other")
    clouds = sorted(path for path in drive.rglob("*.bin") if "velodyne_times" not in path.parts)
    clouds[2].write_bytes(b"")
    expected = rf"{clouds[2].name}: found no point, expected {POINTS}, as many as .*\.label has labels"
    with pytest.raises(DataError, match=expected):
        read_all(drive)


def test_two_files_of_one_number_are_refused(drive: Path) -> None:
    shutil.copy(drive / "velodyne/000001.bin", drive / "velodyne/1.bin")
    with pytest.raises(DataError, match=r"1\.bin: found a second file of number 1"):
        open_source(drive)


@pytest.mark.parametrize(
    "options",
    [
        {"loader": "rosbag9"},
        {"camera": "left"},
        {"label_encoding": "pascal"},
        {"sweep": "spiral"},
    ],
)
def test_unknown_options_are_refused(drive: Path, options: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match="expected"):
        open_source(drive, **options)


def test_paths_without_a_drive_are_refused(tmp_path: Path) -> None:
    (tmp_path / "sequences").mkdir()
    (tmp_path / "file").write_text("x")
    for name in ("empty", "full"):
        (tmp_path / name).mkdir()
    for k in range(7):
        (tmp_path / "full" / f"{k}.txt").touch()
    for path, message in [
        (tmp_path / "absent", "found no file or folder"),
        (tmp_path / "file", "found no layout that is known, expected KITTI odometry"),
        (tmp_path / "empty", "found no layout that is known, expected KITTI odometry"),
        (tmp_path / "full", "known in a folder of 0.txt, 1.txt, 2.txt, 3.txt, 4.txt and 2 more, expected"),
        (tmp_path / "full", "; or a bag: PATH.bag, PATH.mcap, PATH.db3, or a rosbag2 folder$"),
        (tmp_path, "sequences: found an empty folder"),
    ]:
        with pytest.raises(DataError, match=message):
            open_source(path)
    with pytest.raises(DataError, match="neither a folder sequences nor"):
        open_source(tmp_path / "empty", loader="kitti")


def test_names_of_loaders_are_unique() -> None:
    assert "kitti" in loader_names()
    loader = Loader(lambda path: False, lambda path, options: open_source(path), "none")
    for name in ("kitti", "auto"):
        with pytest.raises(ConfigError, match="taken"):
            register_loader(name, loader)


@pytest.mark.parametrize(
    ("said", "message"),
    [
        ({"name": 5}, "a KeptDrive: name: found 5, expected text"),
        ({"nominal": "Tr"}, "nominal: found the text 'Tr', expected a gtsam.Pose3"),
        ({"camera": None}, "camera: "),
        ({"frames": ()}, "found no frame"),
    ],
)
def test_what_a_loader_brings_is_checked(drive: Path, said: dict[str, Any], message: str) -> None:
    kept = KeptDrive.of(open_source(drive))
    loader = Loader(lambda path: False, lambda path, options: replace(kept, **said), "none")
    with pytest.raises(DataError, match=message):
        loader.opened(drive, SourceOptions())


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "no JSON"),
        ("[1]", "a JSON list"),
        ('{"time_offset_s": 0}', "no entry 'T_camera_lidar'"),
        ('{"T_camera_lidar": [[1, 2], [3, 4]]}', r"shape \(2, 2\)"),
        ('{"T_camera_lidar": [[2,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}', "expected a rotation"),
        (
            '{"T_camera_lidar": [[1,0,0,0],[0,1,0,0],[0,0,1,0]], "time_offset_s": "x"}',
            "time_offset_s: found 'x'",
        ),
    ],
)
def test_bad_ground_truth_is_refused(drive: Path, content: str, message: str) -> None:
    (drive / "groundtruth.json").write_text(content)
    with pytest.raises(DataError, match=rf"groundtruth\.json.*{message}"):
        open_source(drive)


@pytest.mark.parametrize(
    ("option", "value", "expected"),
    [
        ("frames", 5, "expected A:B, or a slice"),
        ("camera", 2, "expected a text"),
        ("cloud", None, "expected a text"),
        ("sequence", 0, "expected a text"),
        ("image_shift", 1.5, "expected a whole number"),
        ("sweep_start_deg", "0", "expected a number"),
        ("sweep", ["auto"], "expected one of"),
        ("loader", ["kitti"], "expected the name of a format"),
    ],
)
def test_options_of_another_kind_are_refused(drive: Path, option: str, value: object, expected: str) -> None:
    options: dict[str, Any] = {option: value}
    with pytest.raises(ConfigError, match=expected):
        open_source(drive, **options)


def test_a_name_that_no_file_can_have() -> None:
    with pytest.raises(DataError, match="expected a drive"):
        open_source("x" * 5000)


@pytest.mark.parametrize(
    "frames", ["3", "a:b", "-2:", "3:3", "4:2", "0:6", "5:9", slice(0, 4, 2), slice(-2, None)]
)
def test_bad_ranges_are_refused(drive: Path, frames: str | slice) -> None:
    with pytest.raises(ConfigError, match=r"^frames .*(the drive has frames 0:5|expected)"):
        open_source(drive, frames=frames)


# --- what is missing is left out and counted --------------------------------------------------------------


def test_missing_labels_masks_and_pictures_are_left_out_and_counted(
    drive: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (drive / "labels/000001.label").unlink()
    (drive / "semantic_2/000002.png").unlink()
    (drive / "image_2/000003.png").unlink()
    (drive / "image_2/000004.png").unlink()
    (drive / "semantic_2/000004.png").unlink()
    (drive / "velodyne/000000.bin").unlink()
    source = open_source(drive)
    frames = list(source)
    assert [frame.scan is None for frame in frames] == [True, False, False, False, False]
    assert [frame.image is None for frame in frames] == [False, False, False, False, True]
    unlabelled, bare, blind = frames[1].scan, frames[2].image, frames[3].image
    assert unlabelled is not None and not unlabelled.has_labels and len(unlabelled.points) == POINTS
    assert bare is not None and not bare.has_mask and bare.has_picture
    assert blind is not None and blind.has_mask and not blind.has_picture
    with caplog.at_level("WARNING", "sst_graph"):
        found = prepare_drive(source, (SemanticClass.VEHICLE,))
    assert found.left_out.counts() == {
        "scans_without_labels": 1,
        "images_without_mask": 1,
        "images_without_picture": 1,
    }
    assert len(found.image_pairs) == len(found.images) - 1
    assert [record.getMessage() for record in caplog.records] == [
        "kitti/00: left out: 1 scan without labels, 1 image without mask, 1 image without picture"
    ]


def test_a_drive_without_any_label_is_no_surprise(drive: Path, caplog: pytest.LogCaptureFixture) -> None:
    shutil.rmtree(drive / "labels")
    shutil.rmtree(drive / "semantic_2")
    with caplog.at_level("WARNING", "sst_graph"):
        found = prepare_drive(open_source(drive), (SemanticClass.OBJECT,))
    assert found.left_out.counts() == {"scans_without_labels": FRAMES, "images_without_mask": FRAMES}
    assert not caplog.records


def test_a_cloud_in_millimetres_is_read_for_the_diagnosis_to_name_its_unit(drive: Path) -> None:
    """Of 85 m."""
    coordinate(3, 85_000.0)(drive)
    scan = open_source(drive)[2].scan
    assert scan is not None and scan.left_out == 0 and float(scan.points[3, 1]) == 85_000.0


@pytest.mark.parametrize("value", [np.nan, -np.inf])
def test_points_that_are_no_numbers_are_left_out_with_their_labels_and_times(
    drive: Path, value: float
) -> None:
    (drive / "velodyne_times").mkdir()
    times = np.linspace(-0.05, 0.05, POINTS).astype("<f4")
    for k in range(FRAMES):
        times.tofile(drive / f"velodyne_times/{k:06d}.bin")
    coordinate(1, value)(drive)
    coordinate(7, value)(drive)
    bad = times.copy()
    bad[[1, 7]] = np.nan  # nobody asks for the time of a point that is not there
    bad.tofile(drive / "velodyne_times/000002.bin")
    labels = np.fromfile(drive / "labels/000002.label", "<u4")
    labels[7] = 7  # nor for its class
    labels.tofile(drive / "labels/000002.label")
    whole = np.fromfile(drive / "velodyne/000002.bin", "<f4").reshape(-1, 4)[:, :3]
    scan = open_source(drive)[2].scan
    assert scan is not None and scan.left_out == 2 and scan.offsets_s is not None
    kept = np.delete(np.arange(POINTS), [1, 7])
    assert np.array_equal(scan.points, whole[kept]) and np.array_equal(scan.offsets_s, times[kept])
    assert (scan.classes == SemanticClass.VEHICLE).tolist() == [k in (0, 2) for k in kept]
    drive_ = prepare_drive(open_source(drive), (SemanticClass.VEHICLE,))
    assert drive_.left_out.counts() == {"points": 2, "scans_with_such_points": 1}


def test_complete_data_report_nothing_missing(drive: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level("INFO", "sst_graph"):
        assert prepare_drive(open_source(drive), (SemanticClass.VEHICLE,)).left_out.counts() == {}
    assert caplog.records == []


def test_folders_without_any_partner_are_refused(drive: Path) -> None:
    for path in (drive / "semantic_2").iterdir():
        path.rename(path.with_name(f"{int(path.stem) + 5:06d}.png"))
    (drive / "times.txt").write_text("".join(f"{0.1 * k}\n" for k in range(10)))
    with pytest.raises(DataError, match="semantic_2: found no file with the number of one beside it"):
        open_source(drive)


@pytest.mark.parametrize("name", ["calib.txt", "times.txt", SCAN, "labels/000002.label", PICTURE, MASK])
def test_what_is_no_regular_file_is_refused_at_once(drive: Path, name: str) -> None:
    (drive / name).unlink()
    os.mkfifo(drive / name)
    with pytest.raises(DataError, match=f"{name}: found a FIFO"):
        read_all(drive)
    (drive / name).unlink()
    (drive / name).symlink_to(Path(name).name)
    with pytest.raises(DataError, match=f"{name}: found an unreadable file"):
        read_all(drive)


def test_a_folder_in_place_of_the_truth_is_refused(drive: Path) -> None:
    (drive / "groundtruth.json").mkdir()
    with pytest.raises(DataError, match=r"groundtruth\.json: found a folder"):
        open_source(drive)


def test_a_name_that_would_write_to_the_terminal_is_shown(drive: Path) -> None:
    folder = drive.parent.parent
    evil = folder.with_name("evil\x1b[31m\nname")
    folder.rename(evil)
    assert open_source(evil).name == r"evil\x1b[31m\nname/00"
    (evil / "sequences/00/calib.txt").unlink()
    with pytest.raises(DataError) as caught:
        open_source(evil)
    assert str(caught.value).isprintable()


def test_missing_pictures_are_no_repeated_picture() -> None:
    """What the statistics compares of images without pictures is their masks."""
    masks = [np.full((6, 8), c, np.uint8) for c in (0, 1, 1)]
    a, b, c = (image_statistics(k, CameraImage(k, mask, NO_PICTURE)) for k, mask in enumerate(masks))
    assert a.picture_digest != b.picture_digest == c.picture_digest and not a.profiles


def test_a_drive_without_any_labels_is_read(kitti_drive: Path) -> None:
    shutil.rmtree(kitti_drive / "labels")
    shutil.rmtree(kitti_drive / "semantic_2")
    frame = open_source(kitti_drive)[0]
    assert frame.scan is not None
    assert frame.image is not None
    assert not frame.scan.has_labels
    assert not frame.image.has_mask
    assert frame.image.has_picture

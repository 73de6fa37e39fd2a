"""Bags that cannot be used: one clear line and exit code 2."""

from __future__ import annotations

import os
import re
import shutil
import struct
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rosbags")

from bags import CLOUD, EPOCH_NS, IMAGE, INFO, KINDS, MASK, BagWriter, Kind, Messages, files_of, writing

from sst_graph.cameras import BrownConradyCamera, Rectification
from sst_graph.cli import main
from sst_graph.data import open_source
from sst_graph.errors import MissingDependencyError
from sst_graph.factors.camera import PinholeCamera
from sst_graph.types import SemanticClass

CAMERA = PinholeCamera(30.0, 30.0, 16.0, 12.0, 32, 24)
MAKE = Messages()
PIXELS = np.full((24, 32, 3), 60, np.uint8)
CHUNK_INDEX = 8
"""Opcode of a record of MCAP."""


def cloud(stamp_ns: int, make: Messages = MAKE) -> Any:
    points = np.zeros(20, [("x", "<f4"), ("y", "<f4"), ("z", "<f4")])
    points["x"] = np.arange(20) + 1.0
    return make.cloud(stamp_ns, points)


def fill(bag: BagWriter, leave_out: Sequence[str] = (), frames: int = 4, later_ns: int = 0) -> None:
    """A tiny drive at 10 Hz."""
    make = bag.messages
    for k in range(frames):
        stamp_ns = EPOCH_NS + k * 100_000_000
        for topic, message in (
            (INFO, make.info(CAMERA, stamp_ns)),
            (IMAGE, make.image(stamp_ns + later_ns, PIXELS)),
            (CLOUD, cloud(stamp_ns, make)),
        ):
            if topic not in leave_out:
                bag.add(topic, message, stamp_ns)


def made(tmp_path: Path, *changes: Callable[[BagWriter], None], kind: Kind = "mcap") -> Path:
    path = tmp_path / ("drive.bag" if kind == "ros1" else "drive")
    with writing(path, kind) as bag:
        for change in changes:
            change(bag)
    return path


def refused(capsys: pytest.CaptureFixture[str], path: Path, *options: str) -> str:
    assert main(["info", str(path), *options]) == 2
    out, err = capsys.readouterr()
    lines = [line for line in err.splitlines() if line.strip()]
    assert out == "" and len(lines) == 1 and lines[0].startswith("sst-graph: error: ")
    return lines[0]


def test_a_topic_is_missing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = refused(capsys, made(tmp_path, lambda bag: fill(bag, [CLOUD])))
    assert "no topic of sensor_msgs/msg/PointCloud2" in line
    assert f"{IMAGE} (sensor_msgs/Image, 4)" in line and f"{INFO} (sensor_msgs/CameraInfo, 4)" in line


def test_two_image_topics_are_listed_and_one_is_chosen(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def rear(bag: BagWriter) -> None:
        bag.add("/rear/image", bag.messages.image(EPOCH_NS + 1, PIXELS), EPOCH_NS)

    path = made(tmp_path, fill, rear)
    line = refused(capsys, path)
    assert "/front/image_rect (sensor_msgs/Image, 4), /rear/image (sensor_msgs/Image, 1)" in line
    assert line.endswith("expected one, named by --image-topic; several cameras by --camera")
    assert main(["info", str(path), "--image-topic", "/rear/image"]) == 0
    assert "1 in /rear/image" in capsys.readouterr().out


def test_a_compressed_copy_is_no_second_camera(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def copy(bag: BagWriter) -> None:
        bag.add(f"{IMAGE}/compressed", bag.messages.compressed(EPOCH_NS, b"x"), EPOCH_NS)

    assert main(["info", str(made(tmp_path, fill, copy))]) == 0
    assert f"4 in {IMAGE}" in capsys.readouterr().out


def test_depths_of_an_rgb_d_camera_are_no_second_camera_and_no_lidar(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def depths(bag: BagWriter) -> None:
        raw = bag.messages.image(EPOCH_NS, np.zeros((24, 64), np.uint8), "16UC1")
        for topic in ("/front/depth/image_rect_raw", "/front/aligned_depth_to_color/image_raw"):
            bag.add(topic, raw, EPOCH_NS)
        bag.add("/front/depth/color/points", cloud(EPOCH_NS), EPOCH_NS)

    assert main(["info", str(made(tmp_path, fill, depths))]) == 0
    out = capsys.readouterr().out
    assert f"4 in {IMAGE}" in out and f"4 in {CLOUD}" in out
    # Where there is nothing else they are taken, or refused by what they hold.
    alone = made(tmp_path / "alone", lambda bag: fill(bag, [IMAGE, CLOUD]), depths)
    assert "several topics of sensor_msgs/msg/Image" in refused(capsys, alone)


def test_a_named_topic_that_is_not_there_or_of_another_type(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = made(tmp_path, fill)
    assert "no message of /masks (--mask-topic); there are" in refused(capsys, path, "--mask-topic", "/masks")
    line = refused(capsys, path, "--cloud-topic", IMAGE)
    assert f"--cloud-topic {IMAGE} of sensor_msgs/msg/Image, expected sensor_msgs/msg/PointCloud2" in line


def test_an_encoding_that_is_not_understood(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def deep(bag: BagWriter) -> None:
        bag.add(IMAGE, bag.messages.image(EPOCH_NS, np.zeros((24, 64), np.uint8), "16UC1"), EPOCH_NS)

    line = refused(capsys, made(tmp_path, lambda bag: fill(bag, [IMAGE]), deep))
    assert "found encoding '16UC1', expected one of mono8" in line


def test_fields_that_are_not_understood(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def polar(bag: BagWriter) -> None:
        points = np.zeros(20, [("range", "<f4"), ("azimuth", "<f4")])
        bag.add(CLOUD, bag.messages.cloud(EPOCH_NS, points), EPOCH_NS)

    line = refused(capsys, made(tmp_path, lambda bag: fill(bag, [CLOUD]), polar))
    assert "found fields range, azimuth without x, y, z, expected a cloud with x, y, z" in line


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("share", [0.0, 0.02, 0.4, 0.9])
def test_a_bag_cut_short(
    kind: Kind, share: float, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = made(tmp_path, lambda bag: fill(bag, frames=40), kind=kind)
    file = path if kind == "ros1" else files_of(path, ".mcap" if kind == "mcap" else ".db3")[0]
    file.write_bytes(file.read_bytes()[: int(share * file.stat().st_size)])
    line = refused(capsys, path)
    assert str(path) in line and "cut short" in line


def test_stamps_of_zero_and_the_times_of_recording(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def unstamped(bag: BagWriter) -> None:
        for k in range(4):
            bag.add(IMAGE, bag.messages.image(0, PIXELS), EPOCH_NS + k * 50_000_000)

    path = made(tmp_path, lambda bag: fill(bag, [IMAGE]), unstamped)
    assert "4 of 4 messages with stamp 0" in refused(capsys, path)
    stamps = [f.image.stamp_ns for f in open_source(path, stamps="received") if f.image is not None]
    assert stamps == [EPOCH_NS + k * 50_000_000 for k in range(4)]


@pytest.mark.parametrize("header_ns", [0, EPOCH_NS])
def test_masks_belong_to_their_images_at_the_times_of_recording(tmp_path: Path, header_ns: int) -> None:
    """By their headers, where these are stamped."""

    def masked(bag: BagWriter) -> None:
        for k in range(3):
            stamp_ns, received_ns = header_ns and header_ns + k, EPOCH_NS + k * 50_000_000
            mask = np.full(PIXELS.shape[:2], 26 if k == 1 else 0, np.uint8)
            bag.add(IMAGE, bag.messages.image(stamp_ns, PIXELS), received_ns)
            bag.add(
                MASK, bag.messages.image(stamp_ns, mask, "mono8"), received_ns + bool(header_ns) * 2_000_000
            )

    path = made(tmp_path, lambda bag: fill(bag, [IMAGE]), masked)
    images = [frame.image for frame in open_source(path, stamps="received", mask_topic=MASK)]
    assert [image.mask.max() == SemanticClass.VEHICLE for image in filter(None, images)] == [
        False,
        True,
        False,
    ]


def test_stamps_that_jump_back(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def back(bag: BagWriter) -> None:
        stamp_ns = EPOCH_NS - 5_000_000_000
        bag.add(IMAGE, bag.messages.image(stamp_ns, PIXELS), EPOCH_NS + 1_000_000_000)

    assert "stamps that jump back by 5.300 s at message 4" in refused(capsys, made(tmp_path, fill, back))


def test_messages_out_of_order_are_sorted_and_repeated_ones_left_out(tmp_path: Path) -> None:
    def late(bag: BagWriter) -> None:
        for stamp_ns in (EPOCH_NS + 150_000_000, EPOCH_NS + 300_000_000):
            bag.add(IMAGE, bag.messages.image(stamp_ns, PIXELS), EPOCH_NS + 1_000_000_000)

    source = open_source(made(tmp_path, fill, late))
    stamps = [f.image.stamp_ns - EPOCH_NS for f in source if f.image is not None]
    assert stamps == [0, 100_000_000, 150_000_000, 200_000_000, 300_000_000]


def test_images_of_a_lens_that_distorts_are_rectified(tmp_path: Path) -> None:
    def distorted(bag: BagWriter) -> None:
        info = bag.messages.info(CAMERA, d=np.array([-0.2, 0.0, 0.0, 0.0, 0.0]))
        bag.add("/raw/camera_info", info, EPOCH_NS)
        bag.add("/raw/image", bag.messages.image(EPOCH_NS, PIXELS), EPOCH_NS)

    source = open_source(made(tmp_path, distorted, lambda bag: fill(bag, [IMAGE, INFO])))
    rectification = Rectification.of(BrownConradyCamera(CAMERA, (-0.2, 0.0, 0.0, 0.0, 0.0)))
    assert source.camera == rectification.camera
    pictures = [frame.image.pixels for frame in source if frame.image is not None]
    assert pictures and all((picture == rectification.picture(PIXELS)).all() for picture in pictures)


PLAIN = "fx: 31\nfy: 32\ncx: 16\ncy: 12\nwidth: 32\nheight: 24\n"
LENS = "distortion_model: plumb_bob\ndistortion: [-0.1, 0, 0, 0]\n"
CHAIN = """
cam0: {intrinsics: [30, 30, 16, 12], resolution: [32, 24], rostopic: /rear/image_raw}
cam1: {intrinsics: [31, 32, 16, 12], resolution: [32, 24], rostopic: %s}
"""


def test_a_file_stands_in_the_place_of_a_missing_or_empty_camera_info(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def without_calibration(bag: BagWriter) -> None:
        bag.add(INFO, bag.messages.info(CAMERA, k=np.zeros(9), p=np.zeros(12)), EPOCH_NS)
        fill(bag, leave_out=[INFO])

    (tmp_path / "a").mkdir()
    missing = made(tmp_path / "a", lambda bag: fill(bag, leave_out=[INFO]))
    assert "the camera in a file (--camera-file)" in refused(capsys, missing)
    empty = made(tmp_path, without_calibration)
    assert "K = 0, an uncalibrated camera, expected a calibrated one, or its file" in refused(capsys, empty)
    file = tmp_path / "camera.yaml"
    for bag in (missing, empty):
        for text in (PLAIN, CHAIN % IMAGE, CHAIN % "/front/image_raw/compressed"):
            file.write_text(text)
            source = open_source(bag, camera_file=str(file))
            assert source.camera == PinholeCamera(31.0, 32.0, 16.0, 12.0, 32, 24)
    assert main(["info", str(missing), "--camera-file", str(file)]) == 0
    assert f"camera model from {file}" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (PLAIN.replace("32\nh", "64\nh"), "64x24 px, expected 32x24 px, the size of the images"),
        (PLAIN + LENS, "a plumb_bob lens for /front/image_rect, whose name says"),
        (CHAIN % "/left/image_raw", "cam0 (/rear/image_raw), cam1 (/left/image_raw), expected one of"),
        ("a: 1\n", "found keys a, expected fx, fy, cx, cy"),
    ],
)
def test_files_that_are_not_the_camera_of_the_images(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, words: str
) -> None:
    path, file = made(tmp_path, fill), tmp_path / "camera.yaml"
    file.write_text(text)
    assert words in refused(capsys, path, "--camera-file", str(file))
    found = refused(capsys, path, "--camera-file", str(file), "--info-topic", INFO)
    assert f"--info-topic {INFO}: means nothing with --camera-file" in found


@pytest.mark.parametrize("kind", KINDS)
def test_a_camera_whose_model_changes_is_reported(
    tmp_path: Path, kind: Kind, caplog: pytest.LogCaptureFixture
) -> None:
    """The first model that is none of zeros is taken: a driver may publish zeros until it has one."""

    def infos(*cameras: PinholeCamera | None) -> Callable[[BagWriter], None]:
        def add(bag: BagWriter) -> None:
            for k, camera in enumerate(cameras):
                stamp_ns = EPOCH_NS + k * 50_000_000
                message = bag.messages.info(camera or CAMERA, stamp_ns)
                name = "K" if kind == "ros1" else "k"
                bag.add(INFO, message if camera else replace(message, **{name: np.zeros(9)}), stamp_ns)

        return add

    other = replace(CAMERA, fx=40.0)
    for k, (cameras, fx, others) in enumerate(
        [
            ((CAMERA, CAMERA, CAMERA), 30.0, 0),
            ((CAMERA, other, CAMERA, other), 30.0, 2),
            ((None, other, None, other), 40.0, 0),
        ]
    ):
        caplog.clear()
        folder = tmp_path / f"{k}"
        folder.mkdir()
        drive = open_source(made(folder, infos(*cameras), lambda bag: fill(bag, [INFO]), kind=kind))
        assert drive.camera.fx == fx
        said = f"{others} CameraInfo of {INFO} of another camera than the first"
        assert (said in caplog.text) == (said in " ".join(drive.facts().notes)) == bool(others)


def test_masks_with_stamps_of_no_image(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def masks(bag: BagWriter) -> None:
        bag.add(MASK, bag.messages.image(EPOCH_NS + 7, PIXELS[..., 0].copy(), "mono8"), EPOCH_NS)

    line = refused(capsys, made(tmp_path, fill, masks), "--mask-topic", MASK)
    assert f"masks at other stamps, such as {EPOCH_NS + 7} ns" in line


def test_options_of_other_formats(
    tmp_path: Path, kitti_drive: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = made(tmp_path, fill)
    assert "--sequence 1: means nothing for" in refused(capsys, path, "--sequence", "1")
    assert "--mask-topic /m: means nothing for" in refused(capsys, kitti_drive, "--mask-topic", "/m")
    assert "the drive has frames 0:4" in refused(capsys, path, "--frames", "3:9")


@pytest.mark.parametrize("kind", ["sqlite3", "mcap"])
def test_a_folder_whose_recording_was_ended_before_its_metadata(
    kind: Kind, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One file is the bag; several are put together by ROS, which knows how."""
    path = made(tmp_path, fill, kind=kind)
    whole = open_source(path)
    (path / "metadata.yaml").unlink()
    alone = open_source(path)
    stamps = [[frame.scan.stamp_ns for frame in drive if frame.scan is not None] for drive in (alone, whole)]
    assert len(stamps[0]) == 4 and stamps[0] == stamps[1]
    (only,) = files_of(path, {"mcap": ".mcap", "sqlite3": ".db3"}[kind])
    shutil.copy(only, path / f"later{only.suffix}")
    found = refused(capsys, path)
    assert "found 2 bags (drive" in found and "'ros2 bag reindex' writes it" in found


def test_the_parts_of_a_ros1_bag(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """ROS 1 keeps no list of them; the package that reads bags puts them together."""
    for k in range(2):
        with writing(tmp_path / f"drive_{k}.bag", "ros1") as bag:
            fill(bag)
    found = refused(capsys, tmp_path)
    assert "found 2 bags (drive_0.bag, drive_1.bag)" in found and "ros2" not in found
    assert f"'rosbags-convert --src {tmp_path}/*.bag --dst DRIVE' joins the parts of one drive" in found


@pytest.mark.parametrize("text", ["", "rosbag2_bagfile_information:\n", "rosbag2_bagfile_information: 3\n"])
def test_a_folder_whose_metadata_lacks_entries(
    text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = made(tmp_path, fill)
    (path / "metadata.yaml").write_text(text)
    line = refused(capsys, path)
    assert "cannot be read" in line and "NoneType" not in line and "Error" not in line


@pytest.mark.parametrize("count", ["-1", "9" * 400, "0x" + "f" * 6000])
def test_a_count_of_messages_that_is_none(
    count: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = made(tmp_path, fill)
    metadata = path / "metadata.yaml"
    metadata.write_text(re.sub("message_count: [0-9]+", f"message_count: {count}", metadata.read_text()))
    line = refused(capsys, path)
    assert "cannot be read" in line and "a count of messages that is none" in line


def test_an_mcap_file_of_other_messages_than_those_of_ros_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = made(tmp_path, fill)
    (only,) = files_of(path, ".mcap")
    data = only.read_bytes()
    assert data[21:25] == b"ros2"
    other = tmp_path / "other.mcap"
    other.write_bytes(data[:21] + b"ros1" + data[25:])
    assert "found MCAP of profile 'ros1', expected profile 'ros2'" in refused(capsys, other)


@pytest.mark.parametrize("kind", KINDS)
def test_a_fifo_in_the_place_of_a_file_is_not_waited_for(
    kind: Kind, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = made(tmp_path, fill, kind=kind)
    file = path if kind == "ros1" else files_of(path, ".mcap" if kind == "mcap" else ".db3")[0]
    file.unlink()
    os.mkfifo(file)
    said = "no layout that is known" if kind == "ros1" else "a FIFO, expected a bag"
    assert f"{file}: found {said}" in refused(capsys, path)


def test_what_is_no_bag(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "notes.txt").write_text("no bag")
    assert "found no layout that is known" in refused(capsys, tmp_path / "notes.txt")
    assert "found no bag, expected a bag: PATH.bag" in refused(capsys, tmp_path, "--loader", "ros")
    assert "no file or folder" in refused(capsys, tmp_path / "absent.mcap")


def test_without_rosbags_the_message_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = made(tmp_path, fill)
    monkeypatch.setitem(sys.modules, "rosbags.rosbag2", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'sst-graph\[ros\]'"):
        open_source(path)


def test_an_index_that_points_far_behind_the_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (file,) = files_of(made(tmp_path, fill), ".mcap")
    data = bytearray(file.read_bytes())
    (summary,) = struct.unpack_from("<Q", data, len(data) - 8 - 4 - 16)
    while data[summary] != CHUNK_INDEX:
        summary += 9 + struct.unpack_from("<Q", data, summary + 1)[0]
    struct.pack_into("<Q", data, summary + 9 + 16, 2**63 - 40)  # start of the chunk
    file.write_bytes(data)
    line = refused(capsys, file)
    assert "cannot be read" in line and str(file) in line

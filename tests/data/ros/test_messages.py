"""Messages of the sensors: encodings, fields, layouts."""

from __future__ import annotations

import dataclasses
import tracemalloc
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import gtsam
import numpy as np
import pytest

pytest.importorskip("rosbags")

from bags import CAMERA_FRAME, EPOCH_NS, LIDAR_FRAME, Messages, chain

from sst_graph.cameras import BrownConradyCamera
from sst_graph.data.point_files import read_cloud
from sst_graph.data.ros.camera_info import image_geometry
from sst_graph.data.ros.clouds import MessagePoints, cloud_of
from sst_graph.data.ros.images import mask_of, picture_of
from sst_graph.data.ros.topics import COMPRESSED, IMAGE
from sst_graph.data.ros.transforms import Transforms
from sst_graph.errors import DataError
from sst_graph.factors.camera import PinholeCamera

MAKE = Messages()
RNG = np.random.default_rng(4)
BGR = RNG.integers(0, 255, (6, 10, 3), dtype=np.uint8)
STAMP_NS = EPOCH_NS + 123_456_789
CAMERA = PinholeCamera(700.0, 710.0, 320.0, 180.0, 640, 360)


@pytest.mark.parametrize("padding", [0, 5])
def test_colours_in_every_order(padding: int) -> None:
    alpha = np.full((6, 10, 1), 9, np.uint8)
    for encoding, pixels in {
        "bgr8": BGR,
        "rgb8": BGR[..., ::-1],
        "bgra8": np.concatenate([BGR, alpha], axis=2),
        "rgba8": np.concatenate([BGR[..., ::-1], alpha], axis=2),
    }.items():
        message = MAKE.image(STAMP_NS, np.ascontiguousarray(pixels), encoding, padding)
        np.testing.assert_array_equal(picture_of(message, IMAGE, "here"), BGR)
    grey = MAKE.image(STAMP_NS, BGR[..., 0].copy(), "mono8", padding)
    np.testing.assert_array_equal(picture_of(grey, IMAGE, "here"), np.repeat(BGR[..., :1], 3, axis=2))


@pytest.mark.parametrize("padding", [0, 6])
@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("encoding", ["mono", "rgb", "bgra", "bayer_grbg"])
def test_of_16_bits_the_upper_ones_are_read(encoding: str, big: bool, padding: int) -> None:
    shape = {"rgb": (6, 10, 3), "bgra": (6, 10, 4)}.get(encoding, (6, 10))
    values = RNG.integers(0, 2**16, shape, dtype=np.uint16)
    data = values.astype(">u2" if big else "<u2").view(np.uint8).reshape(6, -1)
    of_16 = replace(MAKE.image(STAMP_NS, data, f"{encoding}16", padding), width=10, is_bigendian=int(big))
    of_8 = MAKE.image(STAMP_NS, (values >> 8).astype(np.uint8), f"{encoding}8")
    np.testing.assert_array_equal(picture_of(of_16, IMAGE, "here"), picture_of(of_8, IMAGE, "here"))
    with pytest.raises(DataError, match=f"expected 20x6 px of .* bytes .{encoding}16"):
        picture_of(replace(of_16, width=20), IMAGE, "here")


@pytest.mark.parametrize("encoding", ["yuv422", "yuv422_yuy2"])
def test_a_picture_of_a_size_that_its_encoding_cannot_have(encoding: str) -> None:
    """Two pixels share their colour, and seven cannot."""
    even = MAKE.image(STAMP_NS, np.full((6, 8, 2), 128, np.uint8), encoding)
    assert picture_of(even, IMAGE, "here").shape == (6, 8, 3)
    odd = MAKE.image(STAMP_NS, np.full((6, 7, 2), 128, np.uint8), encoding)
    with pytest.raises(DataError, match=f"7x6 px, expected a size that encoding {encoding} can have"):
        picture_of(odd, IMAGE, "here")


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_bayer_patterns_give_the_colour_of_the_scene(pattern: str) -> None:
    colour = {"b": 40, "g": 120, "r": 220}
    tile = np.array([colour[letter] for letter in pattern], np.uint8).reshape(2, 2)
    message = MAKE.image(STAMP_NS, np.tile(tile, (8, 8)), f"bayer_{pattern}8")
    np.testing.assert_array_equal(
        picture_of(message, IMAGE, "here")[4:-4, 4:-4], np.full((8, 8, 3), (40, 120, 220))
    )


@pytest.mark.parametrize("form", ["bayer_{}8; png compressed ", "bayer_{}16; png compressed", "{}8", "mono8"])
def test_bayer_patterns_that_were_compressed_as_they_are(form: str) -> None:
    for pattern in ("rggb", "bggr", "gbrg", "grbg"):
        mosaic = RNG.integers(0, 255, (8, 10), dtype=np.uint8)
        data = cv2.imencode(".png", mosaic)[1].tobytes()
        found = picture_of(MAKE.compressed(STAMP_NS, data, form.format(pattern)), COMPRESSED, "here")
        plain = MAKE.image(STAMP_NS, mosaic, f"bayer_{pattern}8" if "bayer" in form else "mono8")
        np.testing.assert_array_equal(found, picture_of(plain, IMAGE, "here"))
    # A camera's driver may have made it colours before.
    data = cv2.imencode(".png", BGR)[1].tobytes()
    colours = MAKE.compressed(STAMP_NS, data, "bayer_rggb8; png compressed bgr8")
    np.testing.assert_array_equal(picture_of(colours, COMPRESSED, "here"), BGR)


def test_compressed_pictures_and_masks() -> None:
    data = cv2.imencode(".png", BGR)[1].tobytes()
    np.testing.assert_array_equal(picture_of(MAKE.compressed(STAMP_NS, data), COMPRESSED, "here"), BGR)
    mask = np.arange(30, dtype=np.uint8).reshape(5, 6)
    data = cv2.imencode(".png", mask)[1].tobytes()
    np.testing.assert_array_equal(mask_of(MAKE.compressed(STAMP_NS, data), COMPRESSED, "here"), mask)
    jpeg = cv2.imencode(".jpg", np.full((16, 16, 3), 90, np.uint8))[1].tobytes()
    found = picture_of(MAKE.compressed(STAMP_NS, jpeg, "bgr8; jpeg compressed bgr8"), COMPRESSED, "here")
    assert np.abs(found.astype(int) - 90).max() <= 2
    with pytest.raises(DataError, match="truncated"):
        picture_of(MAKE.compressed(STAMP_NS, jpeg[:-40], "jpeg"), COMPRESSED, "here")


@pytest.mark.parametrize(
    ("message", "words"),
    [
        (
            MAKE.image(STAMP_NS, np.zeros((4, 8), np.uint8), "16UC1"),
            "'16UC1', expected one of mono8.*8 bits",
        ),
        (MAKE.image(STAMP_NS, BGR[:, :4].copy(), "rgba8"), "12, expected 4x6 px of 4 bytes"),
        (MAKE.compressed(STAMP_NS, b"x", "16UC1; compressedDepth png"), "compressedDepth"),
    ],
)
def test_pictures_that_are_not_understood(message: Any, words: str) -> None:
    type_name = IMAGE if hasattr(message, "encoding") else COMPRESSED
    with pytest.raises(DataError, match=words):
        picture_of(message, type_name, "here")
    with pytest.raises(DataError, match="mask in encoding 'bgr8'"):
        mask_of(MAKE.image(STAMP_NS, BGR), IMAGE, "here")


def table(count: int = 5, **columns: Any) -> np.ndarray[Any, Any]:
    """x y z in 1, 2, 3, ... and other columns."""
    dtype = [(axis, "<f4") for axis in "xyz"] + [(name, values.dtype) for name, values in columns.items()]
    rows = np.zeros(count, dtype)
    for k, axis in enumerate("xyz"):
        rows[axis] = np.arange(count) + 1 + k
    for name, values in columns.items():
        rows[name] = values
    return rows


def read(rows: np.ndarray[Any, Any], big: bool = False, **options: bool) -> MessagePoints:
    return cloud_of(MAKE.cloud(STAMP_NS, rows, big), STAMP_NS, "here", **options)


SECONDS = np.array([0.0, 0.01, 0.025, 0.05, 0.0999])


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("t", (SECONDS * 1e9).round().astype("<u4")),  # Ouster
        ("offset_time", (SECONDS * 1e9).round().astype("<u4")),  # Livox
        ("time", SECONDS.astype("<f4")),  # Velodyne
        ("timestamp", SECONDS.astype("<f8")),  # Hesai, relative
        ("timestamp", 1_700_000_000.0 + (0.123456789 + SECONDS).astype("<f8")),  # Hesai, RoboSense
        ("timestamp", (SECONDS * 1e9 + float(STAMP_NS)).astype("<f8")),  # Livox, driver 2
        ("t", (SECONDS * 1e9).round().astype("<i8").astype("<u4")),
        ("time", (SECONDS * 1e6).astype("<f4")),  # drivers that count microseconds, milliseconds
        ("time", (SECONDS * 1e3).astype("<f4")),
        ("time", (SECONDS * 1e9).astype("<f8")),
        ("t", (SECONDS * 1e6).round().astype("<u4")),
        ("timestamp", (SECONDS * 1e6) + STAMP_NS * 1e-3),
    ],
)
def test_times_of_points(name: str, values: np.ndarray[Any, Any]) -> None:
    cloud = read(table(**{name: values}))
    assert cloud.offsets_s is not None and cloud.offsets_s.dtype == np.float32
    np.testing.assert_allclose(cloud.offsets_s, SECONDS, atol=5e-7)
    assert read(table(**{name: values}), times=False).offsets_s is None


@pytest.mark.parametrize(
    "rings", [np.arange(5, dtype=kind) for kind in ("u1", "<u2", "<i4", "<f4", "<f8")], ids=lambda r: r.dtype
)
@pytest.mark.parametrize("names", [("ring", "time"), ("Ring", "T"), ("channel", "time_stamp")])
def test_names_and_types_of_rings_and_times(rings: np.ndarray[Any, Any], names: tuple[str, str]) -> None:
    cloud = read(table(**{names[0]: rings, names[1]: SECONDS}))
    assert cloud.rings is not None and cloud.offsets_s is not None
    np.testing.assert_array_equal(cloud.rings, np.arange(5, dtype=np.uint16))
    np.testing.assert_allclose(cloud.offsets_s, SECONDS, atol=5e-7)


@pytest.mark.parametrize("values", [np.arange(5) - 1.0, np.arange(5) + 0.5, np.full(5, np.nan)])
def test_fields_called_ring_that_hold_no_laser_numbers_are_passed_over(values: np.ndarray[Any, Any]) -> None:
    assert read(table(ring=values)).rings is None
    assert read(table(ring=values, laser_id=np.arange(5, dtype=np.uint8))).rings is not None


def test_two_fields_whose_names_differ_in_case_only() -> None:
    """The first is taken."""
    cloud = read(table(t=SECONDS, T=np.full(5, 20.0)))
    assert cloud.offsets_s is not None
    np.testing.assert_allclose(cloud.offsets_s, SECONDS, atol=5e-7)


def test_times_before_the_stamp() -> None:
    cloud = read(table(time=-SECONDS.astype("<f4")))
    assert cloud.offsets_s is not None
    np.testing.assert_allclose(cloud.offsets_s, -SECONDS, atol=1e-8)


@pytest.mark.parametrize("values", [SECONDS / 1000.0, (SECONDS * 1e6).round().astype("<u4")])
def test_times_too_close_for_a_scan_in_any_unit_have_the_usual_one(values: np.ndarray[Any, Any]) -> None:
    """A part of the sweep that lasts 10 us."""
    few = values[:2] if values.dtype.kind == "f" else values[:2] // 10
    cloud = read(table(2, time=few))
    expected = few if few.dtype.kind == "f" else few * 1e-9
    assert cloud.offsets_s is not None
    np.testing.assert_allclose(cloud.offsets_s, expected, rtol=1e-6)


@pytest.mark.parametrize("kind", ["<f4", "<f8", "<u4"])
@pytest.mark.parametrize("value", [0, 1_700_000_000])
def test_times_that_are_all_the_same_are_none(kind: str, value: int) -> None:
    """Also absolute seconds as floats of 32 bits, which round to one value."""
    assert read(table(time=np.full(5, value, kind))).offsets_s is None


def test_times_of_another_clock_are_refused() -> None:
    with pytest.raises(DataError, match=r"field 'timestamp' with times up to .*--sweep clockwise"):
        read(table(timestamp=SECONDS + 1_600_000_000.0))


@pytest.mark.parametrize("big", [False, True])
def test_padding_byte_order_and_rows(big: bool) -> None:
    order = ">" if big else "<"
    layout = np.dtype(
        {
            "names": ["z", "ring", "x", "y"],
            "formats": [f"{order}f8", f"{order}u2", f"{order}f4", f"{order}f4"],
            "offsets": [1, 11, 13, 20],
            "itemsize": 37,
        }
    )
    rows = np.zeros((3, 4), layout)
    for k, name in enumerate("xyz"):
        rows[name] = np.arange(12).reshape(3, 4) + 1 + 100 * k
    rows["ring"] = np.arange(3)[:, None]
    message = MAKE.cloud(STAMP_NS, rows, big)
    expected = np.arange(12)[:, None] + np.array([1.0, 101.0, 201.0])
    cloud = cloud_of(message, STAMP_NS, "here")
    np.testing.assert_array_equal(cloud.points, expected)
    assert cloud.rings is not None and cloud.rings.tolist() == [0] * 4 + [1] * 4 + [2] * 4
    # The same with 6 bytes behind each row.
    data = np.concatenate([message.data.reshape(3, -1), np.full((3, 6), 255, np.uint8)], axis=1)
    message.data, message.row_step = data.ravel(), data.shape[1]
    np.testing.assert_array_equal(cloud_of(message, STAMP_NS, "here").points, expected)


def test_points_without_a_return_are_left_out_with_their_columns() -> None:
    rows = table(ring=np.arange(5, dtype="<u2"), time=SECONDS.astype("<f4"))
    rows["y"][1] = np.nan
    rows["time"][1] = np.nan
    for axis in "xyz":
        rows[axis][3] = 0.0
    cloud = read(rows)
    assert cloud.left_out == 2 and len(cloud.points) == 3
    assert cloud.rings is not None and cloud.rings.tolist() == [0, 2, 4]
    assert cloud.offsets_s is not None and cloud.offsets_s[1] == np.float32(0.025)


def test_a_single_laser_number_tells_no_lasers(tmp_path: Path) -> None:
    """Drivers leave the field at 0; lasers then follow from the order of the points."""
    assert read(table(ring=np.zeros(5, "<u2"))).rings is None
    rows = table(ring=np.full(5, 7, "<u2"))
    np.save(tmp_path / "a.npy", rows)
    assert read_cloud(tmp_path / "a.npy").rings() is None


def test_values_beyond_32_bits_are_left_out_in_silence() -> None:
    """Doubles that no float of 32 bits holds, and signalling NaN."""
    rows = np.zeros(4, [("x", "<f8"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f8")])
    rows["x"], rows["intensity"] = [1.0, 1e300, 2.0, -1e300], [1.0, 1.0, 1e300, 1.0]
    rows["y"].view("<u4")[2] = 0x7FA00000
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        cloud = read(rows)
    assert cloud.left_out == 3 and cloud.points.tolist() == [[1.0, 0.0, 0.0]]


def test_the_step_of_a_single_row_takes_no_memory() -> None:
    message = MAKE.image(STAMP_NS, BGR[:1])
    tracemalloc.start()
    picture = picture_of(dataclasses.replace(message, step=2**32 - 1), IMAGE, "here")
    assert tracemalloc.get_traced_memory()[1] < 1_000_000
    tracemalloc.stop()
    np.testing.assert_array_equal(picture, BGR[:1])


def test_labels_are_read_where_they_are_asked_for() -> None:
    rows = table(label=np.full(5, 10, "<u2"), instance=np.arange(5, dtype="<u2"))
    assert read(rows).labels is None
    labels = read(rows, labels=True).labels
    assert labels is not None and labels.tolist() == [10 | k << 16 for k in range(5)]
    packed = read(table(label=np.full(5, 10 | 7 << 16, "<u4")), labels=True).labels
    assert packed is not None and packed.tolist() == [10 | 7 << 16] * 5


def test_clouds_that_are_not_understood() -> None:
    with pytest.raises(
        DataError, match="fields range, azimuth without x, y, z, expected a cloud with x, y, z"
    ):
        read(np.zeros(3, [("range", "<f4"), ("azimuth", "<f4")]))
    message = MAKE.cloud(STAMP_NS, table())
    message.data = message.data[:-1]
    with pytest.raises(DataError, match="59 bytes, expected 5x1 points of 12 bytes"):
        cloud_of(message, STAMP_NS, "here")
    message.point_step = 8
    with pytest.raises(DataError, match="at least 12 bytes a point"):
        cloud_of(message, STAMP_NS, "here")


def test_intrinsics_of_raw_and_rectified_images() -> None:
    P = np.array([[650.0, 0, 300, -325], [0, 651, 170, 0], [0, 0, 1, 0]])
    R = gtsam.Rot3.Ypr(0.01, -0.02, 0.005)
    info = MAKE.info(CAMERA, p=P.ravel(), r=R.matrix().ravel())
    raw = image_geometry(info, "/cam/image_raw", (640, 360), "here")
    assert raw.model == BrownConradyCamera(CAMERA) and raw.cRo.equals(gtsam.Rot3(), 1e-12)
    rectified = image_geometry(info, "/cam/image_rect_color", (640, 360), "here")
    assert rectified.model == BrownConradyCamera(PinholeCamera(650.0, 651.0, 300.0, 170.0, 640, 360))
    assert rectified.cRo.equals(R, 1e-9)
    ros1 = Messages(is_ros1=True).info(CAMERA)
    assert image_geometry(ros1, "/cam/image_raw", (640, 360), "here").model.intrinsics == CAMERA


@pytest.mark.parametrize(
    ("topic", "rectified"),
    [
        ("/cam/image_rect", True),
        ("/cam/rect/image", True),
        ("/cam/rectified_image/compressed", True),
        ("/cam/image_unrect", False),
        ("/direct/image_raw", False),
        ("/redirected/image", False),
    ],
)
def test_images_are_rectified_by_a_word_of_their_topic(topic: str, rectified: bool) -> None:
    info = MAKE.info(CAMERA, p=np.array([650.0, 0, 300, 0, 0, 651, 170, 0, 0, 0, 1, 0]))
    found = image_geometry(info, topic, (640, 360), "here").model.intrinsics
    assert (found.fx == 650.0) == rectified


def region(x: int, y: int, width: int, height: int) -> Any:
    offsets = {"x_offset": x, "y_offset": y, "width": width, "height": height}
    return MAKE.make("sensor_msgs/msg/RegionOfInterest", **offsets, do_rectify=False)


@pytest.mark.parametrize("topic", ["/cam/image_raw", "/cam/image_rect"])
def test_images_of_a_part_of_the_sensor_and_binned_ones(topic: str) -> None:
    """A direction falls on u = (u_full - x_offset) / binning_x."""
    full = MAKE.info(CAMERA, d=np.array([-0.1, 0.01, 0.0, 0.0, 0.0]) * (topic == "/cam/image_raw"))
    rays = np.array([[0.1, -0.05, 1.0], [-0.2, 0.1, 1.0], [0.0, 0.0, 1.0]])
    whole, _ = image_geometry(full, topic, (640, 360), "here").model.project(rays)
    for changes, size, corner, binning in (
        ({"binning_x": 2, "binning_y": 2}, (320, 180), (0, 0), (2, 2)),
        ({"roi": region(40, 100, 500, 200)}, (500, 200), (40, 100), (1, 1)),
        ({"roi": region(41, 100, 500, 201), "binning_x": 4, "binning_y": 2}, (125, 100), (41, 100), (4, 2)),
        ({"roi": region(0, 0, 640, 360)}, (640, 360), (0, 0), (1, 1)),
        # Drivers that give the calibration of the binned images say the binning, too.
        ({"binning_x": 2, "binning_y": 2}, (640, 360), (0, 0), (1, 1)),
    ):
        model = image_geometry(replace(full, **changes), topic, size, "here").model
        assert (model.width, model.height) == size
        uvs, valid = model.project(rays)
        assert valid.all()
        np.testing.assert_allclose(uvs, (whole - corner) / binning, atol=1e-9)


def test_images_of_another_size_than_the_region_binned() -> None:
    info = MAKE.info(CAMERA, binning_x=2, binning_y=2, roi=region(0, 0, 600, 300))
    expected = "640x360 px, a region of 600x300 px, binned 2x2, expected 320x180 px, the size of the images"
    with pytest.raises(DataError, match=expected):
        image_geometry(info, "/cam/image_raw", (320, 180), "here")
    with pytest.raises(DataError, match="binning or a region of interest, expected images of the full"):
        image_geometry(replace(info, width=0, height=0), "/cam/image_raw", (320, 180), "here")
    # The region's size stands beside an offset from the corner: whose K is it?
    part = MAKE.info(CAMERA, roi=region(40, 100, CAMERA.width, CAMERA.height))
    with pytest.raises(DataError, match="binning or a region of interest, expected images of the full"):
        image_geometry(part, "/cam/image_raw", (CAMERA.width, CAMERA.height), "here")


def test_a_mask_of_inexact_numbers_is_refused() -> None:
    data = cv2.imencode(".jpg", np.full((6, 8), 26, np.uint8))[1].tobytes()
    with pytest.raises(
        DataError, match="a JPEG picture, whose numbers are not exact, expected a mask as PNG"
    ):
        mask_of(MAKE.compressed(STAMP_NS, data, "jpeg"), COMPRESSED, "here")


def test_cameras_that_cannot_be_used() -> None:
    distorted = MAKE.info(CAMERA, d=np.array([-0.3, 0.1, 0.0, 0.0, 0.0]))
    lens = image_geometry(distorted, "/cam/image_raw", (640, 360), "here").model
    assert lens == BrownConradyCamera(CAMERA, (-0.3, 0.1, 0.0, 0.0, 0.0))
    rectified = image_geometry(distorted, "/cam/image_rect", (640, 360), "here")
    assert rectified.model == BrownConradyCamera(CAMERA)
    for uncalibrated in (MAKE.info(CAMERA, d=np.zeros(0), width=0, height=0), MAKE.info(CAMERA)):
        found = image_geometry(uncalibrated, "/cam/image_raw", (640, 360), "here").model
        assert found == BrownConradyCamera(CAMERA)
    with pytest.raises(DataError, match="640x360 px, expected 320x180 px"):
        image_geometry(MAKE.info(CAMERA), "/cam/image_raw", (320, 180), "here")
    with pytest.raises(DataError, match="K = 0, an uncalibrated camera"):
        image_geometry(MAKE.info(CAMERA, k=np.zeros(9)), "/cam/image_raw", (640, 360), "here")
    sheared = np.array([1.0, 0.5, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0])
    for R in (sheared, np.full(9, np.inf)):
        with pytest.raises(DataError, match="here: R"):
            image_geometry(MAKE.info(CAMERA, r=R), "/cam/image_rect", (640, 360), "here")
    with pytest.raises(DataError, match="P = 0, an uncalibrated camera"):
        image_geometry(replace(distorted, p=np.zeros(12)), "/cam/image_rect", (640, 360), "here")
    only_K = MAKE.info(CAMERA, p=np.zeros(12), r=np.zeros(9))
    for D in (np.zeros(5), np.zeros(0)):
        found = image_geometry(replace(only_K, d=D), "/cam/image_rect", (640, 360), "here").model
        assert found == BrownConradyCamera(CAMERA)


CTL = gtsam.Pose3(gtsam.Rot3.Ypr(0.3, -0.2, 1.0), np.array([0.1, -0.3, 0.2]))


def transforms(*messages: Any) -> Transforms:
    found = Transforms()
    for message in messages:
        found.add(message)
    return found


def test_a_chain_of_transforms_gives_the_pose_of_the_lidar_in_the_camera() -> None:
    pose, words = transforms(MAKE.transforms(chain(CTL))).pose(CAMERA_FRAME, LIDAR_FRAME)
    assert pose is not None and pose.equals(CTL, 1e-9)
    assert words == f"by transforms {CAMERA_FRAME} - base_link - mast - {LIDAR_FRAME}"


def test_a_frame_that_no_transform_has_is_named_with_those_that_there_are() -> None:
    pose, words = transforms(MAKE.transforms(chain(CTL))).pose("usb_cam", LIDAR_FRAME)
    assert pose is None
    assert words.endswith(f"; 'usb_cam' not among base_link, {CAMERA_FRAME}, mast, {LIDAR_FRAME}")


def _with_quaternion(message: Any, xyzw: Sequence[float], x: float = 0.0) -> Any:
    """A TFMessage whose last transform has this quaternion, and this translation along x."""
    *others, last = message.transforms
    rotation = replace(last.transform.rotation, **dict(zip("xyzw", xyzw, strict=True)))
    translation = replace(last.transform.translation, x=x)
    changed = replace(last.transform, rotation=rotation, translation=translation)
    return replace(message, transforms=[*others, replace(last, transform=changed)])


@pytest.mark.parametrize(
    ("xyzw", "x", "words"),
    [
        ((0.0, 0.0, 0.0, 0.0), 0.0, "a quaternion of length 0, not 1"),
        ((1.0, 0.0, 0.0, 1.0), 0.0, "a quaternion of length 1.414, not 1"),
        ((np.nan, 0.0, 0.0, 1.0), 0.0, "a quaternion of length nan, not 1"),
        ((0.0, 0.0, 0.0, 1.0), np.inf, "a translation that is not finite"),
    ],
)
def test_a_transform_that_is_none_gives_no_pose(xyzw: Sequence[float], x: float, words: str) -> None:
    """Of messages that were never filled in gtsam would make the identity, of others no rotation."""
    found = transforms(_with_quaternion(MAKE.transforms({(CAMERA_FRAME, LIDAR_FRAME): CTL}), xyzw, x))
    expected = f"the transform from '{CAMERA_FRAME}' to '{LIDAR_FRAME}' has {words}"
    assert found.pose(CAMERA_FRAME, LIDAR_FRAME) == (None, expected)
    assert transforms().joined(found).pose(CAMERA_FRAME, LIDAR_FRAME) == (None, expected)


def test_a_quaternion_typed_by_hand_gives_a_rotation() -> None:
    message = MAKE.transforms({(CAMERA_FRAME, LIDAR_FRAME): CTL})
    pose, _ = transforms(_with_quaternion(message, (0.7, 0.0, 0.0, 0.7))).pose(CAMERA_FRAME, LIDAR_FRAME)
    assert pose is not None
    np.testing.assert_allclose(pose.rotation().matrix(), gtsam.Rot3.Rx(np.pi / 2).matrix(), atol=1e-12)


def test_chains_that_are_missing_moving_or_ambiguous_give_no_pose() -> None:
    edges = chain(CTL)
    whole = MAKE.transforms(edges)
    moved = MAKE.transforms({("base_link", "mast"): gtsam.Pose3()})
    second = MAKE.transforms({("roof", LIDAR_FRAME): gtsam.Pose3()})
    part = MAKE.transforms({edge: pose for edge, pose in edges.items() if edge[1] != "mast"})
    for found, words in (
        (transforms(part), "no chain of transforms"),
        (transforms(whole, moved), "from 'base_link' to 'mast' is not constant"),
        (transforms(whole, second), "several parents: mast, roof"),
    ):
        pose, reason = found.pose(CAMERA_FRAME, LIDAR_FRAME)
        assert pose is None and words in reason
    assert transforms(whole, whole).pose(CAMERA_FRAME, LIDAR_FRAME)[0] is not None


@pytest.mark.parametrize(
    ("turn_rad", "metres", "is_constant"),
    [(5e-5, 0.0, True), (0.0, 8e-4, True), (2e-4, 0.0, False), (0.0, 2e-3, False)],
)
def test_a_transform_that_is_published_with_rounding_is_constant(
    turn_rad: float, metres: float, is_constant: bool
) -> None:
    mast = chain(CTL)["base_link", "mast"]
    moved = mast * gtsam.Pose3(gtsam.Rot3.Rz(turn_rad), np.array([metres, 0.0, 0.0]))
    found = transforms(MAKE.transforms(chain(CTL)), MAKE.transforms({("base_link", "mast"): moved}))
    for either in (found, transforms().joined(found), found.beside(transforms())):
        pose, reason = either.pose(CAMERA_FRAME, LIDAR_FRAME)
        if is_constant:
            assert pose is not None and pose.equals(CTL, 1e-9)
            assert reason.endswith("; base_link - mast varies, by less than 1 mm and 1e-4 rad")
        else:
            assert pose is None and reason.endswith("from 'base_link' to 'mast' is not constant")

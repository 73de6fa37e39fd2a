"""Livox's CustomMsg: its bytes as rosbags writes them, and a bag of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rosbags")

from bags import EPOCH_NS, IMAGE, INFO, KINDS, Kind, Messages, writing
from rosbags.typesys import get_types_from_msg

from sst_graph.data import open_source
from sst_graph.data.info import drive_info
from sst_graph.data.ros.livox import CUSTOM, OLDER_CUSTOM, custom_points
from sst_graph.errors import DataError
from sst_graph.factors.camera import PinholeCamera

CAMERA = PinholeCamera(30.0, 30.0, 16.0, 12.0, 32, 24)
POINT = "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\nuint8 line\n"
MESSAGE = (
    "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\nuint8[3] rsvd\n"
    "CustomPoint[] points\n"
)
RNG = np.random.default_rng(8)


def custom(make: Messages, count: int, frame: str, name: str = CUSTOM) -> Any:
    """A message of points, each a millisecond after the other, the first of which is no return."""
    package = name.partition("/")[0]
    if name not in make.types.fielddefs:
        make.types.register(get_types_from_msg(POINT, f"{package}/msg/CustomPoint"))
        make.types.register(get_types_from_msg(MESSAGE, name))
    xyz = RNG.uniform(1.0, 20.0, (count, 3)).astype(np.float32)
    xyz[:1] = 0.0
    points = [
        make.make(
            f"{package}/msg/CustomPoint",
            offset_time=1_000_000 * k,
            **{axis: float(xyz[k, j]) for j, axis in enumerate("xyz")},
            reflectivity=k % 200,
            tag=16,
            line=k % 6,
        )
        for k in range(count)
    ]
    header = make.header(EPOCH_NS, frame)
    fields = {"timebase": EPOCH_NS, "point_num": count, "lidar_id": 1, "rsvd": np.zeros(3, np.uint8)}
    return make.make(name, header=header, points=points, **fields)


@pytest.mark.parametrize("count", [0, 1, 7])
@pytest.mark.parametrize("frame", ["", "livox_frame", "l", "li", "liv"])
@pytest.mark.parametrize("is_ros1", [True, False])
def test_points_are_those_that_rosbags_wrote(is_ros1: bool, frame: str, count: int) -> None:
    make = Messages(is_ros1)
    message = custom(make, count, frame)
    data = make.encoded(message)
    at = 16 + len(frame) + (not is_ros1)
    found = custom_points(data, at, is_ros1, "here")
    for name in ("offset_time", "x", "y", "z", "reflectivity", "tag", "line"):
        expected = np.array([getattr(point, name) for point in message.points], found.dtype[name])
        np.testing.assert_array_equal(found[name], expected)
    if count:
        with pytest.raises(DataError, match=r"found \d+ bytes for \d points?, expected a CustomMsg"):
            custom_points(data[:-4], at, is_ros1, "here")
    with pytest.raises(DataError, match="for 0 points, expected a CustomMsg"):
        custom_points(data[: at + 3], at, is_ros1, "here")


@pytest.mark.parametrize("name", [CUSTOM, *OLDER_CUSTOM])
@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_of_them_is_a_drive(kind: Kind, name: str, tmp_path: Path) -> None:
    path = tmp_path / ("drive.bag" if kind == "ros1" else "drive")
    with writing(path, kind) as bag:
        make: Any = bag.messages
        sent = custom(make, 100, "livox_frame", name)
        bag.add(INFO, make.info(CAMERA, EPOCH_NS), EPOCH_NS)
        bag.add(IMAGE, make.image(EPOCH_NS, np.full((24, 32, 3), 60, np.uint8)), EPOCH_NS)
        bag.add("/livox/lidar", sent, EPOCH_NS)
    assert (
        "of the clouds: offset_time, x, y, z, reflectivity, tag, line"
        in drive_info(open_source(path)).notes[1]
    )
    scan = open_source(path)[0].scan
    assert scan is not None and scan.stamp_ns == EPOCH_NS and scan.left_out == 1
    np.testing.assert_array_equal(scan.points[:, 1], np.array([p.y for p in sent.points[1:]], np.float32))
    assert scan.offsets_s is not None and scan.intensities is not None
    np.testing.assert_allclose(scan.offsets_s, 1e-3 * np.arange(1, 100), atol=1e-8)
    np.testing.assert_array_equal(scan.intensities, np.arange(1, 100, dtype=np.float32))

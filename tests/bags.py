"""Bags for tests, written with the writers of rosbags."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import gtsam
import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2

from sst_graph.data.arrays import read_labels
from sst_graph.data.images import read_mask
from sst_graph.data.kitti.odometry import KittiSource
from sst_graph.data.ros.messages import BagWriter, MessageMaker
from sst_graph.factors.camera import PinholeCamera
from sst_graph.types import Scan

Kind = Literal["ros1", "sqlite3", "mcap"]
KINDS: tuple[Kind, ...] = ("ros1", "sqlite3", "mcap")
EPOCH_NS = 1_700_000_000_000_000_000
"""Added to the stamps of drives that begin at 0: a stamp of 0 is none."""

IMAGE, CLOUD, INFO, MASK = "/front/image_rect", "/lidar/points", "/front/camera_info", "/front/mask"
CAMERA_FRAME, LIDAR_FRAME = "front_optical", "lidar"


class Messages(MessageMaker):
    """Messages of one camera and one LiDAR."""

    def image(
        self, stamp_ns: int, pixels: NDArray[np.uint8], encoding: str = "bgr8", padding: int = 0
    ) -> Any:
        """padding: bytes behind each row."""
        message = super().image(self.header(stamp_ns, CAMERA_FRAME), pixels, encoding)
        rows = np.pad(message.data.reshape(message.height, -1), [(0, 0), (0, padding)], constant_values=77)
        return dataclasses.replace(message, step=rows.shape[1], data=rows.ravel())

    def compressed(self, stamp_ns: int, data: bytes, form: str = "png") -> Any:
        header = self.header(stamp_ns, CAMERA_FRAME)
        bytes_ = np.frombuffer(data, np.uint8)
        return self.make("sensor_msgs/msg/CompressedImage", header=header, format=form, data=bytes_)

    def cloud(self, stamp_ns: int, table: NDArray[Any], big: bool = False) -> Any:
        message = super().cloud(self.header(stamp_ns, LIDAR_FRAME), table)
        return dataclasses.replace(message, is_bigendian=big)

    def info(self, camera: PinholeCamera, stamp_ns: int = EPOCH_NS, **changes: Any) -> Any:
        message = self.camera_info(self.header(stamp_ns, CAMERA_FRAME), camera)
        return dataclasses.replace(message, **changes)

    def transforms(self, poses: Mapping[tuple[str, str], gtsam.Pose3], stamp_ns: int = EPOCH_NS) -> Any:
        return super().transforms(poses, stamp_ns)


@contextmanager
def writing(path: Path, kind: Kind) -> Iterator[BagWriter]:
    """A writer of the bag ``path`` (a file for ros1, else a folder)."""
    if kind == "ros1":
        with Writer1(path) as writer:
            yield BagWriter(Messages(is_ros1=True), writer)
    else:
        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        with Writer2(path, version=9, storage_plugin=plugin) as writer:
            yield BagWriter(Messages(), writer)


def table_of(scan: Scan, labels: NDArray[np.uint32]) -> NDArray[Any]:
    """A cloud's points as a driver packs them, 4 bytes of padding behind z, with labels."""
    names, formats = ["x", "y", "z", "ring", "label", "instance"], ["<f4", "<f4", "<f4", "<u2", "<u2", "<u2"]
    offsets, size = [0, 4, 8, 16, 18, 20], 32
    if scan.offsets_s is not None:
        names, formats, offsets = [*names, "time"], [*formats, "<f4"], [*offsets, 24]
    table = np.zeros(
        len(scan.points), {"names": names, "formats": formats, "offsets": offsets, "itemsize": size}
    )
    for axis, values in zip("xyz", scan.points.T, strict=True):
        table[axis] = values
    if scan.rings is not None:
        table["ring"] = scan.rings
    table["label"], table["instance"] = labels & 0xFFFF, labels >> 16
    if scan.offsets_s is not None:
        table["time"] = scan.offsets_s
    return table


def chain(cTl: gtsam.Pose3) -> dict[tuple[str, str], gtsam.Pose3]:
    """Transforms whose chain from the camera to the LiDAR is cTl."""
    bTc = gtsam.Pose3(gtsam.Rot3.Ypr(-1.5, 0.1, -1.6), np.array([1.5, 0.2, 1.2]))
    base = gtsam.Pose3(gtsam.Rot3(), np.array([0.0, 0.0, 0.3]))
    return {
        ("base_link", CAMERA_FRAME): bTc,
        ("base_link", "mast"): base,
        ("mast", LIDAR_FRAME): base.inverse() * bTc * cTl,
    }


def bag_of(
    source: KittiSource, path: Path, kind: Kind = "mcap", image_later_ns: int = 0, labels: bool = True
) -> Path:
    """The bag of a drive in KITTI's layout, with its masks and labels; what is to be opened.

    Args:
        image_later_ns: added to the stamps of images and masks.
        labels: with masks; the clouds have labels in any case.
    """
    with writing(path, kind) as bag:
        make = bag.messages
        bag.add("/tf_static", make.transforms(chain(source.nominal)), EPOCH_NS)
        bag.add(INFO, make.info(source.camera), EPOCH_NS)
        entries: list[tuple[int, str, Any]] = []
        for position in range(len(source)):
            index = source.frame_number(position)
            number = index + source.options.image_shift
            scan, image = source.read_scan(position), source.read_image(position)
            if scan is not None:
                stamp_ns = EPOCH_NS + scan.stamp_ns
                table = table_of(scan, read_labels(source.files.labels[index], len(scan.points)))
                entries.append((stamp_ns, CLOUD, make.cloud(stamp_ns, table)))
            if image is not None:
                stamp_ns = EPOCH_NS + image.stamp_ns + image_later_ns
                entries.append((stamp_ns, IMAGE, make.image(stamp_ns, image.pixels)))
                if labels:
                    mask = read_mask(source.files.masks[number])
                    entries.append((stamp_ns, MASK, make.image(stamp_ns, mask, "mono8")))
            # A recorder gets what was stamped with different delays: pictures after 30 ms, clouds after 5.
            for stamp_ns, topic, message in entries:
                bag.add(topic, message, stamp_ns + (5_000_000 if topic == CLOUD else 30_000_000))
            entries.clear()
    return path


def files_of(path: Path, suffix: str) -> Sequence[Path]:
    """Files of a rosbag2 folder."""
    return sorted(path.glob(f"*{suffix}"))

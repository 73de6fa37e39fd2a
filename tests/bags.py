"""Bags for tests, written with the writers of rosbags."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import gtsam
import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from sst_graph.data.arrays import read_labels
from sst_graph.data.images import read_mask
from sst_graph.data.kitti.odometry import KittiSource
from sst_graph.factors.camera import PinholeCamera
from sst_graph.types import Scan

Kind = Literal["ros1", "sqlite3", "mcap"]
KINDS: tuple[Kind, ...] = ("ros1", "sqlite3", "mcap")
EPOCH_NS = 1_700_000_000_000_000_000
"""Added to the stamps of drives that begin at 0: a stamp of 0 is none."""

IMAGE, CLOUD, INFO, MASK = "/front/image_rect", "/lidar/points", "/front/camera_info", "/front/mask"
CAMERA_FRAME, LIDAR_FRAME = "front_optical", "lidar"

_POINT_TYPES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
_TF = "tf2_msgs/msg/TFMessage"


class Messages:
    """Messages of ROS 1 or 2."""

    def __init__(self, ros1: bool = False) -> None:
        self.ros1 = ros1
        self.types = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
        if ros1:
            self.types.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", _TF))

    def make(self, name: str, /, **fields: Any) -> Any:
        return self.types.types[name](**fields)

    def header(self, stamp_ns: int, frame: str) -> Any:
        seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
        time = self.make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
        number = {"seq": 0} if self.ros1 else {}
        return self.make("std_msgs/msg/Header", stamp=time, frame_id=frame, **number)

    def image(
        self, stamp_ns: int, pixels: NDArray[np.uint8], encoding: str = "bgr8", padding: int = 0
    ) -> Any:
        """pixels: (h, w) or (h, w, channels); padding: bytes behind each row."""
        height, width = pixels.shape[:2]
        rows = pixels.reshape(height, -1)
        padded = np.concatenate([rows, np.full((height, padding), 77, np.uint8)], axis=1)
        return self.make(
            "sensor_msgs/msg/Image",
            header=self.header(stamp_ns, CAMERA_FRAME),
            height=height,
            width=width,
            encoding=encoding,
            is_bigendian=0,
            step=padded.shape[1],
            data=padded.ravel(),
        )

    def compressed(self, stamp_ns: int, data: bytes, form: str = "png") -> Any:
        header = self.header(stamp_ns, CAMERA_FRAME)
        bytes_ = np.frombuffer(data, np.uint8)
        return self.make("sensor_msgs/msg/CompressedImage", header=header, format=form, data=bytes_)

    def cloud(self, stamp_ns: int, table: NDArray[Any], big: bool = False) -> Any:
        """table: (n,) or (height, width) structured, as its dtype lays it out."""
        rows = table.reshape(1, -1) if table.ndim == 1 else table
        fields = [
            self.make(
                "sensor_msgs/msg/PointField",
                name=name,
                offset=table.dtype.fields[name][1],
                datatype=_POINT_TYPES[table.dtype[name].str[1:]],
                count=1,
            )
            for name in table.dtype.names
        ]
        step = table.dtype.itemsize
        return self.make(
            "sensor_msgs/msg/PointCloud2",
            header=self.header(stamp_ns, LIDAR_FRAME),
            height=rows.shape[0],
            width=rows.shape[1],
            fields=fields,
            is_bigendian=big,
            point_step=step,
            row_step=step * rows.shape[1],
            data=np.frombuffer(np.ascontiguousarray(rows).tobytes(), np.uint8),
            is_dense=False,
        )

    def info(self, camera: PinholeCamera, stamp_ns: int = EPOCH_NS, **changes: Any) -> Any:
        P = np.column_stack([camera.matrix, np.zeros(3)])
        fields = {"D": np.zeros(5), "K": camera.matrix.ravel(), "R": np.eye(3).ravel(), "P": P.ravel()}
        roi = self.make(
            "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        values = {
            "header": self.header(stamp_ns, CAMERA_FRAME),
            "height": camera.height,
            "width": camera.width,
            "distortion_model": "plumb_bob",
            "binning_x": 0,
            "binning_y": 0,
            "roi": roi,
            **{name if self.ros1 else name.lower(): value for name, value in fields.items()},
        }
        return self.make("sensor_msgs/msg/CameraInfo", **{**values, **changes})

    def transforms(self, poses: Mapping[tuple[str, str], gtsam.Pose3]) -> Any:
        """poses: of the child in the parent, by (parent, child)."""
        return self.make(_TF, transforms=[self._transform(*edge, pose) for edge, pose in poses.items()])

    def _transform(self, parent: str, child: str, pose: gtsam.Pose3) -> Any:
        q, t = pose.rotation().toQuaternion(), pose.translation()
        return self.make(
            "geometry_msgs/msg/TransformStamped",
            header=self.header(EPOCH_NS, parent),
            child_frame_id=child,
            transform=self.make(
                "geometry_msgs/msg/Transform",
                translation=self.make("geometry_msgs/msg/Vector3", x=t[0], y=t[1], z=t[2]),
                rotation=self.make("geometry_msgs/msg/Quaternion", x=q.x(), y=q.y(), z=q.z(), w=q.w()),
            ),
        )


@dataclass
class BagWriter:
    """A bag that is being written."""

    messages: Messages
    writer: Any
    connections: dict[str, Any]

    def add(self, topic: str, message: Any, received_ns: int) -> None:
        name = message.__msgtype__
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, name, typestore=self.messages.types)
        types = self.messages.types
        data = (
            types.serialize_ros1(message, name) if self.messages.ros1 else types.serialize_cdr(message, name)
        )
        self.writer.write(self.connections[topic], received_ns, bytes(data))


@contextmanager
def writing(path: Path, kind: Kind) -> Iterator[BagWriter]:
    """A writer of the bag ``path`` (a file for ros1, else a folder)."""
    if kind == "ros1":
        with Writer1(path) as writer:
            yield BagWriter(Messages(ros1=True), writer, {})
    else:
        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        with Writer2(path, version=9, storage_plugin=plugin) as writer:
            yield BagWriter(Messages(), writer, {})


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

"""Writing a simulated drive as a bag, as a vehicle with ROS 2 records one (extra ``ros``)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.errors import MissingDependencyError
from sst_graph.simulator.drive import RawFrame, SimulatedDrive
from sst_graph.simulator.surfaces import CITYSCAPES, SEMANTIC_KITTI

IMAGE, MASK, INFO, CLOUD = "/camera/image_rect", "/camera/mask", "/camera/camera_info", "/lidar/points"
CAMERA_FRAME, LIDAR_FRAME = "camera_optical", "lidar"
EPOCH_NS = 1_700_000_000_000_000_000
"""Added to the stamps of the drive, which begin at 0: a stamp of 0 is none."""
POINT = np.dtype(
    [(axis, "<f4") for axis in "xyz"] + [(name, "<u2") for name in ("ring", "label", "instance")]
)
_DATATYPES = {"<f4": 7, "<u2": 4}
"""As PointField numbers them."""


def write_bag(drive: SimulatedDrive, path: str | Path, labels: bool = True) -> Path:
    """Write the drive as the rosbag2 folder ``path`` (mcap): images, scans, intrinsics, nominal extrinsic.

    Images have the stamps of the camera's clock and scans those of the LiDAR's, as the drive has them. The
    clouds hold no times of single points.

    Args:
        labels: with masks (Cityscapes label ids) on a topic and labels (SemanticKITTI) in the clouds.

    Raises:
        MissingDependencyError: ``rosbags`` is not installed.
        rosbags.rosbag2.WriterError: ``path`` is there already.
    """
    try:
        from rosbags.rosbag2 import StoragePlugin, Writer
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise MissingDependencyError(
            "bags need rosbags, which is not installed: pip install 'sst-graph[ros]'"
        ) from None
    messages = _Messages(get_typestore(Stores.ROS2_HUMBLE))
    with Writer(Path(path), version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        bag = _Bag(messages.types, writer, {})
        bag.add("/tf_static", messages.transform(drive.nominal), EPOCH_NS)
        bag.add(INFO, messages.camera_info(drive), EPOCH_NS)
        for position in range(len(drive)):
            stamp_ns, frame = EPOCH_NS + int(drive.stamps_ns[position]), drive.raw(position)
            bag.add(CLOUD, messages.cloud(stamp_ns, _table(frame, labels)), stamp_ns)
            bag.add(IMAGE, messages.image(stamp_ns, frame.pixels, "bgr8"), stamp_ns)
            if labels:
                bag.add(MASK, messages.image(stamp_ns, CITYSCAPES[frame.pixel_kinds], "mono8"), stamp_ns)
    return Path(path)


def _table(frame: RawFrame, labels: bool) -> NDArray[Any]:
    """(n,) points as a driver packs them."""
    table = np.zeros(len(frame.points), POINT if labels else POINT[["x", "y", "z", "ring"]])
    for axis, values in zip("xyz", frame.points.T, strict=True):
        table[axis] = values
    table["ring"] = frame.rings
    if labels:
        table["label"] = SEMANTIC_KITTI[frame.point_kinds]
        table["instance"] = frame.point_instances
    return table


@dataclass
class _Bag:
    """A bag that is being written."""

    types: Any
    writer: Any
    connections: dict[str, Any]

    def add(self, topic: str, message: Any, received_ns: int) -> None:
        name = message.__msgtype__
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, name, typestore=self.types)
        self.writer.write(self.connections[topic], received_ns, self.types.serialize_cdr(message, name))


@dataclass(frozen=True)
class _Messages:
    """Messages of ROS 2."""

    types: Any

    def make(self, name: str, /, **fields: Any) -> Any:
        return self.types.types[name](**fields)

    def header(self, stamp_ns: int, frame: str) -> Any:
        seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
        time = self.make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
        return self.make("std_msgs/msg/Header", stamp=time, frame_id=frame)

    def image(self, stamp_ns: int, pixels: NDArray[np.uint8], encoding: str) -> Any:
        """pixels: (h, w) or (h, w, 3)."""
        return self.make(
            "sensor_msgs/msg/Image",
            header=self.header(stamp_ns, CAMERA_FRAME),
            height=pixels.shape[0],
            width=pixels.shape[1],
            encoding=encoding,
            is_bigendian=0,
            step=pixels[0].size,
            data=np.ascontiguousarray(pixels).ravel(),
        )

    def cloud(self, stamp_ns: int, table: NDArray[Any]) -> Any:
        """table: (n,), a structure of fields."""
        fields = [
            self.make(
                "sensor_msgs/msg/PointField", name=name, offset=offset, datatype=_DATATYPES[kind.str], count=1
            )
            for name, (kind, offset, *_) in (table.dtype.fields or {}).items()
        ]
        return self.make(
            "sensor_msgs/msg/PointCloud2",
            header=self.header(stamp_ns, LIDAR_FRAME),
            height=1,
            width=len(table),
            fields=fields,
            is_bigendian=False,
            point_step=table.dtype.itemsize,
            row_step=table.nbytes,
            data=np.frombuffer(table.tobytes(), np.uint8),
            is_dense=True,
        )

    def camera_info(self, drive: SimulatedDrive) -> Any:
        camera = drive.camera
        return self.make(
            "sensor_msgs/msg/CameraInfo",
            header=self.header(EPOCH_NS, CAMERA_FRAME),
            height=camera.height,
            width=camera.width,
            distortion_model="plumb_bob",
            d=np.zeros(5),
            k=camera.matrix.ravel(),
            r=np.eye(3).ravel(),
            p=np.column_stack([camera.matrix, np.zeros(3)]).ravel(),
            binning_x=0,
            binning_y=0,
            roi=self.make(
                "sensor_msgs/msg/RegionOfInterest",
                x_offset=0,
                y_offset=0,
                height=0,
                width=0,
                do_rectify=False,
            ),
        )

    def transform(self, cTl: gtsam.Pose3) -> Any:
        q: Any = cTl.rotation().toQuaternion()  # the stubs do not know it
        t = cTl.translation()
        pose = self.make(
            "geometry_msgs/msg/Transform",
            translation=self.make("geometry_msgs/msg/Vector3", x=t[0], y=t[1], z=t[2]),
            rotation=self.make("geometry_msgs/msg/Quaternion", x=q.x(), y=q.y(), z=q.z(), w=q.w()),
        )
        stamped = self.make(
            "geometry_msgs/msg/TransformStamped",
            header=self.header(EPOCH_NS, CAMERA_FRAME),
            child_frame_id=LIDAR_FRAME,
            transform=pose,
        )
        return self.make("tf2_msgs/msg/TFMessage", transforms=[stamped])

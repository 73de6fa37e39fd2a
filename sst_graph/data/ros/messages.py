"""Making messages of ROS 1 or 2, their bytes, and bags of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.data.ros.bag import TF_MESSAGE, message_types
from sst_graph.data.ros.clouds import POINT_FIELD_TYPES
from sst_graph.factors.camera import PinholeCamera

_DATATYPES = {name: number for number, name in POINT_FIELD_TYPES.items()}


class MessageMaker:
    """Makes messages, as rosbags holds them.

    Args:
        is_ros1: messages of ROS 1 instead of ROS 2.
    """

    def __init__(self, is_ros1: bool = False) -> None:
        self.is_ros1 = is_ros1
        self.types = message_types(is_ros1)

    def make(self, type_name: str, /, **fields: Any) -> Any:
        """A message of any type that rosbags knows; all its fields have to be given."""
        return self.types.types[type_name](**fields)

    def decoded(self, data: bytes, type_name: str) -> Any:
        """A message from its bytes; raises what rosbags raises."""
        decode = self.types.deserialize_ros1 if self.is_ros1 else self.types.deserialize_cdr
        return decode(data, type_name)

    def encoded(self, message: Any) -> bytes:
        """The bytes of a message."""
        encode = self.types.serialize_ros1 if self.is_ros1 else self.types.serialize_cdr
        return bytes(encode(message, message.__msgtype__))

    def header(self, stamp_ns: int, frame: str) -> Any:
        """std_msgs/Header."""
        seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
        time = self.make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
        number = {"seq": 0} if self.is_ros1 else {}
        return self.make("std_msgs/msg/Header", stamp=time, frame_id=frame, **number)

    def image(self, header: Any, pixels: NDArray[np.uint8], encoding: str) -> Any:
        """sensor_msgs/Image of (h, w) or (h, w, channels)."""
        height, width = pixels.shape[:2]
        rows = np.ascontiguousarray(pixels).reshape(height, -1)
        return self.make(
            "sensor_msgs/msg/Image",
            header=header,
            height=height,
            width=width,
            encoding=encoding,
            is_bigendian=0,
            step=rows.shape[1],
            data=rows.ravel(),
        )

    def cloud(self, header: Any, table: NDArray[Any]) -> Any:
        """sensor_msgs/PointCloud2 of a structured array, (n,) or (h, w), laid out as its dtype says."""
        rows = np.ascontiguousarray(table.reshape(1, -1) if table.ndim == 1 else table)
        fields = [
            self.make(
                "sensor_msgs/msg/PointField",
                name=name,
                offset=offset,
                datatype=_DATATYPES[kind.str[1:]],
                count=1,
            )
            for name, (kind, offset, *_) in (table.dtype.fields or {}).items()
        ]
        return self.make(
            "sensor_msgs/msg/PointCloud2",
            header=header,
            height=rows.shape[0],
            width=rows.shape[1],
            fields=fields,
            is_bigendian=False,
            point_step=table.dtype.itemsize,
            row_step=table.dtype.itemsize * rows.shape[1],
            data=np.frombuffer(rows.tobytes(), np.uint8),
            is_dense=False,
        )

    def camera_info(self, header: Any, camera: PinholeCamera) -> Any:
        """sensor_msgs/CameraInfo of rectified pictures."""
        projection = np.column_stack([camera.matrix, np.zeros(3)])
        matrices = {
            "D": np.zeros(5),
            "K": camera.matrix.ravel(),
            "R": np.eye(3).ravel(),
            "P": projection.ravel(),
        }
        return self.make(
            "sensor_msgs/msg/CameraInfo",
            header=header,
            height=camera.height,
            width=camera.width,
            distortion_model="plumb_bob",
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
            **{name if self.is_ros1 else name.lower(): values for name, values in matrices.items()},
        )

    def transforms(self, poses: Mapping[tuple[str, str], gtsam.Pose3], stamp_ns: int) -> Any:
        """tf2_msgs/TFMessage of poses of the child in the parent, by (parent, child)."""
        stamped = [self._transform(self.header(stamp_ns, edge[0]), edge[1], poses[edge]) for edge in poses]
        return self.make(TF_MESSAGE, transforms=stamped)

    def _transform(self, header: Any, child: str, pose: gtsam.Pose3) -> Any:
        q: Any = pose.rotation().toQuaternion()  # the stubs do not know it
        x, y, z = map(float, pose.translation())
        return self.make(
            "geometry_msgs/msg/TransformStamped",
            header=header,
            child_frame_id=child,
            transform=self.make(
                "geometry_msgs/msg/Transform",
                translation=self.make("geometry_msgs/msg/Vector3", x=x, y=y, z=z),
                rotation=self.make("geometry_msgs/msg/Quaternion", x=q.x(), y=q.y(), z=q.z(), w=q.w()),
            ),
        )


@dataclass(frozen=True)
class BagWriter:
    """A bag that is being written.

    Attributes:
        messages: makes its messages.
        writer: of rosbags, open.
    """

    messages: MessageMaker
    writer: Any
    _connections: dict[str, Any] = field(default_factory=dict)

    def add(self, topic: str, message: Any, received_ns: int) -> None:
        """Write a message; a topic has the type of its first one."""
        if topic not in self._connections:
            self._connections[topic] = self.writer.add_connection(
                topic, message.__msgtype__, typestore=self.messages.types
            )
        self.writer.write(self._connections[topic], received_ns, self.messages.encoded(message))

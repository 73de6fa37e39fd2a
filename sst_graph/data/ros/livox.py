"""Livox's CustomMsg, which livox_ros_driver 1 and 2 publish unless they are told to give a PointCloud2.

Behind the header stand timebase (uint64), point_num (uint32), lidar_id, three reserved bytes, and the points:
a count (uint32) and for each offset_time (uint32) [ns], x, y, z (float32) [m], reflectivity, tag and line
(uint8). ROS 1 packs them; ROS 2 (CDR) aligns each number to its size, counted from behind the first four
bytes.

Source: CustomMsg.msg and CustomPoint.msg of Livox-SDK/livox_ros_driver2.
"""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sst_graph.data.arrays import MAX_POINTS
from sst_graph.errors import DataError, count_of

CUSTOM = "livox_ros_driver2/msg/CustomMsg"
OLDER_CUSTOM = ("livox_ros_driver/msg/CustomMsg", "livox_interfaces/msg/CustomMsg")
"""Types of other drivers with the fields of :data:`CUSTOM`."""

_NAMES = ("offset_time", "x", "y", "z", "reflectivity", "tag", "line")
_FORMATS = ("u4", "f4", "f4", "f4", "u1", "u1", "u1")
_BEFORE_COUNT, _OF_POINT = 16, 19
"""Bytes from timebase to the count of points, and of a point."""


def custom_points(data: bytes, at: int, is_ros1: bool, place: str) -> NDArray[Any]:
    """Points (n,) of a message, by the names of their fields.

    Args:
        data: the message.
        at: where its header ends.

    Raises:
        DataError: fewer bytes than points, or more points than a scan has.
    """
    order, step = "<", _OF_POINT
    if not is_ros1:
        order, step = "<" if data[1] & 1 else ">", _OF_POINT + 1
        at += -(at - 4) % 8
    at += _BEFORE_COUNT
    count = struct.unpack_from(f"{order}I", data, at)[0] if len(data) >= at + 4 else 0
    body = data[at + 4 :]
    if count > MAX_POINTS or len(data) < at + 4 or len(body) < step * count - (step - _OF_POINT):
        found = f"{count_of(len(data), 'byte')} for {count_of(count, 'point')}"
        raise DataError(place, found, f"a CustomMsg of {step} bytes a point, at most {MAX_POINTS} points")
    layout = np.dtype(
        {
            "names": _NAMES,
            "formats": [order + kind for kind in _FORMATS],
            "offsets": [0, 4, 8, 12, 16, 17, 18],
            "itemsize": step,
        }
    )
    # CDR leaves out the padding of the last point.
    return np.frombuffer(body[: step * count].ljust(step * count, b"\0"), layout, count)

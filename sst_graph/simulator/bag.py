"""Writing a simulated drive as a bag, as a vehicle with ROS 2 records one (extra ``ros``)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sst_graph.data.ros.messages import BagWriter, MessageMaker
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
    except ImportError:
        raise MissingDependencyError(
            "bags need rosbags, which is not installed: pip install 'sst-graph[ros]'"
        ) from None
    make = MessageMaker()
    with Writer(Path(path), version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        bag = BagWriter(make, writer)
        extrinsic = {(CAMERA_FRAME, LIDAR_FRAME): drive.nominal}
        bag.add("/tf_static", make.transforms(extrinsic, EPOCH_NS), EPOCH_NS)
        bag.add(INFO, make.camera_info(make.header(EPOCH_NS, CAMERA_FRAME), drive.camera), EPOCH_NS)
        for position in range(len(drive)):
            stamp_ns, frame = EPOCH_NS + int(drive.stamps_ns[position]), drive.raw(position)
            of_lidar, of_camera = make.header(stamp_ns, LIDAR_FRAME), make.header(stamp_ns, CAMERA_FRAME)
            bag.add(CLOUD, make.cloud(of_lidar, _table(frame, labels)), stamp_ns)
            bag.add(IMAGE, make.image(of_camera, frame.pixels, "bgr8"), stamp_ns)
            if labels:
                mask = CITYSCAPES[frame.pixel_kinds]
                bag.add(MASK, make.image(of_camera, mask, "mono8"), stamp_ns)
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

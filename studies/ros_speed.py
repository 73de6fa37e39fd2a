"""How fast the ROS 2 node is: a KITTI drive published over DDS at given rates, forth and back.

    make ros-check                                                     an environment with ROS 2
    OMP_NUM_THREADS=1 PYTHONPATH=. build/ros-kilted/bin/python studies/ros_speed.py DRIVE

The delay of a line is the time from the publication of its cloud to its arrival here; ``hold_s``, for which
the node waits for messages out of order, is a part of it. What is published (the player) and the node share
the machine. The last column is the node's processor time for a pair, from its first message to the last; the
tracker's start is in it. Played back, an image that is stamped too late is too early: a drive without a time
offset.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from numpy.typing import NDArray
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo
from std_msgs.msg import String
from tf2_msgs.msg import TFMessage

from sst_graph.data import KittiSource, open_source
from sst_graph.data.arrays import read_labels
from sst_graph.data.images import read_mask
from sst_graph.data.ros.messages import MessageMaker
from sst_graph.ros_node.topics import message_class

EPOCH_NS = 1_700_000_000_000_000_000
"""Added to the stamps of drives that begin at 0: a stamp of 0 is none."""
TYPES = {
    "image": "sensor_msgs/msg/Image",
    "mask": "sensor_msgs/msg/Image",
    "cloud": "sensor_msgs/msg/PointCloud2",
}
CAMERA, LIDAR = "front_optical", "lidar"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("drive", type=Path)
    parser.add_argument("--turns", type=int, default=5, help="times that the drive is played, forth or back")
    parser.add_argument("--rates", type=float, nargs="+", default=[1.0], help="of what was recorded")
    arguments = parser.parse_args()
    source = open_source(arguments.drive)
    if not isinstance(source, KittiSource):
        parser.error("a drive in KITTI's layout is needed")
    frames = [list(messages_of(source, k)) for k in range(len(source))]
    heads = (
        "rate",
        "pairs",
        "lines",
        "delay, median [ms]",
        "95 %",
        "slowest",
        "most behind [s]",
        "lost",
        "CPU [ms]",
    )
    print(f"| {' | '.join(heads)} |")
    print("|---|---|---|---|---|---|---|---|---|")
    for rate in arguments.rates:
        print(played(source, frames, rate, arguments.turns), flush=True)


def messages_of(source: KittiSource, position: int) -> Iterator[tuple[str, int, Any]]:
    """Topic, stamp [ns] and message of all that belongs to a frame."""
    make = MessageMaker()
    number = source.frame_number(position)
    scan, image = source.read_scan(position), source.read_image(position)
    if scan is not None:
        labels = read_labels(source.files.labels[number], len(scan.points))
        yield "cloud", scan.stamp_ns, make.cloud(make.header(0, LIDAR), table_of(scan.points, labels))
    if image is not None:
        mask = read_mask(source.files.masks[number])
        yield "mask", image.stamp_ns, make.image(make.header(0, CAMERA), mask, "mono8")
        yield "image", image.stamp_ns, make.image(make.header(0, CAMERA), image.pixels, "bgr8")


def table_of(points: NDArray[np.float64], labels: NDArray[np.uint32]) -> NDArray[Any]:
    """A cloud as a driver packs it, with labels."""
    names = [(axis, "<f4") for axis in "xyz"] + [("label", "<u2"), ("instance", "<u2")]
    table = np.zeros(len(points), names)
    for axis, values in zip("xyz", points.T, strict=True):
        table[axis] = values
    table["label"], table["instance"] = labels & 0xFFFF, labels >> 16
    return table


def played(source: KittiSource, frames: list[list[tuple[str, int, Any]]], rate: float, turns: int) -> str:
    """The row of one rate: the drive is played forth and back, and the node's lines are timed."""
    make, domain = MessageMaker(), 1 + os.getpid() % 100
    context = rclpy.context.Context()
    context.init(args=[], domain_id=domain)
    node: Any = rclpy.create_node("player", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    came: dict[int, float] = {}
    sent: dict[int, float] = {}
    diagnostics: list[DiagnosticArray] = []

    def take(message: String) -> None:
        came.setdefault(json.loads(message.data)["stamp_ns"], time.monotonic())

    node.create_subscription(String, "/sst_graph/status", take, 1000)
    node.create_subscription(DiagnosticArray, "/diagnostics", diagnostics.append, 1000)
    latched = quality("TRANSIENT_LOCAL", 1)
    info, transforms = (
        node.create_publisher(CameraInfo, "/info", latched),
        node.create_publisher(TFMessage, "/tf_static", latched),
    )
    info.publish(make.encoded(make.camera_info(make.header(EPOCH_NS, CAMERA), source.camera)))
    transforms.publish(make.encoded(make.transforms({(CAMERA, LIDAR): source.nominal}, EPOCH_NS)))
    publishers = {
        one: node.create_publisher(message_class(kind), f"/{one}", quality("VOLATILE", 60))
        for one, kind in TYPES.items()
    }
    topics = {"image_topic": "/image", "mask_topic": "/mask", "cloud_topic": "/cloud", "info_topic": "/info"}
    given = [w for k, v in {**topics, "sweep": "compensated"}.items() for w in ("-p", f"{k}:={v}")]
    command = [sys.executable, "-m", "sst_graph.ros_node", "--ros-args", *given]
    process = subprocess.Popen(command, env={**os.environ, "ROS_DOMAIN_ID": str(domain)})
    try:
        while not all(one.get_subscription_count() for one in publishers.values()):
            executor.spin_once(timeout_sec=0.05)
        begin, first_ns, used_s = time.monotonic() + 1.0, frames[0][0][1], processor_s(process.pid)
        for stamp_ns, messages in forth_and_back(frames, turns):
            encoded = []
            for topic, own_ns, message in messages:
                at_ns = EPOCH_NS + stamp_ns + own_ns
                header = make.header(at_ns, message.header.frame_id)
                encoded.append((topic, at_ns, make.encoded(replace(message, header=header))))
            for topic, at_ns, data in encoded:
                due = begin + 1e-9 * (at_ns - EPOCH_NS - first_ns) / rate
                while (left := due - time.monotonic()) > 0:
                    executor.spin_once(timeout_sec=left)
                publishers[topic].publish(data)
                if topic == "cloud":
                    sent[at_ns] = time.monotonic()
        last, used_s = time.monotonic(), processor_s(process.pid) - used_s
        while time.monotonic() < last + 10.0 and max(sent) not in came:
            executor.spin_once(timeout_sec=0.05)
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(timeout=60.0)
        executor.shutdown()
        node.destroy_node()
        context.shutdown()
    delays = 1e3 * np.array([came[one] - sent[one] for one in sent if one in came])
    values = [{one.key: one.value for one in status.values} for each in diagnostics for status in each.status]
    behind = max(float(one["behind_s"]) for one in values if "behind_s" in one)
    lost = sum(max(int(one[key]) for one in values if key in one) for key in ("lost", "dropped"))
    row = (
        f"{rate:g}",
        len(sent),
        len(delays),
        *(f"{each:.0f}" for each in (np.median(delays), np.percentile(delays, 95), delays.max())),
        f"{behind:.1f}",
        lost,
        f"{1e3 * used_s / len(sent):.0f}",
    )
    return f"| {' | '.join(map(str, row))} |"


def forth_and_back(
    frames: list[list[tuple[str, int, Any]]], turns: int
) -> Iterator[tuple[int, list[tuple[str, int, Any]]]]:
    """Frames, and what to add to their stamps so that time goes on [ns]."""
    stamps = [messages[0][1] for messages in frames]
    step = (stamps[-1] - stamps[0]) // (len(stamps) - 1)
    now = 0
    for turn in range(turns):
        order = range(len(frames)) if turn % 2 == 0 else range(len(frames) - 2, -1, -1)
        for k in order if turn == 0 or turn % 2 else range(1, len(frames)):
            yield now - (stamps[k] - stamps[0]), frames[k]
            now += step


def processor_s(process: int) -> float:
    """User and system seconds of a process so far (Linux)."""
    user, system = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[11:13]
    return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")


def quality(durability: str, depth: int) -> QoSProfile:
    return QoSProfile(
        depth=depth, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy[durability]
    )


if __name__ == "__main__":
    main()

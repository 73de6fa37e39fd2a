"""Between the core and the topics of a ROS 2 node; ``node`` is rclpy's, or has its methods."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from typing import Any

from sst_graph.data.ros.bag import TF_MESSAGE
from sst_graph.data.ros.messages import MessageMaker
from sst_graph.ros_node.calibration_node import CalibrationNode
from sst_graph.ros_node.published import DIAGNOSTICS, STRING, Published
from sst_graph.ros_node.sensor import SensorRecord
from sst_graph.ros_node.settings import NodeSettings

_LATCHED, _RELIABLE = ("RELIABLE", "TRANSIENT_LOCAL"), ("RELIABLE", "VOLATILE")
_BEST_EFFORT = "BEST_EFFORT", "VOLATILE"
_QUALITIES = {"transforms": (_LATCHED,), "info": (_LATCHED, _RELIABLE, _BEST_EFFORT)}
_OF_SENSORS = _RELIABLE, _BEST_EFFORT
"""What the publishers of a topic are asked for, the best first."""


@dataclass(frozen=True)
class Quality:
    """Quality of service of a subscription, by the names of ROS; at most ``depth`` messages wait."""

    reliability: str
    durability: str
    depth: int


class Subscription:
    """Messages of a topic as bytes, in the best quality of service that its publishers offer.

    The middleware reports a publisher that offers less than is asked for; then the next quality is asked
    for. Best effort alone would fit all of them, and lose pictures and clouds of more than half a megabyte,
    which are sent in pieces.

    Attributes:
        topic: its name before it is remapped.
        record: is told what is lost, and as what the topic is published.
    """

    def __init__(
        self, node: Any, part: str, topic: str, record: SensorRecord, take: Callable[[bytes], None]
    ) -> None:
        """part: that the topic has in the node's core, ``CalibrationNode.topics``."""
        self.topic, self.record = topic, record
        self._node, self._take = node, take
        self._qualities = list(_QUALITIES.get(part, _OF_SENSORS))
        self._subscription: Any = None
        self._again: Callable[[], None] = lambda: None

    def listen(self, subscribe: Subscribe, depth: int) -> None:
        """Begin, with the best quality that has not been tried."""
        self._again = partial(self.listen, subscribe, depth)
        self._subscription = subscribe(self, Quality(*self._qualities.pop(0), depth))

    def look(self) -> None:
        """Note as what the topic is published."""
        found = self._node.get_publishers_info_by_topic(self.topic)
        self.record.published = frozenset(one.topic_type for one in found)

    def taken(self, data: bytes, info: Any) -> None:
        """Note how long a message waited, and take it."""
        received_ns = info["received_timestamp"]
        if received_ns:
            self.record.wait(1e-9 * (time.time_ns() - received_ns))
        self._take(data)

    def lost(self, event: Any) -> None:
        """Note messages that the network lost."""
        self.record.lose(event.total_count_change, self._node.get_clock().now().nanoseconds)

    @property
    def incompatible(self) -> Callable[[Any], None] | None:
        """What is to be done where a publisher offers less; None where there is no less to ask for."""
        return self._ask_for_less if self._qualities else None

    def _ask_for_less(self, event: Any) -> None:
        self._node.destroy_subscription(self._subscription)
        self._again()


Subscribe = Callable[[Subscription, Quality], Any]
"""Makes the subscription of the middleware, which can be destroyed."""


class Publishers:
    """The publishers of status, transforms and diagnostics."""

    def __init__(self, node: Any) -> None:
        self._make = MessageMaker()
        self._publishers = {
            "status": node.create_publisher(message_class(STRING), "~/status", 100),
            "transforms": node.create_publisher(message_class(TF_MESSAGE), "/tf", 100),
            "diagnostics": node.create_publisher(message_class(DIAGNOSTICS), "/diagnostics", 10),
        }

    def publish(self, published: Published) -> None:
        """Publish all that is there."""
        for kind, publisher in self._publishers.items():
            if (message := getattr(published, kind)) is not None:
                publisher.publish(self._make.encoded(message))

    def wait(self, duration: Any) -> None:
        """Until all has arrived, at most rclpy's ``duration`` for each topic."""
        for publisher in self._publishers.values():
            publisher.wait_for_all_acked(duration)


class Bridge:
    """Gives the core what the node receives, and publishes what the core answers."""

    def __init__(self, node: Any, core: CalibrationNode) -> None:
        self._node, self._core = node, core
        self._publishers = Publishers(node)
        self._subscriptions: list[Subscription] = []

    def listen(self, settings: NodeSettings, subscribe: Subscribe) -> None:
        """Begin with all topics; ``settings`` has their names before they are remapped."""
        for part, record in self._core.topics.items():
            topic = getattr(settings, f"{part}_topic", record.topic)
            one = Subscription(self._node, part, topic, record, partial(self._take, part))
            self._subscriptions.append(one)
            one.listen(subscribe, settings.queue)

    def tick(self) -> None:
        """Diagnostics, and a change of the state for the log; to be called once a second or so."""
        for one in self._subscriptions:
            one.look()
        self._publishers.publish(self._core.tick(self._now_ns()))
        if news := self._core.news():
            self._node.get_logger().info(news)

    def finish(self, duration: Any) -> None:
        """Use what waits, publish the solution of the whole window, and wait until that has arrived."""
        for published in self._core.finish(self._now_ns()):
            self._publishers.publish(published)
        self.tick()
        self._publishers.wait(duration)

    def _take(self, part: str, data: bytes) -> None:
        for published in self._core.add_bytes(part, data, self._now_ns()):
            self._publishers.publish(published)

    def _now_ns(self) -> int:
        return int(self._node.get_clock().now().nanoseconds)


def message_class(type_name: str) -> Any:
    """The class of "sensor_msgs/msg/Image", of ROS 2's own package."""
    package, _, name = type_name.split("/")
    return getattr(import_module(f"{package}.msg"), name)

"""Topics that the node listens to and publishes; what is in it needs rclpy."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from importlib import import_module
from typing import Any

from sst_graph.data.ros.messages import MessageMaker
from sst_graph.ros_node.published import Published
from sst_graph.ros_node.sensor import SensorRecord

_LATCHED, _RELIABLE = ("RELIABLE", "TRANSIENT_LOCAL"), ("RELIABLE", "VOLATILE")
_BEST_EFFORT = "BEST_EFFORT", "VOLATILE"
_QUALITIES = {"transforms": (_LATCHED,), "info": (_LATCHED, _RELIABLE, _BEST_EFFORT)}
_OF_SENSORS = _RELIABLE, _BEST_EFFORT
"""What the publishers of a topic are asked for, the best first."""


class Subscription:
    """Messages of a topic as bytes, in the best quality of service that its publishers offer.

    The middleware reports a publisher that offers less than is asked for; then the next quality is asked
    for. Best effort alone would fit all of them, and lose pictures and clouds of more than half a megabyte,
    which are sent in pieces.
    """

    def __init__(
        self, node: Any, part: str, topic: str, record: SensorRecord, take: Callable[[bytes], None]
    ) -> None:
        """
        Args:
            part: that the topic has in the node's core, ``CalibrationNode.topics``.
            topic: its name before it is remapped.
            record: is told what is lost, and as what the topic is published.
        """
        self._node, self._topic, self._record, self._take = node, topic, record, take
        self._qualities = list(_QUALITIES.get(part, _OF_SENSORS))
        self._subscription: Any = None

    def listen(self, depth: int) -> None:
        """Begin; at most ``depth`` messages wait to be taken."""
        from rclpy.event_handler import SubscriptionEventCallbacks
        from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

        reliability, durability = self._qualities.pop(0)
        quality = QoSProfile(
            depth=depth, reliability=ReliabilityPolicy[reliability], durability=DurabilityPolicy[durability]
        )
        events = SubscriptionEventCallbacks(message_lost=self._lost)
        if self._qualities:
            events.incompatible_qos = partial(self._ask_for_less, depth)
        self._subscription = self._node.create_subscription(
            message_class(self._record.type_name),
            self._topic,
            self._taken,
            quality,
            event_callbacks=events,
            raw=True,
        )

    def look(self) -> None:
        """Note as what the topic is published."""
        found = self._node.get_publishers_info_by_topic(self._topic)
        self._record.published = frozenset(one.topic_type for one in found)

    def _taken(self, data: bytes, info: Any) -> None:
        """Note how long the message waited, and take it."""
        received_ns = info["received_timestamp"]
        if received_ns:
            self._record.wait(1e-9 * (time.time_ns() - received_ns))
        self._take(data)

    def _ask_for_less(self, depth: int, event: Any) -> None:
        self._node.destroy_subscription(self._subscription)
        self.listen(depth)

    def _lost(self, event: Any) -> None:
        self._record.lose(event.total_count_change, self._node.get_clock().now().nanoseconds)


class Publishers:
    """The publishers of status, transforms and diagnostics."""

    def __init__(self, node: Any) -> None:
        from diagnostic_msgs.msg import DiagnosticArray
        from std_msgs.msg import String
        from tf2_msgs.msg import TFMessage

        self._make = MessageMaker()
        self._publishers = {
            "status": node.create_publisher(String, "~/status", 100),
            "transforms": node.create_publisher(TFMessage, "/tf", 100),
            "diagnostics": node.create_publisher(DiagnosticArray, "/diagnostics", 10),
        }

    def publish(self, published: Published) -> None:
        """Publish all that is there."""
        for kind, publisher in self._publishers.items():
            if (message := getattr(published, kind)) is not None:
                publisher.publish(self._make.encoded(message))

    def wait(self) -> None:
        """Until all has arrived, at most a second for each topic."""
        from rclpy.duration import Duration

        for publisher in self._publishers.values():
            publisher.wait_for_all_acked(Duration(seconds=1))


def message_class(type_name: str) -> Any:
    """The class of "sensor_msgs/msg/Image"."""
    package, _, name = type_name.split("/")
    return getattr(import_module(f"{package}.msg"), name)

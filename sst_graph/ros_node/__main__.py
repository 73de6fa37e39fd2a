"""The ROS 2 node (docs/how-to/ros-node.md): all that needs rclpy. It takes and publishes bytes."""

from __future__ import annotations

import sys
from functools import partial
from typing import Any

from sst_graph.errors import ConfigError, SstGraphError
from sst_graph.ros_node.calibration_node import CalibrationNode
from sst_graph.ros_node.startup import read_settings, stopping, with_resolved_topics
from sst_graph.ros_node.topics import Bridge, Quality, Subscription, message_class


def main() -> None:
    """Work until SIGINT or SIGTERM; then use what waits, solve the whole window, and publish that."""
    from rclpy.clock import Clock, ClockType
    from rclpy.duration import Duration
    from rclpy.exceptions import NameValidationException
    from rclpy.executors import SingleThreadedExecutor

    # 1. The node and its core, by the parameters, which cannot be changed from then on.
    stops = stopping()
    node = node_of_arguments()
    descriptor = message_class("rcl_interfaces/msg/ParameterDescriptor")
    fixed = partial(descriptor, read_only=True, dynamic_typing=True)
    settings, config = read_settings(node, fixed)
    name = node.get_fully_qualified_name().lstrip("/")
    refusals = RuntimeError, ValueError, NameValidationException
    core = CalibrationNode(with_resolved_topics(node, settings, refusals), config, name)
    # 2. What is published comes of messages, and of a timer that runs where /clock stands still.
    bridge = Bridge(node, core)
    bridge.listen(settings, partial(subscribe, node))
    node.create_timer(1.0, bridge.tick, clock=Clock(clock_type=ClockType.STEADY_TIME))
    # 3. Work.
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    while not stops:
        executor.spin_once(timeout_sec=0.2)
    # 4. The end: at most a second for each topic.
    bridge.finish(Duration(seconds=1))
    node.destroy_node()
    executor.shutdown()


def node_of_arguments() -> Any:
    """The node, which leaves signals alone.

    Raises:
        ConfigError: arguments that ROS does not understand, or that are none of ROS.
    """
    import rclpy
    from rclpy.exceptions import NameValidationException
    from rclpy.signals import SignalHandlerOptions
    from rclpy.utilities import remove_ros_args

    try:
        rclpy.init(args=sys.argv, signal_handler_options=SignalHandlerOptions.NO)
        node = rclpy.create_node("sst_graph", automatically_declare_parameters_from_overrides=True)
    except ValueError:
        raise ConfigError("arguments of ROS: found a parameter that is an empty list") from None
    except (RuntimeError, NameValidationException) as error:
        raise ConfigError(f"arguments of ROS: {' '.join(str(error).split())}") from None
    if others := remove_ros_args(sys.argv)[1:]:
        raise ConfigError(f"found {' '.join(others)}, expected parameters, --ros-args -p name:=value")
    return node


def subscribe(node: Any, one: Subscription, quality: Quality) -> Any:
    """A subscription of rclpy to messages as bytes, in that quality of service."""
    from rclpy.event_handler import SubscriptionEventCallbacks
    from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

    reliability, durability = ReliabilityPolicy[quality.reliability], DurabilityPolicy[quality.durability]
    profile = QoSProfile(depth=quality.depth, reliability=reliability, durability=durability)
    events = SubscriptionEventCallbacks(incompatible_qos=one.incompatible, message_lost=one.lost)
    kind = message_class(one.record.type_name)
    return node.create_subscription(kind, one.topic, one.taken, profile, event_callbacks=events, raw=True)


if __name__ == "__main__":
    try:
        main()
    except ModuleNotFoundError as missing:
        todo = "pip install 'sst-graph[ros]'" if missing.name == "rosbags" else "source ROS 2 first"
        raise SystemExit(f"sst_graph.ros_node: {missing.name} is not installed: {todo}") from None
    except SstGraphError as error:
        why = str(error).removeprefix("NodeSettings.")
        raise SystemExit(f"sst_graph.ros_node: {why}") from None

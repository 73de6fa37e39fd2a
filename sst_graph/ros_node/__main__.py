"""The ROS 2 node (docs/how-to/ros-node.md). It takes and publishes bytes; rosbags decodes and encodes."""

from __future__ import annotations

from functools import partial

from sst_graph.errors import SstGraphError
from sst_graph.ros_node.calibration_node import CalibrationNode


def main() -> None:
    """Work until SIGINT or SIGTERM; then use what waits, solve the whole window, and publish that."""
    from rclpy.clock import Clock, ClockType
    from rclpy.executors import SingleThreadedExecutor

    from sst_graph.ros_node.startup import node_of_arguments, read_settings, stopping, with_resolved_topics
    from sst_graph.ros_node.topics import Publishers, Subscription

    # 1. The node and its core, by the parameters.
    stops = stopping()
    node = node_of_arguments()
    settings, config = read_settings(node)
    name = node.get_fully_qualified_name().lstrip("/")
    core = CalibrationNode(with_resolved_topics(node, settings), config, name)
    # 2. What is published comes of messages, and of a timer that runs where /clock stands still.
    publishers = Publishers(node)

    def now_ns() -> int:
        return int(node.get_clock().now().nanoseconds)

    def take(part: str, data: bytes) -> None:
        for published in core.add_bytes(part, data, now_ns()):
            publishers.publish(published)

    def tick() -> None:
        for one in subscriptions:
            one.look()
        publishers.publish(core.tick(now_ns()))
        if news := core.news():
            node.get_logger().info(news)

    subscriptions = []
    for part, record in core.topics.items():
        topic = getattr(settings, f"{part}_topic", record.topic)
        subscriptions.append(Subscription(node, part, topic, record, partial(take, part)))
        subscriptions[-1].listen(settings.queue)
    node.create_timer(1.0, tick, clock=Clock(clock_type=ClockType.STEADY_TIME))
    # 3. Work.
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    while not stops:
        executor.spin_once(timeout_sec=0.2)
    # 4. The end.
    for published in core.finish(now_ns()):
        publishers.publish(published)
    tick()
    publishers.wait()
    node.destroy_node()
    executor.shutdown()


if __name__ == "__main__":
    try:
        main()
    except ModuleNotFoundError as missing:
        todo = "pip install 'sst-graph[ros]'" if missing.name == "rosbags" else "source ROS 2 first"
        raise SystemExit(f"sst_graph.ros_node: {missing.name} is not installed: {todo}") from None
    except SstGraphError as error:
        why = str(error).removeprefix("NodeSettings.")
        raise SystemExit(f"sst_graph.ros_node: {why}") from None

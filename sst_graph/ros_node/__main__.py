"""The ROS 2 node (docs/how-to/ros-node.md). It takes and publishes bytes; rosbags decodes and encodes."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

from sst_graph.config import with_overrides
from sst_graph.ros_node.calibration_node import CalibrationNode, image_type
from sst_graph.ros_node.published import NodeMessages, Published
from sst_graph.ros_node.settings import NodeSettings
from sst_graph.tracker.config import TrackerConfig


def main() -> None:
    """Spin until ROS shuts down."""
    import rclpy
    from diagnostic_msgs.msg import DiagnosticArray
    from rclpy.executors import ExternalShutdownException
    from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
    from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2
    from std_msgs.msg import String
    from tf2_msgs.msg import TFMessage

    rclpy.init()
    node = rclpy.create_node("sst_graph")
    values = {k: node.declare_parameter(k, v).value for k, v in dataclasses.asdict(NodeSettings()).items()}
    overrides = node.declare_parameter("tracker_settings", [""]).value
    config = with_overrides(TrackerConfig(), [one for one in overrides if one])
    core, make = CalibrationNode(NodeSettings(**values), config), NodeMessages()
    publishers = {
        "status": node.create_publisher(String, "~/status", 10),
        "transforms": node.create_publisher(TFMessage, "/tf", 100),
        "diagnostics": node.create_publisher(DiagnosticArray, "/diagnostics", 10),
    }

    def publish(published: Published) -> None:
        for name, publisher in publishers.items():
            if (message := getattr(published, name)) is not None:
                publisher.publish(make.encoded(message))

    def now_ns() -> int:
        return int(node.get_clock().now().nanoseconds)

    def take(add: Any, type_name: str, data: bytes) -> None:
        for published in add(make.decoded(data, type_name), now_ns()) or ():
            publish(published)

    def listen(topic: str, kind: Any, add: Any, qos: Any = qos_profile_sensor_data) -> None:
        type_name = f"{kind.__module__.partition('.')[0]}/msg/{kind.__name__}"
        node.create_subscription(kind, topic, partial(take, add, type_name), qos, raw=True)

    for topic, add in ((core.camera.topic, core.add_image), (core.masks.topic, core.add_mask)):
        if topic:
            compressed = image_type(topic).endswith("CompressedImage")
            kind = CompressedImage if compressed else Image
            listen(topic, kind, partial(add, type_name=image_type(topic)))
    listen(core.lidar.topic, PointCloud2, core.add_cloud)
    listen(core.settings.info_topic, CameraInfo, core.add_info)
    latched = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    listen("/tf_static", TFMessage, core.add_transforms, latched)
    node.create_timer(1.0, lambda: publish(core.tick(now_ns())))
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        if rclpy.ok():
            rclpy.shutdown()


if __name__ == "__main__":
    try:
        main()
    except ModuleNotFoundError as missing:
        raise SystemExit(f"sst_graph.ros_node: {missing.name} is not installed: source ROS 2 first") from None

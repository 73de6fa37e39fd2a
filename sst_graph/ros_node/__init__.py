"""The tracker on ROS 2 topics (docs/how-to/ros-node.md).

Everything but ``__main__`` is plain Python on messages as rosbags decodes them; ``python -m
sst_graph.ros_node`` is the node, and needs rclpy.
"""

from sst_graph.ros_node.calibration_node import CalibrationNode
from sst_graph.ros_node.published import Published
from sst_graph.ros_node.settings import NodeSettings

__all__ = ["CalibrationNode", "NodeSettings", "Published"]

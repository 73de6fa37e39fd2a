"""The node's parameters, and the signals that end it; ``node`` is rclpy's, or has its methods."""

from __future__ import annotations

import dataclasses
import signal
from collections.abc import Callable
from typing import Any

from sst_graph.errors import ConfigError
from sst_graph.ros_node.settings import NodeSettings, node_settings, parameter_defaults
from sst_graph.tracker.config import TrackerConfig

_OF_ROS = {"use_sim_time", "start_type_description_service"}
"""Parameters that every node has."""


def stopping() -> list[int]:
    """A list that is empty until SIGINT or SIGTERM comes; a second one ends the process at once."""
    stops: list[int] = []

    def stop(number: int, _: Any) -> None:
        stops.append(number)
        signal.signal(number, signal.SIG_DFL)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop)
    return stops


def read_settings(node: Any, descriptor: Callable[[], Any]) -> tuple[NodeSettings, TrackerConfig]:
    """Settings of node and tracker by the node's parameters, each declared anew with a ``descriptor``.

    Those of other names are warned of: a file of parameters may be that of several nodes.

    Raises:
        ConfigError: a value that cannot be used.
    """
    values = {}
    for name, default in parameter_defaults().items():
        value = default
        if node.has_parameter(name):
            value = node.get_parameter(name).value
            node.undeclare_parameter(name)
        values[name] = node.declare_parameter(name, value, descriptor()).value
    for name in sorted(node.get_parameters_by_prefix("")):
        if name not in values and name not in _OF_ROS and not name.startswith("qos_overrides."):
            node.get_logger().warning(f"parameter {name} is none of this node and is not used")
    return node_settings(values)


def with_resolved_topics(
    node: Any, settings: NodeSettings, refusals: tuple[type[Exception], ...]
) -> NodeSettings:
    """``settings`` with the names that the topics have in the graph: in the namespace, and remapped.

    Args:
        refusals: what the node raises for a name that no topic can have.

    Raises:
        ConfigError: a name that no topic can have.
    """
    given = {name: value for name, value in dataclasses.asdict(settings).items() if name.endswith("_topic")}
    found: dict[str, Any] = {}
    for name, value in given.items():
        try:
            found[name] = node.resolve_topic_name(value) if value else ""
        except refusals as error:
            raise ConfigError(f"{name}: found {value!r}: {' '.join(str(error).split())}") from None
    return dataclasses.replace(settings, **found)

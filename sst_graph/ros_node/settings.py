"""Parameters of the ROS 2 node."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, get_args

from sst_graph.classes import MaskEncoding
from sst_graph.config import Settings, setting, with_overrides
from sst_graph.data.source import TURNS
from sst_graph.errors import ConfigError
from sst_graph.sweep_timing import SweepStamp
from sst_graph.tracker.config import TrackerConfig

INIT_TF, INIT_NONE = "tf", "none"


@dataclass(frozen=True)
class NodeSettings(Settings):
    """Topics, and how the tracker is run on them; each is a ROS parameter of the same name."""

    image_topic: str = setting("image", doc="Image or CompressedImage (a name that ends in /compressed).")
    info_topic: str = setting("camera_info", doc="CameraInfo of these images.")
    cloud_topic: str = setting("points", doc="PointCloud2.")
    mask_topic: str = setting(
        "", doc="Masks with the stamps of their images; the field label of the clouds is then read, too."
    )
    label_encoding: str = setting(
        "ids", choices=tuple(MaskEncoding), doc="Numbers of the masks; as --label-encoding, but for auto."
    )
    init: str = setting(
        INIT_TF,
        doc="Start: tf (the transforms on /tf_static), none, or a KITTI calib.txt or calibration.json.",
    )
    sweep: str = setting(
        "auto",
        choices=("auto", "compensated", *TURNS),
        doc="Times of the points: auto (those in the clouds), compensated, clockwise, counterclockwise.",
    )
    sweep_period_s: float = setting(0.1, at_least=0.001, at_most=60.0, doc="Duration of a turn.")
    sweep_stamp: SweepStamp = setting(
        "forward",
        choices=get_args(SweepStamp),
        doc="The instant of a turn that a cloud's stamp names, as --sweep-stamp.",
    )
    lidar_pose: str = setting(
        "",
        doc="T_cloud_lidar, as --lidar-pose: where the LiDAR is in the axes of the clouds, if these are not "
        "its own.",
    )
    publish: str = setting(
        "adopted",
        choices=("adopted", "latest", "none"),
        doc="On /tf: the adopted calibration, the latest estimate (latest), or nothing (none).",
    )
    parent: str = setting(
        "camera",
        choices=("camera", "lidar"),
        doc="Parent on /tf: camera or lidar. The child must have no other parent.",
    )
    hold_s: float = setting(
        0.2, at_least=0.0, at_most=10.0, doc="Messages wait so long to be put in the order of their stamps."
    )
    queue: int = setting(
        60, at_least=2, at_most=10000, doc="Most messages that wait; the oldest are dropped."
    )
    silent_s: float = setting(1.0, at_least=0.01, at_most=3600.0, doc="A sensor without a message is silent.")

    def __post_init__(self) -> None:
        for name in ("image_topic", "info_topic", "cloud_topic", "init"):
            if not getattr(self, name):
                raise ConfigError(f"{name}: found an empty name, expected one")


def parameter_defaults() -> dict[str, Any]:
    """All parameters of the node with their defaults, in the types of ROS."""
    return {**dataclasses.asdict(NodeSettings()), "tracker_settings": [""]}


def node_settings(parameters: Mapping[str, Any]) -> tuple[NodeSettings, TrackerConfig]:
    """Settings of the node and of its tracker by the values of ROS parameters.

    Raises:
        ConfigError: an unknown name, or a value that cannot be used.
    """
    values = dict(parameters)
    overrides = values.pop("tracker_settings", [])
    listed = [overrides] if isinstance(overrides, str) else list(overrides)
    if not all(isinstance(one, str) for one in listed):
        raise ConfigError(f'tracker_settings: found {listed}, expected texts, ["name=value"]')
    if unknown := sorted(set(values) - set(parameter_defaults())):
        raise ConfigError(
            f"found a parameter {unknown[0]!r}, expected one of {', '.join(parameter_defaults())}"
        )
    config = with_overrides(TrackerConfig(), [one for one in listed if one])
    return NodeSettings(**values), config

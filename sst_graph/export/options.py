"""What the formats need beside a result: names of frames, which way round, the vehicle's own transforms."""

from __future__ import annotations

import re
from dataclasses import dataclass

from sst_graph.data.kitti.calib import KittiCalibration
from sst_graph.data.ros.transforms import Transforms
from sst_graph.errors import ConfigError
from sst_graph.factors.arguments import checked_type

_NAME = re.compile(r"/?[A-Za-z0-9_](?:[A-Za-z0-9_/.]|-(?!-))*")
CAMERA, NUMBER = "{camera}", "{number}"
"""In the name of a frame: the camera's own name, and its number in the rig."""


@dataclass(frozen=True)
class ExportOptions:
    """Names, direction, and what is known of the vehicle.

    In the names of the camera's frames ``{camera}`` stands for the camera's name and ``{number}`` for its
    place in the rig.

    Attributes:
        camera_frame: name of the camera's optical frame (x right, y down, z forward); by default
            ``camera_optical_frame``, of a rig ``{camera}_optical_frame``.
        camera_link: name of the camera's link (x forward, y left, z up); by default that of the optical frame
            with ``_link`` in the place of ``_optical_frame``.
        lidar_frame: name of the LiDAR's frame.
        parent, child: frames of the transform that is written: one of the camera, one of the LiDAR's side.
        tree: transforms of the vehicle that hold the LiDAR's frame.
        kitti: calib.txt whose P lines say where the camera stands beside camera 0; None takes the
            camera itself for camera 0.

    Raises:
        ConfigError: names that no format can hold, or one for two frames.
        FactorError: a name that is no text, or something else than transforms and a calibration of KITTI.
    """

    camera_frame: str | None = None
    camera_link: str | None = None
    lidar_frame: str = "lidar"
    parent: str | None = None
    child: str | None = None
    tree: Transforms | None = None
    kitti: KittiCalibration | None = None

    def __post_init__(self) -> None:
        for field in ("camera_frame", "camera_link", "parent", "child"):
            what, expected = f"{field} of ExportOptions", "the name of a frame, or None"
            checked_type(what, getattr(self, field), (str, type(None)), expected)
        checked_type("lidar_frame of ExportOptions", self.lidar_frame, str, "the name of a frame")
        tree, kitti = (Transforms, type(None)), (KittiCalibration, type(None))
        checked_type("tree of ExportOptions", self.tree, tree, "Transforms, or None")
        checked_type("kitti of ExportOptions", self.kitti, kitti, "a KittiCalibration, or None")
        for name in (self.camera_frame, self.camera_link, self.lidar_frame, self.parent, self.child):
            if name is not None and not _NAME.fullmatch(name.replace(CAMERA, "c").replace(NUMBER, "0")):
                raise ConfigError(f"frame name {name!r}: expected letters, digits, '_', '/', '.', single '-'")
        if self.camera_frame is not None and self.camera_frame == self.camera_link:
            found = f"frame name {self.camera_frame!r}: found for the optical frame and the link"
            raise ConfigError(f"{found}, expected two names")
        if self.lidar_frame in (self.camera_frame, self.camera_link):
            raise ConfigError(f"frame name {self.lidar_frame!r}: found for both sensors, expected two names")

"""Calibrations in the formats of other programs: ``export``, ``import``."""

from __future__ import annotations

import argparse
from pathlib import Path

from sst_graph.cli.options.base_parser import Commands

EXPORTS = (
    "kitti",
    "ros-tf",
    "ros1-launch",
    "ros2-launch",
    "ros2-launch-xml",
    "urdf",
    "xacro",
    "autoware",
    "kalibr",
    "openvins",
    "mins",
    "opencv",
    "nuscenes",
    "gtsam",
)
"""Formats of ``sst_graph.export``, which is not imported for the help's sake; a test compares them."""


def add_export(commands: Commands) -> argparse.ArgumentParser:
    text = "write a result in the format of another program"
    export = commands.add_parser(
        "export",
        help=text,
        description=f"{text[0].upper()}{text[1:]}; docs/how-to/export.md states frames and signs.",
    )
    export.add_argument(
        "result", metavar="RESULT", type=Path, help="calibration.json, rig.json, or the folder of one"
    )
    export.add_argument(
        "--to",
        required=True,
        choices=EXPORTS,
        help="format; gtsam: the marginal on (E, D) as JSON with a serialized LinearContainerFactor",
    )
    export.add_argument("--out", type=Path, metavar="FILE", help="file to write (default: stdout)")
    export.add_argument("--overwrite", action="store_true", help="replace the file")
    export.add_argument(
        "--force", action="store_true", help="export a result whose status is not ok, with a warning"
    )
    export.add_argument(
        "--calib",
        type=Path,
        metavar="FILE",
        help="kitti only: calib.txt whose P lines place the camera beside camera 0 "
        "(without it the camera counts as camera 0)",
    )
    frames = export.add_argument_group("frames (docs/how-to/export.md)")
    frames.add_argument(
        "--camera-frame",
        metavar="NAME",
        help="the camera's optical frame, z forward (default camera_optical_frame; of a rig "
        "{camera}_optical_frame, with the camera's name for {camera})",
    )
    frames.add_argument(
        "--camera-link",
        metavar="NAME",
        help="the camera's link, x forward (default: the optical frame's name with _link for _optical_frame)",
    )
    frames.add_argument(
        "--lidar-frame", default="lidar", metavar="NAME", help="the LiDAR's frame (default %(default)s)"
    )
    frames.add_argument(
        "--parent",
        metavar="FRAME",
        help="write the pose of the child in this frame: the LiDAR's, the camera's (default), or one of "
        "--tree; the kit (autoware), the ego frame (nuscenes), the IMU (kalibr, openvins, mins)",
    )
    frames.add_argument(
        "--child", metavar="FRAME", help="the other end: a frame of the camera, or one of the LiDAR's side"
    )
    frames.add_argument(
        "--tree",
        type=Path,
        metavar="FILE",
        help="the vehicle's transforms, with the LiDAR's frame: URDF, a launch file, tf messages as YAML, "
        "Autoware's sensor kit",
    )
    return export


IMPORTS = ("calibration", *EXPORTS)
"""Formats of ``sst_graph.imports``; a test compares them."""


def add_import(commands: Commands) -> argparse.ArgumentParser:
    text = "turn a calibration of another program into a start for --init"
    command = commands.add_parser(
        "import",
        help=text,
        description=f"{text[0].upper()}{text[1:]}; docs/how-to/imports.md states what is taken for what. "
        "--init FILE reads the same files where nothing has to be named.",
    )
    command.add_argument("file", metavar="FILE", type=Path, help="file in a format that export writes")
    command.add_argument(
        "--from", dest="form", choices=IMPORTS, help="format (default: recognized by the contents)"
    )
    command.add_argument("--camera", metavar="NAME", help="the camera, of a file with several")
    frames = command.add_argument_group("frames")
    frames.add_argument(
        "--camera-frame", metavar="NAME", help="the camera's optical frame: x right, y down, z forward"
    )
    frames.add_argument(
        "--camera-link", metavar="NAME", help="instead, the camera's link: x forward, y left, z up"
    )
    frames.add_argument("--lidar-frame", metavar="NAME", help="the LiDAR's frame")
    frames.add_argument(
        "--parent",
        metavar="FRAME",
        help="kalibr, openvins: frame in the IMU's place (default: the LiDAR itself)",
    )
    frames.add_argument(
        "--tree",
        type=Path,
        metavar="FILE",
        help="further transforms, such as that from --parent to the LiDAR",
    )
    command.add_argument("--out", type=Path, metavar="FILE", help="file to write (default: stdout)")
    command.add_argument("--overwrite", action="store_true", help="replace the file")
    return command

"""How a calibration is estimated: method, start, classes, settings."""

from __future__ import annotations

import argparse
from pathlib import Path

from sst_graph.cli.options.base_parser import Parser


def add_method(command: Parser) -> None:
    """How one drive or several are calibrated."""
    command.add_argument(
        "--method",
        choices=("auto", "joint", "edges", "both", "motion", "paper", "static", "semalign"),
        help="auto: joint where both sensors have labels, both where one of several drives has none, else "
        "edges (default); joint: extrinsic and offset by outlines of labelled objects; edges: the same by "
        "LiDAR edges and pictures, no labels needed; both: joint in frames with labels, edges in the others; "
        "motion: LiDAR odometry against visual odometry, no labels needed; paper: SST-Calib as printed; "
        "static: its first stage, the extrinsic alone; semalign: sampled starts, the extrinsic alone",
    )
    command.add_argument(
        "--init",
        metavar="dataset|none|FILE",
        default="dataset",
        help="start: the data's nominal calibration (default), no guess at all, or a calibration.json or "
        "another file that import reads (KITTI, ROS, Kalibr, ...)",
    )
    command.add_argument(
        "--classes", metavar="vehicle|all|A,B", help="classes to align, such as vehicle,pole"
    )
    add_estimate(command)
    add_settings(command)
    command.add_argument(
        "--no-report", action="store_true", help="leave out report.html, the page with pictures and charts"
    )


def add_estimate(command: Parser) -> None:
    command.add_argument(
        "--estimate",
        metavar="NAMES",
        help="estimate assumptions together with the calibration: some of focal, cx, cy, k1, "
        "k2, sweep, skew, line_delay, range_bias, range_scale, elevation, separated by commas; k1=0.05 gives "
        "the standard deviation of its prior about 0 (docs/understand/assumptions.md)",
    )


def add_settings(command: argparse.ArgumentParser) -> None:
    """Settings of the stage's configuration."""
    settings = command.add_argument_group("settings")
    settings.add_argument("--config", type=Path, metavar="FILE", help="settings as JSON or TOML")
    settings.add_argument(
        "--set",
        dest="settings",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="one setting, such as a.b=0.5 (repeatable; after --config)",
    )

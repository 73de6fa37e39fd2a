"""What is known of several cameras on one vehicle."""

from __future__ import annotations

from sst_graph.cli.options.base_parser import Parser


def add_rig(command: Parser) -> None:
    """What is known of several cameras."""
    rig = command.add_argument_group("several cameras (docs/how-to/rigs.md)")
    rig.add_argument(
        "--rig",
        metavar="dataset|FILE",
        help="known poses between the cameras: those of the data's nominal calibration, or of Kalibr's "
        "camchain.yaml (T_cn_cnm1) or KITTI's calib.txt",
    )
    rig.add_argument(
        "--rig-sigma",
        metavar="DEG,CM",
        help="how well these are known, one sigma along each axis (default 0.03,0.2)",
    )
    rig.add_argument(
        "--one-trigger", action="store_true", help="all cameras are triggered together: one time offset"
    )

"""The commands on a drive alone: ``info``, ``segment``."""

from __future__ import annotations

import argparse
from pathlib import Path

from sst_graph.cli.options.base_parser import Commands
from sst_graph.cli.options.data import add_label_options, add_networks, add_source_options


def add_info(commands: Commands) -> argparse.ArgumentParser:
    text = "what a drive holds: sensors, rates, stamps, gaps, labels, and what is missing for which method"
    info = commands.add_parser("info", help=text, description=text)
    info.add_argument(
        "data", metavar="DATA", type=Path, nargs="*", help="dataset or sequence folder, or a bag"
    )
    add_source_options(info, several_cameras=True)
    add_label_options(info)
    info.add_argument("--json", action="store_true", help="print JSON (units in the names)")
    return info


def add_segment(commands: Commands) -> argparse.ArgumentParser:
    text = "label a drive by networks ahead of its calibration, and keep the labels"
    segment = commands.add_parser(
        "segment",
        help=text,
        description=f"{text[0].upper()}{text[1:]}; docs/how-to/networks.md has examples.",
    )
    segment.add_argument(
        "data", metavar="DATA", type=Path, nargs="*", help="dataset or sequence folder, or a bag"
    )
    add_source_options(segment, several_cameras=True)
    add_networks(segment.add_argument_group("networks (docs/how-to/networks.md)"))
    segment.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="folder of labels, for --labels DIR; what it has is not made again (default: the user's cache, "
        "where the other commands look for the labels of their networks)",
    )
    return segment

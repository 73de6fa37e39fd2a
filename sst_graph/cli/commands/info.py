"""``sst-graph info``: what a drive holds, and what is missing for which method."""

from __future__ import annotations

import argparse
import dataclasses
import json

from sst_graph.cli.messages import say
from sst_graph.cli.reading import open_drive
from sst_graph.data.info import drive_info, info_text


def run(args: argparse.Namespace) -> int:
    """Print the summary of the drive."""
    info = drive_info(open_drive(args, args.data))
    say(json.dumps(dataclasses.asdict(info), indent=1, ensure_ascii=False) if args.json else info_text(info))
    return 0

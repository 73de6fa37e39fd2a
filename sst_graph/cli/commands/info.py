"""``sst-graph info``: what a drive holds, and what is missing for which method."""

from __future__ import annotations

import argparse
import dataclasses
import json

from sst_graph.cli.messages import say
from sst_graph.cli.reading import cameras_of_one_drive, open_drive
from sst_graph.data.info import drive_info, info_text


def run(args: argparse.Namespace) -> int:
    """Print the summary of the drive; of several cameras one for each."""
    infos = {}
    for camera in cameras_of_one_drive(args):
        args.camera = camera
        infos[camera] = drive_info(open_drive(args, args.data[0]))
    if args.json:
        tables = {camera: dataclasses.asdict(info) for camera, info in infos.items()}
        printed = tables if len(tables) > 1 else next(iter(tables.values()))
        say(json.dumps(printed, indent=1, ensure_ascii=False))
    else:
        say("\n\n".join(info_text(info) for info in infos.values()))
    return 0

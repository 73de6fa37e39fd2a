"""The commands on a result: ``evaluate``, ``inspect``, ``overlay``, ``view``."""

from __future__ import annotations

import argparse
from pathlib import Path

from sst_graph.cli.options.base_parser import Commands
from sst_graph.cli.options.data import add_label_options, add_source_options


def add_evaluate(commands: Commands) -> argparse.ArgumentParser:
    text = "compare a result with the truth: QAD, AEAD [deg], ATD [cm], time error [ms], NEES"
    evaluate = commands.add_parser("evaluate", help=text, description=text)
    evaluate.add_argument("result", metavar="RESULT", type=Path, help="calibration.json, or its folder")
    evaluate.add_argument(
        "--truth",
        metavar="FILE",
        type=Path,
        required=True,
        help="groundtruth.json, calibration.json, a KITTI calib.txt (then without time offset), or the data "
        "set that RESULT was made of, whose truth or published calibration it is compared with",
    )
    evaluate.add_argument(
        "--truth-sigma",
        metavar="ROT_DEG,TRANS_CM,MS",
        help="how well the truth is known itself, one sigma along each axis; the NEES counts it in "
        "(0.1,1,2 for KITTI's published calibration)",
    )
    evaluate.add_argument("--json", action="store_true", help="print JSON (degrees, metres, seconds)")
    return evaluate


def add_inspect(commands: Commands) -> argparse.ArgumentParser:
    text = "how far a result can be trusted, what to record next, and how it fits a drive"
    inspect = commands.add_parser(
        "inspect",
        help=text,
        description=f"{text[0].upper()}{text[1:]}; docs/how-to/inspect.md explains each line.",
    )
    inspect.add_argument("result", metavar="RESULT", type=Path, help="calibration.json, or its folder")
    inspect.add_argument(
        "data",
        metavar="DATA",
        type=Path,
        nargs="?",
        help="drive: measure on it how well the calibration in RESULT fits, by labels and by edges of the "
        "pictures",
    )
    inspect.add_argument("--all-frames", action="store_true", help="every frame in the table")
    inspect.add_argument(
        "--next", type=int, default=10, metavar="N", help="frames to record next (default %(default)s)"
    )
    inspect.add_argument("--json", action="store_true", help="print JSON (units in the names)")
    inspect.add_argument("--plots", type=Path, metavar="DIR", help="folder for plots as PNG")
    inspect.add_argument("--overwrite", action="store_true", help="replace earlier plots in DIR")
    add_source_options(inspect)
    add_label_options(inspect)
    return inspect


def add_overlay(commands: Commands) -> argparse.ArgumentParser:
    text = "draw the LiDAR into the camera image, before and after a calibration"
    overlay = commands.add_parser(
        "overlay",
        help=text,
        description=f"{text}. The caption has the share of vehicles' boundary points within 1.5 px of the "
        "contour, in that frame alone; sst-graph inspect RESULT DATA has that of the drive, and what labels "
        "allow.",
    )
    overlay.add_argument("result", metavar="RESULT", type=Path, help="calibration.json, or its folder")
    overlay.add_argument("data", metavar="DATA", type=Path, help="drive: dataset or sequence folder")
    add_source_options(overlay)
    add_label_options(overlay)
    overlay.add_argument(
        "--frame", type=int, metavar="K", help="index of the frame to draw (default: the middle one)"
    )
    overlay.add_argument(
        "--before",
        metavar="initial|dataset|FILE",
        default="initial",
        help="what to compare with: the result's own start (default), the data's nominal, or a file",
    )
    written = overlay.add_mutually_exclusive_group()
    written.add_argument(
        "--out", type=Path, metavar="PNG", help="picture of one frame to write (default overlay.png)"
    )
    written.add_argument(
        "--video", type=Path, metavar="MP4|GIF", help="video of all frames to write, instead of a picture"
    )
    overlay.add_argument("--overwrite", action="store_true", help="replace the picture or the video")
    return overlay


def add_view(commands: Commands) -> argparse.ArgumentParser:
    text = "show a result in the viewer rerun: clouds, pictures, matches, trajectory, tracks, sigmas"
    view = commands.add_parser("view", help=text, description=text)
    view.add_argument("result", metavar="RESULT", type=Path, help="calibration.json, or its folder")
    view.add_argument("data", metavar="DATA", type=Path, help="drive: dataset or sequence folder, or a bag")
    add_source_options(view)
    add_label_options(view)
    view.add_argument(
        "--save", type=Path, metavar="RRD", help="write a file for the viewer, instead of opening it"
    )
    view.add_argument("--overwrite", action="store_true", help="replace the file")
    return view

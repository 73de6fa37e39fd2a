"""The commands that calibrate: ``calibrate``, ``batch``, ``track``."""

from __future__ import annotations

import argparse
from pathlib import Path

from sst_graph.cli.options.base_parser import SIGN, Commands, Parser
from sst_graph.cli.options.data import add_label_options, add_source_options
from sst_graph.cli.options.method import add_estimate, add_method, add_settings


def add_calibrate(commands: Commands) -> argparse.ArgumentParser:
    text = "estimate T_camera_lidar and the time offset of one or several drives"
    calibrate = commands.add_parser(
        "calibrate",
        help=text,
        description=f"{text[0].upper()}{text[1:]}: p_camera = T_camera_lidar . p_lidar (camera: x right, "
        f"y down, z forward), {SIGN}. Several drives share one extrinsic.",
    )
    calibrate.add_argument(
        "data", metavar="DATA", type=Path, nargs="*", help="dataset or sequence folder, or a bag"
    )
    add_source_options(calibrate, several_cameras=True)
    add_label_options(calibrate)
    add_method(calibrate)
    calibrate.add_argument(
        "--time-offset-per-drive", action="store_true", default=None, help="one time offset for each drive"
    )
    _add_rig(calibrate)
    calibrate.add_argument(
        "--out",
        type=Path,
        default=Path("calibration"),
        metavar="DIR",
        help="folder to write (default %(default)s)",
    )
    calibrate.add_argument(
        "--video", type=Path, metavar="MP4|GIF", help="write the LiDAR in the pictures along the drives, too"
    )
    calibrate.add_argument(
        "--json", action="store_true", help="print the result as JSON (units in the names), not a summary"
    )
    calibrate.add_argument(
        "--overwrite", action="store_true", help="replace an earlier result in DIR, and the video"
    )
    return calibrate


def _add_rig(command: Parser) -> None:
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


def add_batch(commands: Commands) -> argparse.ArgumentParser:
    text = "calibrate many drives, each in a process of its own; fuse those of one vehicle; one summary"
    batch = commands.add_parser(
        "batch",
        help=text,
        description=f"{text[0].upper()}{text[1:]} (docs/how-to/batch.md). "
        "Drives that are done are not run again.",
    )
    batch.add_argument(
        "drives",
        metavar="DRIVES",
        help="folder of drives, pattern such as 'drives/*' (in quotes), or list: one path or URL a line, or "
        "a CSV with a column drive and any of name, vehicle, date",
    )
    batch.add_argument(
        "--out", required=True, metavar="DIR", help="folder to write or to go on with, or a URL"
    )
    batch.add_argument(
        "--workers", type=int, metavar="N", help="drives at a time on this machine (default: its processors)"
    )
    batch.add_argument(
        "--dask",
        default="",
        metavar="ADDRESS|local",
        help="run on a Dask cluster: its scheduler, such as tcp://host:8786, or local (extra dask)",
    )
    batch.add_argument(
        "--retries",
        type=int,
        default=2,
        metavar="N",
        help="further attempts after a crash (default %(default)s)",
    )
    batch.add_argument("--time-limit", type=float, metavar="S", help="longest time of a drive in seconds")
    batch.add_argument("--memory-limit", type=float, metavar="GB", help="largest memory of a drive")
    batch.add_argument(
        "--name-parts",
        type=int,
        default=1,
        metavar="N",
        help="how many of the last parts of its path make a drive's name (default %(default)s)",
    )
    vehicles = batch.add_argument_group("vehicles")
    vehicles.add_argument(
        "--vehicle-from",
        metavar="REGEX|CSV",
        help="vehicle and date of a drive: a regular expression on its path with the groups vehicle and "
        "date, or a CSV with columns drive, vehicle and date",
    )
    vehicles.add_argument(
        "--drift",
        metavar="DEG,CM,MS",
        help="random walk of a vehicle's calibration: standard deviation along each axis after one day "
        "(default 0.005,0.05,0.1)",
    )
    vehicles.add_argument(
        "--false-alarm-rate",
        type=float,
        metavar="P",
        help="probability that a change or a contradicting drive is named of a vehicle without any "
        "(default 0.001)",
    )
    own = len(batch._actions)
    add_source_options(batch)
    add_label_options(batch)
    add_method(batch)
    batch.set_defaults(passed_on=tuple(batch._actions[own:]), time_offset_per_drive=None)
    return batch


def add_track(commands: Commands) -> argparse.ArgumentParser:
    text = "calibrate frame by frame: one line of JSON a frame on stdout"
    track = commands.add_parser("track", help=text, description=text)
    track.add_argument("data", metavar="DATA", type=Path, help="dataset or sequence folder, or a bag")
    add_source_options(track)
    add_label_options(track)
    track.add_argument(
        "--init",
        metavar="dataset|none|FILE",
        help="start: the data's nominal calibration (default), no guess at all, or a file",
    )
    track.add_argument(
        "--method",
        choices=("auto", "joint", "edges", "both"),
        help="auto: edges where the drive has no labels, else joint (default); joint: outlines of labelled "
        "objects; edges: LiDAR edges and pictures, no labels needed; both: joint in frames with labels, "
        "edges in the others",
    )
    track.add_argument("--classes", metavar="vehicle|all|A,B", help="classes to align")
    add_estimate(track)
    add_settings(track)
    track.add_argument("--checkpoint", type=Path, metavar="FILE", help="save the tracker here as it goes")
    track.add_argument("--checkpoint-every", type=int, metavar="N", help="frames between saves (default 50)")
    track.add_argument(
        "--resume",
        action="store_true",
        help="go on from the checkpoint, if it is there, with the frames after it; the drive must be the one "
        "it was saved on, and options that are given those it was made with",
    )
    track.add_argument("--out", type=Path, metavar="FILE", help="write the last estimate as calibration.json")
    track.add_argument("--view", action="store_true", help="show the tracker in the viewer rerun as it runs")
    track.add_argument("--view-save", type=Path, metavar="RRD", help="write a file for that viewer")
    track.add_argument("--overwrite", action="store_true", help="replace the files that are written")
    return track

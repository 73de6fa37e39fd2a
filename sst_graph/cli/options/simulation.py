"""The commands on simulated streets: ``demo``, ``simulate``, ``experiment``."""

from __future__ import annotations

import argparse
from pathlib import Path

from sst_graph.cli.options.base_parser import SIGN, Commands
from sst_graph.cli.options.method import add_settings


def add_demo(commands: Commands) -> argparse.ArgumentParser:
    text = "simulate a street, calibrate it from disk, check against the truth, write report and overlays"
    demo = commands.add_parser("demo", help=text, description=text)
    demo.add_argument(
        "--out",
        type=Path,
        default=Path("out/demo"),
        metavar="DIR",
        help="folder to write (default %(default)s)",
    )
    demo.add_argument("--seed", type=int, default=1, help="seed of the street (default %(default)s)")
    demo.add_argument("--overwrite", action="store_true", help="replace an earlier demo in that folder")
    return demo


def add_simulate(commands: Commands) -> argparse.ArgumentParser:
    text = "write a simulated drive in the KITTI odometry + SemanticKITTI layout, with its truth"
    simulate = commands.add_parser("simulate", help=text, description=text)
    simulate.add_argument("out", metavar="OUT", type=Path, help="folder to write")
    simulate.add_argument("--seed", type=int, help="seed of the street and of all noise")
    simulate.add_argument("--frames", type=int, metavar="N", help="number of frames")
    simulate.add_argument(
        "--time-offset", type=float, metavar="S", help=f"true time offset in seconds, of either sign: {SIGN}"
    )
    motions = "mixed, standing, constant, stop_and_go, no_stop, turning, there_and_back"
    simulate.add_argument("--motion", metavar="NAME", help=motions)
    simulate.add_argument("--label-noise", type=float, metavar="LEVEL", help="0: exact, 1: usual, 2: poor")
    simulate.add_argument(
        "--rolling", action="store_true", default=None, help="measure each point at its own time"
    )
    simulate.add_argument(
        "--stereo", action="store_true", help="write image_3 and semantic_3 as well, 0.53 m to the right"
    )
    add_settings(simulate)
    simulate.add_argument("--overwrite", action="store_true", help="replace an earlier drive in OUT")
    return simulate


def add_experiment(commands: Commands) -> argparse.ArgumentParser:
    text = "make a table of accuracy, as Markdown: on simulated streets, or on real drives"
    experiment = commands.add_parser("experiment", help=text, description=text)
    experiment.add_argument(
        "name",
        metavar="NAME",
        help="accuracy, assumptions, basin, consistency, drives, fit, motion, peers, rigs, slam, windows, or "
        "a table of SST-Calib: table1, table2, table3, table4; any other name prints what each of them "
        "shows; drives and windows need --data",
    )
    experiment.add_argument(
        "--data",
        nargs="+",
        action="extend",
        metavar="DIR",
        help="real drives with a reference calibration, or a KITTI odometry root, of which table1 to table4 "
        "take sequence 00 (default: simulated streets)",
    )
    experiment.add_argument("--streets", type=int, metavar="N", help="number of streets")
    experiment.add_argument("--seed", type=int, help="seed of the first street")
    experiment.add_argument("--methods", metavar="A,B", help="methods to compare, such as paper,joint")
    experiment.add_argument(
        "--jobs", type=int, metavar="N", help="basin, peers, table1 to table4: processes (default: 1)"
    )
    add_settings(experiment)
    experiment.add_argument(
        "--out",
        type=Path,
        metavar="FILE",
        help="file to write (default: the terminal); table1 to table4 put a CSV, a plot and the runs beside "
        "it, and go on from those runs",
    )
    experiment.add_argument("--overwrite", action="store_true", help="replace the files")
    return experiment

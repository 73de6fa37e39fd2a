"""Memory, processor time and errors of `sst-graph calibrate` on drives of several lengths. Prints a table.

    OMP_NUM_THREADS=1 python benchmarks/calibrate_memory.py --frames 60 400
    OMP_NUM_THREADS=1 python benchmarks/calibrate_memory.py --frames 60 400 --method edges --half

A street of each seed is simulated and written to a temporary folder, with ``--half`` with pictures of half
KITTI's size. Each calibration runs in a process of its own, whose largest resident memory the kernel tells.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from sst_graph.experiments.markdown import lines
from sst_graph.metrics import calibration_errors
from sst_graph.result import read_result
from sst_graph.simulator import SimulationConfig, simulate, write_drive
from sst_graph.types import GroundTruth

HEAD = "| frames | peak memory [MB] | processor [s] | rotation [deg] | translation (ATD) [cm] | NEES of 7 |"
HALF = {"width": 621, "height": 188}


def calibrated(drive: Path, truth: GroundTruth, arguments: list[str], out: Path) -> tuple[float, ...]:
    """Peak memory [MB], user and system seconds, rotation [deg], ATD [cm] and NEES of a calibration."""
    process = subprocess.Popen(
        [sys.executable, "-m", "sst_graph", "calibrate", str(drive), "--out", str(out), *arguments],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode not in (0, 3):  # 3: finished, but not to be trusted
        raise SystemExit(f"calibrate ended with {process.returncode}")
    result = read_result(out)
    errors = calibration_errors(result.T_camera_lidar, result.time_offset_s, truth, result.covariance)
    seconds = usage.ru_utime + usage.ru_stime
    nees = np.nan if errors.nees is None else errors.nees.joint
    return usage.ru_maxrss / 1024.0, seconds, errors.qad_deg, 100.0 * errors.atd_m, nees


def rows(args: argparse.Namespace) -> Iterator[list[str]]:
    """A row for each length; cells: one figure for each seed."""
    streets = {
        seed: simulate(SimulationConfig(seed=seed, frames=max(args.frames), **(HALF if args.half else {})))
        for seed in args.seeds
    }
    with tempfile.TemporaryDirectory() as folder:
        for seed, street in streets.items():
            write_drive(street, Path(folder) / f"drive{seed}")
        for frames in args.frames:
            some = ["--frames", f"0:{frames}", "--method", args.method]
            found = [
                calibrated(
                    Path(folder) / f"drive{seed}", street.truth, some, Path(folder) / f"out{seed}_{frames}"
                )
                for seed, street in streets.items()
            ]
            columns = zip(*found, strict=True)
            cells = (
                "; ".join(f"{value:.{digits}f}" for value in column)
                for column, digits in zip(columns, (0, 0, 3, 2, 1), strict=True)
            )
            yield [f"{frames:,}", *cells]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frames", nargs="+", type=int, default=[60, 400])
    parser.add_argument("--method", default="auto")
    parser.add_argument("--seeds", nargs="+", type=int, default=[5, 6])
    parser.add_argument("--half", action="store_true", help="pictures of half the size")
    for line in lines(HEAD, rows(parser.parse_args())):
        print(line, flush=True)


if __name__ == "__main__":
    main()

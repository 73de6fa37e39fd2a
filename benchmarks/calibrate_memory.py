"""Largest memory of `sst-graph calibrate` on drives of several lengths. Prints one line a length.

    OMP_NUM_THREADS=1 python benchmarks/calibrate_memory.py --frames 60 400

A street is simulated with pictures of half KITTI's size and written to a temporary folder; DATA takes a drive
that is there. Each calibration runs in a process of its own, whose largest resident memory the kernel tells.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from sst_graph.simulator import SimulationConfig, simulate, write_drive


def peak_mb(drive: Path, frames: int, method: str, out: Path) -> float:
    """Largest resident memory [MB] of a calibration of the first frames."""
    arguments = ["calibrate", str(drive), "--frames", f"0:{frames}", "--method", method, "--out", str(out)]
    process = subprocess.Popen(
        [sys.executable, "-m", "sst_graph", *arguments],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode not in (0, 3):  # 3: finished, but not to be trusted
        raise SystemExit(f"calibrate ended with {process.returncode}")
    return usage.ru_maxrss / 1024.0


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", nargs="?", type=Path)
    parser.add_argument("--frames", nargs="+", type=int, default=[60, 400])
    parser.add_argument("--method", default="auto")
    parser.add_argument("--seed", type=int, default=5)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        drive = args.data
        if drive is None:
            drive = Path(folder) / "drive"
            config = SimulationConfig(seed=args.seed, frames=max(args.frames), width=621, height=188)
            write_drive(simulate(config), drive)
        first = None
        for frames in args.frames:
            peak = peak_mb(drive, frames, args.method, Path(folder) / f"out{frames}")
            first = peak if first is None else first
            print(f"{frames} frames: {peak:.0f} MB, {peak / first:.2f} times the first", flush=True)


if __name__ == "__main__":
    main()

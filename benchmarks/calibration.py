"""Processor time of a calibration, this code against another checkout of it, alternately.

    OMP_NUM_THREADS=1 python -m benchmarks.calibration --other ../other --pairs 5
    OMP_NUM_THREADS=1 python -m benchmarks.calibration --other ../other --drive DATA --image-shift 1

Each calibration is a process of its own, from the first import to the last file; its user seconds count, for
a busy machine must count as little as it can. Without ``--drive``, streets of 60 frames and of one at 1242 x
375 are simulated. Prints a table, with the median of the pairs' ratios, and says where the two print other
results.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sst_graph.experiments.markdown import lines
from sst_graph.simulator import SimulationConfig, simulate, write_drive

HERE = Path(__file__).resolve().parents[1]
FRAMES = 60, 1


@dataclass(frozen=True)
class Run:
    """User seconds of a calibration, and what it printed without the files that it wrote."""

    seconds: float
    printed: str


def calibrated(code: Path, arguments: list[str], out: Path) -> Run:
    """A calibration by a checkout of the code.

    Raises:
        SystemExit: it did not end with a result.
    """
    command = [sys.executable, "-m", "sst_graph", "calibrate", *arguments]
    environment = {**os.environ, "PYTHONPATH": str(code)}
    with (out / "printed").open("w+") as printed:
        process = subprocess.Popen(
            [*command, "--out", str(out / "result"), "--overwrite"],
            cwd=code,
            env=environment,
            stdout=printed,
            stderr=subprocess.DEVNULL,
        )
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode not in (0, 3):
            raise SystemExit(f"{code}: calibrate ended with exit code {process.returncode}, expected 0 or 3")
        printed.seek(0)
        lines = [line for line in printed if not line.startswith("wrote")]
    return Run(usage.ru_utime, "".join(lines))


def compared(name: str, arguments: list[str], other: Path, pairs: int, out: Path) -> list[str]:
    """A row of the table, from so many pairs of runs."""
    found = [[calibrated(code, arguments, out) for code in (other, HERE)] for _ in range(pairs)]
    seconds = np.array([[run.seconds for run in pair] for pair in found])
    ratios = seconds[:, 0] / seconds[:, 1]
    alike = len({run.printed for pair in found for run in pair}) == 1
    cells = [name, f"{np.median(seconds[:, 0]):.1f}", f"{np.median(seconds[:, 1]):.1f}"]
    cells += [f"{np.median(ratios):.2f}", f"{ratios.min():.2f} to {ratios.max():.2f}"]
    return [*cells, "yes" if alike else "no"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--other", type=Path, required=True, help="checkout that this one is compared with")
    parser.add_argument("--pairs", type=int, default=5)
    parser.add_argument("--drive", help="a drive on disk instead of simulated streets")
    parser.add_argument("--image-shift", type=int, default=0)
    args = parser.parse_args()
    head = f"| calibration, {args.pairs} pairs | other [s] | this [s] | ratio | of the pairs | same output |"
    for line in lines(head, rows(args)):
        print(line, flush=True)


def rows(args: argparse.Namespace) -> Iterator[list[str]]:
    """A row for the drive, or for each street."""
    other = args.other.resolve()
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        if args.drive is not None:
            data = str(Path(args.drive).resolve())
            some = [data, "--image-shift", str(args.image_shift)]
            yield compared(Path(data).name, some, other, args.pairs, place)
            return
        for frames in FRAMES:
            street = place / f"street_{frames}"
            write_drive(simulate(SimulationConfig(seed=3, frames=frames)), street)
            name = f"street, {frames} frame{'s' * (frames > 1)}"
            yield compared(name, [str(street)], other, args.pairs, place)


if __name__ == "__main__":
    main()

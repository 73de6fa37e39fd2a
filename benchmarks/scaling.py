"""Cost of the batch solve against number of frames, labelled points, image size and cameras.

    OMP_NUM_THREADS=1 python -m benchmarks.scaling --out out/scaling
    OMP_NUM_THREADS=1 python -m benchmarks.scaling --only frames --frames 25 50 100 200 400 --out out/scaling

Simulated streets are written to a temporary folder, and each calibration is a process of its own, whose
processor seconds and largest resident memory count. ``prepare`` reads the frames and keeps their features,
``solve`` is everything after it. OUT gets scaling.md, a table for each question with log-log slopes (of all
sizes, by least squares, and between the last two), and scaling.svg (extra ``plot``). Work that does not grow
flattens the slope of small sizes; the last two say more about larger ones. A rig has the same camera several
times: for the cost that makes no difference.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sst_graph import CalibrationConfig, open_source
from sst_graph.batch.calibrate import calibrate_prepared, prepare_drives
from sst_graph.rig.calibrate import Guess, KnownRig, calibrate_rig_prepared, prepare_rig
from sst_graph.simulator import SimulationConfig, simulate, write_drive
from sst_graph.types import SemanticClass

COSTS = "prepare [s]", "solve [s]", "peak memory [MB]"
STREET = SimulationConfig(seed=5, frames=20, width=621, height=188, azimuth_limit_deg=60.0)
FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Series:
    """One question.

    Attributes:
        unknown: what is varied.
        sizes: (k,) of it.
        costs: (k, 3) as :data:`COSTS`.
    """

    unknown: str
    sizes: FloatArray
    costs: FloatArray

    def slopes(self) -> tuple[FloatArray, FloatArray]:
        """(3,) of all sizes, and (3,) between the last two."""
        x, y = np.log(self.sizes), np.log(self.costs)
        return np.polyfit(x, y, 1)[0], (y[-1] - y[-2]) / (x[-1] - x[-2])

    def table(self) -> str:
        lines = [f"| {self.unknown} | {' | '.join(COSTS)} |", "|---|---|---|---|"]
        for size, (prepare, solve, memory) in zip(self.sizes, self.costs, strict=True):
            lines.append(f"| {size:,.0f} | {prepare:.2f} | {solve:.2f} | {memory:.0f} |")
        for name, slopes in zip(("slope", "slope of the last two"), self.slopes(), strict=True):
            lines.append(f"| {name} | {' | '.join(f'{slope:.2f}' for slope in slopes)} |")
        return "\n".join(lines)


def peak_mb() -> float:
    """Largest resident memory of this process; ``ru_maxrss`` has that of the process that started it too."""
    line = next(line for line in Path("/proc/self/status").read_text().splitlines() if "VmHWM" in line)
    return float(line.split()[1]) / 1024.0


def calibrated(drive: Path, frames: int, cameras: int) -> dict[str, Any]:
    """In the process that is measured: seconds of both parts, memory, labelled points of a scan."""
    cv2.setNumThreads(1)
    source, config = open_source(drive)[:frames], CalibrationConfig()
    assert source.nominal is not None
    began = time.process_time()
    if cameras == 1:
        drives = prepare_drives([source], config)
        prepared = time.process_time()
        status = calibrate_prepared(drives, source.nominal, config).status
    else:
        names = [f"cam{k}" for k in range(cameras)]
        of_rig = prepare_rig({name: [source] for name in names}, config)
        prepared = time.process_time()
        guesses = {name: Guess(source.nominal, 0.0) for name in names}
        status = calibrate_rig_prepared(of_rig, guesses, config, KnownRig()).status
    ended = time.process_time()
    peak, scan = peak_mb(), source[0].scan
    assert scan is not None
    labelled = int((scan.classes == SemanticClass.VEHICLE).sum())
    seconds = {"prepare": prepared - began, "solve": ended - prepared}
    return {**seconds, "peak_mb": peak, "labelled": labelled, "status": status}


def measured(drive: Path, frames: int, cameras: int = 1) -> tuple[list[float], float]:
    """The costs of a process of its own, and labelled points of a scan."""
    command = [sys.executable, "-m", "benchmarks.scaling", "--one", str(drive), str(frames), str(cameras)]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True)
    if done.returncode:
        raise SystemExit(f"a calibration ended with {done.returncode}")
    found = json.loads(done.stdout.splitlines()[-1])
    print(f"{drive.name}, {frames} frames, {cameras} cameras: {found}", file=sys.stderr, flush=True)
    return [found["prepare"], found["solve"], found["peak_mb"]], found["labelled"]


def written(folder: Path, name: str, config: SimulationConfig) -> Path:
    write_drive(simulate(config), folder / name)
    return folder / name


def by_frames(folder: Path, sizes: Sequence[float]) -> Series:
    drive = written(folder, "frames", replace(STREET, frames=int(max(sizes))))
    costs = [measured(drive, int(size))[0] for size in sizes]
    return Series("frames", np.array(sizes), np.array(costs))


def by_points(folder: Path, steps_deg: Sequence[float]) -> Series:
    costs, labelled = [], []
    for step in sorted(steps_deg, reverse=True):
        dense = replace(STREET, azimuth_step_deg=step, vehicle_density=0.3)
        cost, points = measured(written(folder, f"step{step:g}", dense), STREET.frames)
        costs.append(cost)
        labelled.append(points)
    return Series("labelled points a scan, 20 frames", np.array(labelled), np.array(costs))


def by_image(folder: Path, scales: Sequence[float]) -> Series:
    costs, pixels = [], []
    for scale in scales:
        width, height = round(1242 * scale), round(375 * scale)
        config = replace(STREET, width=width, height=height)
        costs.append(measured(written(folder, f"{width}x{height}", config), STREET.frames)[0])
        pixels.append(width * height)
    return Series("pixels of an image, 20 frames", np.array(pixels), np.array(costs))


def by_cameras(folder: Path, sizes: Sequence[float]) -> Series:
    drive = written(folder, "cameras", STREET)
    costs = [measured(drive, STREET.frames, int(size))[0] for size in sizes]
    return Series("cameras, 20 frames", np.array(sizes), np.array(costs))


SERIES = {"frames": by_frames, "points": by_points, "image": by_image, "cameras": by_cameras}


def draw(series: Sequence[Series], path: Path) -> None:
    """A panel a question, both axes logarithmic."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(3.2 * len(series), 3.2), layout="constrained")
    for axes, each in zip(figure.subplots(1, len(series), squeeze=False)[0], series, strict=True):
        for name, cost in zip(COSTS[:2], each.costs.T, strict=False):
            axes.loglog(each.sizes, cost, "o-", label=name)
        axes.set_xlabel(each.unknown)
        axes.grid(True, which="both", alpha=0.3)
        axes.legend()
    figure.savefig(path)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("out/scaling"))
    parser.add_argument("--only", nargs="+", choices=tuple(SERIES), default=list(SERIES))
    parser.add_argument("--frames", nargs="+", type=int, default=[15, 30, 60, 120, 240])
    parser.add_argument("--points", nargs="+", type=float, default=[3.0, 0.8, 0.2, 0.05], metavar="STEP_DEG")
    parser.add_argument("--image", nargs="+", type=float, default=[0.25, 0.5, 1.0, 2.0], metavar="SCALE")
    parser.add_argument("--cameras", nargs="+", type=int, default=[1, 2, 4, 6])
    parser.add_argument("--one", nargs=3, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.one:
        print(json.dumps(calibrated(Path(args.one[0]), int(args.one[1]), int(args.one[2]))))
        return
    sizes = {name: sorted(getattr(args, name), reverse=name == "points") for name in args.only}
    for name, each in sizes.items():
        if len(each) < 2:
            parser.error(f"--{name}: found {len(each)} sizes, expected 2 or more")
    args.out.mkdir(parents=True, exist_ok=True)
    series: list[Series] = []
    for name in args.only:
        with tempfile.TemporaryDirectory() as folder:
            series.append(SERIES[name](Path(folder), sizes[name]))
        print(series[-1].table() + "\n", flush=True)
        (args.out / "scaling.md").write_text("\n\n".join(each.table() for each in series) + "\n")
    draw(series, args.out / "scaling.svg")


if __name__ == "__main__":
    main()

"""Cost of the batch solve against number of frames, labelled points, image size and cameras.

    OMP_NUM_THREADS=1 python -m benchmarks.scaling --out out/scaling
    OMP_NUM_THREADS=1 python -m benchmarks.scaling --only frames --frames 25 50 100 200 400 --out out/scaling

Simulated streets are written to a temporary folder, and each calibration is a process of its own, whose
processor seconds and largest resident memory count. ``prepare`` reads the frames and keeps their features;
``12 iterations`` is the same work at every size: as many outer iterations (match, build, solve) from the true
extrinsic. ``--whole`` adds ``whole estimate``, what ``calibrate`` does after prepare from the nominal
extrinsic, without the search for causes: how many searches and tests it makes depends on what it finds, and
its status stands beside it. OUT gets scaling.md, a table for each question with log-log slopes (of all sizes,
by least squares, and between the last two), and scaling.svg. Work that does not grow makes
the slope of small sizes flatter; the last two say more about larger ones.

Frames are those of a street of 41, played forth and back under rising stamps (a drive reversed in time is a
drive), so that one is like another. Points are varied by the angle between two firings, on a street full of
trucks. A rig has the same camera several times: for the cost that makes no difference.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph import CalibrationConfig, open_source
from sst_graph.batch.calibrate import calibrate_prepared, prepare_drives
from sst_graph.batch.problem import CalibrationProblem
from sst_graph.drive.preparation import Drive
from sst_graph.experiments.markdown import table
from sst_graph.factors.camera import PinholeCamera
from sst_graph.graph.outer_loop import solve_joint
from sst_graph.graph.state import State
from sst_graph.rig.calibrate import calibrate_rig_prepared, prepare_rig
from sst_graph.rig.known import KnownRig
from sst_graph.simulator import SimulationConfig, simulate, write_drive
from sst_graph.types import CameraImage, Frame, GroundTruth, Guess, Scan, SemanticClass

COSTS, WHOLE = ("prepare [s]", "12 iterations [s]", "peak memory [MB]"), "whole estimate [s]"
ITERATIONS, FRAMES, STREET_FRAMES, PERIOD_NS = 12, 6, 41, 100_000_000
STREET = SimulationConfig(
    seed=5, frames=FRAMES, width=621, height=188, azimuth_limit_deg=60.0, time_offset_s=0.0
)
FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Series:
    """One question.

    Attributes:
        unknown: what is varied.
        sizes: (k,) of it.
        costs: (k, 3) as :data:`COSTS`, or (k, 4) with that of :data:`WHOLE`.
        statuses: k of the whole estimates, empty without.
    """

    unknown: str
    sizes: FloatArray
    costs: FloatArray
    statuses: list[str]

    @classmethod
    def of(cls, unknown: str, sizes: Sequence[float], found: Sequence[dict[str, Any]]) -> Series:
        names = ["prepare", "solve", "peak_mb", *(["estimate"] if found[0]["status"] else [])]
        costs = np.array([[one[name] for name in names] for one in found])
        return cls(unknown, np.array(sizes, float), costs, [one["status"] for one in found])

    def slopes(self) -> tuple[FloatArray, FloatArray]:
        """(3 or 4,) of all sizes, and between the last two."""
        x, y = np.log(self.sizes), np.log(self.costs)
        return np.array([np.polyfit(x, cost, 1)[0] for cost in y.T]), (y[-1] - y[-2]) / (x[-1] - x[-2])

    def table(self) -> str:
        whole = any(self.statuses)
        heads = [*COSTS, *([WHOLE, "status"] if whole else [])]
        rows = []
        for size, cost, status in zip(self.sizes, self.costs, self.statuses, strict=True):
            cells = [f"{one:.0f}" if one > 100.0 else f"{one:.2f}" for one in cost]
            rows.append([f"{size:,.0f}", *cells, *([status] if whole else [])])
        for name, slopes in zip(("slope", "slope of the last two"), self.slopes(), strict=True):
            cells = [f"{slope:.2f}" for slope in slopes]
            rows.append([name, *cells, *([""] if whole else [])])
        return table(f"| {self.unknown} | {' | '.join(heads)} |", rows)


def peak_mb() -> float:
    """Largest resident memory of this process; ``ru_maxrss`` has that of the process that started it too."""
    line = next(line for line in Path("/proc/self/status").read_text().splitlines() if "VmHWM" in line)
    return float(line.split()[1]) / 1024.0


@dataclass(frozen=True)
class ForthAndBack:
    """So many frames of a drive, played forth and back under rising stamps (a ``Source``)."""

    source: Any
    count: int

    @property
    def name(self) -> str:
        return str(self.source.name)

    @property
    def camera(self) -> PinholeCamera:
        camera: PinholeCamera = self.source.camera
        return camera

    @property
    def nominal(self) -> gtsam.Pose3 | None:
        nominal: gtsam.Pose3 | None = self.source.nominal
        return nominal

    @property
    def truth(self) -> GroundTruth | None:
        truth: GroundTruth | None = self.source.truth
        return truth

    @property
    def sweep(self) -> str:
        return str(self.source.sweep)

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, position: int) -> Frame:
        if not 0 <= position < self.count:
            raise IndexError(position)
        return Frame(position, self.read_scan(position), self.read_image(position))

    def __iter__(self) -> Iterator[Frame]:
        return (self[position] for position in range(self.count))

    def frame_number(self, position: int) -> int:
        return position

    def read_scan(self, position: int) -> Scan:
        scan: Scan = self.source.read_scan(self._played(position))
        return replace(scan, stamp_ns=position * PERIOD_NS)

    def read_image(self, position: int) -> CameraImage:
        image: CameraImage = self.source.read_image(self._played(position))
        return replace(image, stamp_ns=position * PERIOD_NS)

    def _played(self, position: int) -> int:
        last = len(self.source) - 1
        phase = position % (2 * last)
        return phase if phase <= last else 2 * last - phase


def calibrated(drive: Path, frames: int, cameras: int, whole: bool) -> dict[str, Any]:
    """In the process that is measured: seconds of all parts, memory, labelled points of a scan."""
    cv2.setNumThreads(1)
    source = ForthAndBack(open_source(drive), frames)
    config = CalibrationConfig(method="joint", find_causes=False, decide_sweep=False)
    assert source.nominal is not None and source.truth is not None
    began = time.process_time()
    names = [f"cam{k}" for k in range(cameras)]
    drives = (
        {"cam0": prepare_drives([source], config)}
        if cameras == 1
        else prepare_rig({name: [source] for name in names}, config)
    )
    prepared = time.process_time()
    for own in drives.values():
        solve_twelve(own, source.truth, config)
    solved, status = time.process_time(), ""
    if whole and cameras == 1:
        status = calibrate_prepared(drives["cam0"], source.nominal, config).status
    elif whole:
        guesses = dict.fromkeys(names, Guess(source.nominal, 0.0))
        status = calibrate_rig_prepared(drives, guesses, config, KnownRig()).status
    ended, peak, scan = time.process_time(), peak_mb(), source[0].scan
    assert scan is not None
    labelled = int((scan.classes == SemanticClass.VEHICLE).sum())
    seconds = {"prepare": prepared - began, "solve": solved - prepared, "estimate": ended - solved}
    return {**seconds, "peak_mb": peak, "labelled": labelled, "status": status}


def solve_twelve(drives: Sequence[Drive], truth: GroundTruth, config: CalibrationConfig) -> None:
    """Outer iterations from the truth, the same number whatever they find."""
    time_offset_s = truth.time_offset_s
    assert time_offset_s is not None
    problem = CalibrationProblem.of(drives, Guess(truth.cTl, time_offset_s), config)
    joint = replace(problem.joint(), config=replace(problem.config.joint, max_outer=ITERATIONS))
    found = solve_joint(joint, State(truth.cTl, (time_offset_s,)), step_sigmas=0.0)
    assert found.outer_iterations == ITERATIONS


def measured(drive: Path, frames: int, whole: bool, cameras: int = 1) -> dict[str, Any]:
    """What a process of its own took."""
    command = [sys.executable, "-m", "benchmarks.scaling", "--one", str(drive), str(frames), str(cameras)]
    command += ["--whole"] if whole else []
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True)
    if done.returncode:
        raise SystemExit(f"a calibration ended with {done.returncode}")
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    print(f"{drive.name}, {frames} frames, {cameras} cameras: {found}", file=sys.stderr, flush=True)
    return found


def written(folder: Path, name: str, config: SimulationConfig) -> Path:
    write_drive(simulate(config), folder / name)
    return folder / name


def by_frames(folder: Path, sizes: Sequence[float], whole: bool) -> Series:
    drive = written(folder, "frames", replace(STREET, frames=STREET_FRAMES))
    return Series.of("frames", sizes, [measured(drive, int(size), whole) for size in sizes])


def by_points(folder: Path, steps_deg: Sequence[float], whole: bool) -> Series:
    found = []
    for step in sorted(steps_deg, reverse=True):
        dense = replace(STREET, azimuth_step_deg=step, vehicle_density=0.4, truck_fraction=0.6)
        found.append(measured(written(folder, f"step{step:g}", dense), FRAMES, whole))
    labelled = [one["labelled"] for one in found]
    return Series.of(f"labelled points a scan, {FRAMES} frames", labelled, found)


def by_image(folder: Path, scales: Sequence[float], whole: bool) -> Series:
    found, pixels = [], []
    for scale in scales:
        width, height = round(1242 * scale), round(375 * scale)
        config = replace(STREET, width=width, height=height)
        found.append(measured(written(folder, f"{width}x{height}", config), FRAMES, whole))
        pixels.append(width * height)
    return Series.of(f"pixels of an image, {FRAMES} frames", pixels, found)


def by_cameras(folder: Path, sizes: Sequence[float], whole: bool) -> Series:
    drive = written(folder, "cameras", STREET)
    found = [measured(drive, FRAMES, whole, int(size)) for size in sizes]
    return Series.of(f"cameras, {FRAMES} frames", sizes, found)


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
    parser.add_argument("--frames", nargs="+", type=int, default=[1, 10, 40, 160, 400])
    parser.add_argument(
        "--points", nargs="+", type=float, default=[4.0, 1.0, 0.25, 0.06, 0.02], metavar="STEP_DEG"
    )
    parser.add_argument("--image", nargs="+", type=float, default=[0.25, 0.5, 1.0, 2.0], metavar="SCALE")
    parser.add_argument("--cameras", nargs="+", type=int, default=[1, 2, 4, 6])
    parser.add_argument("--whole", action="store_true", help="the whole estimate, too")
    parser.add_argument("--one", nargs=3, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.one:
        print(json.dumps(calibrated(Path(args.one[0]), int(args.one[1]), int(args.one[2]), args.whole)))
        return
    sizes = {name: sorted(getattr(args, name), reverse=name == "points") for name in args.only}
    for name, each in sizes.items():
        if len(each) < 2:
            parser.error(f"--{name}: found {len(each)} sizes, expected 2 or more")
    args.out.mkdir(parents=True, exist_ok=True)
    series: list[Series] = []
    for name in args.only:
        with tempfile.TemporaryDirectory() as folder:
            series.append(SERIES[name](Path(folder), sizes[name], args.whole))
        print(series[-1].table(), flush=True)
        (args.out / "scaling.md").write_text("\n".join(each.table() for each in series))
    draw(series, args.out / "scaling.svg")


if __name__ == "__main__":
    main()

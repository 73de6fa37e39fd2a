"""Steps of mount and clock in mid-drive: which sizes are found, and what is found on clean drives: tables.

    OMP_NUM_THREADS=1 python studies/contradictions.py --streets 6
    OMP_NUM_THREADS=1 python studies/contradictions.py --streets 50 --clean

Small simulated streets of 30 frames at half the usual size. The joint solution starts at the truth, without a
global search, and the stamps' rhythm is not looked at: what is found is found by the drive's stretches alone.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import gtsam
import numpy as np

from sst_graph import CalibrationConfig
from sst_graph.batch.calibrate import prepare_drives
from sst_graph.batch.contradictions import Contradictions, find_contradictions
from sst_graph.batch.part_solver import PartSolver
from sst_graph.batch.problem import CalibrationProblem
from sst_graph.data.kept_drive import KeptDrive
from sst_graph.errors import EstimationError
from sst_graph.experiments.markdown import table
from sst_graph.graph.outer_loop import NARROW_KERNELS_PX, solve_joint
from sst_graph.graph.state import State
from sst_graph.simulator import SimulationConfig, simulate
from sst_graph.types import Frame, Guess, Source

FRAMES = 30
MOTIONS = ("mixed", "stop_and_go", "no_stop", "turning", "standing", "mixed", "constant", "stop_and_go")
SPEEDS_MPS = (8.5, 6.0, 6.0, 5.0, 5.0, 3.0, 8.0, 4.0)
DENSITIES = (0.25, 0.13, 0.2, 0.3)
MOVING = (0.1, 0.2, 0.0, 0.3)
OFFSETS_S = (0.05, 0.0, 0.1, -0.07)
KNOCKS_DEG = (0.1, 0.2, 0.3, 0.5, 1.0, 2.0, 3.0)
CLOCKS_MS = (10.0, 20.0, 50.0, 100.0, 200.0)


def street(seed: int) -> SimulationConfig:
    """The street of a seed."""
    kind = seed % 8
    return SimulationConfig(
        seed=seed,
        frames=FRAMES,
        width=621,
        height=188,
        azimuth_limit_deg=50.0,
        azimuth_step_deg=0.3,
        motion=MOTIONS[kind],
        speed_mps=SPEEDS_MPS[kind],
        vehicle_density=DENSITIES[(seed // 8) % 4],
        moving_fraction=MOVING[(seed // 2) % 4],
        time_offset_s=OFFSETS_S[(seed // 3) % 4],
    )


def knocked(frames: Sequence[Frame], first: int, axis: np.ndarray, degrees: float) -> list[Frame]:
    """From a frame on the LiDAR is turned about an axis of its own."""
    R = gtsam.Rot3.Expmap(np.radians(degrees) * axis / np.linalg.norm(axis)).matrix()
    found = []
    for frame in frames:
        if frame.index >= first and frame.scan is not None:
            points = (frame.scan.points.astype(np.float64) @ R.T).astype(np.float32)
            frame = replace(frame, scan=replace(frame.scan, points=points))
        found.append(frame)
    return found


def clock_set(frames: Sequence[Frame], first: int, milliseconds: float) -> list[Frame]:
    """From a frame on images are stamped later."""
    found = []
    for frame in frames:
        if frame.index >= first and frame.image is not None:
            stamp = frame.image.stamp_ns + round(1e6 * milliseconds)
            frame = replace(frame, image=replace(frame.image, stamp_ns=stamp))
        found.append(frame)
    return found


def contradictions_of(source: Source, start: State) -> Contradictions:
    """What the default settings find in a drive, its joint solution sought from ``start``."""
    config = CalibrationConfig()
    noise = replace(config.noise, lower_edges=tuple(config.classes))
    drives = prepare_drives([source], config)
    problem = CalibrationProblem.of(drives, Guess(*start.calibration()), replace(config, noise=noise))
    solution = solve_joint(problem.joint(), start, NARROW_KERNELS_PX)
    return find_contradictions(PartSolver(problem, solution.state))


def found_in(seed: int, edits: Sequence[Callable[[list[Frame]], list[Frame]]]) -> list[Contradictions | None]:
    """What is found in a street's frames after each edit; None where no joint solution exists."""
    drive = simulate(street(seed))
    kept = KeptDrive.of(drive, sweep="auto")
    start = State(drive.truth.cTl, (drive.truth.time_offset_s or 0.0,))
    found: list[Contradictions | None] = []
    for edit in edits:
        try:
            found.append(contradictions_of(replace(kept, frames=edit(list(kept.frames))), start))
        except EstimationError:
            found.append(None)
    return found


def place_of(seed: int) -> tuple[int, np.ndarray]:
    """First frame after the step, in the middle half of the drive, and the axis of a knock."""
    rng = np.random.default_rng([seed, 7])
    return int(rng.integers(FRAMES // 4, 3 * FRAMES // 4 + 1)), rng.normal(size=3)


Steps = Mapping[int, Sequence[bool]]
"""By seed: whether each step was found."""


def knocks_table(found: Steps) -> str:
    """On how many streets a knock of each size is found."""
    sizes = " | ".join(f"{degrees:g}°" for degrees in KNOCKS_DEG)
    counts = [f"{sum(hits)} of {len(found)}" for hits in zip(*found.values(), strict=True)]
    return table(f"| knock | {sizes} |", [["found", *counts]])


def clocks_table(found: Steps) -> str:
    """Which steps of the clock are found on each street."""
    sizes = " | ".join(f"{ms:g} ms" for ms in CLOCKS_MS)
    rows = [
        [f"seed {seed} ({street(seed).motion})", *("yes" if hit else "no" for hit in hits)]
        for seed, hits in found.items()
    ]
    return table(f"| clock step | {sizes} |", rows)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--streets", type=int, default=6)
    parser.add_argument("--seed", type=int, default=100)
    parser.add_argument("--clean", action="store_true", help="unchanged drives only: false alarms")
    args = parser.parse_args()
    seeds = range(args.seed, args.seed + args.streets)
    if args.clean:
        alarms = 0
        for seed in seeds:
            found = found_in(seed, [list])[0]
            sentences = () if found is None else found.sentences
            alarms += bool(sentences)
            said = " ".join(sentences) or "nothing"
            print(f"seed {seed}, {street(seed).motion}: {said}", file=sys.stderr, flush=True)
        print(table("| clean drives | with an alarm |", [[str(len(seeds)), str(alarms)]]))
        return
    sizes = [("knock", f"{degrees:g} deg") for degrees in KNOCKS_DEG]
    sizes += [("clock", f"{ms:g} ms") for ms in CLOCKS_MS]
    hits: dict[int, list[bool]] = {}
    for seed in seeds:
        first, axis = place_of(seed)
        edits = [lambda f, d=d, k=first, a=axis: knocked(f, k, a, d) for d in KNOCKS_DEG]
        edits += [lambda f, ms=ms, k=first: clock_set(f, k, ms) for ms in CLOCKS_MS]
        for number, found in enumerate(found_in(seed, edits)):
            hits.setdefault(seed, []).append(found is not None and bool(found.diagnostics["within"]))
            print(
                f"seed {seed}, {street(seed).motion}, {' '.join(sizes[number])} at {first}: "
                f"{' '.join(found.sentences) if found else 'no solution'}",
                file=sys.stderr,
                flush=True,
            )
    knocks = len(KNOCKS_DEG)
    print(knocks_table({seed: some[:knocks] for seed, some in hits.items()}))
    print(clocks_table({seed: some[knocks:] for seed, some in hits.items()}))


if __name__ == "__main__":
    main()

"""Sweeps decided from the scans, on simulated streets. Prints tables.

    OMP_NUM_THREADS=1 python studies/sweep.py decide --streets 30      what the scans tell
    OMP_NUM_THREADS=1 python studies/sweep.py decide --seeds 515 527   the same of chosen streets
    OMP_NUM_THREADS=1 python studies/sweep.py drives STOP PARKED       what those of drives on disk tell
    OMP_NUM_THREADS=1 python studies/sweep.py calibrate --streets 6    what it costs the calibration

Every street has a rate of 5 to 20 Hz, a speed of 1 to 20 m/s, a sense of rotation, a start of the turn and a
profile of the motion of its own, drawn from its seed. "compensated": measured point after point like a raw
one, then moved to the stamp by the true motion.
"""

from __future__ import annotations

import argparse
import functools
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np

from sst_graph import CalibrationConfig, calibrate, open_source
from sst_graph.data.kept_drive import KeptDrive
from sst_graph.experiments.markdown import lines, table
from sst_graph.metrics import nees
from sst_graph.odometry.sweep import FRACTIONS, SweepDecision, decide_sweep
from sst_graph.simulator import SimulationConfig, simulate
from sst_graph.types import Calibration, Scan, SemanticClass


def street(seed: int, output: str, frames: int) -> SimulationConfig:
    """A street with a raw or compensated sweep of its own."""
    rng = np.random.default_rng([seed, 20])
    speed = float(np.exp(rng.uniform(np.log(1.0), np.log(20.0))))
    options: dict[str, Any] = {
        "frame_rate_hz": float(rng.choice([5.0, 10.0, 20.0])),
        "speed_mps": speed,
        "motion": str(
            rng.choice(["constant", "no_stop", "turning"] if speed < 9.0 else ["constant", "no_stop"])
        ),
        "sweep_sense": str(rng.choice(["clockwise", "counterclockwise"])),
        "sweep_start_deg": float(rng.uniform(-180.0, 180.0)),
        "sweep_stamp": str(rng.choice(["forward", "start", "end"])),
        "azimuth_limit_deg": float(rng.choice([50.0, 60.0, 180.0])),
    }
    return SimulationConfig(
        seed=seed, frames=frames, rolling=True, sweep_output=output, azimuth_step_deg=0.35, **options
    )


def decided(config: SimulationConfig) -> SweepDecision:
    """What the scans of a street tell; each is made once."""
    drive = simulate(config)
    return decide_sweep(functools.cache(drive.scan), len(drive))


def decide(args: argparse.Namespace) -> None:
    """Of every street, raw and compensated: right, undecided or wrong, by view and metres in a turn."""
    counts: Counts = {}
    for seed in args.seeds or range(args.seed, args.seed + args.streets):
        for output in args.outputs.split(","):
            config = street(seed, output, args.frames)
            truth = "compensated" if output == "compensated" else config.sweep_sense
            began = time.perf_counter()
            found = decided(config)
            seconds = time.perf_counter() - began
            kind = 0 if found.kind == truth else 2 if found.kind in FRACTIONS else 1
            turn_m = config.speed_mps / config.frame_rate_hz
            band = next(name for low, name in _BANDS_M.items() if turn_m >= low)
            view = "full" if config.azimuth_limit_deg == 180.0 else f"±{config.azimuth_limit_deg:.0f}°"
            cells = counts.setdefault((view, band), {name: [0, 0, 0] for name in args.outputs.split(",")})
            cells[output][kind] += 1
            how = f"{config.speed_mps:.1f} m/s, {config.frame_rate_hz:.0f} Hz, {config.motion}, "
            worse = ", ".join(f"{name} {sigmas:.1f}" for name, sigmas in found.worse_by.items())
            how += f"{view}, start {config.sweep_start_deg:.0f} deg"
            said = f"{seed}, {truth}, {how}: {found.sentence} ({worse}; {seconds:.0f} s)"
            print(said, file=sys.stderr, flush=True)
    print(decisions_table(counts))


Counts = dict[tuple[str, str], dict[str, list[int]]]
"""Streets right, undecided and wrong, by view and metres in a turn, and by clouds."""
_BANDS_M = {0.3: "0.3 m or more", 0.15: "0.15 to 0.3 m", 0.0: "below 0.15 m"}
"""By the least metres in a turn."""


def without_labels(scan: Scan | None) -> Scan | None:
    """A scan of which no point's class is known."""
    if scan is None:
        return None
    return replace(scan, classes=np.full_like(scan.classes, SemanticClass.IGNORE), instances=None)


def decisions_table(counts: Counts) -> str:
    """A row for each view and metres in a turn; cells: right, undecided, wrong."""
    outputs = list(next(iter(counts.values())))
    bands = list(_BANDS_M.values())
    order = sorted(counts, key=lambda key: (key[0] != "full", key[0] == "±50°", bands.index(key[1])))
    rows = [[*key, *(", ".join(map(str, counts[key][name])) for name in outputs)] for key in order]
    return table(f"| view | driven in a turn | {' | '.join(outputs)} |", rows)


def drives(args: argparse.Namespace) -> None:
    """What the scans of drives on disk tell, with their labels and without."""
    head = "| drive | speed | decision | f | compensated | clockwise | counter-clockwise |"
    for line in lines(head, drive_rows(args.data)):
        print(line, flush=True)


def drive_rows(data: Sequence[str]) -> Iterator[list[str]]:
    """Speed [m/s], decision, share of the turn, and by how many sigmas each hypothesis is worse."""
    for path in data:
        drive = KeptDrive.of(open_source(path))
        scans = [None if frame.scan is None else replace(frame.scan, offsets_s=None) for frame in drive]
        for name, some in ((drive.name, scans), ("without labels", list(map(without_labels, scans)))):
            found = decide_sweep(some.__getitem__, len(some))
            worse = [f"{found.worse_by[kind]:.1f}" for kind in FRACTIONS]
            share = f"{found.fraction:.2f} ± {found.sigma:.2f}"
            yield [name, f"{found.speed_mps:.1f} m/s", found.kind, share, *worse]


def errors(config: SimulationConfig, timed: bool) -> tuple[list[float], str, str]:
    """[rotation deg, translation cm, offset ms, NEES of 7], status and decision of a calibration."""
    drive = simulate(config)
    truth = drive.truth
    away = np.random.default_rng([config.seed, 99]).uniform(-1.0, 1.0, 6) * np.repeat([0.08, 0.05], 3)
    result = calibrate(drive, truth.cTl.retract(away), CalibrationConfig())
    assert truth.time_offset_s is not None
    error = Calibration(truth.cTl, truth.time_offset_s).local_coordinates(result.calibration)
    figures = [
        float(np.degrees(np.linalg.norm(error[:3]))),
        float(100.0 * np.linalg.norm(error[3:6])),
        float(1e3 * abs(error[6])),
        nees(error, result.covariance),
    ]
    decision = result.diagnostics["sweep"][drive.name]["sentence"]
    return figures, result.status, "times given" if timed else decision


def calibrations(args: argparse.Namespace) -> None:
    """The same streets with times for every point, without, and compensated."""
    tables: dict[str, list[list[float]]] = {}
    head = "| street | data | rotation deg | translation cm | offset ms | NEES of 7 | status | sweep |"
    for line in lines(head, calibration_rows(args, tables)):
        print(line, flush=True)
    for output, rows in tables.items():
        middle = np.median(np.array(rows), axis=0)
        print(f"\nmedian, {output}: " + ", ".join(f"{value:.3g}" for value in middle))


def calibration_rows(args: argparse.Namespace, tables: dict[str, list[list[float]]]) -> Iterator[list[str]]:
    """A row for each street and kind of data, whose figures go to ``tables``."""
    for seed in range(args.seed, args.seed + args.streets):
        rng = np.random.default_rng([seed, 21])
        base = SimulationConfig(
            seed=seed,
            frames=args.frames,
            width=932,
            height=282,
            motion="mixed",
            rolling=True,
            time_offset_s=0.1,
            azimuth_step_deg=0.25,
            azimuth_limit_deg=90.0,
            sweep_sense=str(rng.choice(["clockwise", "counterclockwise"])),  # type: ignore[arg-type]
            sweep_start_deg=float(rng.choice([180.0, 120.0, -120.0])),
        )
        for output in ("times", *args.outputs.split(",")):
            config = replace(base, sweep_output=output)  # type: ignore[arg-type]
            figures, status, decision = errors(config, output == "times")
            tables.setdefault(output, []).append(figures)
            yield [str(seed), output, *(f"{figure:.3g}" for figure in figures), status, decision]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("decide", "drives", "calibrate"))
    parser.add_argument("data", nargs="*", help="of drives: their folders")
    parser.add_argument("--seeds", type=int, nargs="+", help="of decide: instead of --streets and --seed")
    parser.add_argument("--streets", type=int, default=6)
    parser.add_argument("--frames", type=int, default=30)
    parser.add_argument("--seed", type=int, default=500)
    parser.add_argument("--outputs", default="raw,compensated", help="which of them")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    {"decide": decide, "drives": drives, "calibrate": calibrations}[args.what](args)


if __name__ == "__main__":
    main()

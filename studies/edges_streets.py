"""Calibration by edges on streets of two simulators and on real drives: errors, sigmas, NEES. Prints a table.

    OMP_NUM_THREADS=1 python -m studies.edges_streets                 six streets of each simulator
    OMP_NUM_THREADS=1 python -m studies.edges_streets own-504 third-900 DRIVE

Starts are within 4.4 deg and 10 cm by axis. Errors are in the LiDAR's axes: roll, pitch, yaw; forward, left,
up. Real drives are read with ``--image-shift 1``; their reference is taken for exact. Reasons go to stderr.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sst_graph import CalibrationConfig, calibrate, open_source
from sst_graph.experiments.markdown import lines, table
from sst_graph.experiments.starts import error_of
from sst_graph.metrics import nees
from sst_graph.simulator import SimulationConfig, simulate
from sst_graph.types import Source
from studies.simulators.third_street import ThirdConfig, ThirdStreet

FloatArray = NDArray[np.float64]
STREETS = [*(f"own-{seed}" for seed in range(504, 510)), *(f"third-{seed}" for seed in range(900, 906))]
OFFSETS_S = (0.05, -0.08, 0.0)
UNITS = np.array([*[180.0 / np.pi] * 3, 100.0, 100.0, 100.0, 1e3])
HEAD = (
    "| drive | rotation [deg] | translation [cm] | time offset [ms] "
    "| sigma: rotation | translation | time offset | NEES / 7 | status | seconds |"
)


def source_of(name: str) -> Source:
    """A street ``own-SEED``, ``wide-SEED`` (24 frames of ``sst-graph simulate``) or ``third-SEED``, or the
    drive in a folder."""
    kind, _, seed = name.partition("-")
    if kind not in ("own", "third", "wide"):
        return open_source(name, image_shift=1)
    number = int(seed)
    offset_s = OFFSETS_S[number % 3]
    if kind == "wide":
        return simulate(SimulationConfig(seed=number, frames=24, azimuth_limit_deg=60.0))
    if kind == "own":
        motion = ("no_stop", "stop_and_go", "mixed", "turning")[number % 4]
        return simulate(
            SimulationConfig(
                seed=number, frames=30, motion=motion, azimuth_limit_deg=50.0, time_offset_s=offset_s
            )
        )
    motion, moving = (("stop", 0.0), ("vary", 0.3))[number % 2]
    return ThirdStreet(
        ThirdConfig(seed=number, frames=30, motion=motion, time_offset_s=offset_s, moving_fraction=moving)
    )


def start_step(name: str) -> FloatArray:
    """(6,) from the truth to the start: the same for a street or a drive's folder each time, wherever it
    lies."""
    own = Path(name).name
    rng = np.random.default_rng([sum((i + 1) * ord(c) for i, c in enumerate(own)), 0])
    return np.r_[np.radians(rng.uniform(-5.0, 5.0, 3) * np.sqrt(0.75)), rng.uniform(-0.1, 0.1, 3)]


def cells(values: FloatArray) -> tuple[str, str, str]:
    """Seven errors or sigmas, with their signs: rotation [deg], translation [cm], time offset [ms]."""
    r = values * UNITS
    return (
        ", ".join(f"{angle:+.2f}" for angle in r[:3]),
        ", ".join(f"{shift:+.1f}" for shift in r[3:6]),
        f"{r[6]:+.1f}",
    )


def sigma_cells(covariance: FloatArray) -> tuple[str, str, str]:
    """Sigmas of a (7, 7) covariance, as :func:`cells` has errors."""
    rotation, translation, offset = cells(np.sqrt(np.diag(covariance)))
    return rotation.replace("+", ""), translation.replace("+", ""), offset.replace("+", "")


def short(name: str) -> str:
    """A street's name, or the last part of a drive's folder."""
    return f"`{Path(name).name}`"


def rows(
    names: Sequence[str], guessed: bool, found: list[tuple[FloatArray, float]]
) -> Iterator[Sequence[str]]:
    """A row a drive; errors and NEES go to ``found``."""
    for name in names:
        source = source_of(name)
        truth, began = source.truth, time.process_time()
        assert truth is not None
        start = truth.cTl.retract(start_step(name)) if guessed else None
        result = calibrate(source, start, CalibrationConfig(method="edges"))
        seconds = time.process_time() - began
        error = error_of(result.calibration, truth)
        share = nees(error, result.covariance) / 7.0
        found.append((error * UNITS, share))
        for reason in result.reasons:
            print(f"{name}: {reason}", file=sys.stderr, flush=True)
        sigmas = sigma_cells(result.covariance)
        yield short(name), *cells(error), *sigmas, f"{share:.1f}", result.status, f"{seconds:.0f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("names", nargs="*", default=STREETS)
    parser.add_argument("--no-guess", action="store_true", help="start from motion alone")
    args = parser.parse_args()
    found: list[tuple[FloatArray, float]] = []
    for line in lines(HEAD, rows(args.names, not args.no_guess, found)):
        print(line, flush=True)
    errors, shares = np.array([error for error, _ in found]), np.array([each for _, each in found])
    rotation, shift = np.linalg.norm(errors[:, :3], axis=1), np.abs(errors[:, 3:6]).mean(axis=1)
    of_all = (
        ("rotation [deg]", rotation),
        ("ATD [cm]", shift),
        ("time offset [ms]", np.abs(errors[:, 6])),
        ("NEES / 7", shares),
    )
    summary = [
        (what, *(f"{value:.2f}" for value in (np.median(each), each.mean(), each.max())))
        for what, each in of_all
    ]
    print("\n" + table("| of all | median | mean | largest |", summary))


if __name__ == "__main__":
    main()

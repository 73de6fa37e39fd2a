"""Calibrates simulated drives that differ only in how the vehicle moves: the data of two figures.

``python docs/figures/make.py --measure`` runs it and writes drives.csv beside this file.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sst_graph import CalibrationConfig, calibrate
from sst_graph.config import with_overrides
from sst_graph.metrics import nees, tangent_error
from sst_graph.simulator import SimulationConfig, simulate
from sst_graph.simulator.config import Motion

FILE = Path(__file__).with_name("drives.csv")
MOTIONS: tuple[Motion, ...] = ("standing", "constant", "no_stop", "stop_and_go", "turning")
SEEDS = range(9100, 9104)
UNKNOWNS = ("rx", "ry", "rz", "x", "y", "z", "offset")


@dataclass(frozen=True)
class Calibrated:
    """One drive and its calibration.

    Attributes:
        motion: how the vehicle moves.
        seed: of the street.
        status: of the result.
        sigmas: (7,) standard deviations [rad, m, s], about and along the LiDAR's axes.
        errors: (7,) truth minus estimate, in the same units and axes.
        nees: squared error in units of the covariance; 7 on average where the covariance holds.
        correlation: of the translation along x and the time offset.
    """

    motion: str
    seed: int
    status: str
    sigmas: NDArray[np.float64]
    errors: NDArray[np.float64]
    nees: float
    correlation: float


def calibrated(motion: Motion, seed: int) -> Calibrated:
    """A street of 20 frames, 621 x 188 px, 50 ms late, seen by a vehicle that moves in this way."""
    config = SimulationConfig(
        seed=seed, frames=20, width=621, height=188, azimuth_limit_deg=60.0, motion=motion, time_offset_s=0.05
    )
    drive = simulate(config)
    result = calibrate(
        drive, drive.nominal, with_overrides(CalibrationConfig(), ["find_causes=false", "use_motion=never"])
    )
    truth = drive.truth
    late_s = result.time_offset_s - truth.time_offset_s
    errors = tangent_error(result.T_camera_lidar, truth.cTl, late_s)
    sigmas = np.sqrt(np.diag(result.covariance))
    correlation = result.covariance[3, 6] / (sigmas[3] * sigmas[6])
    return Calibrated(
        motion, seed, result.status, sigmas, errors, nees(errors, result.covariance), float(correlation)
    )


def measure(said: Callable[[str], None]) -> None:
    """Calibrate all drives and write the file."""
    rows = []
    for motion in MOTIONS:
        for seed in SEEDS:
            rows.append(calibrated(motion, seed))
            said(f"{motion} {seed}: {rows[-1].status}")
    write(rows)


def write(rows: Iterable[Calibrated]) -> None:
    with FILE.open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        heads = [f"{kind}_{name}" for kind in ("sigma", "error") for name in UNKNOWNS]
        table.writerow(["motion", "seed", "status", *heads, "nees", "correlation_x_offset"])
        for row in rows:
            numbers = [f"{value:.4g}" for value in (*row.sigmas, *row.errors, row.nees, row.correlation)]
            table.writerow([row.motion, row.seed, row.status, *numbers])


def read() -> Iterator[Calibrated]:
    """The drives of the file."""
    with FILE.open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            sigmas = np.array([float(row[f"sigma_{name}"]) for name in UNKNOWNS])
            errors = np.array([float(row[f"error_{name}"]) for name in UNKNOWNS])
            rest = float(row["nees"]), float(row["correlation_x_offset"])
            yield Calibrated(row["motion"], int(row["seed"]), row["status"], sigmas, errors, *rest)

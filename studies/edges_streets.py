"""Calibration by edges on streets of two simulators and on real drives: errors, sigmas, NEES. Prints a table.

    OMP_NUM_THREADS=1 python -m studies.edges_streets                 six streets of each simulator
    OMP_NUM_THREADS=1 python -m studies.edges_streets own-504 third-900 DRIVE

Starts are within 4.4 deg and 10 cm by axis. Errors are in the LiDAR's axes: roll, pitch, yaw; forward, left,
up. Real drives are read with ``--image-shift 1``; their reference is taken for exact.
"""

from __future__ import annotations

import argparse
import time

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph import CalibrationConfig, calibrate, open_source
from sst_graph.simulator import SimulationConfig, simulate
from sst_graph.types import Source
from studies.simulators.third_street import ThirdConfig, ThirdStreet

FloatArray = NDArray[np.float64]
STREETS = [*(f"own-{seed}" for seed in range(504, 510)), *(f"third-{seed}" for seed in range(900, 906))]
OFFSETS_S = (0.05, -0.08, 0.0)
UNITS = np.array([*[180.0 / np.pi] * 3, 100.0, 100.0, 100.0, 1e3])


def source_of(name: str) -> Source:
    """A street ``own-SEED`` or ``third-SEED``, or the drive in a folder."""
    kind, _, seed = name.partition("-")
    if kind not in ("own", "third"):
        return open_source(name, image_shift=1)
    number = int(seed)
    offset_s = OFFSETS_S[number % 3]
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
    """(6,) from the truth to the start: the same for a name each time."""
    rng = np.random.default_rng([sum((i + 1) * ord(c) for i, c in enumerate(name)), 0])
    return np.r_[np.radians(rng.uniform(-5.0, 5.0, 3) * np.sqrt(0.75)), rng.uniform(-0.1, 0.1, 3)]


def row(values: FloatArray) -> str:
    """Seven errors or sigmas."""
    r = values * UNITS
    return f"{r[0]:+.3f} {r[1]:+.3f} {r[2]:+.3f} | {r[3]:+5.1f} {r[4]:+5.1f} {r[5]:+5.1f} | {r[6]:+5.1f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("names", nargs="*", default=STREETS)
    errors, nees = [], []
    for name in parser.parse_args().names:
        source = source_of(name)
        truth, began = source.truth, time.process_time()
        assert truth is not None
        result = calibrate(source, truth.cTl.retract(start_step(name)), CalibrationConfig(method="edges"))
        seconds = time.process_time() - began
        step = gtsam.Pose3.Logmap(truth.cTl.between(result.T_camera_lidar))
        error = np.append(step, result.time_offset_s - truth.time_offset_s)
        errors.append(error)
        nees.append(float(error @ np.linalg.solve(result.covariance, error)) / 7.0)
        sigmas = np.sqrt(np.diag(result.covariance))
        print(f"{name:10s} {result.status}  {row(error)}  sigmas {row(sigmas)}", end="")
        print(f"  NEES/7 {nees[-1]:.2f}  {seconds:.0f} s", flush=True)
        for reason in result.reasons:
            print(f"    {reason}", flush=True)
    table = np.abs(np.array(errors) * UNITS)
    rotation, shift = np.linalg.norm(table[:, :3], axis=1), table[:, 3:6].mean(axis=1)
    for what, column in (
        ("deg", rotation),
        ("cm ATD", shift),
        ("ms", table[:, 6]),
        ("NEES/7", np.array(nees)),
    ):
        print(f"{what}: median {np.median(column):.3f}, mean {column.mean():.3f}, largest {column.max():.3f}")


if __name__ == "__main__":
    main()

"""Vehicles that brake hard: the body rocks within a few scans, faster than the scans can follow.

    OMP_NUM_THREADS=1 python -m studies.braking [--streets 8] [--seed 700]

On simulated streets the body answers steps of acceleration, one every 0.5 to 1.2 s, by 0.4 to 1.2 deg of
pitch: as a spring of 1.3 to 2.6 Hz with a damping of 0.3. The time offset by motion alone and by `joint`,
over its sigma; NEES of 7.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from sst_graph.batch import CalibrationConfig, calibrate_prepared
from sst_graph.batch.config import Method
from sst_graph.drive.preparation import Drive, prepare_drive
from sst_graph.experiments.starts import errors_of
from sst_graph.simulator import SimulationConfig, simulate
from sst_graph.simulator.config import Motion
from sst_graph.simulator.motion import EgoMotion, ego_motion
from sst_graph.types import GroundTruth

FloatArray = NDArray[np.float64]
MOTIONS: tuple[Motion, ...] = ("mixed", "no_stop", "constant", "turning")
METHODS: tuple[Method, ...] = ("motion", "joint")
_DAMPING = 0.3


def answer(seconds: FloatArray, frequency_hz: float) -> FloatArray:
    """(n,) answer of a spring to a unit step of its load, seconds (n,) after it."""
    after, rate = np.maximum(seconds, 0.0), 2.0 * np.pi * frequency_hz
    root = np.sqrt(1.0 - _DAMPING**2)
    swing = np.cos(root * rate * after) + _DAMPING / root * np.sin(root * rate * after)
    return np.asarray(1.0 - np.exp(-_DAMPING * rate * after) * swing)


def rocked(motion: EgoMotion, until_s: float, rng: np.random.Generator) -> EgoMotion:
    """The motion, its body pitching by steps of acceleration in turn to either side."""
    angles, at_s, side = motion.angles.copy(), 0.3, 1.0
    while at_s < until_s:
        size, frequency_hz = np.radians(rng.uniform(0.4, 1.2)), rng.uniform(1.3, 2.6)
        angles[:, 1] += side * size * answer(motion.t - at_s, frequency_hz)
        at_s, side = at_s + rng.uniform(0.5, 1.2), -side
    return replace(motion, angles=angles)


def drive_of(config: SimulationConfig) -> tuple[Drive, GroundTruth]:
    """A street whose vehicle brakes hard, and its truth."""
    rng = np.random.default_rng([config.seed, 5])
    gentle: Callable[..., EgoMotion] = ego_motion

    def hard(*args: object) -> EgoMotion:
        return rocked(gentle(*args), config.frames * config.period_s, rng)

    with patch("sst_graph.simulator.street.ego_motion", hard):
        source = simulate(config)
    settings = CalibrationConfig()
    return prepare_drive(source, settings.classes, settings.prepare), source.truth


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--streets", type=int, default=8)
    parser.add_argument("--seed", type=int, default=700)
    args = parser.parse_args()
    print("| street | method | status | time offset [ms] error, sigma | over sigma | NEES |")
    print("|---|---|---|---|---|---|")
    shares: dict[Method, list[float]] = {method: [] for method in METHODS}
    for k in range(args.streets):
        config = SimulationConfig(
            seed=args.seed + k,
            frames=40,
            motion=MOTIONS[k % len(MOTIONS)],
            time_offset_s=0.1 + 0.013 * (k % 8),
        )
        drive, truth = drive_of(config)
        for method in METHODS:
            result = calibrate_prepared([drive], truth.cTl, replace(CalibrationConfig(), method=method))
            errors, sigma_ms = errors_of(result, truth), result.sigmas().time_offset_ms
            assert errors.time_offset_s is not None and errors.nees is not None
            shares[method].append(1e3 * errors.time_offset_s / sigma_ms)
            print(
                f"| {config.seed}, {config.motion} | {method} | {result.status} "
                f"| {1e3 * errors.time_offset_s:+.2f}, {sigma_ms:.2f} | {shares[method][-1]:+.1f} "
                f"| {errors.nees.joint:.1f} |",
                flush=True,
            )
    for method, values in shares.items():
        rms, largest = np.sqrt(np.mean(np.square(values))), np.abs(values).max()
        print(f"{method}: {rms:.1f} sigmas root mean square, {largest:.1f} the largest")


if __name__ == "__main__":
    main()

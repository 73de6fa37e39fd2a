"""Drift mode against a random walk: is it followed, and do the history's sigmas cover it? Prints a table.

    OMP_NUM_THREADS=1 python -m studies.tracker_drift --streets 5

Each street: a simulated drive (half-size pictures) is played forth and back while the camera yaws by a random
walk of the rate that the tracker assumes, and its clock walks too. The masks are warped and the stamps moved.
"""

from __future__ import annotations

import argparse
import dataclasses
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from benchmarks.tracker_run import PERIOD_NS, endless
from sst_graph import Tracker, TrackerConfig
from sst_graph.experiments.markdown import table
from sst_graph.simulator import SimulatedDrive, SimulationConfig, simulate
from sst_graph.tracker.config import DriftConfig
from sst_graph.tracker.window.epochs import EPOCH_S
from sst_graph.types import Frame
from studies.tracker_steps import Step

DRIFT = DriftConfig(enabled=True, rotation_deg=0.05, translation_m=0.0005, time_offset_s=0.001)


@dataclass(frozen=True)
class Walk:
    """True yaw [rad] and clock shift [s] of the camera, frame by frame."""

    yaw_rad: NDArray[np.float64]
    shift_s: NDArray[np.float64]

    @classmethod
    def random(cls, frames: int, seed: int) -> Walk:
        rng, root = np.random.default_rng(seed), np.sqrt(PERIOD_NS * 1e-9)
        yaw = np.radians(DRIFT.rotation_deg) * root * rng.standard_normal(frames)
        shift = DRIFT.time_offset_s * root * rng.standard_normal(frames)
        return cls(np.cumsum(yaw), np.cumsum(shift))


def drifted(frame: Frame, walk: Walk, drive: SimulatedDrive) -> Frame:
    """The frame as the drifting camera would have it."""
    assert frame.image is not None
    yaw_deg = float(np.degrees(walk.yaw_rad[frame.index]))
    step = Step("drift", (0.0, yaw_deg, 0.0), -1e3 * float(walk.shift_s[frame.index]))
    return dataclasses.replace(frame, image=step.applied(frame.image, drive))


def run(seed: int, frames: int) -> dict[str, float]:
    """Errors of the history on one street."""
    drive = simulate(
        SimulationConfig(
            seed=seed,
            frames=40,
            width=621,
            height=188,
            azimuth_limit_deg=50.0,
            azimuth_step_deg=0.3,
            time_offset_s=0.0,
            motion="no_stop",
        )
    )
    walk = Walk.random(frames, seed)
    tracker = Tracker(drive.camera, TrackerConfig(drift=DRIFT), drive.truth.cTl)
    tracker.initializer.work_per_frame = None  # all epochs from the first on
    alarms = 0
    for frame in endless(list(drive), frames):
        alarms += tracker.add(drifted(frame, walk, drive)).alarm
    yaw, offset, steady = [], [], []
    for entry in tracker.estimate.history():
        # An epoch's calibration is that of its middle.
        k = min(frames - 1, int(entry.stamp_ns / PERIOD_NS + 0.5e9 * EPOCH_S / PERIOD_NS))
        truth = gtsam.Rot3.Ry(walk.yaw_rad[k]) * drive.truth.cTl.rotation()
        turn = gtsam.Rot3.Logmap(truth.between(entry.cTl.rotation()))
        axis = truth.matrix().T @ np.array([0.0, 1.0, 0.0])
        sigma = float(np.sqrt(axis @ entry.covariance[:3, :3] @ axis))
        yaw.append((float(axis @ turn), sigma))
        steady.append(walk.yaw_rad[k])
        offset.append((entry.time_offset_s - walk.shift_s[k], float(np.sqrt(entry.covariance[6, 6]))))
    return {**_summary("yaw_deg", yaw, 180.0 / np.pi), **_summary("offset_ms", offset, 1e3)} | {
        "walked_deg": float(np.degrees(np.ptp(steady))),
        "epochs": len(yaw),
        "alarms": alarms,
    }


def _summary(name: str, errors: list[tuple[float, float]], unit: float) -> dict[str, float]:
    error, sigma = np.array(errors).T
    return {
        f"{name}_rms": float(unit * np.sqrt(np.mean(error**2))),
        f"{name}_sigma": float(unit * np.median(sigma)),
        f"{name}_covered_95": float(np.mean(np.abs(error) < 1.96 * sigma)),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--streets", type=int, default=5)
    parser.add_argument("--frames", type=int, default=400)
    args = parser.parse_args()
    streets = [run(seed, args.frames) for seed in range(args.streets)]
    mean = {name: float(np.mean([street[name] for street in streets])) for name in streets[0]}
    rows = []
    for what, name, unit in (("yaw", "yaw_deg", "deg"), ("time offset", "offset_ms", "ms")):
        rms, sigma, covered = (mean[f"{name}_{key}"] for key in ("rms", "sigma", "covered_95"))
        rows.append([what, f"{rms:.3f} {unit}", f"{sigma:.3f} {unit}", f"{covered:.0%}"])
    print(table("| | rms error of the history | its sigma | within 1.96 sigma |", rows))
    alarms = sum(street["alarms"] for street in streets)
    print(f"Means over {len(streets)} streets, {alarms:.0f} alarms, {mean['walked_deg']:.2f} deg of yaw.")


if __name__ == "__main__":
    main()

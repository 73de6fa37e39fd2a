"""A camera of 30 Hz beside a LiDAR of 10 Hz against one of 10 Hz: errors and consistency on the same streets.

Each street is driven through once, 4 s by default. The camera of 10 Hz takes the images at the scans' stamps.

    python -m studies.camera_rate --streets 8
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sst_graph import calibrate
from sst_graph.data import DriveProperties, Sensor, SourceOptions, merged
from sst_graph.experiments.starts import errors_of, start_near
from sst_graph.simulator import SimulatedDrive, SimulationConfig, simulate
from sst_graph.types import Source

TIME_OFFSET_S = 0.1


def drive_of(street: SimulatedDrive, images_hz: int) -> Source:
    """Every third frame's scan, and its image or all images."""
    scans = list(range(1, len(street), 3))
    images: Sequence[int] = range(len(street)) if images_hz == 30 else scans
    return merged(
        DriveProperties("street", street.camera, street.nominal, street.truth),
        Sensor(street.stamps_ns[scans], lambda k: street.scan(scans[k])),
        Sensor(street.stamps_ns[list(images)], lambda k: street.image(images[k])),
        SourceOptions(sweep="compensated"),
        Path("street"),
    )


def run(seed: int, scans: int, images_hz: int) -> np.ndarray:
    """(4,) rotation [deg], translation [cm], size of the time offset's error [ms], NEES over 7."""
    config = SimulationConfig(seed=seed, frames=3 * scans, frame_rate_hz=30.0, time_offset_s=TIME_OFFSET_S)
    street = simulate(config)
    start = start_near(street.truth.cTl, 10.0, 0.1, np.random.default_rng([seed, 11]))
    result = calibrate(drive_of(street, images_hz), start)
    errors = errors_of(result, street.truth)
    assert errors.time_offset_s is not None and errors.nees is not None
    sizes = errors.qad_deg, 100.0 * errors.atd_m, 1e3 * abs(errors.time_offset_s)
    return np.array([*sizes, errors.nees.joint / 7.0])


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--streets", type=int, default=8)
    parser.add_argument("--seed", type=int, default=7100, help="of the first street")
    parser.add_argument("--scans", type=int, default=40)
    options = parser.parse_args()
    print("| camera | rotation [deg] | ATD [cm] | time offset [ms] | NEES / 7, mean |")
    print("|---|---|---|---|---|")
    for images_hz in (10, 30):
        seeds = range(options.seed, options.seed + options.streets)
        found = np.array([run(seed, options.scans, images_hz) for seed in seeds])
        middle = np.median(found, axis=0)
        cells = f"{middle[0]:.3f} | {middle[1]:.2f} | {middle[2]:.2f} | {found[:, 3].mean():.2f}"
        print(f"| {images_hz} Hz | {cells} |", flush=True)


if __name__ == "__main__":
    main()

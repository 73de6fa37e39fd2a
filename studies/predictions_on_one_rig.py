"""Predictions of ``inspect``, against calibrations of the same rig on more of the same drive.

A simulated drive of 42 frames (standing, accelerating, turning) is cut: its first 14 frames are calibrated
and predict the sigmas that 14 and 28 frames more will give, with the record's average view and the motion
that these frames then have; the first 28 and all 42 frames are calibrated too. Prints claimed over predicted.

    python studies/predictions_on_one_rig.py 21 22
"""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np

from sst_graph.batch import calibrate_prepared
from sst_graph.drive.preparation import Drive, PrepareConfig, prepare_drive
from sst_graph.inspect.frame_information import frames_of, with_offset
from sst_graph.inspect.planning import considered_covariance, predicted_covariance
from sst_graph.simulator import SimulationConfig, simulate
from sst_graph.types import SemanticClass

CUTS = (14, 28, 42)


def first(drive: Drive, count: int) -> Drive:
    """The drive's first frames."""
    motions = drive.lidar_motions[: count - 1]
    return replace(drive, scans=drive.scans[:count], images=drive.images[:count], lidar_motions=motions)


def main() -> None:
    print("| street | frames added | rot x | rot y | rot z | x | y | z | offset | geometric mean |")
    print("|---" * 10 + "|")
    for seed in map(int, sys.argv[1:]):
        street = SimulationConfig(
            seed=seed,
            frames=CUTS[-1],
            width=621,
            height=188,
            azimuth_limit_deg=55.0,
            azimuth_step_deg=0.35,
            vehicle_density=0.25,
            moving_fraction=0.0,
            time_offset_s=0.05,
        )
        source = simulate(street)
        drive = prepare_drive(source, [SemanticClass.VEHICLE], PrepareConfig(use_visual_odometry=False))
        found = [
            calibrate_prepared([first(drive, n)], source.truth.cTl, initial_time_offset_s=0.05) for n in CUTS
        ]
        record = frames_of(found[0])
        view = np.mean([frame.view for frame in record], axis=0)
        for count, result in zip(CUTS[1:], found[1:], strict=True):
            twists = [frame.l_twist for frame in frames_of(result)][len(record) :]
            more = np.sum([with_offset(view, twist) for twist in twists], axis=0)
            lasting = considered_covariance(found[0])
            predicted = np.sqrt(np.diag(predicted_covariance(found[0].covariance, more, lasting)))
            ratios = np.sqrt(np.diag(result.covariance)) / predicted
            mean = float(np.exp(np.log(ratios).mean()))
            cells = " | ".join(f"{ratio:.2f}" for ratio in (*ratios, mean))
            print(f"| {seed} | {count - CUTS[0]} | {cells} |", flush=True)


if __name__ == "__main__":
    main()

"""Results of several drives of one vehicle, fused: errors against what the fused covariance says.

    OMP_NUM_THREADS=1 python -m studies.fused_drives --vehicles 20 --drives 6

Every vehicle has sensors with errors of its own: the parameters of all assumptions (focal length, principal
point, distortion, sweep, clock, ranges, ...) are drawn once from their prior deviations, and are the same in
all of its drives through small streets (studies/small_streets.py). Each drive is calibrated by itself, and
the results are fused through their marginals, with what they have in common and as if that were each
drive's own (apart). Prints a Markdown table: NEES over its dimension, which should be 1, and vehicles that
the fusion refuses as contradicting, at its own significance of 0.001.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace

import cv2
import gtsam
import numpy as np

from sst_graph.batch import calibrate_prepared, prepare_drives
from sst_graph.errors import ContradictionError
from sst_graph.experiments.markdown import NONE, table
from sst_graph.export import CalibrationMarginal, Common, fuse_marginals, marginal_of_result
from sst_graph.metrics import nees
from sst_graph.types import Calibration
from studies.small_streets import CONFIG, FIRST_SEED, drawn, street

_REFERENCE = gtsam.Pose3()
"""What all streets' extrinsics are moved to, so that one vehicle has one."""


def marginal_of(seed: int, vehicle: int) -> CalibrationMarginal | None:
    """Of the result on a street with the sensors of a vehicle, about the reference, or None of a failure."""
    drive = drawn(vehicle, street(seed)[1])
    result = calibrate_prepared(prepare_drives([drive], CONFIG), drive.nominal, CONFIG)
    if result.status == "not_converged":
        return None
    assert drive.truth is not None and drive.truth.time_offset_s is not None
    off = gtsam.Pose3.Logmap(drive.truth.cTl.between(result.T_camera_lidar))
    offset_s = result.time_offset_s - drive.truth.time_offset_s
    return replace(marginal_of_result(result), cTl=_REFERENCE.retract(off), time_offset_s=offset_s)


def nees_of(marginal: CalibrationMarginal) -> float:
    """NEES over its dimension."""
    error = Calibration(_REFERENCE).local_coordinates(marginal.best())
    return nees(error, marginal.covariance()) / len(error)


def outcome(parts: Sequence[CalibrationMarginal]) -> tuple[float, bool]:
    """NEES of the fused marginal, and whether fusion refuses its parts."""
    try:
        fuse_marginals(parts)
        refused = False
    except ContradictionError:
        refused = True
    return nees_of(fuse_marginals(parts, significance=0.0)), refused


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--vehicles", type=int, default=20)
    parser.add_argument("--drives", type=int, default=6)
    args = parser.parse_args()
    cv2.setNumThreads(1)
    single, together, apart, used = [], [], [], 0
    for vehicle in range(args.vehicles):
        seeds = range(
            FIRST_SEED + 1000 + vehicle * args.drives, FIRST_SEED + 1000 + (vehicle + 1) * args.drives
        )
        parts = [part for seed in seeds if (part := marginal_of(seed, vehicle)) is not None]
        if len(parts) < 2:
            continue
        used += len(parts)
        single += [nees_of(part) for part in parts]
        together.append(outcome(parts))
        apart.append(outcome([replace(part, common=Common()) for part in parts]))
        print(f"vehicle {vehicle}: {together[-1]} {apart[-1]}", file=sys.stderr, flush=True)
    print(f"\n{len(together)} vehicles, {used} drives\n")
    print(table_of(single, {"fused": together, "fused, apart": apart}))


def table_of(single: Sequence[float], fused: Mapping[str, Sequence[tuple[float, bool]]]) -> str:
    """NEES of drives by themselves, and by name NEES of fused ones and whether fusion refuses them."""
    rows = [["drives by themselves", _of_values(single), NONE]]
    for name, found in fused.items():
        rows.append([name, _of_values([one for one, _ in found]), str(sum(refused for _, refused in found))])
    return table("| | mean, median, largest | vehicles refused as contradicting |", rows)


def _of_values(values: Sequence[float]) -> str:
    return f"{np.mean(values):.2f}, {np.median(values):.2f}, {max(values):.1f}"


if __name__ == "__main__":
    main()

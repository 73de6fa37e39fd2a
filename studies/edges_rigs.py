"""Stereo pairs without labels on simulated streets: errors, joint covariance, what a known pose adds.

    OMP_NUM_THREADS=1 python -m studies.edges_rigs --seeds 507 504 550 551

Streets and starts are those of ``studies.edges_streets``; the second camera has KITTI's baseline and the same
trigger. NEES are divided by their dimension.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence

import numpy as np

from sst_graph import CalibrationConfig
from sst_graph.experiments.markdown import lines
from sst_graph.metrics import nees, tangent_error
from sst_graph.rig import KnownPose, KnownRig, RigResult
from sst_graph.rig.calibrate import calibrate_rig_prepared, prepare_rig
from sst_graph.simulator import SimulatedDrive
from sst_graph.simulator.rig import beside, stereo_pose, with_mounts
from sst_graph.types import Guess
from studies.edges_streets import source_of, start_step

CONFIG = CalibrationConfig(method="edges")
HEAD = (
    "| street | known | left | NEES | right | NEES | of both | of the pose between "
    "| correlation of roll, pitch, yaw |"
)
KNOWN = {
    "own images": KnownRig(),
    "known pose, one trigger": KnownRig((KnownPose("right", "left", stereo_pose()),), one_trigger=True),
}


def row(rig: dict[str, SimulatedDrive], result: RigResult) -> list[str]:
    """Errors of both cameras, the NEES of each, of both at once and of the pose between them."""
    errors, cells = [], []
    for name, drive in rig.items():
        one = result[name]
        late_s = one.time_offset_s - drive.config.time_offset_s
        error = tangent_error(one.T_camera_lidar, drive.truth.cTl, late_s)
        errors.append(error)
        degrees, centimetres = np.degrees(np.linalg.norm(error[:3])), 100.0 * np.linalg.norm(error[3:6])
        cells.append(f"{degrees:.2f}°, {centimetres:.1f} cm, {1e3 * error[6]:+.1f} ms, {one.status}")
        cells.append(f"{nees(error, one.covariance) / 7:.2f}")
    sigmas = np.sqrt(np.diag(result.covariance))
    shared = np.diag(result.covariance[:7, 7:]) / (sigmas[:7] * sigmas[7:])
    between = result.relative_pose("right", "left")
    step = tangent_error(between.T_camera_reference, stereo_pose())[:6]
    of_both, of_pose = nees(np.concatenate(errors), result.covariance), nees(step, between.covariance)
    cells += [f"{of_both / 14:.2f}", f"{of_pose / 6:.2f}"]
    cells.append(", ".join(f"{value:.2f}" for value in shared[:3]))
    return cells


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[507, 504])
    for line in lines(HEAD, rows(parser.parse_args().seeds)):
        print(line, flush=True)


def rows(seeds: Sequence[int]) -> Iterator[list[str]]:
    """Each street with and without what is known of its rig."""
    for seed in seeds:
        name = f"own-{seed}"
        drive = source_of(name)
        assert isinstance(drive, SimulatedDrive)
        rig = with_mounts(drive, {"right": beside(drive, stereo_pose())}, "left")
        drives = prepare_rig({camera: [one] for camera, one in rig.items()}, CONFIG)
        start = start_step(name)
        guesses = {camera: Guess(one.truth.cTl.retract(start)) for camera, one in rig.items()}
        for known, what in KNOWN.items():
            found = calibrate_rig_prepared(drives, guesses, CONFIG, what)
            yield [f"`{name}`", known, *row(rig, found)]


if __name__ == "__main__":
    main()

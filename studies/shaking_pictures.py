"""Pictures that shift against the cloud from image to image, as under a mount that vibrates.

    OMP_NUM_THREADS=1 python -m studies.shaking_pictures

Pictures and masks of simulated streets are moved by an amount of their own, normally distributed, half as far
across as up or down. Estimated by labels; NEES (of 7) and the largest error over its deviation of results
that are ``ok``, without the part of the covariance by such shifts and with it.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import NamedTuple

import cv2
import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph import CalibrationConfig
from sst_graph.batch.calibrate import finished, joint_method, prepare_drives
from sst_graph.covariance.image_shifts import image_shifts
from sst_graph.data.kept_drive import KeptDrive
from sst_graph.experiments.starts import error_of
from sst_graph.types import Guess
from studies.edges_streets import source_of, start_step
from studies.subtle_faults import with_numbered_images

FloatArray = NDArray[np.float64]
STREETS = (*(f"own-{seed}" for seed in range(600, 604)), *(f"third-{seed}" for seed in range(610, 614)))
SIZES_PX = (0.0, 1.0, 2.0)


def shaken(drive: KeptDrive, pixels: float, seed: int) -> KeptDrive:
    """Each image moved by an amount of its own; ``pixels``: its deviation up or down, twice that across."""
    shifts = np.random.default_rng(seed).normal(size=(len(drive.frames), 2)) * [0.5 * pixels, pixels]
    size = drive.camera.width, drive.camera.height

    def moved(array: NDArray[np.uint8], k: int, how: int) -> NDArray[np.uint8]:
        M = np.array([[1.0, 0.0, shifts[k, 0]], [0.0, 1.0, shifts[k, 1]]])
        return cv2.warpAffine(array, M, size, flags=how, borderMode=cv2.BORDER_REPLICATE).astype(np.uint8)

    return with_numbered_images(
        drive,
        lambda k, image: replace(
            image,
            mask=moved(image.mask, k, cv2.INTER_NEAREST),
            pixels=moved(image.pixels, k, cv2.INTER_LINEAR),
            instances=None,
        ),
    )


class Outcome(NamedTuple):
    """Status, shifts found [px], and of the covariances without and with them: NEES, largest error."""

    status: str
    sigmas_px: FloatArray
    nees: FloatArray
    worst: FloatArray


def outcome_of(drive: KeptDrive, start: gtsam.Pose3) -> Outcome:
    """Of one drive by labels, against its truth."""
    config, truth = CalibrationConfig(), drive.truth
    assert truth is not None and truth.time_offset_s is not None
    drives, guess = prepare_drives([drive], config), Guess(start)
    result, estimate = finished(lambda: joint_method(drives, guess, config, None), drives, guess, config)
    assert estimate is not None and estimate.solved is not None
    solved = estimate.solved.estimate
    last = solved.solution
    shifts = image_shifts(solved.robust, last.pairs, last.values, last.state)
    error = error_of(result.calibration, truth)
    covariances = result.covariance - shifts.covariance[:7, :7], result.covariance
    nees = np.array([float(error @ np.linalg.solve(C, error)) for C in covariances])
    worst = np.array([np.abs(error / np.sqrt(np.diag(C))).max() for C in covariances])
    return Outcome(result.status, shifts.sigmas_px, nees, worst)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("names", nargs="*", default=STREETS)
    names = parser.parse_args().names
    print("| moved [px] | ok | found across, down [px] | NEES without, with | worst error [sigma] |")
    print("|---|---|---|---|---|")
    for pixels in SIZES_PX:
        found = []
        for name in names:
            source = source_of(name)
            drive = shaken(KeptDrive.of(source), pixels, int(name.partition("-")[2]))
            assert source.truth is not None
            found.append(outcome_of(drive, source.truth.cTl.retract(start_step(name))))
        trusted = [each for each in found if each.status == "ok"]
        shifts = np.median([each.sigmas_px for each in found], axis=0)
        nees = np.median([each.nees for each in trusted], axis=0)
        worst = np.max([each.worst for each in trusted], axis=0)
        print(
            f"| {pixels:g} | {len(trusted)} of {len(found)} | {shifts[0]:.2f}, {shifts[1]:.2f} | "
            f"{nees[0]:.1f}, {nees[1]:.1f} | {worst[0]:.1f}, {worst[1]:.1f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()

"""Pictures that shift against the cloud from image to image, as under a mount that vibrates, and stamps of
images that jitter.

    OMP_NUM_THREADS=1 python -m studies.shaking_pictures

Pictures and masks of simulated streets are moved by an amount of their own, normally distributed, half as far
across as up or down; or the stamps of images are. By labels, with ``calibrate`` and, over the same frames,
with the tracker: medians of NEES (of 7), and the largest error over its deviation, without the part of the
covariance by such shifts and with it. Of ``calibrate`` results that are ``ok``; of the tracker all that have
an estimate, for in so few frames hardly one is confirmed.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import cv2
import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph import CalibrationConfig, Tracker, TrackerConfig
from sst_graph.batch.calibrate import finished, joint_method, prepare_drives
from sst_graph.covariance.image_shifts import ImageShifts, image_shifts
from sst_graph.data.kept_drive import KeptDrive
from sst_graph.experiments.markdown import lines
from sst_graph.experiments.starts import error_of
from sst_graph.odometry.sweep import with_sweep
from sst_graph.types import Guess
from studies.edges_streets import source_of, start_step
from studies.subtle_faults import with_numbered_images

FloatArray = NDArray[np.float64]
STREETS = (*(f"own-{seed}" for seed in range(600, 604)), *(f"third-{seed}" for seed in range(610, 614)))
HEAD = (
    "| pictures [px], stamps [ms] | by | ok | found across, down [px], stamps [ms] "
    "| NEES (of 7) without, with the shifts in the covariance | worst error without, with |"
)
CASES = ((0.0, 0.0), (1.0, 0.0), (2.0, 0.0), (0.0, 10.0))
"""Deviation of the pictures, up or down [px], and of the stamps [ms]."""


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


def jittered(drive: KeptDrive, milliseconds: float, seed: int) -> KeptDrive:
    """Each image stamped by an error of its own."""
    late_ns = 1e6 * milliseconds * np.random.default_rng(seed).normal(size=len(drive.frames))
    return with_numbered_images(
        drive, lambda k, image: replace(image, stamp_ns=image.stamp_ns + round(late_ns[k]))
    )


class Outcome(NamedTuple):
    """Status, shifts found [px, px, ms]; of the covariances without and with them: NEES, largest error."""

    status: str
    found: FloatArray
    nees: FloatArray
    worst: FloatArray

    @classmethod
    def of(cls, status: str, error: FloatArray, shifts: ImageShifts, covariance: FloatArray) -> Outcome:
        """error: (7,) of extrinsic and time offset; covariance: (7, 7) with the shifts."""
        both = covariance - shifts.covariance[:7, :7], covariance
        nees = np.array([float(error @ np.linalg.solve(C, error)) for C in both])
        worst = np.array([np.abs(error / np.sqrt(np.diag(C))).max() for C in both])
        return cls(status, shifts.sigmas * [1.0, 1.0, 1e3], nees, worst)


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
    return Outcome.of(result.status, error_of(result.calibration, truth), shifts, result.covariance)


def tracked(drive: KeptDrive, start: gtsam.Pose3) -> Outcome | None:
    """Of one drive by the tracker, against its truth; None where it finds no start."""
    assert drive.truth is not None
    drive = with_sweep(drive, True)
    tracker = Tracker(drive.camera, TrackerConfig(), start, sweep=drive.sweep_decision)
    for frame in drive:
        tracker.add(frame)
    last = tracker.optimize()
    if last.covariance is None:
        return None
    error, shifts = error_of(last.calibration, drive.truth), tracker.estimate.uncertainty.shifts
    return Outcome.of(last.status, error, shifts, last.covariance)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("names", nargs="*", default=STREETS)
    names = parser.parse_args().names
    for line in lines(HEAD, rows(names)):
        print(line, flush=True)


def rows(names: Sequence[str]) -> Iterator[list[str]]:
    """Each case, by both ways."""
    for pixels, milliseconds in CASES:
        by_all, by_tracker = [], []
        for name in names:
            source, seed = source_of(name), int(name.partition("-")[2])
            drive = KeptDrive.of(source)
            drive = shaken(drive, pixels, seed) if pixels else drive
            drive = jittered(drive, milliseconds, seed) if milliseconds else drive
            assert source.truth is not None
            start = source.truth.cTl.retract(start_step(name))
            by_all.append(outcome_of(drive, start))
            by_tracker += filter(None, [tracked(drive, start)])
        case = f"{pixels:g}, {milliseconds:g}"
        yield [case, "calibrate", *_cells(by_all, [one for one in by_all if one.status == "ok"])]
        yield [case, "tracker", *_cells(by_tracker, by_tracker)]


def _cells(outcomes: Sequence[Outcome], counted: Sequence[Outcome]) -> list[str]:
    """counted: those whose errors are."""
    ok = sum(one.status == "ok" for one in outcomes)
    across, down, late_ms = np.median([one.found for one in outcomes], axis=0)
    nees = np.median([one.nees for one in counted], axis=0)
    worst = np.max([one.worst for one in counted], axis=0)
    return [
        f"{ok} of {len(outcomes)}",
        f"{across:.2f}, {down:.2f}, {late_ms:.1f}",
        f"{nees[0]:.1f}, {nees[1]:.1f}",
        f"{worst[0]:.1f}, {worst[1]:.1f} σ",
    ]


if __name__ == "__main__":
    main()

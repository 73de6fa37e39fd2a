"""Steps of the calibration on streets of all kinds: how soon noticed, and what is learnt. Prints Markdown.

    OMP_NUM_THREADS=1 python studies/tracker_steps.py
    OMP_NUM_THREADS=1 python studies/tracker_steps.py --seed 760 --streets 4

Each street: a simulated drive (time offset 100 ms, label noise 1) is tracked from a guess 2 deg and 9 cm off,
and goes on from a checkpoint several times: as it was, with the camera knocked, and with its clock jumping.
Kinds of motion, shares of moving vehicles and densities alternate.
"""

from __future__ import annotations

import argparse
import dataclasses
import tempfile
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import cv2
import gtsam
import numpy as np

from sst_graph import Tracker
from sst_graph.experiments.wrong_drives import turned_picture
from sst_graph.metrics import nees
from sst_graph.simulator import SimulatedDrive, SimulationConfig, simulate
from sst_graph.simulator.config import Motion
from sst_graph.types import Calibration, CameraImage, Frame

GUESS = np.array([0.02, -0.02, 0.02, 0.05, -0.05, 0.05])
MOTIONS: tuple[Motion, ...] = ("mixed", "no_stop", "turning", "constant", "stop_and_go")
SCENES = ((0.2, 0.13), (0.5, 0.13), (0.2, 0.06))
"""Shares of moving vehicles, and vehicles per metre of street."""
SILENT_NEES = 9.0
"""NEES / 7 above which an estimate that is called ok, without any doubt, is a silent failure."""
KINDS = list(product(MOTIONS, SCENES))


@dataclass(frozen=True)
class Step:
    """A turn of the camera about its own axes [deg], and a jump of its stamps [ms]."""

    name: str
    turn_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    late_ms: float = 0.0

    @property
    def rotation(self) -> gtsam.Rot3:
        return gtsam.Rot3.Expmap(np.radians(self.turn_deg))

    def applied(self, image: CameraImage, drive: SimulatedDrive) -> CameraImage:
        """The image as the camera has it after the step; what it did not see before is unknown."""
        mask = image.mask
        if any(self.turn_deg):
            mask = turned_picture(mask, drive.camera, self.rotation, cv2.INTER_NEAREST, borderValue=255)
        return dataclasses.replace(image, mask=mask, stamp_ns=image.stamp_ns + round(1e6 * self.late_ms))


STEPS = (
    Step("none"),
    Step("yaw 1 deg", (0.0, 1.0, 0.0)),
    Step("pitch 8 deg", (8.0, 0.0, 0.0)),
    Step("clock 30 ms", late_ms=30.0),
    Step("clock -200 ms", late_ms=-200.0),
)


def _frames_of(tracker: Tracker, frames: list[Frame], step: Step, drive: SimulatedDrive) -> str:
    """Cells: the alarm's frame; suspected, unconfirmed, silent frames; status, errors and NEES at the end."""
    alarms, suspected, unconfirmed, silent, speed = [], 0, 0, 0, 0.0
    turn, late_s = gtsam.Pose3(step.rotation, np.zeros(3)), 1e-3 * step.late_ms
    truth = Calibration(turn * drive.truth.cTl, (drive.truth.time_offset_s or 0.0) - late_s)
    for k, frame in enumerate(frames):
        assert frame.image is not None
        update = tracker.add(dataclasses.replace(frame, image=step.applied(frame.image, drive)))
        alarms += [k + 1] if update.alarm else []
        suspected += bool(update.suspected_change)
        unconfirmed += update.status == "unconfirmed"
        error = update.calibration.local_coordinates(truth)
        known = np.diag(update.sigmas**2) if update.covariance is None else update.covariance
        share = nees(error, known) / 7.0
        silent += update.status == "ok" and not update.suspected_change and share > SILENT_NEES
        if k == 0 and tracker.inputs.window.motions:
            motion = tracker.inputs.window.motions[-1]
            speed = float(np.linalg.norm(motion.aTb.translation())) / (1e-9 * (motion.to_ns - motion.from_ns))
    return (
        f"{speed:.1f} | {', '.join(map(str, alarms)) or '–'} | {suspected} | {unconfirmed} | {silent} "
        f"| {update.status} | {np.degrees(np.linalg.norm(error[:3])):.2f} "
        f"| {100 * np.abs(error[3:6]).mean():.1f} | {1e3 * abs(error[6]):.1f} | {share:.1f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=700)
    parser.add_argument("--streets", type=int, default=len(KINDS))
    parser.add_argument("--before", type=int, default=44, help="frames before the step")
    parser.add_argument("--after", type=int, default=30, help="frames after it")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    print(
        "| street | motion, moving, density | step | speed [m/s] | alarm in frame | suspected | unconfirmed "
        "| silent | status | rotation [deg] | ATD [cm] | offset [ms] | NEES / 7 |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|---|---|---|")
    for number in range(args.streets):
        motion, (moving, density) = KINDS[number % len(KINDS)]
        config = SimulationConfig(
            seed=args.seed + number,
            frames=args.before + args.after,
            motion=motion,
            time_offset_s=0.1,
            moving_fraction=moving,
            vehicle_density=density,
        )
        drive = simulate(config)
        frames = list(drive)
        tracker = Tracker(drive.camera, None, drive.truth.cTl.retract(GUESS))
        tracker.initializer.work_per_frame = None  # the estimate is there well before the step
        early = sum(tracker.add(frame).alarm for frame in frames[: args.before])
        with tempfile.TemporaryDirectory() as folder:
            checkpoint = Path(folder) / "tracker.npz"
            tracker.save(checkpoint)
            for step in STEPS:
                cells = _frames_of(Tracker.load(checkpoint), frames[args.before :], step, drive)
                said = step.name if not early else f"{step.name} ({early} alarms before it)"
                print(f"| {config.seed} | {motion}, {moving:g}, {density:g} | {said} | {cells} |", flush=True)


if __name__ == "__main__":
    main()

"""A long run of the tracker: cost of a frame, its growth, memory, alarms. Prints one JSON document.

    OMP_NUM_THREADS=1 python benchmarks/tracker_run.py --frames 5000
    python benchmarks/tracker_run.py --frames 440 --step knock --step-at 340

A short simulated drive (no time offset) is played forth and back under rising stamps: a drive reversed in
time is a drive. Times are CPU seconds of this process on one thread, for a busy machine must not count.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import resource
import time
from collections.abc import Iterator

import cv2
import gtsam
import numpy as np

from sst_graph import Tracker, TrackerConfig
from sst_graph.data.simulator import SimulatedDrive, SimulationConfig, simulate
from sst_graph.estimators.tracker_config import DriftConfig
from sst_graph.types import CameraImage, Frame

PERIOD_NS = 100_000_000
KNOCK = gtsam.Rot3.Ry(np.radians(1.0))


def endless(frames: list[Frame], total: int) -> Iterator[Frame]:
    """The frames forth and back, with new stamps."""
    order = [*range(len(frames)), *range(len(frames) - 2, 0, -1)]
    for k in range(total):
        frame, stamp = frames[order[k % len(order)]], k * PERIOD_NS
        assert frame.scan is not None and frame.image is not None
        yield Frame(
            k,
            dataclasses.replace(frame.scan, stamp_ns=stamp),
            dataclasses.replace(frame.image, stamp_ns=stamp),
        )


def changed(image: CameraImage, drive: SimulatedDrive, step: str) -> CameraImage:
    """The image after a camera knock of 1 deg, or a clock jump of 30 ms."""
    if step == "clock":
        return dataclasses.replace(image, stamp_ns=image.stamp_ns + 30_000_000)
    K = drive.camera.matrix
    H = K @ KNOCK.matrix() @ np.linalg.inv(K)
    size = (drive.camera.width, drive.camera.height)
    mask = cv2.warpPerspective(image.mask, H, size, flags=cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
    return dataclasses.replace(image, mask=mask)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=5000)
    parser.add_argument("--drive-frames", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--drift", action="store_true")
    parser.add_argument("--step", choices=("none", "knock", "clock"), default="none")
    parser.add_argument("--step-at", type=int, default=0)
    args = parser.parse_args()
    cv2.setNumThreads(1)
    drive = simulate(
        SimulationConfig(
            seed=args.seed,
            frames=args.drive_frames,
            motion="stop_and_go",
            time_offset_s=0.0,
            azimuth_limit_deg=60.0,
        )
    )
    frames = list(drive)
    tracker = Tracker(drive.camera, TrackerConfig(drift=DriftConfig(enabled=args.drift)), drive.nominal)
    costs, memory, alarms, chi2 = [], [], [], []
    for frame in endless(frames, args.frames):
        if args.step != "none" and frame.index >= args.step_at:
            assert frame.image is not None
            frame = dataclasses.replace(frame, image=changed(frame.image, drive, args.step))
        began = time.process_time()
        update = tracker.add(frame)
        costs.append(1e3 * (time.process_time() - began))
        memory.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
        if update.alarm:
            alarms.append(frame.index)
        if update.chi2 is not None:
            chi2.append(update.chi2)
    settled = np.array(costs[100:])
    block = min(500, len(settled) // 2)
    truth = drive.truth.cTl
    if args.step == "knock":
        truth = gtsam.Pose3(KNOCK, np.zeros(3)) * truth
    error = truth.between(tracker.point.cTl)
    report = {
        "frames": args.frames,
        "ms_median": float(np.median(settled)),
        "ms_p99": float(np.quantile(settled, 0.99)),
        "ms_last_over_first": float(settled[-block:].mean() / settled[:block].mean()),
        "memory_mb_after_200": memory[min(200, len(memory) - 1)],
        "memory_mb_at_end": memory[-1],
        "alarms": alarms,
        "chi2_max": max(chi2, default=None),
        "chi2_p999": float(np.quantile(chi2, 0.999)) if chi2 else None,
        "labelled_points": int(np.median([(f.scan.classes == 1).sum() for f in frames if f.scan])),
        "rotation_error_deg": float(np.degrees(np.linalg.norm(gtsam.Rot3.Logmap(error.rotation())))),
        "translation_error_m": float(np.linalg.norm(error.translation())),
        "time_offset_s": tracker.point.offset_s,
        "sigmas": np.sqrt(np.diag(tracker.covariance)[:7]).tolist(),
    }
    print(json.dumps(report, indent=2))


if __name__ == "__main__":
    main()

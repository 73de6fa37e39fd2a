"""A long run of the tracker: cost of a frame, its growth, memory, alarms. Prints one JSON document.

    OMP_NUM_THREADS=1 python -m benchmarks.tracker_run --frames 5000
    OMP_NUM_THREADS=1 python -m benchmarks.tracker_run --frames 5000 --markdown
    OMP_NUM_THREADS=1 python -m benchmarks.tracker_run --frames 300 --checkpoint-every 10
    OMP_NUM_THREADS=1 python -m benchmarks.tracker_run --frames 300 --street heavy
    OMP_NUM_THREADS=1 python -m benchmarks.tracker_run --frames 440 --step knock --step-at 340

    OMP_NUM_THREADS=1 python -m benchmarks.tracker_run --drive DATA --image-shift 1 --checkpoint-every 10

Streets: ``plain`` has about 5,000 labelled points a scan, ``heavy`` twice as many. A simulated drive (no
time offset) is played forth and back under rising stamps: a drive reversed in time is a drive. Times are
CPU seconds of this process on one thread, for a busy machine must not count. ``all_frames`` are all, from the
first on, with the start and the saves; the other times are of those after the first hundred, with those in
which the window is relinearized, which are given apart as well.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import resource
import tempfile
import time
from collections.abc import Iterator

import cv2
import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph import Tracker, TrackerConfig, open_source
from sst_graph.experiments import markdown
from sst_graph.simulator import SimulationConfig, simulate
from sst_graph.tracker.config import DriftConfig
from sst_graph.tracker.storage.checkpoint import Saver
from sst_graph.tracker.track_update import TrackUpdate
from sst_graph.types import Frame
from studies.tracker_steps import Step

PERIOD_NS = 100_000_000
WARM_UP = 100
STREETS = {
    "plain": SimulationConfig(seed=3, vehicle_density=0.06),
    "heavy": SimulationConfig(seed=1),
}
STEPS = {step.name: step for step in (Step("knock", (0.0, 1.0, 0.0)), Step("clock", late_ms=30.0))}


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


def _quantiles(costs: NDArray[np.float64]) -> dict[str, float]:
    """Median, 99 % and largest of some frames' costs [ms]."""
    if len(costs) == 0:
        return {}
    return {
        "median": float(np.median(costs)),
        "p99": float(np.quantile(costs, 0.99)),
        "max": float(costs.max()),
        "max_over_median": float(costs.max() / np.median(costs)),
    }


def table(costs_ms: NDArray[np.float64], memory_mb: NDArray[np.float64]) -> str:
    """Cost of a frame and largest memory until then, of all frames and of each fifth of them."""
    rows = []
    for part in (np.arange(len(costs_ms)), *np.array_split(np.arange(len(costs_ms)), 5)):
        own = costs_ms[part]
        median, p99, slowest = np.median(own), np.quantile(own, 0.99), own.max()
        cells = [f"{median:.1f}", f"{p99 / median:.2f}", f"{slowest / median:.2f}"]
        cells += [str(part[own.argmax()]), f"{memory_mb[part[-1]]:.0f}"]
        rows.append([f"{part[0]:,} to {part[-1]:,}", *cells])
    return markdown.table(
        "| frames | median [ms] | p99 / median | slowest / median | its frame | memory [MB] |", rows
    )


class Timed:
    """A tracker that saves now and then, and what each frame costs with that."""

    def __init__(self, tracker: Tracker, saver: Saver, every: int) -> None:
        """every: frames between saves; 0: none."""
        self.tracker, self._saver, self._every = tracker, saver, every
        self.ms: list[float] = []
        self.saves: list[bool] = []

    def add(self, frame: Frame) -> TrackUpdate:
        began, k = time.process_time(), len(self.ms)
        if self._every:
            self._saver.follow(self.tracker)
        update = self.tracker.add(frame)
        self.saves.append(self._every > 0 and k % self._every == self._every - 1)
        if self.saves[-1]:
            self._saver.save(self.tracker)
        self.ms.append(1e3 * (time.process_time() - began))
        return update

    def report(self) -> dict[str, object]:
        """All frames, and those with a save."""
        each, saves = np.array(self.ms), np.array(self.saves)
        return {
            "all_frames": _quantiles(each),
            "with_a_save": _quantiles(each[saves]),
            "largest": {int(k): float(each[k]) for k in np.argsort(-each)[:5]},
        }


def drive_report(path: str, image_shift: int, every: int, config: TrackerConfig) -> dict[str, object]:
    """Cost of each frame of a drive, and of solving the window at its end."""
    source, started = open_source(path, image_shift=image_shift), None
    with tempfile.TemporaryDirectory() as folder, Saver(f"{folder}/tracker.npz") as saver:
        timed = Timed(Tracker(source.camera, config, source.nominal), saver, every)
        for k, frame in enumerate(source):
            timed.add(frame)
            started = k if started is None and timed.tracker.estimate.exists else started
    began = time.process_time()
    last = timed.tracker.optimize()
    return {
        "frames": len(timed.ms),
        "started_with_frame": started,
        **timed.report(),
        "optimize_s": time.process_time() - began,
        "status": last.status,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=5000)
    parser.add_argument("--drive-frames", type=int, default=40)
    parser.add_argument("--street", choices=tuple(STREETS), default="plain")
    parser.add_argument("--drift", action="store_true")
    parser.add_argument("--step", choices=("none", *STEPS), default="none")
    parser.add_argument("--step-at", type=int, default=0)
    parser.add_argument("--drive", help="a drive on disk instead of a street: the cost of all its frames")
    parser.add_argument("--image-shift", type=int, default=0)
    parser.add_argument("--checkpoint-every", type=int, default=0, help="frames between saves; 0: none")
    parser.add_argument("--markdown", action="store_true", help="a table instead of JSON (streets only)")
    args = parser.parse_args()
    config = TrackerConfig(drift=DriftConfig(enabled=args.drift))
    if args.drive is not None:
        cv2.setNumThreads(1)
        report = drive_report(args.drive, args.image_shift, args.checkpoint_every, config)
        print(json.dumps(report, indent=2))
        return
    if args.frames < WARM_UP + 20:
        parser.error(f"--frames {args.frames}: expected {WARM_UP + 20} or more, for {WARM_UP} warm up")
    cv2.setNumThreads(1)
    drive = simulate(
        dataclasses.replace(
            STREETS[args.street],
            frames=args.drive_frames,
            motion="stop_and_go",
            time_offset_s=0.0,
            azimuth_limit_deg=60.0,
        )
    )
    frames, step = list(drive), STEPS.get(args.step)
    tracker = Tracker(drive.camera, config, drive.nominal)
    memory, alarms, chi2, relinearizing, started = [], [], [], [], None
    with tempfile.TemporaryDirectory() as folder, Saver(f"{folder}/tracker.npz") as saver:
        timed = Timed(tracker, saver, args.checkpoint_every)
        for frame in endless(frames, args.frames):
            if step is not None and frame.index >= args.step_at:
                assert frame.image is not None
                frame = dataclasses.replace(frame, image=step.applied(frame.image, drive))
            relinearizing.append(tracker.estimate.relinearization is not None)
            update = timed.add(frame)
            started = frame.index if started is None and tracker.estimate.exists else started
            memory.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
            if update.alarm:
                alarms.append(frame.index)
            if update.chi2 is not None:
                chi2.append(update.chi2)
    costs = timed.ms
    if args.markdown:
        print(table(np.array(costs), np.array(memory)))
        print(f"{len(alarms)} alarms, largest statistic {max(chi2, default=0.0):.1f}.")
        return
    steady, settles = np.array(costs[WARM_UP:]), np.array(relinearizing[WARM_UP:])
    block = min(500, len(steady) // 2)
    truth = drive.truth.cTl
    if step is not None:
        truth = gtsam.Pose3(step.rotation, np.zeros(3)) * truth
    error = truth.between(tracker.estimate.point.cTl)
    report = {
        "frames": args.frames,
        "street": args.street,
        "labelled_points": int(np.median([(f.scan.classes == 1).sum() for f in frames if f.scan])),
        "points": int(np.median([len(f.scan.points) for f in frames if f.scan])),
        "started_with_frame": started,
        **timed.report(),
        "ms_median": float(np.median(steady)),
        "ms_p99": float(np.quantile(steady, 0.99)),
        "ms_max": float(steady.max()),
        "relinearizing_frames": int(settles.sum()),
        "ms_relinearizing": _quantiles(steady[settles]),
        "ms_not_relinearizing": _quantiles(steady[~settles]),
        "ms_last_over_first": float(steady[-block:].mean() / steady[:block].mean()),
        "memory_mb_after_200": memory[min(200, len(memory) - 1)],
        "memory_mb_at_end": memory[-1],
        "alarms": alarms,
        "chi2_max": max(chi2, default=None),
        "chi2_p999": float(np.quantile(chi2, 0.999)) if chi2 else None,
        "rotation_error_deg": float(np.degrees(np.linalg.norm(gtsam.Rot3.Logmap(error.rotation())))),
        "translation_error_m": float(np.linalg.norm(error.translation())),
        "time_offset_s": tracker.estimate.point.time_offset_s,
        "sigmas": np.sqrt(np.diag(tracker.estimate.covariance)[:7]).tolist(),
    }
    print(json.dumps(report, indent=2))


if __name__ == "__main__":
    main()

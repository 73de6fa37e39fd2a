"""The tracker by edges at the end of a drive: status, errors, sigmas, time. Prints a table.

    OMP_NUM_THREADS=1 python -m studies.edges_tracker own-504 own-507 third-901
    OMP_NUM_THREADS=1 python -m studies.edges_tracker DRIVE              a folder, with --image-shift 1

Starts of the streets are those of ``studies/edges_streets.py``, that of a drive is 5.6 deg and 11 cm off. Of
a drive's labels only the masks are read, which keep moving things out of visual odometry: a folder without
label files is a drive that nobody labelled. Errors and sigmas are in the LiDAR's axes: roll, pitch, yaw;
forward, left, up. ``--at-once`` makes the start with the frame that it is due with, so that a short drive
shows the estimate frame by frame.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from sst_graph import CalibrationConfig, Tracker, TrackerConfig
from sst_graph.odometry.sweep import with_sweep
from studies.edges_streets import row, source_of, start_step

AWAY = np.array([*np.radians([3.0, -4.0, 2.5]), 0.06, -0.08, 0.05])


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("names", nargs="+")
    parser.add_argument("--at-once", action="store_true")
    arguments = parser.parse_args()
    for name in arguments.names:
        drive = with_sweep(source_of(name), True)
        truth = drive.truth
        if truth is None or truth.time_offset_s is None:
            parser.error(f"{name}: no reference calibration")
        begin = truth.cTl.retract(start_step(name) if name.startswith(("own-", "third-")) else AWAY)
        config = TrackerConfig(calibration=CalibrationConfig(method="edges"))
        tracker = Tracker(drive.camera, config, begin, sweep=drive.sweep_decision)
        if arguments.at_once:
            tracker.initializer.work_per_frame = None
        seconds, statuses = [], list[str]()
        for frame in drive:
            began = time.process_time()
            statuses.append(tracker.add(frame).status)
            seconds.append(time.process_time() - began)
        began = time.process_time()
        update = tracker.optimize()
        late = update.time_offset_s - truth.time_offset_s
        error = np.append(truth.cTl.localCoordinates(update.T_camera_lidar), late)
        print(f"{name}: {update.status}, {1e3 * np.median(seconds):.0f} ms a frame (median), ", end="")
        print(f"the slowest {1e3 * max(seconds):.0f} ms, the window at the end ", end="")
        print(f"{time.process_time() - began:.0f} s; before: {', '.join(dict.fromkeys(statuses))}")
        print(f"  errors {row(error)}\n  sigmas {row(update.sigmas)}", flush=True)
        for reason in (*update.contradictions, *(weak.sentence for weak in update.weak_directions)):
            print(f"  {reason}")


if __name__ == "__main__":
    main()

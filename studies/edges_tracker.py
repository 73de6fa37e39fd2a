"""The tracker by edges at the end of a drive: status, errors, sigmas, time. Prints a table.

    OMP_NUM_THREADS=1 python -m studies.edges_tracker own-504 own-507 third-901
    OMP_NUM_THREADS=1 python -m studies.edges_tracker DRIVE              a folder, with --image-shift 1

Starts of the streets are those of ``studies/edges_streets.py``, that of a drive is 5.6 deg and 11 cm off. Of
a drive's labels only the masks are read, which keep moving things out of visual odometry: a folder without
label files is a drive that nobody labelled. Errors and sigmas are in the LiDAR's axes: roll, pitch, yaw;
forward, left, up. ``--at-once`` makes the start with the frame that it is due with, so that a short drive
shows the estimate frame by frame. Contradictions and weak directions go to stderr.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence

import numpy as np

from sst_graph import CalibrationConfig, Tracker, TrackerConfig
from sst_graph.experiments.markdown import lines
from sst_graph.experiments.starts import error_of
from sst_graph.odometry.sweep import with_sweep
from studies.edges_streets import cells, short, sigma_cells, source_of, start_step

AWAY = np.array([*np.radians([3.0, -4.0, 2.5]), 0.06, -0.08, 0.05])


HEAD = (
    "| drive | rotation [deg] | translation [cm] | time offset [ms] | sigma: rotation | translation "
    "| time offset | largest error [sigma] | status | a frame [ms]: median, largest | window at the end [s] |"
)


def cells_of(name: str, at_once: bool) -> Sequence[str]:
    """The cells of one drive."""
    drive = with_sweep(source_of(name), True)
    truth = drive.truth
    if truth is None or truth.time_offset_s is None:
        raise SystemExit(f"{name}: no reference calibration")
    begin = truth.cTl.retract(start_step(name) if name.startswith(("own-", "third-")) else AWAY)
    config = TrackerConfig(calibration=CalibrationConfig(method="edges"))
    tracker = Tracker(drive.camera, config, begin, sweep=drive.sweep_decision)
    if at_once:
        tracker.initializer.work_per_frame = None
    seconds = []
    for frame in drive:
        began = time.process_time()
        tracker.add(frame)
        seconds.append(time.process_time() - began)
    began = time.process_time()
    update = tracker.optimize()
    at_end = time.process_time() - began
    for reason in (*update.contradictions, *(weak.sentence for weak in update.weak_directions)):
        print(f"{name}: {reason}", file=sys.stderr, flush=True)
    error = error_of(update.calibration, truth)
    worst = float(np.abs(error / update.sigmas).max())
    milliseconds = 1e3 * np.array(seconds)
    return (
        short(name),
        *cells(error),
        *sigma_cells(update.covariance),
        f"{worst:.1f}",
        update.status,
        f"{np.median(milliseconds):.0f}, {milliseconds.max():.0f}",
        f"{at_end:.0f}",
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("names", nargs="+")
    parser.add_argument("--at-once", action="store_true")
    arguments = parser.parse_args()
    for line in lines(HEAD, (cells_of(name, arguments.at_once) for name in arguments.names)):
        print(line, flush=True)


if __name__ == "__main__":
    main()

"""Sigmas of a drive by ``calibrate`` and by the tracker, its window solved, with labels and by edges.

    OMP_NUM_THREADS=1 python -m studies.tracker_at_one_speed PARKED

The tracker's graph has no motion factor: at one speed it does not separate forward translation from time
offset. Prints a table.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from sst_graph import CalibrationConfig, Tracker, TrackerConfig, calibrate, open_source
from sst_graph.batch.config import Method
from sst_graph.experiments.markdown import lines
from sst_graph.odometry.sweep import with_sweep

HEAD = "| | by | sigma: forward [cm] | time offset [ms] | status |"
METHODS: dict[str, Method] = {"labels": "joint", "edges": "edges"}


def rows(path: str, shift: int) -> Iterator[list[str]]:
    """Both ways with either method, all from the start that the drive brings."""
    source = with_sweep(open_source(path, image_shift=shift), True)
    for name, method in METHODS.items():
        config = CalibrationConfig(method=method)
        result = calibrate(source, source.nominal, config)
        yield ["`calibrate`", name, *_sigmas(result.covariance), result.status]
        tracker = Tracker(
            source.camera, TrackerConfig(calibration=config), source.nominal, sweep=source.sweep_decision
        )
        for frame in source:
            tracker.add(frame)
        update = tracker.optimize()
        assert update.covariance is not None
        yield ["`track`", name, *_sigmas(update.covariance), update.status]


def _sigmas(covariance: NDArray[np.float64]) -> list[str]:
    """Of forward translation [cm] and time offset [ms]."""
    forward_m, late_s = np.sqrt(np.diag(covariance))[[3, 6]]
    return [f"{100.0 * forward_m:.1f}", f"{1e3 * late_s:.1f}"]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("data", help="folder of a drive")
    parser.add_argument("--image-shift", type=int, default=1)
    args = parser.parse_args()
    for line in lines(HEAD, rows(args.data, args.image_shift)):
        print(line, flush=True)


if __name__ == "__main__":
    main()

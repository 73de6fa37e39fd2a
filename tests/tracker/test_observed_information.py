"""What is kept of scans that leave the window follows the estimate, as the robust kernel has it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from streets import HALF_SIZE

from sst_graph import Tracker, TrackerConfig
from sst_graph.simulator import simulate
from sst_graph.tracker.sums.linearized_pair import linearize_pairs
from sst_graph.tracker.sums.rows import PairColumns


@pytest.fixture(scope="module")
def tracker() -> Tracker:
    """After 24 frames, of which most have left the window."""
    street = simulate(
        dataclasses.replace(HALF_SIZE, seed=3, frames=24, time_offset_s=0.05, motion="stop_and_go")
    )
    default = TrackerConfig(start_scans=8, window=10)
    search = dataclasses.replace(default.calibration.search, enabled=False)
    calibration = dataclasses.replace(default.calibration, search=search)
    tracker = Tracker(
        street.camera, dataclasses.replace(default, calibration=calibration), street.truth.cTl, 0.05
    )
    tracker.initializer.work_per_frame = None
    for frame in street:
        tracker.add(frame)
    return tracker


@pytest.mark.slow
def test_the_observed_information_predicts_the_gradient_elsewhere(tracker: Tracker) -> None:
    """The same matches, biases moved by 0.4 px: the gradient is nearer to the one by the curvatures."""
    assert tracker.estimate.smoother is not None
    by_weight, by_curvature = [], []
    for number, entry in tracker.estimate.smoother.entries.items():
        linear = entry.linear
        step = np.zeros(linear.information.point.size)
        step[7:] = 0.4
        there = linear.information.point.moved(step)
        tracks = tracker.inputs.window.tracks[number]
        columns = PairColumns(tracker.matcher.classes, tracks)
        (relinearized,) = linearize_pairs([entry.pair], there, [columns])
        fresh = relinearized.information.vector
        own = slice(linear.information.point.core_size, linear.information.point.size)
        by_weight.append((linear.information.without_held().at(there).vector - fresh)[own].sum())
        by_curvature.append((linear.observed.without_held().at(there).vector - fresh)[own].sum())
    assert abs(sum(by_curvature)) < 0.5 * abs(sum(by_weight))

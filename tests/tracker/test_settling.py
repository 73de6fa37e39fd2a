"""A running tracker settles with the frames that come, a little with each."""

from __future__ import annotations

import dataclasses
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from streets import TRACKED_STREET, sigmas_apart, tracker_from_truth

from sst_graph import TrackerConfig
from sst_graph.simulator import SimulatedDrive, simulate
from sst_graph.tracker.storage.checkpoint import load_checkpoint, save_checkpoint
from sst_graph.types import Frame


@cache
def _street() -> SimulatedDrive:
    return simulate(dataclasses.replace(TRACKED_STREET, frames=34))


@pytest.fixture(scope="module")
def begun(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Frame]]:
    """Checkpoint of a tracker that has settled for a frame, begun at the truth, and the frames to come."""
    street, config = _street(), TrackerConfig(start_scans=8, start_work=0, window=18, settle_scans=8)
    tracker = tracker_from_truth(street, config)
    frames = list(street)
    for k, frame in enumerate(frames):
        settled = tracker.relinearization is not None
        tracker.add(frame)
        if settled and tracker.relinearization is not None:
            path = tmp_path_factory.mktemp("tracker") / "settling.npz"
            save_checkpoint(tracker, path)
            return path, frames[k + 1 :]
    raise AssertionError("the tracker does not settle")


def test_a_checkpoint_keeps_the_settling(begun: tuple[Path, list[Frame]]) -> None:
    tracker = load_checkpoint(begun[0])
    assert tracker.relinearization is not None and tracker.window.growing
    # With one frame, edges towards the ground have been looked at; the newest scan is matched as it comes.
    assert len(tracker.relinearization.done) == (tracker.config.settle_scans + 1) // 2 + 1
    assert tracker.relinearization.below is not None and tracker.relinearization.below.narrow


def test_a_running_tracker_settles_with_the_frames_that_come(begun: tuple[Path, list[Frame]]) -> None:
    tracker, coming = load_checkpoint(begun[0]), begun[1]
    oldest, sizes = tracker.window.first_scan, []
    for frame in coming:
        assert tracker.add(frame).accepted
        # Nothing leaves before it is settled, though the window is full.
        assert tracker.window.first_scan == oldest
        sizes.append(len(tracker.window.scans))
        if tracker.relinearization is None:
            break
    assert tracker.relinearization is None and sizes[-1] > tracker.config.window
    assert tracker.smoother is not None
    assert set(tracker.smoother.entries) == {number for number, _ in tracker.window.scans}
    # What was held leaves two at a time.
    assert tracker.window.leaving() == [oldest, oldest + 1]
    found, covariance = tracker.point, tracker.covariance.copy()
    assert tracker.settle()
    assert sigmas_apart(tracker, found.cTl, found.offset_s) < 1.0
    np.testing.assert_allclose(np.diag(tracker.covariance), np.diag(covariance), rtol=0.5)


def test_a_settling_that_was_begun_again_ends_alike(begun: tuple[Path, list[Frame]]) -> None:
    once, again, coming = load_checkpoint(begun[0]), load_checkpoint(begun[0]), begun[1]
    again.stop_relinearization()
    assert not again.window.growing and again.add(coming[0]).accepted
    again.begin_relinearization()
    once.add(coming[0])
    for frame in coming[1:]:
        once.add(frame)
        again.add(frame)
    assert once.relinearization is None and again.relinearization is None
    assert sigmas_apart(once, again.point.cTl, again.point.offset_s) < 0.5

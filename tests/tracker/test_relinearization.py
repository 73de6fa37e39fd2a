"""The window of a running tracker is relinearized with the frames that come, some of it with each."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from stored import simulated, stored
from streets import TRACKED_STREET, checkpoint_of, sigmas_apart, tracker_from_truth

from sst_graph import Tracker, TrackerConfig
from sst_graph.tracker.window.relinearization import SCANS
from sst_graph.types import Frame

STREET = dataclasses.replace(TRACKED_STREET, frames=40)
CONFIG = TrackerConfig(start_scans=8, window=18)


def _begun() -> tuple[bytes, int]:
    """Checkpoint of a tracker one frame into a relinearization of its window, and the frames it has seen."""
    street = simulated(STREET)
    tracker = tracker_from_truth(street, CONFIG)
    for k, frame in enumerate(street):
        under_way = tracker.estimate.relinearization is not None
        tracker.add(frame)
        if under_way and tracker.estimate.relinearization is not None:
            return checkpoint_of(tracker), k + 1
    raise AssertionError("the window is not relinearized")


@pytest.fixture(scope="module")
def begun(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Frame]]:
    """The checkpoint, and the frames to come."""
    content, seen = stored(("begun", STREET, CONFIG), _begun)
    path = tmp_path_factory.mktemp("tracker") / "relinearizing.npz"
    path.write_bytes(content)
    street = simulated(STREET)
    return path, [street[k] for k in range(seen, len(street))]


@pytest.mark.slow
def test_a_checkpoint_keeps_the_relinearization(begun: tuple[Path, list[Frame]]) -> None:
    tracker = Tracker.load(begun[0])
    assert tracker.estimate.relinearization is not None and tracker.inputs.window.growing
    # With one frame, lower edges have been checked; the newest scan is matched as it comes.
    assert len(tracker.estimate.relinearization.done) == (SCANS + 1) // 2 + 1
    assert (
        tracker.estimate.relinearization.support is not None
        and tracker.estimate.relinearization.support.narrow
    )


@pytest.mark.slow
def test_the_window_is_relinearized_with_the_frames_that_come(begun: tuple[Path, list[Frame]]) -> None:
    tracker, coming = Tracker.load(begun[0]), begun[1]
    oldest, sizes = tracker.inputs.window.first_scan, []
    for frame in coming:
        assert tracker.add(frame).accepted
        # Nothing leaves before it is done, though the window is full.
        assert tracker.inputs.window.first_scan == oldest
        sizes.append(len(tracker.inputs.window.scans))
        if tracker.estimate.relinearization is None:
            break
    assert tracker.estimate.relinearization is None and sizes[-1] > tracker.setup.config.window
    assert tracker.estimate.smoother is not None
    assert set(tracker.estimate.smoother.entries) == {number for number, _ in tracker.inputs.window.scans}
    # What was held leaves two at a time.
    assert tracker.inputs.window.leaving() == [oldest, oldest + 1]
    found, covariance = tracker.estimate.point, tracker.estimate.covariance.copy()
    assert tracker.optimize().converged
    assert sigmas_apart(tracker, found.cTl, found.time_offset_s) < 1.0
    np.testing.assert_allclose(np.diag(tracker.estimate.covariance), np.diag(covariance), rtol=0.5)


@pytest.mark.slow
def test_a_relinearization_that_was_begun_again_ends_alike(begun: tuple[Path, list[Frame]]) -> None:
    once, again, coming = Tracker.load(begun[0]), Tracker.load(begun[0]), begun[1]
    again.estimate.stop_relinearization()
    assert not again.inputs.window.growing and again.add(coming[0]).accepted
    again.estimate.begin_relinearization()
    once.add(coming[0])
    for frame in coming[1:]:
        once.add(frame)
        again.add(frame)
        if once.estimate.relinearization is None and again.estimate.relinearization is None:
            break
    assert once.estimate.relinearization is None and again.estimate.relinearization is None
    assert sigmas_apart(once, again.estimate.point.cTl, again.estimate.point.time_offset_s) < 0.5

"""A start that is spread over frames: the same estimate as at once, the same however it was interrupted."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
from streets import EARLY_START, sigmas_apart, tracker_from_truth

from sst_graph import Tracker
from sst_graph.errors import EstimationError
from sst_graph.files.object_store import stored
from sst_graph.simulator import SimulatedDrive
from sst_graph.stepwise import Stepwise, whole
from sst_graph.tracker.start.solution import Guess, estimating_first
from sst_graph.tracker.start.steps import _Run
from sst_graph.tracker.storage.checkpoint import load_checkpoint, save_checkpoint
from sst_graph.tracker.storage.snapshot import Snapshot
from sst_graph.types import Frame

SPREAD = dataclasses.replace(EARLY_START, start_work=30)


def test_the_estimate_comes_some_frames_later_and_is_the_same(
    street: SimulatedDrive, frames: list[Frame]
) -> None:
    at_once, spread = tracker_from_truth(street), tracker_from_truth(street, SPREAD)
    for frame in frames:
        a, b = at_once.add(frame), spread.add(frame)
        assert not a.refused and not b.refused
        if not spread.started:
            assert b.reason in ("collecting frames for a start", "looking for a start")
    assert at_once.started and spread.started
    assert len(spread.window.scans) == len(frames) == spread.window.next_scan
    for tracker in (at_once, spread):
        tracker.settle()
    assert sigmas_apart(at_once, spread.point.cTl, spread.point.offset_s) < 0.3


def test_stored_and_taken_back_on_the_way(
    street: SimulatedDrive, frames: list[Frame], tmp_path: Path
) -> None:
    """A checkpoint in the middle of a start, and frames that are taken back: the rest is the same."""
    kept, other = tracker_from_truth(street, SPREAD), tracker_from_truth(street, SPREAD)
    path, saved = tmp_path / "tracker.npz", 0
    for frame in frames[:30]:
        before = Snapshot(other)
        state = stored(other)
        other.add(frame)
        before.restore()
        assert stored(other) == state
        kept.add(frame)
        other.add(frame)
        if other.starting.under_way:
            for tracker in (kept, other):
                save_checkpoint(tracker, path)
            other, saved = load_checkpoint(path), saved + 1
        assert other.started == kept.started
    assert saved > 1 and kept.started
    assert sigmas_apart(kept, other.point.cTl, other.point.offset_s) < 1e-5


def test_a_drive_that_ends_before_the_start_is_done(street: SimulatedDrive, frames: list[Frame]) -> None:
    """Settling brings it to its end, and the answer is as if it had begun in time."""
    slow = tracker_from_truth(street, dataclasses.replace(EARLY_START, start_work=1))
    for frame in frames[:24]:
        update = slow.add(frame)
    assert not slow.started and update.covariance is None
    slow.settle()
    last = slow.current(update)
    assert last.settled and last.accepted and last.covariance is not None
    assert last.status in ("ok", "unobservable")
    assert sigmas_apart(slow, street.truth.cTl, street.truth.time_offset_s or 0.0) < 5.0


def test_each_step_of_a_start_is_small(street: SimulatedDrive, frames: list[Frame]) -> None:
    """With the search, too: what one step is said to cost, and that there are many."""
    tracker = Tracker(street.camera, initial=street.nominal)
    for frame in frames[:11]:
        tracker.add(frame)
    drive, _ = tracker.window.drive()
    steps = list(estimating_first(drive, Guess(street.nominal, 0.0), tracker.config))
    assert max(steps) <= 12 and len(steps) > 100


def test_the_graph_of_a_start_is_made_some_scans_a_frame(street: SimulatedDrive, frames: list[Frame]) -> None:
    """No frame matches all scans of the start, and what a save in between holds is the same."""
    tracker, most, seen = tracker_from_truth(street, dataclasses.replace(SPREAD, start_work=6)), 0, set()
    for frame in frames[:34]:
        before = None if tracker.starting.entering is None else len(tracker.starting.entering.waiting)
        tracker.add(frame)
        entering = tracker.starting.entering
        if before is not None and entering is not None:
            phase = entering.below is None
            most, seen = max(most, before - len(entering.waiting)), seen | {phase}
    assert tracker.started and seen == {False, True} and most <= 6


def test_the_answer_is_told_when_the_work_was_asked_for() -> None:
    def counting() -> Stepwise[int]:
        for _ in range(5):
            yield 2
        return 7

    run = _Run(counting())  # type: ignore[arg-type]
    assert [run.until(work) for work in (4, 10, 3, 11, 10)] == [None, None, None, 7, None]
    assert _Run(counting()).until(None) == 7 == whole(counting())  # type: ignore[arg-type]


def test_a_failure_is_told_each_time() -> None:
    def failing() -> Stepwise[int]:
        yield 1
        raise EstimationError("nothing to see")

    run = _Run(failing())  # type: ignore[arg-type]
    assert run.until(1) is None
    for _ in range(2):
        with pytest.raises(EstimationError, match="nothing to see"):
            run.until(2)

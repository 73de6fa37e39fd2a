"""A start that is spread over frames: the same estimate as at once, the same however it was interrupted."""

from __future__ import annotations

from pathlib import Path

import pytest
from streets import sigmas_apart, tracker_from_truth

from sst_graph import Tracker
from sst_graph.errors import EstimationError
from sst_graph.files.object_store import stored
from sst_graph.simulator import SimulatedDrive
from sst_graph.stepwise import Stepwise, run_to_end
from sst_graph.tracker.spread_work import Run
from sst_graph.tracker.start.first_estimate import StartGuess
from sst_graph.tracker.start.solution import first_estimate_steps
from sst_graph.tracker.storage.snapshot import Snapshot
from sst_graph.types import Frame


def spread_over(street: SimulatedDrive, work_per_frame: int | None) -> Tracker:
    """A tracker whose start takes so much work with each frame; None: all with one."""
    tracker = tracker_from_truth(street)
    tracker.initializer.work_per_frame = work_per_frame
    return tracker


@pytest.mark.slow
def test_the_estimate_comes_some_frames_later_and_is_the_same(
    street: SimulatedDrive, frames: list[Frame]
) -> None:
    at_once, spread = spread_over(street, None), spread_over(street, 30)
    for frame in frames:
        a, b = at_once.add(frame), spread.add(frame)
        assert not a.refused and not b.refused
        if not spread.estimate.exists:
            assert b.reason in ("collecting frames for a start", "searching for a start")
    assert at_once.estimate.exists and spread.estimate.exists
    assert len(spread.inputs.window.scans) == len(frames) == spread.inputs.window.next_scan
    for tracker in (at_once, spread):
        tracker.optimize()
    assert sigmas_apart(at_once, spread.estimate.point.cTl, spread.estimate.point.time_offset_s) < 0.3


@pytest.mark.slow
def test_stored_and_rolled_back_on_the_way(
    street: SimulatedDrive, frames: list[Frame], tmp_path: Path
) -> None:
    """A checkpoint in the middle of a start, and frames that are rolled back: the rest is the same."""
    kept, other = spread_over(street, 30), spread_over(street, 30)
    path, saved = tmp_path / "tracker.npz", 0
    for frame in frames[:30]:
        before = Snapshot(other)
        state = stored(other)
        other.add(frame)
        before.restore()
        assert stored(other) == state
        kept.add(frame)
        other.add(frame)
        if other.initializer.under_way:
            for tracker in (kept, other):
                tracker.save(path)
            other, saved = Tracker.load(path), saved + 1
        assert other.estimate.exists == kept.estimate.exists
    assert saved > 1 and kept.estimate.exists
    assert sigmas_apart(kept, other.estimate.point.cTl, other.estimate.point.time_offset_s) < 1e-5


@pytest.mark.slow
def test_a_drive_that_ends_before_the_start_is_done(street: SimulatedDrive, frames: list[Frame]) -> None:
    """Solving the window brings it to its end, and the answer is as if it had begun in time."""
    slow = spread_over(street, 1)
    for frame in frames[:24]:
        update = slow.add(frame)
    assert not slow.estimate.exists and update.covariance is None
    last = slow.optimize()
    assert last.converged is not None and last.accepted and last.covariance is not None
    assert last.status in ("ok", "unobservable")
    assert sigmas_apart(slow, street.truth.cTl, street.truth.time_offset_s or 0.0) < 5.0


@pytest.mark.slow
def test_each_step_of_a_start_is_small(street: SimulatedDrive, frames: list[Frame]) -> None:
    """With the search, too: the declared cost of a step, and that there are many."""
    tracker = Tracker(street.camera, initial=street.nominal)
    for frame in frames[:11]:
        tracker.add(frame)
    drive, _ = tracker.inputs.window.drive()
    steps = list(first_estimate_steps(drive, StartGuess(street.nominal, 0.0), tracker.setup.config))
    assert max(steps) <= 12 and len(steps) > 100


@pytest.mark.slow
def test_the_graph_of_a_start_is_made_some_scans_a_frame(street: SimulatedDrive, frames: list[Frame]) -> None:
    """No frame matches all scans of the start, and what a save in between holds is the same."""
    tracker, most, seen = spread_over(street, 6), 0, set()
    for frame in frames[:34]:
        before = None if tracker.initializer.graph is None else len(tracker.initializer.graph.waiting)
        tracker.add(frame)
        graph = tracker.initializer.graph
        if before is not None and graph is not None:
            phase = graph.support is None
            most, seen = max(most, before - len(graph.waiting)), seen | {phase}
    assert tracker.estimate.exists and seen == {False, True} and most <= 6


def test_the_estimate_is_returned_when_its_work_is_requested() -> None:
    def counting() -> Stepwise[int]:
        for _ in range(5):
            yield 2
        return 7

    run = Run(counting())  # type: ignore[arg-type]
    assert [run.until(work) for work in (4, 10, 3, 11, 10)] == [None, None, None, 7, None]
    assert Run(counting()).until(None) == 7 == run_to_end(counting())  # type: ignore[arg-type]


def test_a_failure_is_raised_each_time() -> None:
    def failing() -> Stepwise[int]:
        yield 1
        raise EstimationError("nothing to see")

    run = Run(failing())  # type: ignore[arg-type]
    assert run.until(1) is None
    for _ in range(2):
        with pytest.raises(EstimationError, match="nothing to see"):
            run.until(2)

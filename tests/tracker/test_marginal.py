"""The tracker's marginal on (E, D), and its parts as it grows: nothing counts twice."""

from __future__ import annotations

import dataclasses

import gtsam
import numpy as np
import pytest
from streets import EARLY_START, tracker_from_truth

from sst_graph import Tracker
from sst_graph.errors import EstimationError
from sst_graph.export import EXTRINSIC, TIME_OFFSET, fuse_marginals
from sst_graph.simulator import SimulatedDrive
from sst_graph.tracker.marginal import TrackedMarginal, increment, moved_to
from sst_graph.tracker.track_update import current_update
from sst_graph.types import Frame

SHORT = dataclasses.replace(EARLY_START, window=10)
"""Scans leave the window from the tenth on."""


def _far(seed: int, start: int = 1) -> TrackedMarginal:
    """A marginal some degrees and decimetres from others."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(7, 7)) * np.array([300.0] * 3 + [50.0] * 3 + [200.0])
    cTl = gtsam.Pose3.Expmap(rng.normal(size=6) * 0.05)
    return TrackedMarginal(cTl, 0.02 * rng.normal(), root.T @ root, np.zeros(7), start=start)


@pytest.fixture(scope="module")
def marginals(
    street: SimulatedDrive, frames: list[Frame]
) -> tuple[TrackedMarginal, list[TrackedMarginal], Tracker]:
    """The first marginal of a tracker, what it added every four frames since, and the tracker."""
    tracker = tracker_from_truth(street, SHORT)
    first: TrackedMarginal | None = None
    parts: list[TrackedMarginal] = []
    for frame in frames[:30]:
        tracker.add(frame)
        if tracker.estimate.exists and frame.index % 4 == 1:
            if first is None:
                first = known = tracker.marginal()
            else:
                parts.append(tracker.marginal(since=known))
                known = known.plus(parts[-1])  # type: ignore[assignment]
    assert first is not None and len(parts) >= 4 and tracker.inputs.window.first_scan > 10
    parts.append(tracker.marginal(since=known))
    return first, parts, tracker


def test_the_parts_together_are_the_whole(
    marginals: tuple[TrackedMarginal, list[TrackedMarginal], Tracker],
) -> None:
    first, parts, tracker = marginals
    # Parts are no answers of their own: they are added, not compared.
    whole, fused = tracker.marginal(), fuse_marginals([first, *parts], significance=0.0)
    scale = np.sqrt(np.outer(np.diag(whole.information), np.diag(whole.information)))
    np.testing.assert_allclose(fused.information / scale, whole.information / scale, atol=1e-6)
    assert fused.cTl.equals(whole.cTl, 1e-9)
    assert fused.time_offset_s == pytest.approx(whole.time_offset_s, abs=1e-9)
    np.testing.assert_allclose(whole.covariance(), current_update(tracker).covariance, rtol=1e-6)
    # And it did grow on the way.
    assert np.linalg.slogdet(whole.information)[1] > np.linalg.slogdet(first.information)[1] + 1.0


def test_parts_without_news_are_fused_as_well() -> None:
    """What they add is rounding of either sign, whose entries beside the diagonal may be the larger ones."""
    for seed in range(20):
        whole, first = _far(seed), _far(seed + 100)
        more = increment(whole, first)
        nothing = increment(whole, first.plus(more))  # type: ignore[arg-type]
        fused = fuse_marginals([first, more, nothing], significance=0.0)
        assert fused.cTl.equals(whole.cTl, 1e-6)


def test_in_a_graph_of_one_s_own(marginals: tuple[TrackedMarginal, list[TrackedMarginal], Tracker]) -> None:
    """As factors of gtsam, added one after the other: the answer and its covariance are the tracker's."""
    first, parts, tracker = marginals
    graph = gtsam.NonlinearFactorGraph()
    for part in (first, *parts):
        graph.add(part.factor())
    values = gtsam.LevenbergMarquardtOptimizer(graph, first.point()).optimize()
    update = current_update(tracker)
    assert update.covariance is not None
    sigmas = np.sqrt(np.diag(update.covariance))
    step = gtsam.Pose3.Logmap(update.T_camera_lidar.between(values.atPose3(EXTRINSIC)))
    step = np.append(step, values.atVector(TIME_OFFSET)[0] - update.time_offset_s)
    assert np.abs(step / sigmas).max() < 1e-3
    # Counted twice, the information would be too large; in parts it is not.
    variance = gtsam.Marginals(graph, values).marginalCovariance(TIME_OFFSET)[0, 0]
    assert variance == pytest.approx(sigmas[6] ** 2, rel=1e-3)


def test_without_further_frames_a_part_adds_nothing(
    marginals: tuple[TrackedMarginal, list[TrackedMarginal], Tracker],
) -> None:
    first, parts, tracker = marginals
    known = first
    for part in parts:
        known = known.plus(part)  # type: ignore[assignment]
    nothing = tracker.marginal(since=known)
    scale = np.sqrt(np.outer(np.diag(known.information), np.diag(known.information)))
    assert np.abs(nothing.information / scale).max() < 1e-6
    whole = tracker.marginal()
    assert np.abs(tracker.marginal(since=whole).information / scale).max() < 1e-6


@pytest.mark.parametrize("seed", range(5))
def test_a_part_is_exact_however_far_the_estimate_has_moved(seed: int) -> None:
    """Fused with what was known it is the whole, though extrinsics differ by degrees and decimetres."""
    before, after = _far(seed), _far(seed + 100)
    part = increment(after, before)
    fused = fuse_marginals([before, part], significance=0.0)
    np.testing.assert_allclose(fused.information, after.information, rtol=1e-6, atol=1e-3)
    assert fused.cTl.equals(after.cTl, 1e-9) and fused.time_offset_s == pytest.approx(
        after.time_offset_s, abs=1e-10
    )
    again = moved_to(after, after)
    np.testing.assert_allclose(again.information, after.information, rtol=1e-12)
    # Some of it is taken back: that is no answer to compare with others.
    assert np.linalg.eigvalsh(part.information)[0] < 0.0
    with pytest.raises(EstimationError, match="number 1: found information of -"):
        fuse_marginals([before, part])


def test_before_a_start_and_after_a_change(street: SimulatedDrive, frames: list[Frame]) -> None:
    tracker = tracker_from_truth(street)
    with pytest.raises(EstimationError, match="no estimate yet"):
        tracker.marginal()
    assert current_update(tracker).covariance is None and current_update(tracker).covariance_reason
    for frame in frames[:9]:
        tracker.add(frame)
    known = tracker.marginal()
    other = dataclasses.replace(known, start=known.start + 1)
    with pytest.raises(EstimationError, match="the calibration has changed"):
        tracker.marginal(since=other)

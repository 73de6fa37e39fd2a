"""What is kept of scans that leave the window follows the estimate: pairings, and the robust kernel."""

from __future__ import annotations

import dataclasses

import gtsam
import numpy as np
import pytest
from sst_graph.tracker.sums.linearized_pair import linearize_pair
from sst_graph.tracker.window.pending_pairs import MOST, OtherPairing, PendingPairs

from sst_graph import Tracker, TrackerConfig
from sst_graph.simulator import SimulationConfig, simulate
from sst_graph.tracker.window.gaussian import Gaussian, Point

POINT = Point(gtsam.Pose3(), 0.05, np.array([0.3]), (4, 7), np.array([0.1, -0.2]))
N = POINT.size


def _belief(seed: int, point: Point) -> Gaussian:
    rng = np.random.default_rng(seed)
    J = rng.normal(size=(40, point.size))
    return Gaussian(point, J.T @ J, J.T @ rng.normal(size=40))


def _tied(seed: int, point: Point) -> Gaussian:
    belief = _belief(seed, point)
    return Gaussian(point, belief.information + 100.0 * np.eye(point.size), belief.vector)


def _same(a: Gaussian, b: Gaussian) -> None:
    assert a.point.tracks == b.point.tracks
    np.testing.assert_allclose(a.information, b.information, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(a.vector, b.vector, rtol=1e-9, atol=1e-9)


def test_the_past_pairs_anew_when_the_offset_passes_the_middle() -> None:
    prior, rest = _tied(0, POINT), _belief(1, POINT)
    used, other = _belief(2, POINT.seen({4: 0})), _belief(3, POINT.seen({7: 0}))
    past = prior.plus(rest).plus(used)
    undecided = PendingPairs.none(N).plus(used, OtherPairing(other, 0.06, early=False), POINT)
    stays, same = undecided.decided(past, 0.0599)
    assert stays is undecided and same is past
    flipped, changed = undecided.decided(past, 0.0601)
    _same(changed, prior.plus(rest).plus(other))
    assert flipped.early.tolist() == [True]
    back, again = flipped.decided(changed, 0.05)
    _same(again, past)
    np.testing.assert_allclose(back.vector, undecided.vector)


def test_other_pairings_follow_the_point_and_the_objects() -> None:
    """Elsewhere, with one object more and another marginalized out: as if decided before."""
    used, other = _belief(4, POINT.seen({4: 0})), _belief(5, POINT.seen({4: 0}))
    past = _tied(6, POINT).plus(used)
    undecided = PendingPairs.none(N).plus(used, OtherPairing(other, 0.04, early=True), POINT)
    expected = undecided.decided(past, 0.0)[1]
    step = np.full(N, 1e-3)
    step[:3] = 0.0  # translations add exactly
    there = POINT.moved(step)
    # A new object, then another point, then one that is gone (7, of which the pairings say nothing).
    grown = undecided.through(np.eye(N + 1, N)).moved(np.append(step, 0.0))
    past, expected = (b.with_objects({9: 0}, 0.5) for b in (past, expected))
    at = dataclasses.replace(
        there, tracks=past.point.tracks, object_biases_px=np.append(there.object_biases_px, 0.3)
    )
    past, expected = past.at(at), expected.at(at)
    (past, T), (expected, _) = past.without([7]), expected.without([7])
    found = grown.through(T).decided(past, 0.0)[1]
    # 7 is tied to the rest through the past alone, which the pairing changes by little.
    np.testing.assert_allclose(
        found.vector, expected.vector, rtol=0.05, atol=0.05 * np.abs(expected.vector).max()
    )
    scale = np.abs(expected.information).max()
    np.testing.assert_allclose(found.information, expected.information, atol=0.05 * scale)


def test_objects_that_only_the_other_pairing_sees_are_left_out() -> None:
    used, other = _belief(7, POINT.seen({4: 0})), _belief(8, POINT.seen({4: 0, 9: 0}))
    past = _tied(9, POINT).plus(used)
    found = (
        PendingPairs.none(N).plus(used, OtherPairing(other, 0.06, early=False), POINT).decided(past, 1.0)[1]
    )
    _same(found, _tied(9, POINT).plus(other.without([9])[0]))


def test_few_are_kept_and_none_that_would_break_the_past() -> None:
    used, other = _belief(10, POINT), Gaussian(POINT, np.zeros((N, N)), np.zeros(N))
    undecided = PendingPairs.none(N)
    for k in range(MOST + 5):
        undecided = undecided.plus(used, OtherPairing(other, float(k), early=False), POINT)
    assert len(undecided.middles_s) == len(undecided.vector) == MOST
    assert undecided.middles_s[0] == 5.0
    past = _tied(11, POINT)
    assert undecided.decided(past, 1e3) == (undecided, past)


@pytest.fixture(scope="module")
def tracker() -> Tracker:
    """At an offset of half an image period, every scan lies between two images."""
    street = simulate(
        SimulationConfig(
            seed=3,
            frames=24,
            width=621,
            height=188,
            azimuth_limit_deg=50.0,
            azimuth_step_deg=0.3,
            vehicle_density=0.3,
            time_offset_s=0.05,
            motion="stop_and_go",
        )
    )
    default = TrackerConfig(start_scans=8, window=10)
    start = dataclasses.replace(default.calibration.start, enabled=False)
    calibration = dataclasses.replace(default.calibration, start=start)
    tracker = Tracker(
        street.camera, dataclasses.replace(default, calibration=calibration), street.truth.cTl, 0.05
    )
    tracker.initializer.work_per_frame = None
    for frame in street:
        tracker.add(frame)
    return tracker


def test_scans_between_two_images_are_kept_open(tracker: Tracker) -> None:
    assert tracker.estimate.smoother is not None
    undecided, offset_s = tracker.estimate.smoother.undecided, tracker.estimate.point.offset_s
    assert len(undecided.middles_s) > 5
    assert np.array_equal(offset_s >= undecided.middles_s, undecided.early)
    assert undecided.information.shape[1:] == tracker.estimate.smoother.bent.information.shape


def test_the_bent_belief_tells_the_gradient_elsewhere(tracker: Tracker) -> None:
    """The same matches, biases moved by 0.4 px: the gradient is nearer to what the curvatures say."""
    assert tracker.estimate.smoother is not None
    by_weight, by_curvature = [], []
    for number, entry in tracker.estimate.smoother.entries.items():
        score = entry.linear
        step = np.zeros(score.belief.point.size)
        step[7:] = 0.4
        there = score.belief.point.moved(step)
        tracks = tracker.inputs.window.tracks[number]
        fresh = linearize_pair(
            entry.pair, there, tracker.matcher.classes, tracks, tracker.matcher.graph
        ).belief.vector
        own = slice(score.belief.point.core_size, score.belief.point.size)
        by_weight.append((score.belief.without_held().at(there).vector - fresh)[own].sum())
        by_curvature.append((score.bent.without_held().at(there).vector - fresh)[own].sum())
    assert abs(sum(by_curvature)) < 0.5 * abs(sum(by_weight))

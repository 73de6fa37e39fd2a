"""What is kept of scans that leave the window follows the estimate: pairings, and the robust kernel."""

from __future__ import annotations

import dataclasses

import gtsam
import numpy as np
import pytest

from sst_graph import Tracker, TrackerConfig
from sst_graph.simulator import SimulationConfig, simulate
from sst_graph.tracker.sums.linearized_pair import linearize_pair
from sst_graph.tracker.window.gaussian import Gaussian, Point
from sst_graph.tracker.window.pending_pairs import MOST, OtherPairing, PendingPairs

POINT = Point(gtsam.Pose3(), 0.05, np.array([0.3]), (4, 7), np.array([0.1, -0.2]))
N = POINT.size


def _gaussian(seed: int, point: Point) -> Gaussian:
    rng = np.random.default_rng(seed)
    J = rng.normal(size=(40, point.size))
    return Gaussian(point, J.T @ J, J.T @ rng.normal(size=40))


def _tied(seed: int, point: Point) -> Gaussian:
    gaussian = _gaussian(seed, point)
    return Gaussian(point, gaussian.information + 100.0 * np.eye(point.size), gaussian.vector)


def _same(a: Gaussian, b: Gaussian) -> None:
    assert a.point.tracks == b.point.tracks
    np.testing.assert_allclose(a.information, b.information, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(a.vector, b.vector, rtol=1e-9, atol=1e-9)


def test_the_past_pairs_again_when_the_offset_passes_the_middle() -> None:
    prior, rest = _tied(0, POINT), _gaussian(1, POINT)
    used, other = _gaussian(2, POINT.seen({4: 0})), _gaussian(3, POINT.seen({7: 0}))
    past = prior.plus(rest).plus(used)
    pending = PendingPairs.none(N).plus(used, OtherPairing(other, 0.06, early=False), POINT)
    stays, same = pending.resolved(past, 0.0599)
    assert stays is pending and same is past
    flipped, changed = pending.resolved(past, 0.0601)
    _same(changed, prior.plus(rest).plus(other))
    assert flipped.early.tolist() == [True]
    back, again = flipped.resolved(changed, 0.05)
    _same(again, past)
    np.testing.assert_allclose(back.vector, pending.vector)


def test_other_pairings_follow_the_point_and_the_objects() -> None:
    """Elsewhere, with one object more and another marginalized out: as if resolved before."""
    used, other = _gaussian(4, POINT.seen({4: 0})), _gaussian(5, POINT.seen({4: 0}))
    past = _tied(6, POINT).plus(used)
    pending = PendingPairs.none(N).plus(used, OtherPairing(other, 0.04, early=True), POINT)
    expected = pending.resolved(past, 0.0)[1]
    step = np.full(N, 1e-3)
    step[:3] = 0.0  # translations add exactly
    there = POINT.moved(step)
    # A new object, then another point, then one that is gone (7, which the pairings do not see).
    grown = pending.through(np.eye(N + 1, N)).moved(np.append(step, 0.0))
    past, expected = (b.with_objects({9: 0}, 0.5) for b in (past, expected))
    at = dataclasses.replace(
        there, tracks=past.point.tracks, object_biases_px=np.append(there.object_biases_px, 0.3)
    )
    past, expected = past.at(at), expected.at(at)
    (past, T), (expected, _) = past.without([7]), expected.without([7])
    found = grown.through(T).resolved(past, 0.0)[1]
    # 7 is tied to the rest through the past alone, which the pairing changes by little.
    np.testing.assert_allclose(
        found.vector, expected.vector, rtol=0.05, atol=0.05 * np.abs(expected.vector).max()
    )
    scale = np.abs(expected.information).max()
    np.testing.assert_allclose(found.information, expected.information, atol=0.05 * scale)


def test_objects_that_only_the_other_pairing_sees_are_left_out() -> None:
    used, other = _gaussian(7, POINT.seen({4: 0})), _gaussian(8, POINT.seen({4: 0, 9: 0}))
    past = _tied(9, POINT).plus(used)
    found = (
        PendingPairs.none(N).plus(used, OtherPairing(other, 0.06, early=False), POINT).resolved(past, 1.0)[1]
    )
    _same(found, _tied(9, POINT).plus(other.without([9])[0]))


def test_few_are_kept_and_none_that_would_break_the_past() -> None:
    used, other = _gaussian(10, POINT), Gaussian(POINT, np.zeros((N, N)), np.zeros(N))
    pending = PendingPairs.none(N)
    for k in range(MOST + 5):
        pending = pending.plus(used, OtherPairing(other, float(k), early=False), POINT)
    assert len(pending.middles_s) == len(pending.vector) == MOST
    assert pending.middles_s[0] == 5.0
    past = _tied(11, POINT)
    assert pending.resolved(past, 1e3) == (pending, past)


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
    pending, offset_s = tracker.estimate.smoother.pending, tracker.estimate.point.offset_s
    assert len(pending.middles_s) > 5
    assert np.array_equal(offset_s >= pending.middles_s, pending.early)
    assert pending.information.shape[1:] == tracker.estimate.smoother.observed.information.shape


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
        fresh = linearize_pair(
            entry.pair, there, tracker.matcher.classes, tracks, tracker.matcher.graph
        ).information.vector
        own = slice(linear.information.point.core_size, linear.information.point.size)
        by_weight.append((linear.information.without_held().at(there).vector - fresh)[own].sum())
        by_curvature.append((linear.observed.without_held().at(there).vector - fresh)[own].sum())
    assert abs(sum(by_curvature)) < 0.5 * abs(sum(by_weight))

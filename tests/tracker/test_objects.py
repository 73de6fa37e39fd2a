"""Leaving out objects one by one: in the window, after it, and after the objects are gone.

And when the window is relinearized.
"""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from sst_graph.covariance.jackknife import ObjectSpread, composed
from sst_graph.tracker.sums.object_sums import ObjectInformation, ObjectSums
from sst_graph.tracker.window.gaussian import Gaussian, Point
from sst_graph.tracker.window.relinearization import RelinearizationSchedule

TRACKS = (4, 7, 9)
N = 8 + len(TRACKS)


def _point() -> Point:
    return Point(gtsam.Pose3(), 0.05, np.array([0.4]), TRACKS, np.array([0.1, -0.3, 0.2]))


def _frame(seed: int, at: Point) -> tuple[ObjectInformation, dict[int, tuple[np.ndarray, np.ndarray]]]:
    """Twenty rows on each object; by track the full rows (20, N) and residuals."""
    rng, rows, residuals, track, parts = np.random.default_rng(seed), [], [], [], {}
    for k, name in enumerate(TRACKS):
        J = np.zeros((20, N))
        J[:, :7], J[:, 8 + k] = rng.normal(size=(20, 7)), 1.0
        r = rng.normal(size=20) + 0.5
        parts[name] = (J, r)
        rows.append(J)
        residuals.append(r)
        track += [name] * 20
    stacked = np.concatenate(rows), np.concatenate(residuals), np.array(track, dtype=np.intp)
    J, r, tracks = stacked
    return ObjectInformation.of(J, r, np.ones(len(r)), tracks, at), parts


def _whole(*frames: dict[int, tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    H = np.diag([*[1e-2] * 7, 1.0, 4.0, 4.0, 4.0])
    H[7, 8:] = H[8:, 7] = -0.3
    return np.asarray(H + sum(J.T @ J for frame in frames for J, _ in frame.values()))


def _expected(H: np.ndarray, *frames: dict[int, tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """The batch's jackknife, from all rows at once."""
    steps = []
    for name in TRACKS:
        J = np.concatenate([frame[name][0] for frame in frames])
        r = np.concatenate([frame[name][1] for frame in frames])
        steps.append(np.linalg.solve(H - J.T @ J, J.T @ r))
    return np.asarray(2.0 / 3.0 * np.stack(steps).T @ np.stack(steps))


def test_the_jackknife_is_the_batch_s_wherever_the_frames_are() -> None:
    point = _point()
    (one, rows_1), (two, rows_2) = _frame(1, point), _frame(2, point)
    H = _whole(rows_1, rows_2)
    expected = _expected(H, rows_1, rows_2)
    sums = ObjectSums.empty(N)
    both = sums.spread([one, two], np.linalg.inv(H), point)
    np.testing.assert_allclose(both.jackknife, expected, rtol=1e-6, atol=1e-12)
    sums.add(one)
    left = sums.spread([two], np.linalg.inv(H), point)
    np.testing.assert_allclose(left.jackknife, expected, rtol=1e-6, atol=1e-12)
    sums.add(two)
    sums.close((4,), H, np.linalg.inv(H), point)
    assert set(sums.live) == {4} and sums.count == 2
    closed = sums.spread([], np.linalg.inv(H), point)
    np.testing.assert_allclose(closed.jackknife, expected, rtol=1e-6, atol=1e-12)


def test_gone_objects_count_on_when_their_biases_are_marginalized_out() -> None:
    point = _point()
    frame, rows = _frame(3, point)
    H = _whole(rows)
    sums = ObjectSums.empty(N)
    sums.add(frame)
    sums.close((), H, np.linalg.inv(H), point)
    smaller, T = Gaussian(point, H, np.zeros(N)).without([7, 9])
    sums.transform(T)
    found = sums.spread([], np.linalg.inv(smaller.information), smaller.point)
    np.testing.assert_allclose(found.jackknife, _expected(H, rows)[:9, :9], rtol=1e-6, atol=1e-12)


def test_residuals_follow_the_estimate() -> None:
    """Linearized elsewhere, an object says the same: r + J d."""
    point = _point()
    d = np.array([*np.full(6, 1e-7), 1e-3, 0.05, 0.1, -0.2, 0.3])
    frame, rows = _frame(4, point)
    moved = {name: (J, r + J @ d) for name, (J, r) in rows.items()}
    H = _whole(rows)
    expected = _expected(H, moved)
    there = point.moved(d)
    found = ObjectSums.empty(N).spread([frame], np.linalg.inv(H), there)
    sums = ObjectSums.empty(N)
    sums.add(frame)
    after = sums.spread([], np.linalg.inv(H), there)
    np.testing.assert_allclose(found.jackknife, expected, rtol=1e-5, atol=1e-12)
    np.testing.assert_allclose(after.jackknife, expected, rtol=1e-5, atol=1e-12)


def test_one_object_cannot_be_left_out() -> None:
    """What the others would say without it is not known: the correction is the largest."""
    point = Point(gtsam.Pose3(), 0.0, np.zeros(1))
    J, r = np.eye(8), np.ones(8)
    frame = ObjectInformation.of(J, r, np.ones(8), np.zeros(8, dtype=np.intp), point)
    spread = ObjectSums.empty(8).spread([frame], 0.5 * np.eye(8), point)
    assert not spread.jackknife.any() and spread.number == 1.0
    several = ObjectSpread(spread.jackknife, 5.0)
    assert spread.correction > several.correction == pytest.approx(1.25)


def test_objects_that_disagree_beyond_the_model_make_it_grow() -> None:
    """Birge's ratio over the extrinsic: never below 1; the jackknife's own part comes on top."""
    model, shape = np.diag(np.arange(1.0, 9.0)), np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 0.0, 0.0])
    found = [
        composed(model, ObjectSpread(ratio * shape, 5.0), 1.0)[7, 7] / model[7, 7]
        for ratio in (0.1, 1.0, 3.0)
    ]
    assert found[0] == pytest.approx(found[1]) and found[2] == pytest.approx(3.0 * found[1])
    of_six = [composed(model, ObjectSpread(r * shape, 5.0), 1.0)[0, 0] for r in (0.0, 1.0)]
    assert of_six[1] > of_six[0] == pytest.approx(found[0])


def test_an_object_alone_is_not_believed_as_several_are() -> None:
    nothing = np.zeros((8, 8))
    alone, two, many = (composed(np.eye(8), ObjectSpread(nothing, n), 1.0)[0, 0] for n in (1.0, 2.0, 9.0))
    assert alone == pytest.approx(5.0 * two) and two == pytest.approx(many)


def test_the_number_of_objects_counts_those_gone() -> None:
    """Three objects of twenty matches each in two frames, wherever the frames are: three."""
    point = _point()
    (one, rows_1), (two, rows_2) = _frame(1, point), _frame(2, point)
    H = _whole(rows_1, rows_2)
    sums = ObjectSums.empty(N)
    sums.add(one)
    assert sums.spread([two], np.linalg.inv(H), point).number == pytest.approx(3.0)
    sums.close((4,), H, np.linalg.inv(H), point)
    assert (sums.count, sums.weight, sums.weight2) == (2, 40.0, 800.0)
    # Objects seen again after they were closed are others.
    weights = np.array([20.0, 20.0, 40.0, 20.0, 20.0])
    again = sums.spread([two], np.linalg.inv(H), point).number
    assert again == pytest.approx(weights.sum() ** 2 / (weights @ weights))


@pytest.mark.parametrize(
    ("start", "window", "times"),
    [(12, 60, [24, 48, 60, 120, 240]), (30, 60, [60, 120, 240]), (70, 60, [140])],
)
def test_relinearization_gets_rarer(start: int, window: int, times: list[int]) -> None:
    schedule = RelinearizationSchedule(100, 2 * start, window)
    reached = [seen for seen in range(start, 260) if schedule.reached(99 + seen)]
    assert reached == times

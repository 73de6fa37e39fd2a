"""The parts of the tracker, each against an independent answer."""

from __future__ import annotations

import dataclasses
import pickle

import gtsam
import numpy as np
import pytest
from numpy.typing import NDArray

from sst_graph.covariance.error_model import ErrorModel, SideResiduals, fit_error_model
from sst_graph.covariance.image_shifts import NO_MOMENTS
from sst_graph.covariance.level_edges import LevelEdges
from sst_graph.covariance.sums import ScoreSums
from sst_graph.tracker.config import AlarmConfig, TrackerConfig
from sst_graph.tracker.monitor.confirmation import (
    DETECTABLE_OFFSET_S,
    DETECTABLE_TURN_RAD,
    Confirmation,
    detectable_steps,
    steps,
)
from sst_graph.tracker.monitor.monitor import Adoption
from sst_graph.tracker.monitor.statistic import ChangeStatistic, ComparedEstimate, EstimateCovariance
from sst_graph.tracker.sums.linearized_pair import LinearizedPair
from sst_graph.tracker.sums.running_sums import RunningSums
from sst_graph.tracker.window.gaussian import Gaussian, Point, insert_point

FloatArray = NDArray[np.float64]
N = 9


def _gaussian(seed: int) -> Gaussian:
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((20, N))
    point = Point(gtsam.Pose3.Expmap(0.3 * rng.standard_normal(6)), 0.1, rng.standard_normal(2))
    return Gaussian(point, A.T @ A, rng.standard_normal(N))


def test_local_and_moved_are_inverse() -> None:
    a, step = _gaussian(1).point, np.linspace(-0.2, 0.3, N)
    np.testing.assert_allclose(a.local(a.moved(step)), step, atol=1e-12)


def test_the_factor_is_the_gaussian() -> None:
    gaussian, keys = _gaussian(2), [7, 3, 5, 11]
    factor = pickle.loads(pickle.dumps(gaussian.factor(keys)))
    graph, values, ordering = gtsam.NonlinearFactorGraph(), gtsam.Values(), gtsam.Ordering()
    graph.add(factor)
    insert_point(values, keys, gaussian.point)
    for key in keys:
        ordering.push_back(key)
    H, g = graph.linearize(values).hessian(ordering)
    np.testing.assert_allclose(H, gaussian.information, atol=1e-9)
    np.testing.assert_allclose(g, gaussian.vector, atol=1e-9)
    optimum = gtsam.GaussNewtonOptimizer(graph, values).optimize()
    assert optimum.atVector(3)[0] == pytest.approx(gaussian.mean().time_offset_s, abs=1e-6)


def test_a_random_walk_adds_its_variance() -> None:
    gaussian, variances = _gaussian(3), np.linspace(0.0, 0.4, N)
    after = gaussian.drifted(variances)
    expected = np.linalg.inv(gaussian.information) + np.diag(variances)
    np.testing.assert_allclose(np.linalg.inv(after.information), expected, rtol=1e-9)
    np.testing.assert_allclose(
        np.linalg.solve(after.information, after.vector),
        np.linalg.solve(gaussian.information, gaussian.vector),
    )


def test_gaussians_add_about_one_point() -> None:
    a, b = _gaussian(4), _gaussian(5)
    b = Gaussian(a.point.moved(np.full(N, 1e-3)), b.information, b.vector)
    both = a.plus(b)
    H = a.information + b.information
    expected = np.linalg.solve(H, a.vector + b.vector + b.information @ np.full(N, 1e-3))
    np.testing.assert_allclose(np.linalg.solve(both.information, both.vector), expected, atol=1e-9)


def test_error_model_of_simulated_sides() -> None:
    """Known variances of side, side in a frame, and match come back, though a bias an object was fitted."""
    rng = np.random.default_rng(0)
    residuals, sides, frames = [], [], []
    shared = rng.normal(0.0, 0.6, (100, 4))
    shared = (shared - shared.mean(axis=1, keepdims=True)).ravel()
    for side in range(400):
        for frame in range(8):
            residuals.append(shared[side] + rng.normal(0.0, 0.4) + rng.normal(0.0, 0.9, 12))
            sides += [side] * 12
            frames += [frame] * 12
    r, ones = np.concatenate(residuals), np.ones(len(sides))
    model = fit_error_model(SideResiduals.of(r, ones, np.array(sides), np.array(frames)))
    found = np.sqrt([model.side, model.side_frame, model.match])
    np.testing.assert_allclose(found, [0.6, 0.4, 0.9], rtol=0.1)  # floors: 0.36, 0.32


def _score(rng: np.random.Generator, truth: FloatArray, side: int) -> LinearizedPair:
    """A pair of 200 matches on four sides whose residuals follow the error model (0.25, 0, 1)."""
    J = rng.standard_normal((200, N))
    which = np.repeat(np.arange(4), 50)
    r = -J @ truth + rng.standard_normal(200) + 0.5 * rng.standard_normal(4)[which]
    ones, still = np.ones(200), np.zeros(200, np.intp)
    residuals = SideResiduals.of(r, ones, side + which, still)
    point = Point(gtsam.Pose3(), 0.0, np.zeros(2))
    information = Gaussian(point, J.T @ J, -J.T @ r)
    scores = ScoreSums.of_frame(J, ones, side + which, LevelEdges.none(200))
    shifts = {"shifts": NO_MOMENTS, "by_shifts": np.zeros((N, 3))}
    return LinearizedPair(information, information, scores, residuals, 200, **shifts)


def _model() -> ErrorModel:
    return ErrorModel(0.25, 0.0, 1.0)


def _compared(covariance: EstimateCovariance) -> ComparedEstimate:
    return ComparedEstimate(Point(gtsam.Pose3(), 0.0, np.zeros(2)), covariance, _model())


def _chi2(scores: list[LinearizedPair], covariance: EstimateCovariance) -> float:
    return ChangeStatistic(25.0).compare(scores, _compared(covariance)).chi2()


def test_the_statistic_is_chi_square_where_nothing_changed() -> None:
    rng, P = np.random.default_rng(1), 1e-3 * np.eye(N)
    values = [
        _chi2([_score(rng, x, 4 * k) for k in range(3)], EstimateCovariance(P, (), N))
        for x in rng.multivariate_normal(np.zeros(N), P, 300)
    ]
    assert np.mean(values) == pytest.approx(N, rel=0.12)
    assert np.quantile(values, 0.95) == pytest.approx(16.9, rel=0.15)  # chi-square with 9 degrees


def test_a_step_raises_the_alarm_and_quiet_does_not() -> None:
    rng, P = np.random.default_rng(2), 1e-4 * np.eye(N)
    statistic, quiet = ChangeStatistic(25.0), _compared(EstimateCovariance(P, (), N))
    for k in range(200):
        statistic.add([_score(rng, np.zeros(N), 4 * k)], quiet)
        assert not statistic.confirmed
    step = np.full(N, 0.3)
    raised = [
        k
        for k in range(10)
        if statistic.add([_score(rng, step, 9000 + 4 * k)], quiet) and statistic.confirmed
    ]
    assert raised and raised[0] < 8


def test_steps_that_would_be_detected_are_predicted() -> None:
    """The statistic predicted for a step is that of frames with the step, beyond the noise."""
    rng = np.random.default_rng(5)
    tried = np.zeros((7, 2))
    tried[1, 0], tried[6, 1] = 0.02, 0.3
    scores = [_score(rng, np.zeros(N), 4 * k) for k in range(4)]
    exact = EstimateCovariance(np.zeros((N, N)), (), N)
    statistic = ChangeStatistic(25.0)
    compared = statistic.compare(scores, _compared(exact))
    small, large = compared.chi2_of(tried)
    assert small < 5.0 < 50.0 < large
    assert statistic.detectable(compared, tried).tolist() == [False, True]
    stepped = [_score(rng, np.append(tried[:, 1], [0.0, 0.0]), 4 * k) for k in range(4)]
    assert _chi2(stepped, exact) == pytest.approx(large + N, rel=0.3)


def test_frames_by_edges_raise_the_alarm_though_their_matches_follow_the_pose() -> None:
    """The usual size of the statistic says what is noise; how soft matches are, what would have shown."""
    rng = np.random.default_rng(6)
    known = _compared(EstimateCovariance(np.zeros((N, N)), (), N))
    soft, statistic = dataclasses.replace(known, variance_ratio=8.0), ChangeStatistic(25.0)
    for k in range(40):
        value = statistic.add([_score(rng, np.zeros(N), 4 * k)], soft)
        assert not statistic.exceeded
    assert value is not None and statistic.latest is not None
    assert value == pytest.approx(statistic.latest.chi2(), rel=0.3)
    tried = np.zeros((7, 1))
    tried[6, 0] = 0.35
    firm = dataclasses.replace(statistic.latest, variance_ratio=1.0)
    assert firm.chi2_of(tried)[0] > 2.0 * 25.0 > firm.chi2_of(tried)[0] / 4.0
    assert statistic.detectable(firm, tried).all() and not statistic.detectable(statistic.latest, tried).any()
    step = np.append(tried[:, 0], [0.0, 0.0])
    for k in range(8):
        statistic.add([_score(rng, step, 9000 + 4 * k)], soft)
    assert statistic.confirmed


def test_an_estimate_that_is_less_sure_is_confirmed_by_larger_steps() -> None:
    T = gtsam.Pose3(gtsam.Rot3.RzRyRx(-1.5, 0.1, -1.6), np.array([0.1, -0.2, 0.3]))
    sure, wide = np.zeros((7, 7)), np.diag([1.0] * 7)
    least = steps(T, DETECTABLE_TURN_RAD, DETECTABLE_OFFSET_S)
    np.testing.assert_allclose(detectable_steps(T, sure), least)
    np.testing.assert_allclose(detectable_steps(T, wide), 2.0 * least)
    # One standard deviation of a turn about the camera's x axis.
    sigma = 0.5 * DETECTABLE_TURN_RAD
    about_x = steps(T, sigma, 0.0)[:, :1]
    np.testing.assert_allclose(detectable_steps(T, about_x @ about_x.T), least * [1.5, 1.0, 1.0])


def test_turn_and_offset_are_confirmed_apart() -> None:
    found, T = Confirmation(), gtsam.Pose3(gtsam.Rot3.RzRyRx(-1.5, 0.1, -1.6), np.array([0.1, -0.2, 0.3]))
    found.unreliable.add(3)
    found.wait(2.0, moving=True)
    found.wait(1.0, moving=False)
    assert (found.turn_s, found.time_offset_s) == (3.0, 2.0)
    found.add(np.array([True, False, True]))
    assert (found.turn_s, found.time_offset_s) == (3.0, 0.0) and found.unreliable
    found.wait(2.0, moving=True)
    found.add(np.array([True, True, False]))
    assert (found.turn_s, found.time_offset_s) == (0.0, 2.0) and not found.unreliable
    turned = T.retract(steps(T, 0.01, 0.02)[:6, 1])
    assert turned.equals(gtsam.Pose3(gtsam.Rot3.Ry(0.01), np.zeros(3)) * T, 1e-9)
    assert steps(T, 0.01, 0.02)[6].tolist() == [0.0, 0.0, 0.02]


def test_settings_out_of_range() -> None:
    with pytest.raises(ValueError, match="window"):
        TrackerConfig(window=10)
    with pytest.raises(ValueError, match="chi2"):
        AlarmConfig(chi2=0.0)


def test_a_direction_without_information_raises_nothing() -> None:
    """At standstill the score of the time offset is rounding only."""
    rng = np.random.default_rng(3)
    score = _score(rng, np.zeros(N), 0)
    information, vector = score.information.information.copy(), score.information.vector.copy()
    without = np.eye(N)
    without[6, 6] = 0.0
    information = without @ information @ without
    vector[6], information[6, 6] = 1e-15, 1e-20
    still = dataclasses.replace(
        score,
        information=Gaussian(score.information.point, information, vector),
        scores=score.scores.transformed(without),
    )
    assert _chi2([still], EstimateCovariance(1e-6 * np.eye(N), (), N)) < 40.0


def test_objects_come_and_go_without_loss() -> None:
    """Marginalized out one by one, objects leave what the whole problem says, and how surely."""
    rng, gaussian, sigma = np.random.default_rng(4), _gaussian(6), 0.5
    whole = gaussian.with_objects({40: 0, 41: 1, 42: 0}, sigma)
    assert whole.point.tracks == (40, 41, 42) and whole.point.size == N + 3
    alone, _ = whole.without(whole.point.tracks)
    np.testing.assert_allclose(alone.information, gaussian.information, atol=1e-9)
    np.testing.assert_allclose(alone.vector, gaussian.vector, atol=1e-9)
    A = rng.standard_normal((30, N + 2))
    seen = gaussian.point.seen({42: 0, 40: 0})
    whole = whole.plus(Gaussian(seen, A.T @ A, rng.standard_normal(N + 2)))
    S = np.cov(rng.standard_normal((N + 3, 50)))
    rows = np.linalg.inv(whole.information)
    first, T = whole.without([41])
    last, U = first.without([42, 40])
    assert last.point.tracks == ()
    np.testing.assert_allclose(np.linalg.inv(last.information), rows[:N, :N], atol=1e-9)
    expected = (rows @ whole.vector)[:N]
    np.testing.assert_allclose(np.linalg.solve(last.information, last.vector), expected, atol=1e-9)
    robust = np.linalg.inv(last.information)
    robust = robust @ (U @ T @ S @ T.T @ U.T) @ robust
    np.testing.assert_allclose(robust, (rows @ S @ rows)[:N, :N], atol=1e-9)


def test_score_sums_follow_the_objects() -> None:
    rng = np.random.default_rng(5)
    score, sums, model = _score(rng, np.zeros(N), 0), RunningSums.empty(N), ErrorModel(0.25, 0.1, 2.0)
    columns = np.arange(N)
    sums.add(score, columns, 0)
    expected = sums.excess(model)
    sums.grow(N + 2)
    grown = sums.excess(model)
    np.testing.assert_allclose(grown[:N, :N], expected)
    assert not grown[N:].any()
    # A pair counts the same in the window as when it has left it.
    again = _score(rng, np.zeros(N), 2)
    both = sums.with_pairs([again], [columns]).excess(model)
    sums.add(again, columns, 1)
    np.testing.assert_allclose(sums.excess(model), both, rtol=1e-9)
    T = rng.standard_normal((N, N + 2))
    sums.transform(T)
    np.testing.assert_allclose(sums.excess(model), T @ both @ T.T, rtol=1e-9)


def test_a_new_object_is_as_uncertain_as_its_class_and_more() -> None:
    P = np.diag(np.arange(1.0, N + 3.0))
    found = EstimateCovariance(P, (7, 9), N).with_objects({9: 0, 12: 1}, 0.5)
    assert found.shape == (N + 2, N + 2)
    assert found[N, N] == P[N + 1, N + 1]
    assert found[N + 1, N + 1] == P[8, 8] + 0.25 and found[8, N + 1] == P[8, 8]


def test_a_worse_candidate_is_refused() -> None:
    """A covariance within the limits, and held-out costs that are no worse, over enough frames."""
    good, bad = _gaussian(1).point, _gaussian(2).point
    adoption = Adoption()
    for _ in range(9):
        adoption.compare(1.0, 2.0)
    assert not adoption.propose(good, trusted=True)  # too few frames
    adoption.compare(1.0, 2.0)
    assert not adoption.propose(good, trusted=False)  # a covariance past the limits
    assert adoption.propose(good, trusted=True) and adoption.adopted is good
    adoption.restart()
    for _ in range(10):
        adoption.compare(1.1, 1.0)  # a confident candidate that explains held-out frames worse
    assert not adoption.propose(bad, trusted=True) and adoption.adopted is good
    for _ in range(10):
        adoption.compare(1.01, 1.0)
    assert adoption.propose(bad, trusted=True) and adoption.adopted is bad

"""Graduated non-convexity: weights in closed form, outliers found, gtsam's own as the oracle."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from factor_bench import Bench, E

from sst_graph.factors import FactorError, GncParams, custom_factor, gnc, point_to_pixel_factor
from sst_graph.factors.custom.gnc import scaled


@pytest.fixture
def bench(make_scene):
    return Bench(make_scene)


def pull(target, sigma=0.1):
    """A custom factor that wants x at a target."""
    return custom_factor(
        gtsam.noiseModel.Isotropic.Sigma(1, sigma),
        [7],
        lambda x, *, jacobians: (x - target, [np.eye(1)] if jacobians else None),
        [1],
        1,
    )


def test_gnc_finds_the_outliers():
    """Against the closed form, the mean of the inliers; gtsam's own GNC says the same of its factors."""
    rng = np.random.default_rng(2)
    targets = np.concatenate([1.0 + 0.1 * rng.standard_normal(12), rng.uniform(3.0, 9.0, 5)])
    custom, native = gtsam.NonlinearFactorGraph(), gtsam.NonlinearFactorGraph()
    for target in targets:
        custom.add(pull(target))
        noise = gtsam.noiseModel.Isotropic.Sigma(1, 0.1)
        native.add(gtsam.PriorFactorVector(7, np.array([target]), noise))
    values = gtsam.Values()
    values.insert(7, np.array([4.0]))
    for graph in (custom, native):
        found = gnc(graph, values, GncParams(inlier_cost=0.5 * 3.0**2))
        np.testing.assert_array_equal(found.weights > 0.5, np.arange(17) < 12)
        assert found.converged
        assert found.values.atVector(7)[0] == pytest.approx(targets[:12].mean(), abs=1e-6)
    theirs = gtsam.GncLMOptimizer(native, values, gtsam.GncLMParams())
    theirs.optimize()
    # its default limit is the 99 % quantile of chi^2 of one dimension
    found = gnc(custom, values, GncParams(inlier_cost=0.5 * 6.6349))
    np.testing.assert_array_equal(theirs.getWeights() > 0.5, found.weights > 0.5)


def test_gnc_leaves_out_an_image_of_another_place(bench, make_scene):
    """Ten images fit, two are of another scene; a known inlier is never judged."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    values.insert(E, bench.cTl.retract(0.003 * np.ones(6)))
    graph.add(gtsam.PriorFactorPose3(E, bench.cTl, gtsam.noiseModel.Isotropic.Sigma(6, 1.0)))
    for k in range(12):
        seen = bench.points.take(np.arange(len(bench.points)))
        shift = 0.0 if k < 10 else 40.0
        seen = replace(seen, pixels=seen.pixels + shift)
        graph.add(point_to_pixel_factor(seen, E, bench.time_offset_s, bench.twist))
    n = len(bench.points)
    found = gnc(graph, values, GncParams(inlier_cost=10.0 * n), known_inliers=[0])
    np.testing.assert_array_equal(found.weights > 0.5, np.arange(13) < 11)
    clean = gtsam.NonlinearFactorGraph()
    for i in range(11):
        clean.add(graph.at(i))
    expected = gtsam.LevenbergMarquardtOptimizer(clean, values).optimize()
    assert expected.atPose3(E).equals(found.values.atPose3(E), 1e-4)
    with pytest.raises(FactorError, match="inlier_cost"):
        gnc(graph, values, GncParams(inlier_cost=0.0))


@pytest.mark.parametrize(
    "wrong",
    [
        {"mu_step": 1.0},
        {"mu_step": float("nan")},
        {"max_iterations": 0},
        {"max_iterations": 1.5},
        {"weights_tolerance": 0.0},
    ],
)
def test_settings_out_of_range_are_refused(wrong):
    with pytest.raises(FactorError, match=next(iter(wrong))):
        GncParams(10.0, **wrong)


def at(x):
    values = gtsam.Values()
    values.insert(7, np.array([x]))
    return values


def graph_of(targets):
    graph = gtsam.NonlinearFactorGraph()
    for target in targets:
        graph.add(pull(target))
    return graph


def tls_weight(ratio, mu):
    """w of Yang et al., algorithm 1, of a squared residual that is ``ratio`` times the inliers' limit."""
    if ratio >= (mu + 1.0) / mu:
        return 0.0
    return 1.0 if ratio <= mu / (mu + 1.0) else np.sqrt(mu * (mu + 1.0) / ratio) - mu


def test_each_iteration_in_closed_form():
    """Weights by TLS, the solution their weighted mean, mu from 1 / (2 r_max - 1) on by a factor."""
    targets, limit, step = np.array([1.0, 1.05, 0.9, 1.6, 2.5]), 0.5 * 3.0**2, 1.5
    x, mu, weights = targets.mean(), None, np.ones(5)
    for iterations in range(1, 8):
        found = gnc(graph_of(targets), at(0.3), GncParams(limit, step, iterations))
        assert found.iterations == iterations and not found.converged
        assert found.values.atVector(7)[0] == pytest.approx(x, abs=1e-6)
        np.testing.assert_allclose(found.weights, weights, atol=1e-4)
        ratios = 0.5 * ((targets - x) / 0.1) ** 2 / limit
        mu = 1.0 / (2.0 * ratios.max() - 1.0) if mu is None else step * mu
        weights = np.array([tls_weight(ratio, mu) for ratio in ratios])
        x = weights @ targets / weights.sum()


def test_without_an_outlier_one_solution_is_enough():
    graph = graph_of([1.0, 1.1])
    graph.remove(0)
    graph.add(pull(1.0))
    found = gnc(graph, at(0.0), GncParams(0.125 + 1e-6))
    assert found.converged and found.iterations == 1
    np.testing.assert_array_equal(found.weights, [np.nan, 1.0, 1.0])
    assert gnc(graph, at(0.0), GncParams(0.125 - 1e-3)).iterations > 1


def test_a_limit_for_each_factor_and_known_inliers():
    graph = graph_of([0.0, 0.0, 0.0, 1.0])
    wide = gnc(graph, at(0.0), GncParams(lambda position: 1000.0 if position == 3 else 100.0))
    assert wide.values.atVector(7)[0] == pytest.approx(0.25)
    narrow = gnc(graph, at(0.0), GncParams(lambda position: 4.5))
    # mu begins at 1 / (2 * 6.25 - 1) and grows by 1.4 at each iteration until it has passed 1
    assert narrow.iterations == 2 + np.ceil(np.log(11.5) / np.log(1.4))
    np.testing.assert_array_equal(narrow.weights, [1.0, 1.0, 1.0, 0.0])
    known = gnc(graph, at(0.0), GncParams(4.5), known_inliers=[3])
    assert known.weights[3] == 1.0
    trusted = gnc(graph, at(0.0), GncParams(4.5), known_inliers=range(4))
    assert trusted.converged and trusted.iterations == 1 and (trusted.weights == 1.0).all()


def test_scaling_multiplies_the_cost_and_leaves_the_unweighted_error():
    own, native = pull(3.0), gtsam.PriorFactorVector(7, np.zeros(1), gtsam.noiseModel.Isotropic.Sigma(1, 0.2))
    for factor in (own, native):
        quarter = scaled(factor, 0.25)
        assert quarter.error(at(1.0)) == pytest.approx(0.25 * factor.error(at(1.0)), rel=1e-12)
        np.testing.assert_allclose(quarter.unwhitenedError(at(1.0)), factor.unwhitenedError(at(1.0)))


@pytest.mark.parametrize(
    "noise",
    [
        gtsam.noiseModel.Robust.Create(
            gtsam.noiseModel.mEstimator.Huber.Create(1.0), gtsam.noiseModel.Isotropic.Sigma(1, 0.2)
        ),
        gtsam.noiseModel.Constrained.All(1),
    ],
)
def test_what_has_no_gaussian_noise_is_not_scaled(noise):
    with pytest.raises(FactorError, match="a Gaussian noise model"):
        scaled(gtsam.PriorFactorVector(7, np.zeros(1), noise), 0.5)


def test_a_factor_without_noise_is_not_scaled():
    unit = gtsam.noiseModel.Unit.Create(1)
    linear = gtsam.LinearContainerFactor(gtsam.JacobianFactor(7, np.eye(1), np.ones(1), unit))
    with pytest.raises(FactorError, match="a Gaussian noise model"):
        scaled(linear, 0.5)


def test_settings_at_the_edge_of_their_range():
    for edge in (
        {"mu_step": 1.001},
        {"max_iterations": 1},
        {"max_iterations": 100_000},
        {"weights_tolerance": 0.49},
    ):
        GncParams(1.0, **edge)
    for beyond in ({"mu_step": 1e6}, {"max_iterations": 100_001}, {"weights_tolerance": 0.5}):
        with pytest.raises(FactorError):
            GncParams(1.0, **beyond)

"""Graphs with the package's factors are cloned, copied, pickled, put on other keys, and solved by GNC."""

from __future__ import annotations

import copy
import gc
import pickle
import weakref
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from factor_bench import NAMES, Bench, D, E, X

from sst_graph.factors import (
    FactorError,
    GncParams,
    PackedGraph,
    clone_factor,
    clone_graph,
    custom_factor,
    gnc,
    point_to_pixel_factor,
    recipe_of,
    rekeyed,
    time_offset_prior,
)


@pytest.fixture
def bench(make_scene):
    return Bench(make_scene)


@pytest.fixture
def graph(bench):
    """One of every factor, gtsam's own beside them, and an empty slot."""
    whole = gtsam.NonlinearFactorGraph()
    for name in NAMES:
        whole.add(bench.makers()[name](E, D))
    whole.add(time_offset_prior(D, 0.1, 0.05))
    whole.add(gtsam.PriorFactorPose3(E, bench.cTl, gtsam.noiseModel.Isotropic.Sigma(6, 0.1)))
    whole.remove(1)
    return whole


def test_gtsam_itself_cannot(graph):
    """When this fails, gtsam has learned it, and this package's detour can go."""
    with pytest.raises(RuntimeError, match="no clone"):
        graph.clone()


@pytest.mark.parametrize(
    "copied",
    [
        clone_graph,
        lambda graph: copy.deepcopy(PackedGraph.of(graph)).unpack(),
        lambda graph: pickle.loads(pickle.dumps(PackedGraph.of(graph))).unpack(),
    ],
)
def test_a_copy_is_the_same_graph(bench, graph, copied):
    found, values = copied(graph), bench.values()
    assert found.size() == graph.size() and not found.exists(1)
    assert found.error(values) == graph.error(values) > 0.0
    for mine, its in zip(found.linearize(values).hessian(), graph.linearize(values).hessian(), strict=True):
        np.testing.assert_array_equal(mine, its)
    for i in range(graph.size()):
        assert not graph.exists(i) or graph.at(i) is not found.at(i)


def test_a_copy_outlives_the_graph(bench, graph):
    values = bench.values()
    found, error = clone_graph(graph), graph.error(values)
    held = weakref.ref(graph.at(0))
    del graph
    gc.collect()
    assert held() is None
    assert found.error(values) == error


@pytest.mark.parametrize("name", NAMES)
def test_other_keys(bench, name):
    factor = bench.makers()[name](E, D)
    other = {E: gtsam.symbol("e", 7), D: gtsam.symbol("d", 7)}
    values, moved = bench.values(), bench.values()
    moved.insert(other[E], values.atPose3(E))
    moved.insert(other[D], values.atVector(D))
    moved.erase(E)
    moved.erase(D)
    found = rekeyed(factor, other)
    assert set(found.keys()) == {other.get(key, key) for key in factor.keys()}  # noqa: SIM118
    assert found.error(moved) == pytest.approx(factor.error(values), rel=1e-12)
    A, b = found.linearize(moved).jacobian()
    np.testing.assert_allclose(A.T @ b, factor.linearize(values).jacobian()[0].T @ b, rtol=1e-9)
    with pytest.raises(FactorError, match="one key for two variables"):
        rekeyed(factor, {E: D})


def test_a_recipe_names_the_factor(bench):
    recipe = recipe_of(bench.makers()["pose_alignment_factor"](E, D))
    assert recipe is not None and recipe.name == "pose_alignment_factor"
    assert recipe.keys == {X[0]: "X_a", X[1]: "X_b", E: "cTl", D: "offset_s"}
    assert recipe_of(time_offset_prior(D, 0.0, 1.0)) is None


def test_the_factor_of_another_is_refused():
    def callback(this, values, H):
        raise KeyError("no values")

    foreign = gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(1), [3], callback)
    assert recipe_of(foreign) is None
    with pytest.raises(FactorError, match="CustomFactor on 3: found one that another made"):
        clone_factor(foreign)


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
        graph.add(point_to_pixel_factor(seen, E, bench.offset_s, bench.twist))
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

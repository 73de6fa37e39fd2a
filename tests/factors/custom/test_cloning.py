"""Graphs with the package's factors are cloned, copied, pickled and put on other keys."""

from __future__ import annotations

import copy
import gc
import pickle
import weakref

import gtsam
import numpy as np
import pytest
from factor_bench import NAMES, Bench, D, E, X

from sst_graph.factors import (
    FactorError,
    PackedGraph,
    clone_factor,
    clone_graph,
    custom_factor,
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
    assert recipe.keys == {X[0]: "X_a", X[1]: "X_b", E: "cTl", D: "time_offset_s"}
    assert recipe_of(time_offset_prior(D, 0.0, 1.0)) is None


def test_the_factor_of_another_is_refused():
    def callback(this, values, H):
        raise KeyError("no values")

    foreign = gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(1), [3], callback)
    assert recipe_of(foreign) is None
    with pytest.raises(FactorError, match="CustomFactor on 3: found one that another made"):
        clone_factor(foreign)


def test_other_keys_are_distinct():
    """Of a factor of gtsam as of one of ours: gtsam itself would take one variable twice."""
    noise = gtsam.noiseModel.Isotropic.Sigma(6, 1.0)
    between = gtsam.BetweenFactorPose3(1, 2, gtsam.Pose3(), noise)
    assert list(rekeyed(between, {1: 2, 2: 1}).keys()) == [2, 1]
    for new_keys in ({1: 2}, {1: 3, 2: 3}):
        with pytest.raises(FactorError, match="distinct keys"):
            rekeyed(between, new_keys)


KERNELS = ["Huber", "Cauchy", "Tukey", "AsymmetricTukey", "GemanMcClure", "Welsch", "DCS"]


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("nested", [False, True])
def test_a_robust_kernel_comes_back_as_it_was(kernel, nested):
    """gtsam loses half of Tukey's."""
    noise = gtsam.noiseModel.Isotropic.Sigma(6, 0.5)
    noise = gtsam.noiseModel.Robust.Create(getattr(gtsam.noiseModel.mEstimator, kernel).Create(20.0), noise)
    if nested:
        noise = gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Huber.Create(30.0), noise)

    def function(pose, jacobians):
        return gtsam.Pose3.Logmap(pose), [np.eye(6)]

    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(custom_factor(noise, [E], function, [6], 6))
    graph.add(gtsam.PriorFactorPose3(E, gtsam.Pose3(), noise))
    values.insert(E, gtsam.Pose3(gtsam.Rot3(), np.array([3.0, 1.0, -2.0])))
    packed = copy.deepcopy(PackedGraph.of(graph))
    for other in (clone_graph(graph), packed.unpack(), copy.deepcopy(packed).unpack()):
        for k in range(2):
            assert other.at(k).error(values) == graph.at(k).error(values)
            np.testing.assert_array_equal(
                other.at(k).linearize(values).augmentedJacobian(),
                graph.at(k).linearize(values).augmentedJacobian(),
            )


def test_a_kernel_that_gtsam_cannot_store_is_named():
    estimator = gtsam.noiseModel.mEstimator
    kernel = estimator.Custom(lambda d: 1.0, lambda d: d * d, estimator.Base.ReweightScheme.Block, "own")
    noise = gtsam.noiseModel.Robust.Create(kernel, gtsam.noiseModel.Unit.Create(6))
    graph = gtsam.NonlinearFactorGraph()
    graph.add(gtsam.PriorFactorPose3(E, gtsam.Pose3(), noise))
    with pytest.raises(FactorError, match="expected a kernel that gtsam can store"):
        pickle.dumps(PackedGraph.of(graph))

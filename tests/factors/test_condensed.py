"""Condensing loses nothing: algebra, then whole factors against their stacked form."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from sst_graph.factors import (
    FactorError,
    RobustKernel,
    condense,
    frame_factor,
    stacked,
    time_offset_prior,
    velocity_factor,
)
from sst_graph.factors.condensed import gram

E, D, B = (gtsam.symbol(letter, 0) for letter in "edb")


def system(seed, n, cols, rank=None):
    rng = np.random.default_rng(seed)
    J = rng.normal(size=(n, cols)) * np.logspace(-2, 4, cols)
    if rank is not None:
        J[:, rank:] = J[:, :rank] @ rng.normal(size=(rank, cols - rank))
    return J, rng.normal(size=n)


def assert_same(J, r, constant=0.0):
    rc, Jc = condense(gram(np.column_stack([J, r]).T), constant)
    assert Jc.shape == (J.shape[1] + 2, J.shape[1])
    assert (Jc[-1] == 0.0).all()
    scale = np.linalg.norm(J, axis=0)
    scale[scale == 0.0] = 1.0
    np.testing.assert_allclose(rc @ rc, r @ r + constant, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(Jc.T @ rc / scale, J.T @ r / scale, atol=1e-12 * max(np.linalg.norm(r), 1.0))
    np.testing.assert_allclose(
        Jc.T @ Jc / np.outer(scale, scale), J.T @ J / np.outer(scale, scale), atol=1e-12
    )


@pytest.mark.parametrize("rank", [None, 3, 1])
@pytest.mark.parametrize("n", [200, 5, 1])
def test_same_cost_gradient_and_hessian(n, rank):
    assert_same(*system(4, n, 7, rank), constant=0.7)


def test_exact_data_and_empty_systems():
    J, _ = system(5, 50, 7)
    assert_same(J, np.zeros(50))
    assert_same(J, J @ np.ones(7))
    assert_same(np.zeros((50, 7)), np.ones(50))
    assert_same(np.zeros((0, 7)), np.zeros(0))


def graph_of(scenes, bias, condensed):
    """Several frames on one extrinsic, one delay and one bias; a twist each."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    _, cTl, time_offset_s, _ = scenes[0][0]
    values.insert(E, cTl.retract(np.full(6, 0.01)))
    values.insert(D, np.array([time_offset_s + 0.01]))
    values.insert(B, np.array([bias]))
    for k, ((points, _, _, twist), (contour, *_)) in enumerate(scenes):
        V = gtsam.symbol("v", k)
        values.insert(V, twist + 0.05)
        factor = frame_factor([points, contour], E, D, V, [None, B])
        graph.add(factor if condensed else stacked(factor))
        graph.add(velocity_factor(V, twist, 0.01 * np.eye(6)))
    graph.add(time_offset_prior(D, time_offset_s, 0.05))
    return graph, values


@pytest.fixture(params=["none", "cauchy", "geman_mcclure"])
def graphs(request, make_scene):
    kernel = RobustKernel(request.param, 2.0)
    scenes = [
        (
            make_scene(k, 60, kernel=kernel),
            make_scene(k + 50, 40, kernel=kernel, normals=True, per_point=True),
        )
        for k in range(4)
    ]
    return graph_of(scenes, 0.3, True), graph_of(scenes, 0.3, False)


def relative(a, b):
    return np.abs(np.asarray(a) - np.asarray(b)).max() / np.abs(np.asarray(b)).max()


def test_condensed_factors_agree_with_stacked_ones(graphs):
    (condensed, values), (tall, _) = graphs
    assert condensed.error(values) == pytest.approx(tall.error(values), rel=1e-9)
    for k in range(condensed.size()):
        linear, whole = condensed.at(k).linearize(values), tall.at(k).linearize(values)
        assert relative(linear.augmentedInformation(), whole.augmentedInformation()) < 1e-9
    assert condensed.at(0).linearize(values).rows() == 14 + 2
    keys = [E, D, B]
    covariances = [
        gtsam.Marginals(graph, values).jointMarginalCovariance(keys).fullMatrix()
        for graph in (condensed, tall)
    ]
    sigmas = np.sqrt(np.diag(covariances[1]))
    assert (
        relative(covariances[0] / np.outer(sigmas, sigmas), covariances[1] / np.outer(sigmas, sigmas)) < 1e-9
    )


def test_linearization_is_true_to_the_error(graphs):
    (condensed, values), _ = graphs
    for k in range(condensed.size()):
        factor = condensed.at(k)
        at_rest = factor.linearize(values).error(values.localCoordinates(values))
        assert at_rest == pytest.approx(factor.error(values), rel=1e-12)


def test_same_path_of_levenberg_marquardt(graphs):
    results = [gtsam.LevenbergMarquardtOptimizer(graph, values).optimize() for graph, values in graphs]
    difference = results[0].localCoordinates(results[1])
    assert max(np.abs(difference.at(key)).max() for key in (E, D, B)) < 1e-7


@pytest.mark.parametrize(
    ("G", "named"),
    [
        (np.array([[1.0, 0.5], [0.0, 1.0]]), "symmetric"),
        (np.diag([1.0, -1.0]), "negative"),
        (np.array([[1.0, 2.0], [2.0, 1.0]]), "negative"),
    ],
)
def test_refuses_what_is_no_gram_matrix(G, named):
    with pytest.raises(FactorError, match=named):
        condense(G)

"""The sandwich's filling by brute force, the error model from its own draws, and gtsam's marginals."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import gtsam
import numpy as np
import pytest
from linear_systems import system_of, unknowns_of
from scipy.sparse import csr_array

from sst_graph.association.edge_matching import SIDES, TOP
from sst_graph.covariance.cluster_robust import covariance_of, steps_without_objects
from sst_graph.covariance.error_model import (
    ErrorModel,
    fit_error_model,
    freedom_of_sides,
    spread_beyond,
    with_floors,
)
from sst_graph.covariance.level_edges import LevelEdges, shares_that_stay
from sst_graph.covariance.match_table import MatchTable
from sst_graph.covariance.sums import ScoreSums, gram, total
from sst_graph.graph.state import EXTRINSIC, bias_key, time_offset_key, twist_key
from sst_graph.types import SemanticClass

VEHICLE = SemanticClass.VEHICLE


def random_table(seed: int, m: int = 40, n: int = 8) -> MatchTable:
    """Matches on 4 sides of two objects, each seen in 3 frames."""
    rng = np.random.default_rng(seed)
    sides = np.array([0, 1, 2, SIDES])[rng.integers(0, 4, m)]
    frames = rng.integers(0, 3, m)
    roots = rng.uniform(0.1, 1.0, m)
    J = rng.normal(0.0, 1.0, (m, n)) * roots[:, None]
    # The top is level; its rings are 1 m apart or so, its heights as the frames put it.
    errors = np.where(sides == TOP, rng.uniform(0.3, 0.9, m), 0.0)
    places = rng.normal(0.0, 0.1, (3, 3))[frames] + [0.0, 0.0, 1.5]
    level = LevelEdges(errors, places, rng.uniform(0.25, 0.35, m))
    return MatchTable(csr_array(J), roots, roots**2, rng.normal(size=m), sides, frames, level)


def drawn_table(model: ErrorModel, seed: int) -> MatchTable:
    """300 sides, 6 frames of each, 12 matches a frame, with residuals drawn from the model.

    A pose and a mask bias of each object (of three sides) have been fitted to them.
    """
    rng = np.random.default_rng(seed)
    frames = np.repeat(np.arange(1800), 12)
    sides = frames // 6
    fitted = np.column_stack([np.repeat(np.eye(100), 3, axis=0), rng.normal(size=(300, 6))])
    errors = rng.normal(0.0, np.sqrt(model.side), 300)
    r = (
        (errors - fitted @ np.linalg.lstsq(fitted, errors)[0])[sides]
        + rng.normal(0.0, np.sqrt(model.side_frame), 1800)[frames]
        + rng.normal(0.0, np.sqrt(model.match), len(frames))
    )
    names, ones = sides // 3 * SIDES + sides % 3, np.ones(len(r))
    level = LevelEdges.none(len(r))
    return MatchTable(csr_array((len(r), 8)), ones, ones, r, names, frames % 6, level)


@pytest.mark.parametrize("seed", range(3))
def test_steps_without_objects_are_those_of_solving_again(seed: int) -> None:
    table = replace(random_table(seed, m=60), sides=np.repeat(np.arange(5) * SIDES, 12))
    J, r = table.J.toarray(), table.root_weights * table.r
    # A prior that makes 0 the optimum of all: minimise |r + J x|^2 + |P^(1/2) (x - x0)|^2.
    P = np.diag(np.linspace(0.5, 2.0, J.shape[1]))
    x0 = np.linalg.solve(P, J.T @ r)
    steps = steps_without_objects(table, np.linalg.inv(J.T @ J + P))
    assert steps.shape == (5, J.shape[1])
    for number, step in enumerate(steps):
        rest = table.objects != number
        again = np.linalg.solve(J[rest].T @ J[rest] + P, P @ x0 - J[rest].T @ r[rest])
        np.testing.assert_allclose(step, again, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("tight", [1e-6, 1e-3])
def test_what_is_known_beside_the_matches_keeps_its_own_errors(tight: float) -> None:
    """Its covariance is no matter of the matches' errors, weights and objects."""
    table, known = random_table(3, m=60), np.zeros((8, 8))
    known[:7, :7] = np.eye(7) / tight**2
    bread = np.linalg.inv((table.J.T @ table.J).toarray() + known)
    found = covariance_of(bread, table, MODELS[0], known=known)
    np.testing.assert_allclose(np.sqrt(np.diag(found)[:7]) / tight, 1.0, rtol=1e-3)
    without = covariance_of(np.linalg.inv((table.J.T @ table.J).toarray()), table, MODELS[0])
    vague = covariance_of(
        np.linalg.inv((table.J.T @ table.J).toarray() + 1e-9 * np.eye(8)),
        table,
        MODELS[0],
        known=1e-9 * np.eye(8),
    )
    np.testing.assert_allclose(vague, without, rtol=1e-6, atol=1e-9)


def brute_force(table: MatchTable, model: ErrorModel) -> np.ndarray:
    """J^T Z R Z J with the residuals' covariance R (m, m) written out."""
    R = model.side * (table.sides[:, None] == table.sides)
    same = (table.sides[:, None] == table.sides) & (table.frames[:, None] == table.frames)
    R = R + model.side_frame * same
    R = R + model.match * np.eye(len(table.r))
    top = np.flatnonzero(table.sides == TOP)
    if len(top):
        own = table.take(top)
        _, which = np.unique(own.frames, return_inverse=True)
        moments = own.level.moments(own.root_weights**2, which, int(which.max()) + 1).sum(axis=0)
        errors = np.zeros(len(table.r))
        errors[top] = own.level.errors
        R = R + shares_that_stay(moments[None])[0] * np.outer(errors, errors)
    rows = table.root_weights[:, None] * table.J.toarray()
    return rows.T @ R @ rows


MODELS = [ErrorModel(0.7, 0.3, 1.4), ErrorModel(0.0, 0.5, 0.9), ErrorModel(0.6, 0.0, 1.0)]


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("model", MODELS)
def test_score_variance_by_brute_force(seed: int, model: ErrorModel) -> None:
    table = replace(random_table(seed), root_weights=np.ones(40))
    np.testing.assert_allclose(table.scores.variance(model), brute_force(table, model), atol=1e-10)


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("model", MODELS)
def test_score_variance_of_weighted_matches(seed: int, model: ErrorModel) -> None:
    table = random_table(seed)
    # What the clusters share is exact; all in all the variance is never below that of the model.
    shared = replace(model, match=0.0)
    np.testing.assert_allclose(table.scores.variance(shared), brute_force(table, shared), atol=1e-10)
    excess = table.scores.variance(model) - brute_force(table, model)
    assert np.linalg.eigvalsh(excess)[0] > -1e-9


def test_independent_matches_keep_their_information() -> None:
    table = replace(random_table(0), level=LevelEdges.none(40))
    np.testing.assert_allclose(table.scores.variance(ErrorModel(0.0, 0.0, 1.0)), gram(table.J))
    np.testing.assert_allclose(table.scores.excess(ErrorModel(0.0, 0.0, 1.0)), 0.0, atol=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_frames_add_up_and_can_be_left_out(seed: int) -> None:
    """Frame by frame, in other columns, with sides closed: the sums of all matches at once."""
    table, model = random_table(seed), ErrorModel(0.7, 0.3, 1.4)
    parts = [table.take(np.flatnonzero(table.frames == frame)) for frame in range(3)]
    one, two, three = (part.scores for part in parts)
    expected = table.scores.variance(model)
    np.testing.assert_allclose((one + two + three).variance(model), expected, rtol=1e-9)
    np.testing.assert_allclose((table.scores - three).variance(model), (one + two).variance(model), rtol=1e-9)
    first = parts[0]
    dense = ScoreSums.of_frame(first.J.toarray(), first.root_weights, first.sides, first.level)
    np.testing.assert_allclose(dense.variance(model), one.variance(model), rtol=1e-9)
    columns = np.array([9, 0, 3, 4, 1, 7, 2, 5])
    apart = total(10, [one, two, three], [columns] * 3)
    np.testing.assert_allclose(apart.columns(columns).variance(model), expected, rtol=1e-9)
    assert not apart.independent[[6, 8]].any()
    closed = (one + two + three).without_sides([0, 2])
    assert closed.sides.tolist() == [1, SIDES] and closed.level.closed.any()
    np.testing.assert_allclose(closed.variance(model), expected, rtol=1e-9)
    T = np.random.default_rng(seed).normal(size=(5, 8))
    np.testing.assert_allclose(closed.transformed(T).variance(model), T @ expected @ T.T, rtol=1e-9)
    np.testing.assert_allclose(closed.scaled(0.3).variance(model), 0.09 * expected, rtol=1e-9)


def test_fitted_variances_are_those_drawn() -> None:
    model = ErrorModel(1.5, 0.6, 0.9)
    fitted = [fit_error_model(drawn_table(model, seed).residuals) for seed in range(4)]
    assert np.mean([f.match for f in fitted]) == pytest.approx(model.match, rel=0.03)
    assert np.mean([f.side_frame for f in fitted]) == pytest.approx(model.side_frame, rel=0.08)
    assert np.mean([f.side for f in fitted]) == pytest.approx(model.side, rel=0.12)


def test_what_the_fit_swallows() -> None:
    assert freedom_of_sides(300, 100) == pytest.approx(194 / 300)
    assert freedom_of_sides(12, 7) == freedom_of_sides(0, 0) == 0.25


def test_floors() -> None:
    residuals = drawn_table(ErrorModel(0.0, 0.0, 1.0), 0).residuals
    fitted = fit_error_model(residuals)
    assert fitted == with_floors(0.0, 0.0, fitted.match)
    assert min(fitted.side, fitted.side_frame) > 0.1 * fitted.match
    assert fitted.match == pytest.approx(1.0, rel=0.03)
    assert with_floors(9.0, 8.0, 1.0) == ErrorModel(9.0, 8.0, 1.0)


def test_spread_beyond() -> None:
    rng = np.random.default_rng(2)
    groups = np.repeat(np.arange(500), 8)
    variances = rng.uniform(0.2, 1.0, 4000)
    means = rng.normal(0.0, 5.0, 500)[groups] + rng.normal(0.0, np.sqrt(variances + 0.8))
    assert spread_beyond(means, variances, groups) == pytest.approx(0.8, rel=0.1)
    quiet = rng.normal(0.0, np.sqrt(variances))
    assert spread_beyond(quiet, variances, groups) == pytest.approx(0.0, abs=0.04)
    one = np.zeros(4000, dtype=int)
    assert spread_beyond(quiet + 2.0, variances, one, centre=0.0) == pytest.approx(4.0, rel=0.1)
    # One mean in each group tells nothing of a spread.
    assert spread_beyond(means[:5], variances[:5], np.arange(5)) == 0.0


def small_graph() -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Linear ties between extrinsic, offset, a bias and two twists, with correlated noise."""
    rng = np.random.default_rng(5)
    twists = {twist_key(0, 3): 6, twist_key(0, 7): 6}
    keys = {EXTRINSIC: 6, time_offset_key(): 1, bias_key(0, VEHICLE): 1, **twists}
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    values.insert(EXTRINSIC, gtsam.Pose3(gtsam.Rot3.Ypr(0.3, -0.2, 0.1), np.array([0.1, 0.2, 0.3])))
    for key in list(keys)[1:]:
        values.insert(key, rng.normal(size=keys[key]))
    for _ in range(6):
        # JacobianFactors take three keys at most: tie them two at a time, the twists to the others alone.
        *others, V, W = [[key, rng.normal(size=(4, dim))] for key, dim in keys.items()]
        for one, other in [*pairwise(others), (others[-1], V), (others[0], W)]:
            noise = gtsam.noiseModel.Isotropic.Sigma(4, rng.uniform(0.5, 2.0))
            linear = gtsam.JacobianFactor(*one, *other, rng.normal(size=4), noise)
            graph.add(gtsam.LinearContainerFactor(linear, values))
    for key, dim in keys.items():
        prior = gtsam.JacobianFactor(
            key, np.eye(dim), np.zeros(dim), gtsam.noiseModel.Isotropic.Sigma(dim, 3.0)
        )
        graph.add(gtsam.LinearContainerFactor(prior, values))
    return graph, values


def test_marginals_are_gtsams() -> None:
    graph, values = small_graph()
    system = system_of(graph, values)
    found, unknowns = system.covariance(), system.unknowns
    joint = gtsam.Marginals(graph, values).jointMarginalCovariance(list(unknowns.keys))
    expected = np.block([[joint.at(a, b) for b in unknowns.keys] for a in unknowns.keys])
    assert found.shape == (8, 8) == (unknowns.size, unknowns.size)
    np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-10)
    # How a twist follows the others: its covariance with them over theirs.
    responses = system.twist_responses()
    assert set(responses) == {twist_key(0, 3), twist_key(0, 7)}
    for V, response in responses.items():
        both = gtsam.Marginals(graph, values).jointMarginalCovariance([V, *unknowns.keys])
        cross = np.hstack([both.at(V, key) for key in unknowns.keys])
        np.testing.assert_allclose(response @ expected, cross, rtol=1e-8, atol=1e-10)


def test_columns_of_the_unknowns() -> None:
    unknowns = unknowns_of(small_graph()[0])
    assert [unknowns.column(key) for key in unknowns.keys] == [0, 6, 7]

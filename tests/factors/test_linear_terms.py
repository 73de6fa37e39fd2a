"""Scalars with a column in closed form beside a frame's factor."""

from __future__ import annotations

import dataclasses

import gtsam
import numpy as np
import pytest

from sst_graph.factors import (
    Alignment,
    FactorError,
    GroupedBias,
    LinearTerm,
    PinholeCamera,
    RobustKernel,
    frame_factor,
    stacked,
)

CAMERA = PinholeCamera(700.0, 700.0, 600.0, 180.0, 1242, 375)
AXES = gtsam.Rot3(np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]))
E, D, B, N, M = (gtsam.symbol(letter, 0) for letter in "EDBNM")


def silhouettes(seed: int, n: int = 30) -> Alignment:
    rng = np.random.default_rng(seed)
    normals = rng.standard_normal((n, 2))
    return Alignment(
        camera=CAMERA,
        lPs=np.column_stack([rng.uniform(5, 30, n), rng.uniform(-4, 4, n), rng.uniform(-1, 1, n)]),
        base_taus_s=rng.uniform(-0.05, 0.05, n),
        pixels=rng.uniform([0, 0], [1242, 375], (n, 2)),
        sigmas_px=rng.uniform(0.5, 2.0, n),
        normals=normals / np.linalg.norm(normals, axis=1, keepdims=True),
        kernel=RobustKernel("geman_mcclure", 200.0),
    )


def values_at(theta: float, other: float) -> gtsam.Values:
    values = gtsam.Values()
    values.insert(E, gtsam.Pose3(AXES, np.array([0.1, 0.0, -0.2])))
    for key, number in ((D, 0.02), (B, 0.5), (N, theta), (M, other)):
        values.insert(key, np.array([number]))
    return values


def two_terms(condensed: bool) -> tuple[gtsam.CustomFactor, list[Alignment], np.ndarray]:
    parts = [silhouettes(1), silhouettes(2, 20)]
    rng = np.random.default_rng(7)
    a, b, c = rng.standard_normal(30), rng.standard_normal(20), rng.standard_normal(20)
    terms = [[LinearTerm(N, a, 0.1)], [LinearTerm(N, b, 0.1), LinearTerm(M, c)]]
    twist = np.array([0.0, 0.01, 0.0, 0.1, 0.0, 8.0])
    factor = frame_factor(parts, E, D, twist, B, terms=terms)
    return factor if condensed else stacked(factor), parts, np.append(a, b)


def test_the_residual_moves_by_coefficient_times_step() -> None:
    factor, parts, coefficients = two_terms(condensed=False)
    whitened = coefficients / np.concatenate([part.sigmas_px for part in parts])
    plain = stacked(frame_factor(parts, E, D, np.array([0.0, 0.01, 0.0, 0.1, 0.0, 8.0]), B))
    at = plain.unwhitenedError(values_at(0.1, 0.0))
    np.testing.assert_allclose(factor.unwhitenedError(values_at(0.1, 0.0)), at, atol=1e-12)
    # Of a wide kernel the weights hardly change: the residual moves by the column.
    step = (factor.unwhitenedError(values_at(0.1001, 0.0)) - at)[:50]
    np.testing.assert_allclose(step[np.abs(at[:50]) < 2], 1e-4 * whitened[np.abs(at[:50]) < 2], rtol=0.05)


def test_condensed_and_stacked_have_one_cost_gradient_and_hessian() -> None:
    values = values_at(0.15, -0.2)
    tall, condensed = (two_terms(condensed)[0].linearize(values) for condensed in (False, True))
    np.testing.assert_allclose(condensed.information(), tall.information(), rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(
        condensed.augmentedInformation(), tall.augmentedInformation(), rtol=1e-9, atol=1e-6
    )


def test_the_gradient_is_that_of_the_cost() -> None:
    factor, _, _ = two_terms(condensed=True)
    values = values_at(0.15, -0.2)
    gradient = -factor.linearize(values).augmentedInformation()[:-1, -1]
    keys = list(factor.keys())
    for key in (N, M):
        column = sum(6 if k == E else 1 for k in keys[: keys.index(key)])
        moved = []
        for sign in (1.0, -1.0):
            other = gtsam.Values(values)
            other.update(key, values.atVector(key) + sign * 1e-5)
            moved.append(factor.error(other))
        assert gradient[column] == pytest.approx((moved[0] - moved[1]) / 2e-5, rel=1e-5)


def test_an_optimiser_finds_the_scalar() -> None:
    """Residuals made with a known scalar give it back."""
    part = silhouettes(4, 200)
    part = Alignment(
        CAMERA, part.lPs, part.base_taus_s, part.pixels, part.sigmas_px, part.normals, RobustKernel()
    )
    column = np.random.default_rng(9).standard_normal(200)
    twist = np.zeros(6)
    pose = gtsam.Pose3(AXES, np.array([0.1, 0.0, -0.2]))
    r = stacked(frame_factor([part], pose, D, twist)).unwhitenedError(values_at(0, 0))[:200]
    pixels = part.pixels + (r * part.sigmas_px + 0.3 * column)[:, None] * part.normals
    rest = part.sigmas_px, part.normals, RobustKernel()
    exact = Alignment(CAMERA, part.lPs, part.base_taus_s, pixels, *rest)
    graph = gtsam.NonlinearFactorGraph()
    graph.add(frame_factor([exact], pose, D, twist, None, terms=[[LinearTerm(N, column)]]))
    start = gtsam.Values()
    start.insert(D, np.array([0.02]))
    start.insert(N, np.array([0.0]))
    found = gtsam.LevenbergMarquardtOptimizer(graph, start).optimize()
    assert found.atVector(N)[0] == pytest.approx(0.3, abs=1e-6)
    assert found.atVector(D)[0] == pytest.approx(0.02, abs=1e-6)


def test_wrong_terms_are_named() -> None:
    part = silhouettes(1)
    points = Alignment(CAMERA, part.lPs, 0.0, part.pixels, 1.0)
    with pytest.raises(FactorError, match="terms"):
        frame_factor([part], E, D, None, B, terms=[])
    with pytest.raises(FactorError, match="point-to-pixel"):
        frame_factor([points], E, D, None, None, terms=[[LinearTerm(N, np.zeros(30))]])
    with pytest.raises(FactorError, match="coefficients"):
        frame_factor([part], E, D, None, B, terms=[[LinearTerm(N, np.zeros(3))]])
    with pytest.raises(FactorError, match="key"):
        frame_factor([part], E, D, None, B, terms=[[LinearTerm(E, np.zeros(30))]])


@pytest.mark.parametrize("condensed", [True, False])
def test_a_point_behind_the_camera_tells_nothing_of_a_term(condensed: bool) -> None:
    part, column = silhouettes(4, 12), np.linspace(1.0, 2.0, 12)
    points = part.lPs.copy()
    points[3, 0] = -10.0
    behind = dataclasses.replace(part, lPs=points)
    front = part.take(np.delete(np.arange(12), 3))
    values = values_at(0.3, 0.0)
    twist = np.zeros(6)
    both = [
        frame_factor([matches], E, D, twist, B, terms=[[LinearTerm(N, own)]])
        for matches, own in ((behind, column), (front, np.delete(column, 3)))
    ]
    both = both if condensed else [stacked(factor) for factor in both]
    hessians = [factor.linearize(values).augmentedInformation()[:-1, :-1] for factor in both]
    np.testing.assert_allclose(*hessians, rtol=1e-9, atol=1e-9 * np.abs(hessians[0]).max())
    costs = [factor.error(values_at(theta, 0.0)) for factor in both for theta in (0.3, 0.4)]
    assert costs[1] - costs[0] == pytest.approx(costs[3] - costs[2], rel=1e-9)


@pytest.mark.parametrize("condensed", [True, False])
def test_biases_and_terms_that_share_a_key_add_up(condensed: bool) -> None:
    """Two objects with one mask bias, and a scalar of which two terms tell: the gradient is that of the
    cost."""
    part = silhouettes(3)
    a, b = np.random.default_rng(8).standard_normal((2, 30))
    bias = GroupedBias((B, B), np.arange(30) % 2)
    factor = frame_factor([part], E, D, None, [bias], terms=[[LinearTerm(N, a), LinearTerm(N, b)]])
    factor = factor if condensed else stacked(factor)
    values = values_at(0.3, 0.0)
    graph = gtsam.GaussianFactorGraph()
    graph.add(factor.linearize(values))
    gradient = graph.gradientAtZero()
    for key in (B, N):
        costs = []
        for step in (1e-4, -1e-4):
            moved = gtsam.Values(values)
            moved.update(key, values.atVector(key) + step)
            costs.append(factor.error(moved))
        np.testing.assert_allclose(gradient.at(key), (costs[0] - costs[1]) / 2e-4, rtol=1e-5)

"""Graduated non-convexity: which factors of a graph are outliers.

``gtsam.GncLMOptimizer`` clones its graph, which gtsam 4.3 cannot where there is a ``CustomFactor``.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from ..arguments import FloatArray, checked_number, checked_positive, checked_type, described, is_whole
from ..errors import FactorError
from .cloning import checked_graph, own_recipe
from .variables import checked_values, factors_of


@dataclass(frozen=True)
class GncParams:
    """Graduated non-convexity with the truncated least squares kernel.

    Attributes:
        inlier_cost: cost (half the squared whitened error) that an inlier may have; one number, or a function
            of the factor's position. Of an image with n matches under a bounded kernel it is about n.
        mu_step: factor on the control parameter at each iteration, above 1.
        max_iterations: Levenberg-Marquardt solutions, at most.
        weights_tolerance: the weights have converged when all are nearer than this to 0 or 1.

    Raises:
        FactorError: a value out of its range.
    """

    inlier_cost: float | Callable[[int], float]
    mu_step: float = 1.4
    max_iterations: int = 60
    weights_tolerance: float = 1e-3

    def __post_init__(self) -> None:
        if not callable(self.inlier_cost):
            checked_positive("inlier_cost", self.inlier_cost)
        if not 1.0 < checked_number("mu_step", self.mu_step) < 1e6:
            raise FactorError("mu_step", described(self.mu_step), "above 1 and below 1e6")
        if not (is_whole(self.max_iterations) and 1 <= self.max_iterations <= 100_000):
            raise FactorError(
                "max_iterations", described(self.max_iterations), "a whole number up to 100,000"
            )
        if not 0.0 < checked_number("weights_tolerance", self.weights_tolerance) < 0.5:
            raise FactorError("weights_tolerance", described(self.weights_tolerance), "above 0 and below 0.5")


@dataclass(frozen=True, eq=False)
class GncSolution:
    """What :func:`gnc` found.

    Attributes:
        values: the estimate.
        weights: (factors,) from 0 (outlier) to 1 (inlier); NaN in empty slots.
        iterations: Levenberg-Marquardt solutions.
        converged: all weights are 0 or 1.
    """

    values: gtsam.Values
    weights: FloatArray
    iterations: int
    converged: bool


def gnc(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    config: GncParams,
    known_inliers: Collection[int] = (),
) -> GncSolution:
    """Which factors are outliers, and the solution without them; ``gtsam.GncLMOptimizer`` for any factor.

    Yang et al., Graduated Non-Convexity for Robust Spatial Perception, RA-L 2020, algorithm 1 with TLS. A
    factor is weighted as a whole by its noise: an image of this package's factors is in or out, while the
    kernel within it weighs its matches.

    Args:
        graph: factors with a Gaussian noise model (where they have a Robust one, name them inliers).
        values: start.
        config: cost of an inlier, step of mu, and limits.
        known_inliers: positions of factors that keep the weight 1.

    Raises:
        FactorError: a factor that cannot be weighted, no value for one of its keys, or no graph.
    """
    checked_graph("graph of gnc", graph)
    checked_values("values of gnc", values, factors_of(graph))
    checked_type("config of gnc", config, GncParams, "a sst_graph.factors.GncParams")
    expected = "positions of factors, as a list or a set"
    checked_type("known_inliers of gnc", known_inliers, (list, tuple, set, frozenset, range), expected)
    for position in known_inliers:
        if not is_whole(position) or not 0 <= position < graph.size():
            expected = f"positions from 0 to {graph.size() - 1}"
            raise FactorError("known_inliers of gnc", described(position), expected)
    slots = [i for i in range(graph.size()) if graph.exists(i)]
    weighted = [i for i in slots if i not in set(known_inliers)]
    limits = np.array([_limit(config, i) for i in weighted])
    weights = np.full(graph.size(), np.nan)
    weights[slots] = 1.0
    values = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    costs = np.array([graph.at(i).error(values) for i in weighted])
    worst = float((costs / limits).max(initial=0.0))
    if worst <= 1.0:
        return GncSolution(values, weights, 1, True)
    mu, iterations, converged = 1.0 / (2.0 * worst - 1.0), 1, False
    while not converged and iterations < config.max_iterations:
        weights[weighted] = _tls_weights(costs / limits, mu)
        values = gtsam.LevenbergMarquardtOptimizer(_weighted(graph, weights), values).optimize()
        costs = np.array([graph.at(i).error(values) for i in weighted])
        own = weights[weighted]
        converged = bool((np.minimum(own, 1.0 - own) < config.weights_tolerance).all()) and mu > 1.0
        mu, iterations = config.mu_step * mu, iterations + 1
    return GncSolution(values, weights, iterations, converged)


def _limit(config: GncParams, position: int) -> float:
    limit = config.inlier_cost(position) if callable(config.inlier_cost) else config.inlier_cost
    return checked_positive("inlier_cost", limit)


def _tls_weights(ratios: FloatArray, mu: float) -> FloatArray:
    """Weights by cost over limit: 1 below mu / (mu + 1), 0 above (mu + 1) / mu."""
    between = np.sqrt(mu * (mu + 1.0) / np.maximum(ratios, 1e-300)) - mu
    return np.where(ratios <= mu / (mu + 1.0), 1.0, np.where(ratios >= (mu + 1.0) / mu, 0.0, between))


def _weighted(graph: gtsam.NonlinearFactorGraph, weights: FloatArray) -> gtsam.NonlinearFactorGraph:
    whole = gtsam.NonlinearFactorGraph()
    for i, weight in enumerate(weights):
        if np.isnan(weight):
            continue
        whole.add(graph.at(i) if weight == 1.0 else scaled(graph.at(i), max(float(weight), 1e-9)))
    return whole


def scaled(factor: gtsam.NonlinearFactor, weight: float) -> gtsam.NonlinearFactor:
    """The factor with ``weight`` times its cost.

    Raises:
        FactorError: it has no Gaussian noise model.
    """
    weight = checked_positive("weight of a factor", weight)
    noise = factor.noiseModel() if isinstance(factor, gtsam.NoiseModelFactor) else None
    if not isinstance(noise, gtsam.noiseModel.Gaussian) or noise.isConstrained():
        raise FactorError(f"noise of {type(factor).__name__}", type(noise).__name__, "a Gaussian noise model")
    wider = gtsam.noiseModel.Gaussian.SqrtInformation(np.sqrt(weight) * noise.R())
    if isinstance(factor, gtsam.CustomFactor):
        return replace(own_recipe(factor), noise=wider).build()
    assert isinstance(factor, gtsam.NoiseModelFactor)  # it has a noise model
    return factor.cloneWithNewNoiseModel(wider)

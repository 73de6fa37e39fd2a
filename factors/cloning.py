"""Copies of graphs that hold this package's factors, and graduated non-convexity over them.

gtsam 4.3 has no ``clone()`` for a ``CustomFactor``: ``graph.clone()``, ``copy.deepcopy``, ``rekey``, pickling
and ``gtsam.GncLMOptimizer`` fail on it, and on any graph that holds one. A factor of this package gives its
recipe (:func:`sst_graph.factors.recipe_of`), from which it is built anew.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from .custom import FactorRecipe, recipe_of
from .errors import FactorError, checked_positive, described
from .variables import checked_key

FloatArray = NDArray[np.float64]


def clone_factor(factor: gtsam.NonlinearFactor) -> gtsam.NonlinearFactor:
    """A factor that shares nothing with this one: gtsam's own clone, or one built anew from its recipe.

    Raises:
        FactorError: a ``CustomFactor`` that another made.
    """
    if not isinstance(factor, gtsam.CustomFactor):
        return factor.clone()
    return copy.deepcopy(_recipe(factor)).build()


def clone_graph(graph: gtsam.NonlinearFactorGraph) -> gtsam.NonlinearFactorGraph:
    """What ``graph.clone()`` is where all factors can; empty slots stay empty."""
    cloned = gtsam.NonlinearFactorGraph()
    cloned.resize(graph.size())
    for i in range(graph.size()):
        if graph.exists(i):
            cloned.replace(i, clone_factor(graph.at(i)))
    return cloned


def rekeyed(factor: gtsam.NonlinearFactor, new_keys: Mapping[int, int]) -> gtsam.NonlinearFactor:
    """The factor on other keys, what ``factor.rekey`` is where it can; keys that are not named stay.

    A condensed factor looks its variables up by position, so only its keys change.

    Raises:
        FactorError: two variables on one key, or a ``CustomFactor`` that another made.
    """
    if not isinstance(factor, gtsam.CustomFactor):
        return factor.rekey([new_keys.get(int(key), int(key)) for key in list(factor.keys())])
    recipe = _recipe(factor)
    keys = [checked_key("rekeyed", "new_keys", new_keys.get(key, key)) for key in recipe.keys]
    if len(set(keys)) != len(keys):
        raise FactorError("new_keys of rekeyed", "one key for two variables", "distinct keys")
    return replace(recipe, keys=dict(zip(keys, recipe.keys.values(), strict=True))).build()


@dataclass(frozen=True)
class PackedGraph:
    """A graph as ``pickle`` and ``copy.deepcopy`` take it: recipes of this package's factors, the others as
    they are. Unpack only what you packed yourself: a pickle may run any code.

    Attributes:
        factors: by slot; None where it is empty.
    """

    factors: tuple[FactorRecipe | Any | None, ...]

    @staticmethod
    def of(graph: gtsam.NonlinearFactorGraph) -> PackedGraph:
        """Pack a graph.

        Raises:
            FactorError: it holds a ``CustomFactor`` that another made.
        """
        slots = [graph.at(i) if graph.exists(i) else None for i in range(graph.size())]
        return PackedGraph(
            tuple(_recipe(each) if isinstance(each, gtsam.CustomFactor) else each for each in slots)
        )

    def unpack(self) -> gtsam.NonlinearFactorGraph:
        """The graph."""
        graph = gtsam.NonlinearFactorGraph()
        graph.resize(len(self.factors))
        for i, each in enumerate(self.factors):
            if each is not None:
                graph.replace(i, each.build() if isinstance(each, FactorRecipe) else each)
        return graph


def _recipe(factor: gtsam.CustomFactor) -> FactorRecipe:
    recipe = recipe_of(factor)
    if recipe is None:
        keys = ", ".join(gtsam.DefaultKeyFormatter(key) for key in list(factor.keys()))
        expected = "one of sst_graph.factors.custom_factor"
        raise FactorError(f"CustomFactor on {keys}", "one that another made", expected)
    return recipe


@dataclass(frozen=True)
class GncParams:
    """Graduated non-convexity with the truncated least squares kernel.

    Attributes:
        inlier_cost: cost (half the squared whitened error) that an inlier may have; one number, or a function
            of the factor's position. Of an image with n matches under a bounded kernel it is about n.
        growth: of the control parameter, round by round, above 1.
        most_rounds: rounds, at most.
        settled: weights are settled when all are nearer than this to 0 or 1.

    Raises:
        FactorError: a value out of its range.
    """

    inlier_cost: float | Callable[[int], float]
    growth: float = 1.4
    most_rounds: int = 60
    settled: float = 1e-3

    def __post_init__(self) -> None:
        if not 1.0 < self.growth < 1e6:
            raise FactorError("growth", described(self.growth), "above 1 and below 1e6")
        if not (isinstance(self.most_rounds, int) and 1 <= self.most_rounds <= 100_000):
            raise FactorError("most_rounds", described(self.most_rounds), "a whole number from 1 to 100,000")
        if not 0.0 < self.settled < 0.5:
            raise FactorError("settled", described(self.settled), "above 0 and below 0.5")


@dataclass(frozen=True)
class GncSolution:
    """Attributes:
    values: the estimate.
    weights: (factors,) from 0 (outlier) to 1 (inlier); NaN in empty slots.
    rounds: Levenberg-Marquardt solutions.
    settled: all weights are 0 or 1.
    """

    values: gtsam.Values
    weights: FloatArray
    rounds: int
    settled: bool


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
        config: see there.
        known_inliers: positions of factors that are not judged.

    Raises:
        FactorError: a factor that cannot be weighted.
    """
    slots = [i for i in range(graph.size()) if graph.exists(i)]
    judged = [i for i in slots if i not in set(known_inliers)]
    limits = np.array([_limit(config, i) for i in judged])
    weights = np.full(graph.size(), np.nan)
    weights[slots] = 1.0
    values = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    costs = np.array([graph.at(i).error(values) for i in judged])
    worst = float((costs / limits).max(initial=0.0))
    if worst <= 1.0:
        return GncSolution(values, weights, 1, True)
    mu, rounds, settled = 1.0 / (2.0 * worst - 1.0), 1, False
    while not settled and rounds < config.most_rounds:
        weights[judged] = _tls_weights(costs / limits, mu)
        values = gtsam.LevenbergMarquardtOptimizer(_weighted(graph, weights), values).optimize()
        costs = np.array([graph.at(i).error(values) for i in judged])
        own = weights[judged]
        settled = bool((np.minimum(own, 1.0 - own) < config.settled).all()) and mu > 1.0
        mu, rounds = config.growth * mu, rounds + 1
    return GncSolution(values, weights, rounds, settled)


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
        return replace(_recipe(factor), noise=wider).build()
    assert isinstance(factor, gtsam.NoiseModelFactor)  # it has a noise model
    return factor.cloneWithNewNoiseModel(wider)

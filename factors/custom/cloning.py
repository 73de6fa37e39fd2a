"""Copies of graphs that hold this package's factors: clones, other keys, pickles.

gtsam 4.3 has no ``clone()`` for a ``CustomFactor``: ``graph.clone()``, ``copy.deepcopy``, ``rekey``, pickling
and ``gtsam.GncLMOptimizer`` fail on it, and on any graph that holds one. A factor of this package gives its
recipe (:func:`sst_graph.factors.recipe_of`), from which it is built again.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import gtsam

from ..arguments import checked_type
from ..errors import FactorError
from .factor import FactorRecipe, recipe_of
from .stored_noise import StoredNoise, stored_noise
from .variables import checked_key


def clone_factor(factor: gtsam.NonlinearFactor) -> gtsam.NonlinearFactor:
    """A factor that shares nothing with this one: gtsam's own clone, or one built again from its recipe.

    Raises:
        FactorError: a ``CustomFactor`` that another made, or no factor.
    """
    _checked_factor("factor of clone_factor", factor)
    if not isinstance(factor, gtsam.CustomFactor):
        return factor.clone()
    return copy.deepcopy(own_recipe(factor)).build()


def clone_graph(graph: gtsam.NonlinearFactorGraph) -> gtsam.NonlinearFactorGraph:
    """What ``graph.clone()`` is where all factors can; empty slots stay empty.

    Raises:
        FactorError: it holds a ``CustomFactor`` that another made, or is no graph.
    """
    checked_graph("graph of clone_graph", graph)
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
        FactorError: no keys, two variables on one key, or a ``CustomFactor`` that another made.
    """
    _checked_factor("factor of rekeyed", factor)
    checked_type("new_keys of rekeyed", new_keys, Mapping, "a dict from old keys to new ones")
    new = {
        checked_key("rekeyed", "new_keys", old): checked_key("rekeyed", "new_keys", key)
        for old, key in new_keys.items()
    }
    if not isinstance(factor, gtsam.CustomFactor):
        old = [int(key) for key in list(factor.keys())]
        return factor.rekey(_distinct([new.get(key, key) for key in old], len(set(old))))
    recipe = own_recipe(factor)
    keys = _distinct([new.get(key, key) for key in recipe.keys], len(recipe.keys))
    return replace(recipe, keys=dict(zip(keys, recipe.keys.values(), strict=True))).build()


def _distinct(keys: list[int], variables: int) -> list[int]:
    """The new keys, where they are as many as the variables."""
    if len(set(keys)) != variables:
        raise FactorError("new_keys of rekeyed", "one key for two variables", "distinct keys")
    return keys


@dataclass(frozen=True)
class PackedGraph:
    """A graph as ``pickle`` and ``copy.deepcopy`` take it: recipes of this package's factors, the others as
    they are. Unpack only what you packed yourself: a pickle may run any code.

    Attributes:
        factors: by slot; None where it is empty.

    Raises:
        FactorError: something else than factors and recipes.
    """

    factors: tuple[FactorRecipe | Any | None, ...]

    def __post_init__(self) -> None:
        checked_type("factors of PackedGraph", self.factors, tuple, "a tuple, as PackedGraph.of makes it")
        expected = "a FactorRecipe, a factor of a gtsam graph, or None"
        for each in self.factors:
            kinds = (FactorRecipe, gtsam.NonlinearFactor, type(None))
            checked_type("factors of PackedGraph", each, kinds, expected)

    def __reduce__(self) -> tuple[Any, ...]:
        """For copies and pickles: each factor, and its noise where gtsam would not store that whole."""
        return _packed, tuple((each, _noise_apart(each)) for each in self.factors)

    @staticmethod
    def of(graph: gtsam.NonlinearFactorGraph) -> PackedGraph:
        """Pack a graph.

        Raises:
            FactorError: it holds a ``CustomFactor`` that another made, or is no graph.
        """
        checked_graph("graph of PackedGraph", graph)
        slots = [graph.at(i) if graph.exists(i) else None for i in range(graph.size())]
        return PackedGraph(
            tuple(own_recipe(each) if isinstance(each, gtsam.CustomFactor) else each for each in slots)
        )

    def unpack(self) -> gtsam.NonlinearFactorGraph:
        """The graph."""
        graph = gtsam.NonlinearFactorGraph()
        graph.resize(len(self.factors))
        for i, each in enumerate(self.factors):
            if each is not None:
                graph.replace(i, each.build() if isinstance(each, FactorRecipe) else each)
        return graph


def _noise_apart(factor: Any) -> StoredNoise | None:
    """The noise of a factor of gtsam's own, where it is to be stored in parts."""
    if not isinstance(factor, gtsam.NonlinearFactor) or not hasattr(factor, "noiseModel"):
        return None
    stored = stored_noise(factor.noiseModel())
    return stored if isinstance(stored, StoredNoise) else None


def _packed(*factors: tuple[Any, StoredNoise | None]) -> PackedGraph:
    """A packed graph that was stored."""
    return PackedGraph(
        tuple(
            each if noise is None else each.cloneWithNewNoiseModel(noise.restored())
            for each, noise in factors
        )
    )


def checked_graph(what: str, graph: Any) -> None:
    """Nothing, where it is a graph of nonlinear factors."""
    checked_type(what, graph, gtsam.NonlinearFactorGraph, "a gtsam.NonlinearFactorGraph")


def _checked_factor(what: str, factor: Any) -> None:
    checked_type(what, factor, gtsam.NonlinearFactor, "a factor of a gtsam graph")


def own_recipe(factor: gtsam.CustomFactor) -> FactorRecipe:
    """The recipe of one of this package's factors.

    Raises:
        FactorError: another made it.
    """
    recipe = recipe_of(factor)
    if recipe is None:
        keys = ", ".join(gtsam.DefaultKeyFormatter(key) for key in list(factor.keys()))
        expected = "one of sst_graph.factors.custom_factor"
        raise FactorError(f"CustomFactor on {keys}", "one that another made", expected)
    return recipe

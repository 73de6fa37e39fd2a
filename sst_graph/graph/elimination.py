"""The unknowns that are not motion, with the motion of a frozen graph marginalised out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import gtsam
import numpy as np

from sst_graph.graph.building import tracked_objects
from sst_graph.graph.linear import scale_of, with_ridge
from sst_graph.graph.matching import PairMatches
from sst_graph.graph.state import EXTRINSIC, State, bias_key, nuisance_key, object_bias_key, time_offset_key
from sst_graph.types import FloatArray, IntArray


@dataclass(frozen=True)
class Unknowns:
    """Columns of the unknowns that are not motion: the extrinsic, the clocks, parameters of assumptions that
    are estimated, the mask biases."""

    keys: tuple[int, ...]

    @classmethod
    def of(cls, state: State, pairs: Sequence[PairMatches]) -> Unknowns:
        clocks = [time_offset_key(clock) for clock in range(len(state.time_offsets_s))]
        names = dict.fromkeys(name for pair in pairs for own in pair.terms.values() for name in own)
        biases = {bias_key(pair.drive, c) for pair in pairs for c in pair.matches}
        objects = {object_bias_key(drive, track) for drive, _, track in tracked_objects(pairs)}
        return cls((EXTRINSIC, *clocks, *map(nuisance_key, names), *sorted(biases), *sorted(objects)))

    @property
    def size(self) -> int:
        return 6 + len(self.keys) - 1

    @cached_property
    def _places(self) -> dict[int, int]:
        return {key: 0 if place == 0 else 5 + place for place, key in enumerate(self.keys)}

    def column(self, key: int) -> int:
        """First column of a key."""
        return self._places[key]

    def columns(self, key: int) -> IntArray:
        """All columns of a key: six of the extrinsic, one of every other."""
        first = self._places[key]
        return np.arange(first, first + (6 if first == 0 else 1))


@dataclass(frozen=True)
class Eliminated:
    """A frozen graph, linear, whose motion is to be eliminated.

    Attributes:
        unknowns: that stay.
        own: (n, n) information of the factors without motion.
        groups: that of the others by groups of motion.
    """

    unknowns: Unknowns
    own: FloatArray
    groups: Sequence[_Group]

    @classmethod
    def of(cls, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, unknowns: Unknowns) -> Eliminated:
        """The graph linearized at some values."""
        return cls(unknowns, *_information(graph, values, unknowns))

    def covariance(self) -> FloatArray:
        """(n, n) covariance of the unknowns with the motion marginalised out.

        By a scaled Schur complement, for gtsam.Marginals gives up at condition numbers near 1e9, which metres
        and pixels in one matrix reach although every direction is observable. Twists that no factor ties to
        one another are eliminated one after the other: a dense Hessian of a long drive would take a gigabyte.
        """
        own = self.own
        # Scaled to a unit diagonal, that of the motion too.
        diagonal = np.diag(own).copy()
        for group in self.groups:
            diagonal[group.columns] += np.diag(group.information)[: len(group.columns)]
        scale = scale_of(diagonal)
        schur = with_ridge(own * np.outer(scale, scale))
        for columns, information, _ in self.groups:
            m = len(columns)
            scales = np.concatenate([scale[columns], scale_of(np.diag(information)[m:])])
            H = information * np.outer(scales, scales)
            inner = with_ridge(H[m:, m:])
            schur[np.ix_(columns, columns)] += H[:m, :m] - H[:m, m:] @ np.linalg.solve(inner, H[m:, :m])
        return np.asarray(np.linalg.inv(schur) * np.outer(scale, scale))

    def twist_responses(self) -> dict[int, FloatArray]:
        """(6, n) derivative of the optimum of each twist by the unknowns, by the twist's key."""
        found = {}
        for group in self.groups:
            m = len(group.columns)
            for at, key in zip(range(m, len(group.information), 6), group.motion, strict=True):
                rows = group.information[at : at + 6]
                response = np.zeros((6, self.unknowns.size))
                response[:, group.columns] = -np.linalg.solve(rows[:, at : at + 6], rows[:, :m])
                found[key] = response
        return found


def marginal_covariance(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, unknowns: Unknowns
) -> FloatArray:
    """:meth:`Eliminated.covariance` of a graph."""
    return Eliminated.of(graph, values, unknowns).covariance()


class _Group(NamedTuple):
    """Motion that factors tie together, such as one twist.

    Attributes:
        columns: (m,) unknowns that these factors touch as well.
        information: (m + k, m + k) of these factors, over the columns and the motion.
        motion: keys of the motion.
    """

    columns: IntArray
    information: FloatArray
    motion: tuple[int, ...]


def _information(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, unknowns: Unknowns
) -> tuple[FloatArray, list[_Group]]:
    """(n, n) information of the factors without motion, and that of the others by groups of motion."""
    linear, known = graph.linearize(values), set(unknowns.keys)
    own = np.zeros((unknowns.size, unknowns.size))
    together = _Together()
    terms: list[tuple[list[int], FloatArray]] = []
    for i in range(linear.size()):
        factor = linear.at(i)
        keys, information = list(factor.keys()), np.asarray(factor.information())
        moving = [key for key in keys if key not in known]
        if moving:
            together.join(moving)
            terms.append((keys, information))
        else:
            columns = np.concatenate([unknowns.columns(key) for key in keys])
            own[np.ix_(columns, columns)] += information
    by_group: dict[int, list[tuple[list[int], FloatArray]]] = {}
    for keys, information in terms:
        first = next(key for key in keys if key not in known)
        by_group.setdefault(together.root(first), []).append((keys, information))
    sizes = values.zeroVectors()
    return own, [_group(parts, unknowns, sizes) for parts in by_group.values()]


def _group(
    parts: Sequence[tuple[list[int], FloatArray]], unknowns: Unknowns, sizes: gtsam.VectorValues
) -> _Group:
    """The sum of some factors' information."""
    known = set(unknowns.keys)
    motion = sorted({key for keys, _ in parts for key in keys if key not in known})
    touched = sorted({key for keys, _ in parts for key in keys if key in known}, key=unknowns.column)
    columns = np.concatenate([np.zeros(0, np.intp), *map(unknowns.columns, touched)])
    place = {key: np.searchsorted(columns, unknowns.columns(key)) for key in touched}
    end = len(columns)
    for key in motion:
        place[key] = np.arange(end, end + len(sizes.at(key)))
        end += len(place[key])
    information = np.zeros((end, end))
    for keys, part in parts:
        at = np.concatenate([place[key] for key in keys])
        information[np.ix_(at, at)] += part
    return _Group(columns, information, tuple(motion))


class _Together:
    """Keys that belong to the same group (union and find)."""

    def __init__(self) -> None:
        self._above: dict[int, int] = {}

    def root(self, key: int) -> int:
        while (above := self._above.setdefault(key, key)) != key:
            self._above[key] = key = self._above[above]
        return key

    def join(self, keys: Sequence[int]) -> None:
        first = self.root(keys[0])
        for key in keys[1:]:
            self._above[self.root(key)] = first

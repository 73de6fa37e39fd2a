"""The unknowns that are not motion, with the motion of a frozen graph marginalised out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.problem.graph import PairMatches, tracked_objects
from sst_graph.problem.state import EXTRINSIC, State, bias_key, delay_key, nuisance_key, object_bias_key

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Unknowns:
    """Columns of the unknowns that are not motion: the extrinsic, the clocks, parameters of assumptions that
    are estimated, the mask biases."""

    keys: tuple[int, ...]

    @classmethod
    def of(cls, state: State, pairs: Sequence[PairMatches]) -> Unknowns:
        delays = [delay_key(clock) for clock in range(len(state.offsets_s))]
        names = dict.fromkeys(name for pair in pairs for own in pair.terms.values() for name in own)
        biases = {bias_key(pair.drive, c) for pair in pairs for c in pair.matches}
        objects = {object_bias_key(drive, track) for drive, _, track in tracked_objects(pairs)}
        return cls((EXTRINSIC, *delays, *map(nuisance_key, names), *sorted(biases), *sorted(objects)))

    @property
    def size(self) -> int:
        return 6 + len(self.keys) - 1

    def column(self, key: int) -> int:
        """First column of a key."""
        place = self.keys.index(key)
        return 0 if place == 0 else 5 + place


def marginal_covariance(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, unknowns: Unknowns
) -> FloatArray:
    """(n, n) covariance of the unknowns with the motion marginalised out.

    From the dense Hessian by a scaled Schur complement, for gtsam.Marginals gives up at condition
    numbers near 1e9, which metres beside pixels reach without any direction being unobservable.
    """
    hessian = graph.linearize(values).hessian(_ordering(values, unknowns))[0]
    n = unknowns.size
    scale = 1.0 / np.sqrt(np.maximum(np.diag(hessian), 1e-300))
    scaled = hessian * np.outer(scale, scale)
    inverse = np.linalg.inv(scaled + 1e-14 * np.eye(len(scaled)))[:n, :n]
    return np.asarray(inverse * np.outer(scale[:n], scale[:n]))


def twist_responses(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, unknowns: Unknowns
) -> dict[int, FloatArray]:
    """(6, n) how the optimum of each twist follows the unknowns, by the twist's key."""
    hessian, n = graph.linearize(values).hessian(_ordering(values, unknowns))[0], unknowns.size
    return {
        key: np.asarray(-np.linalg.solve(hessian[at : at + 6, at : at + 6], hessian[at : at + 6, :n]))
        for at, key in zip(range(n, len(hessian), 6), _twists(values, unknowns), strict=True)
    }


def _ordering(values: gtsam.Values, unknowns: Unknowns) -> gtsam.Ordering:
    ordering = gtsam.Ordering()
    for key in unknowns.keys:
        ordering.push_back(key)
    for key in _twists(values, unknowns):
        ordering.push_back(key)
    return ordering


def _twists(values: gtsam.Values, unknowns: Unknowns) -> list[int]:
    """Keys of the motion: every other unknown of the graph."""
    return sorted(set(values.keys()) - set(unknowns.keys))

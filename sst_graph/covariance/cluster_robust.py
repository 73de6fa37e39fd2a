"""Cluster-robust covariance of the estimate: errors of neighbouring matches are correlated.

Matches of one side of one object share the error of the mask there: within a frame, and in part over all
frames that see the object (:mod:`sst_graph.covariance.error_model`). The inverse of the information of the
frozen graph, which takes all matches for independent, is the outer factor (the "bread") of a sandwich whose
inner factor is the variance of the score under this model (:mod:`sst_graph.covariance.sums`).

Robust weights are frozen in the graph, as if the kernel stayed as steep as it is on average to the middle;
under heavy tails it is flatter where it counts (Huber, Robust statistics, 1981, sec. 3.2), and the covariance
grows with the square of that ratio.

Some objects have errors that the model does not describe. Where one such object alone determines a direction,
the residuals do not show it: see :mod:`sst_graph.covariance.jackknife`.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import gtsam
import numpy as np

from sst_graph.covariance.error_model import ErrorModel, fit_error_model
from sst_graph.covariance.jackknife import ObjectSpread, composed, steps_without
from sst_graph.covariance.match_table import MatchTable, match_table
from sst_graph.covariance.sums import ScoreSums
from sst_graph.graph.elimination import NormalEquations, Unknowns
from sst_graph.graph.known import KnownCalibration, information_beside
from sst_graph.graph.matching import PairMatches
from sst_graph.graph.state import State
from sst_graph.objects.tracks import ObjectId
from sst_graph.types import FloatArray


@dataclass(frozen=True)
class RobustCovariance:
    """A cluster-robust covariance and what it was made of.

    Attributes:
        bread: (n, n) covariance of [extrinsic 6, offsets, parameters, biases] if all matches were
            independent.
        unknowns: its columns.
        table: the matches.
        known: (n, n) information that is not of the matches, and is right as it is.
    """

    bread: FloatArray
    unknowns: Unknowns
    table: MatchTable
    known: FloatArray

    @cached_property
    def model(self) -> ErrorModel:
        """The error model of the matches."""
        return fit_error_model(self.table.residuals)

    @cached_property
    def matrix(self) -> FloatArray:
        """(n, n) cluster-robust covariance."""
        return covariance_of(self.bread, self.table, self.model, known=self.known)


def robust_covariance(
    system: NormalEquations,
    values: gtsam.Values,
    pairs: Sequence[PairMatches],
    state: State,
    tracks: Sequence[dict[ObjectId, int]],
    prior: KnownCalibration | None = None,
) -> RobustCovariance:
    """Covariance of the unknowns that are not motion, from a frozen problem and its matches.

    Args:
        system: the problem, linear at its optimum ``values``.
        state: that the matches were made at.
        prior: what is known beside the matches, a factor of the graph.
    """
    table = match_table(system, values, pairs, state, tracks)
    known = information_beside(prior, system.unknowns)
    return RobustCovariance(system.covariance(), system.unknowns, table, known)


def covariance_of(
    bread: FloatArray,
    table: MatchTable,
    model: ErrorModel,
    scores: ScoreSums | None = None,
    known: FloatArray | None = None,
) -> FloatArray:
    """(n, n) covariance under an error model of the matches.

    Args:
        bread: (n, n) the same if all matches were independent.
        scores: of the matches, where they are known; by default from the table.
        known: (n, n) information in the bread that is not of the matches: its part of the covariance is that
            of its own errors, whatever those of the matches are.
    """
    scores = table.scores if scores is None else scores
    of_known = np.zeros_like(bread) if known is None else bread @ known @ bread
    covariance = bread - of_known + bread @ scores.excess(model) @ bread
    spread = ObjectSpread.of(steps_without_objects(table, bread), table.object_weights)
    covariance = composed(covariance, spread, table.weight_curvature_ratio) + of_known
    return np.asarray(0.5 * (covariance + covariance.T))


def steps_without_objects(table: MatchTable, bread: FloatArray) -> FloatArray:
    """(objects, n) how far the linearized estimate moves when one object after the other is left out."""
    order = np.argsort(table.objects, kind="stable")
    J, r = table.J[order], (table.root_weights * table.r)[order]
    bounds = np.flatnonzero(np.diff(table.objects[order])) + 1
    steps = []
    for start, end in itertools.pairwise([0, *bounds.tolist(), len(order)]):
        columns = np.unique(J.indices[J.indptr[start] : J.indptr[end]])
        own = J[start:end].toarray()[:, columns]
        information, score = own.T @ own, own.T @ r[start:end]
        steps.append(steps_without(information[None], score[None], columns[None], bread)[0])
    return np.stack(steps)

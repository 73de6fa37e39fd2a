"""Information of each frame: by itself, added to all other frames, and in their order.

Without a frame, the covariance is made again from all other matches as
:mod:`sst_graph.covariance.cluster_robust` makes it: information, error model, and the objects left out in
turn. The matches and their robust weights are kept; the estimate takes the Gauss-Newton step to the
optimum of the other frames, and the residuals follow. Without that step, the left-out frame's gradient would
stay in the residuals, and the jackknife over objects would count it as disagreement among them.

The covariance of the frames up to one, and of one by itself, is a sandwich under the error model of all: the
information of the frames with the motion marginalised out, and the sums of their scores; sides that several
frames see keep their shared error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from sst_graph.covariance.cluster_robust import RobustCovariance, covariance_of
from sst_graph.covariance.error_model import ErrorModel, fit_error_model
from sst_graph.covariance.match_table import MatchTable
from sst_graph.covariance.sums import ScoreSums, total
from sst_graph.drive.preparation import Drive
from sst_graph.errors import count_of
from sst_graph.graph.elimination import Unknowns
from sst_graph.graph.linear import information_inverse
from sst_graph.graph.matching import PairMatches
from sst_graph.graph.state import State, time_offset_key, twist_key
from sst_graph.inspect.frame_information import FrameInformation, positive_part
from sst_graph.inspect.gained import bits_between
from sst_graph.result import FrameId
from sst_graph.types import FloatArray, IntArray


@dataclass(frozen=True)
class FrameTerm:
    """The factors of one frame, its motion marginalised out.

    Attributes:
        columns: (c,) unknowns that they touch.
        information: (c, c) H of their quadratic 1/2 d' H d - g' d.
        vector: (c,) g.
    """

    columns: IntArray
    information: FloatArray
    vector: FloatArray


@dataclass(frozen=True)
class CovarianceSums:
    """Sums over frames, priors included, over n unknowns.

    Attributes:
        information: (n, n).
        scores: of the matches.
    """

    information: FloatArray
    scores: ScoreSums

    def plus(self, term: FrameTerm, scores: ScoreSums) -> CovarianceSums:
        """These frames and one more; its scores are in its own columns."""
        information, every = self.information.copy(), np.arange(len(self.information))
        information[np.ix_(term.columns, term.columns)] += term.information
        return CovarianceSums(information, total(len(every), (self.scores, scores), (every, term.columns)))

    def covariance(self, model: ErrorModel) -> FloatArray:
        """(n, n) cluster-robust covariance."""
        bread = information_inverse(self.information)
        covariance = bread + bread @ self.scores.excess(model) @ bread
        return np.asarray(0.5 * (covariance + covariance.T))


def frame_gains(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    pairs: Sequence[PairMatches],
    state: State,
    drives: Sequence[Drive],
    robust: RobustCovariance,
) -> tuple[FrameInformation, ...]:
    """Information of each pair, in their order; pairs that share a scan or an image count as one."""
    unknowns, table, model = robust.unknowns, robust.table, robust.model
    # 1. Of each frame its factors and the scores of its matches.
    prior, twisted = _frame_information(graph, values, unknowns)
    groups = _groups(pairs)
    terms = [_joined([twisted[key] for key in group.twists]) for group in groups]
    scores = [_scores(table, group.rows, term) for group, term in zip(groups, terms, strict=True)]
    columns = [_own(unknowns, state, group.pair) for group in groups]
    # 2. One frame after the other.
    sums, before = CovarianceSums(prior, ScoreSums.none(len(prior))), []
    for term, own_scores, own in zip(terms, scores, columns, strict=True):
        sums = sums.plus(term, own_scores)
        before.append(np.diag(sums.covariance(model))[own])
    # 3. Each by itself, and added to all the others.
    found, prior_covariance = [], np.asarray(np.linalg.inv(prior))
    after = np.diag(sums.covariance(model))
    for k, group in enumerate(groups):
        own = columns[k]
        without = _left_out(robust, sums, terms[k], scores[k], group.rows)[np.ix_(own, own)]
        view = _view(terms[k], scores[k], prior_covariance, int(own[6]), model)
        gain = _Gain(robust.matrix[np.ix_(own, own)], without, before[k] / after[own])
        found.append(_entry(group, drives[group.pair.drive], state.cTl, view, gain))
    return tuple(found)


def _left_out(
    robust: RobustCovariance, sums: CovarianceSums, term: FrameTerm, scores: ScoreSums, rows: IntArray
) -> FloatArray:
    """(n, n) covariance of a calibration without a frame, its matches and their weights as they are.

    The whole of it is made again from the matches that are left, error model and objects left out in turn
    included: a frame that contradicts the others widens both, and leaving it out narrows them.
    """
    information = sums.information.copy()
    information[np.ix_(term.columns, term.columns)] -= term.information
    bread = information_inverse(information)
    kept = np.delete(np.arange(len(robust.table.r)), rows)
    if len(kept) == 0:
        return bread
    # All gradients sum to nothing at the optimum: those of the others to minus this one's.
    table = robust.table.take(kept).after(-bread[:, term.columns] @ term.vector)
    others = sums.scores - total(len(bread), (scores,), (term.columns,))
    return covariance_of(bread, table, fit_error_model(table.residuals), others, robust.known)


@dataclass(frozen=True)
class _Group:
    """Pairs that share a scan or an image.

    Attributes:
        pair: the first of them.
        rows: in the table of matches.
        twists: keys of their images' twists.
    """

    pair: PairMatches
    rows: IntArray
    twists: tuple[int, ...]


def _groups(pairs: Sequence[PairMatches]) -> list[_Group]:
    """In the order of their first pairs."""
    from_row = np.cumsum([0, *(len(pair) for pair in pairs)])
    groups: dict[tuple[int, int], _Group] = {}
    owners: dict[int, tuple[int, int]] = {}
    for k, pair in enumerate(pairs):
        rows, twist = np.arange(from_row[k], from_row[k + 1]), twist_key(pair.drive, pair.pair.image)
        # A scan with several images, or an image with several scans, is a group; never both at once.
        owner = owners.setdefault(twist, (pair.drive, pair.pair.scan))
        group = groups.get(owner, _Group(pair, rows[:0], ()))
        twists = dict.fromkeys((*group.twists, twist))
        groups[owner] = _Group(group.pair, np.concatenate([group.rows, rows]), tuple(twists))
    return list(groups.values())


def _joined(terms: Sequence[FrameTerm]) -> FrameTerm:
    """The sum of some factors, their columns rising."""
    columns = np.unique(np.concatenate([term.columns for term in terms]))
    H, g = np.zeros((len(columns), len(columns))), np.zeros(len(columns))
    for term in terms:
        at = np.searchsorted(columns, term.columns)
        H[np.ix_(at, at)] += term.information
        g[at] += term.vector
    return FrameTerm(columns, H, g)


def _own(unknowns: Unknowns, state: State, pair: PairMatches) -> IntArray:
    """(7,) columns of the extrinsic and of the pair's clock."""
    return np.array([*range(6), unknowns.column(time_offset_key(state.clock(pair.drive)))])


def _frame_information(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, unknowns: Unknowns
) -> tuple[FloatArray, dict[int, FrameTerm]]:
    """(n, n) information of all that no twist takes part in; the rest by twist."""
    n, known = unknowns.size, set(unknowns.keys)
    prior = np.zeros((n, n))
    terms: dict[int, list[FrameTerm]] = {}
    linear = graph.linearize(values)
    for i in range(linear.size()):
        factor = linear.at(i)
        keys = list(factor.keys())
        twists = [key for key in keys if key not in known]
        if len(twists) > 1:
            raise ValueError(f"a factor on {count_of(len(twists), 'twist')}: frames are no longer separate")
        columns = np.concatenate([_columns(key, unknowns) for key in keys])
        if twists:
            augmented = factor.augmentedInformation()
            term = FrameTerm(columns, augmented[:-1, :-1], augmented[:-1, -1])
            terms.setdefault(twists[0], []).append(term)
        else:
            prior[np.ix_(columns, columns)] += factor.information()
    return prior, {twist: _marginal(_joined(found), n) for twist, found in terms.items()}


def _columns(key: int, unknowns: Unknowns) -> IntArray:
    if key not in unknowns.keys:
        return np.arange(unknowns.size, unknowns.size + 6)
    first = unknowns.column(key)
    return np.arange(first, first + (6 if first == 0 else 1))


def _marginal(term: FrameTerm, n: int) -> FrameTerm:
    """On the columns below ``n``, with the twist marginalised out."""
    columns, H, g = term.columns, term.information, term.vector
    m = int(np.searchsorted(columns, n))
    response = np.linalg.solve(H[m:, m:], H[m:, :m])
    return FrameTerm(columns[:m], H[:m, :m] - H[:m, m:] @ response, g[:m] - response.T @ g[m:])


def _scores(table: MatchTable, rows: IntArray, term: FrameTerm) -> ScoreSums:
    """Sums of the scores of some matches, in the columns of their frame."""
    some = table.take(rows)
    J = some.J[:, term.columns].toarray()
    return ScoreSums.of(J, some.root_weights, some.sides, some.frames, some.level)


def _view(
    term: FrameTerm, scores: ScoreSums, prior_covariance: FloatArray, offset: int, model: ErrorModel
) -> FloatArray:
    """(6, 6) information on the extrinsic of one frame alone, the offset known, mask biases estimated."""
    keep = np.flatnonzero(term.columns != offset)
    columns = term.columns[keep]
    prior = np.linalg.inv(prior_covariance[np.ix_(columns, columns)])
    information = prior + term.information[np.ix_(keep, keep)]
    covariance = CovarianceSums(information, scores.columns(keep)).covariance(model)[:6, :6]
    own = np.linalg.inv(prior_covariance[:6, :6])
    return positive_part(np.linalg.inv(covariance) - own)


@dataclass(frozen=True)
class _Gain:
    """Uncertainty of extrinsic and time offset with and without a frame.

    Attributes:
        full: (7, 7) covariance with all frames.
        without: (7, 7) covariance without this one.
        so_far: (7,) variances with the frames up to this one, over those with all.
    """

    full: FloatArray
    without: FloatArray
    so_far: FloatArray


def _entry(group: _Group, drive: Drive, cTl: gtsam.Pose3, view: FloatArray, gain: _Gain) -> FrameInformation:
    """``view``: (6, 6) information by itself."""
    pair = group.pair
    lPs = np.concatenate([m.alignment.lPs for m in pair.matches.values()])
    us = np.concatenate([m.alignment.pixels[:, 0] for m in pair.matches.values()])
    sigmas = np.sqrt(np.diag(gain.full))
    return FrameInformation(
        FrameId(drive.name, drive.scans[pair.pair.scan].index),
        bits_between(gain.without, gain.full),
        np.sqrt(np.maximum(np.diag(gain.without), 0.0)) / sigmas,
        np.sqrt(np.maximum(gain.so_far, 0.0)),
        view,
        np.asarray(cTl.inverse().AdjointMap() @ pair.motion.c_twist),
        len(group.rows),
        sum(len(np.unique(m.objects)) for m in pair.matches.values()),
        float(np.linalg.norm(lPs, axis=1).min()),
        float((us < drive.camera.cx).mean()),
    )

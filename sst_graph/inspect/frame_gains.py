"""What each frame brings to the covariance: by itself, beside all the others, and one after the other.

Without a frame, the covariance is made anew from all other matches as
:mod:`sst_graph.covariance.cluster_robust` makes it: information, error model, and the objects left out in
turn. The matches and their robust weights stay as they are; the estimate takes the Gauss-Newton step to the
optimum of the other frames, and the residuals follow. Without that step, the left-out frame's pull would
stay in the residuals, and the spread over objects would take it for their disagreement.

The covariance of the frames up to one, and of one by itself, is a sandwich under the error model of all: H
sums the frames' information with the motion marginalised out, the surplus their scores; sides that several
frames see keep their shared error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.covariance.cluster_robust import (
    ErrorModel,
    MatchTable,
    RobustCovariance,
    covariance_of,
    fit_error_model,
    views_of,
)
from sst_graph.drive.preparation import Drive
from sst_graph.graph.building import PairMatches
from sst_graph.graph.elimination import Unknowns
from sst_graph.graph.state import State, time_offset_key, twist_key
from sst_graph.inspect.frame_information import FrameInformation, positive_part
from sst_graph.result import FrameId

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]


@dataclass(frozen=True)
class FrameTerm:
    """What the factors of one frame say, its motion marginalised out.

    Attributes:
        columns: (c,) unknowns that it tells something about.
        information: (c, c) H of its quadratic 1/2 d' H d - g' d.
        pull: (c,) g.
    """

    columns: IntArray
    information: FloatArray
    pull: FloatArray


@dataclass(frozen=True)
class FramePart:
    """One frame's part in the sums behind the covariance.

    Attributes:
        term: what its factors say.
        surplus: (c, c) variance of its score beyond that of independent matches, without what sides share
            over frames.
        sides: (s,) sides it sees.
        scores: (s, c) score of each side for a unit of the side's error.
    """

    term: FrameTerm
    surplus: FloatArray
    sides: IntArray
    scores: FloatArray


@dataclass
class Sums:
    """Sums over frames, priors included; all over the unknowns (n).

    Attributes:
        information: (n, n).
        surplus: (n, n).
        scores: (sides, n).
        side: variance that a side shares over frames.
    """

    information: FloatArray
    surplus: FloatArray
    scores: FloatArray
    side: float

    def add(self, part: FramePart, sign: float = 1.0) -> None:
        """Take a frame in, or out with ``sign`` -1."""
        columns = part.term.columns
        block = np.ix_(columns, columns)
        self.information[block] += sign * part.term.information
        self.surplus[block] += sign * part.surplus
        self.scores[np.ix_(part.sides, columns)] += sign * part.scores

    def covariance(self, columns: IntArray) -> FloatArray:
        """Cluster-robust covariance of some of the unknowns."""
        scale = 1.0 / np.sqrt(np.maximum(np.diag(self.information), 1e-300))
        scaled = self.information * np.outer(scale, scale) + 1e-14 * np.eye(len(scale))
        chosen = np.eye(len(scale))[:, columns]
        rows = np.linalg.solve(scaled, chosen * scale[:, None]).T * scale
        shared = rows @ self.scores.T
        covariance = rows[:, columns] + rows @ self.surplus @ rows.T + self.side * (shared @ shared.T)
        return np.asarray(0.5 * (covariance + covariance.T))


def frame_gains(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    pairs: Sequence[PairMatches],
    state: State,
    drives: Sequence[Drive],
    robust: RobustCovariance,
) -> tuple[FrameInformation, ...]:
    """What each pair brought, in the order of the pairs; pairs that share an image count as one."""
    unknowns, table, model = robust.unknowns, robust.table, robust.model
    prior, twisted = _frame_information(graph, values, unknowns)
    groups = _groups(pairs)
    parts = [_part(table, rows, twisted[key], model) for key, (_, rows) in groups.items()]
    sums = Sums(
        prior.copy(), np.zeros_like(prior), np.zeros((int(table.sides.max()) + 1, len(prior))), model.side
    )
    before = []
    columns = [_own(unknowns, state, pair) for pair, _ in groups.values()]
    for part, own in zip(parts, columns, strict=True):
        sums.add(part)
        before.append(sums.covariance(own))
    found = []
    prior_covariance = np.asarray(np.linalg.inv(prior))
    moving = np.concatenate([np.full(len(pair), pair.moved) for pair in pairs])
    for (pair, rows), part, own, seen in zip(groups.values(), parts, columns, before, strict=True):
        full, without = (
            robust.matrix[np.ix_(own, own)],
            _left_out(robust, sums, part.term, rows, moving)[np.ix_(own, own)],
        )
        view = _view(part, prior_covariance, int(own[6]), model.side)
        so_far = np.diag(seen) / np.diag(sums.covariance(own))
        found.append(_entry(pair, len(rows), drives, state, view, full, without, so_far))
    return tuple(found)


def _left_out(
    robust: RobustCovariance, sums: Sums, term: FrameTerm, rows: IntArray, moving: NDArray[np.bool_]
) -> FloatArray:
    """(n, n) covariance of a calibration without a frame, its matches and their weights as they are.

    The whole of it is made anew from the matches that are left, error model and objects left out in turn
    included: a frame that contradicts the others widens both, and leaving it out narrows them. ``moving``:
    (m,) whether the LiDAR moved, for each match.
    """
    information = sums.information.copy()
    information[np.ix_(term.columns, term.columns)] -= term.information
    scale = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    scaled = information * np.outer(scale, scale) + 1e-14 * np.eye(len(scale))
    bread = np.asarray(np.linalg.inv(scaled)) * np.outer(scale, scale)
    kept = np.delete(np.arange(len(robust.table.r)), rows)
    if len(kept) == 0:
        return bread
    # All pulls sum to nothing at the optimum: those of the others to minus this one's.
    table = robust.table.take(kept).moved(-bread[:, term.columns] @ term.pull)
    views = views_of(table.sides, table.side_frames, moving[kept], table.root_weights**2)
    table = replace(table, views=views)
    return covariance_of(0.5 * (bread + bread.T), table, fit_error_model(table))


def _groups(pairs: Sequence[PairMatches]) -> dict[int, tuple[PairMatches, IntArray]]:
    """For each image's twist: its (first) pair, and its rows in the table of matches."""
    from_row = np.cumsum([0, *(len(pair) for pair in pairs)])
    groups: dict[int, tuple[PairMatches, IntArray]] = {}
    for k, pair in enumerate(pairs):
        rows = np.arange(from_row[k], from_row[k + 1])
        key = twist_key(pair.drive, pair.pair.image)
        first, before = groups.get(key, (pair, rows[:0]))
        groups[key] = (first, np.concatenate([before, rows]))
    return groups


def _own(unknowns: Unknowns, state: State, pair: PairMatches) -> IntArray:
    """(7,) columns of the extrinsic and of the pair's clock."""
    return np.array([*range(6), unknowns.column(time_offset_key(state.clock(pair.drive)))])


def _frame_information(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, unknowns: Unknowns
) -> tuple[FloatArray, dict[int, FrameTerm]]:
    """(n, n) information of all that no twist takes part in; the rest by twist."""
    n, known = unknowns.size, set(unknowns.keys)
    prior = np.zeros((n, n))
    terms: dict[int, list[tuple[IntArray, FloatArray]]] = {}
    linear = graph.linearize(values)
    for i in range(linear.size()):
        factor = linear.at(i)
        keys = list(factor.keys())
        twists = [key for key in keys if key not in known]
        if len(twists) > 1:
            raise ValueError(f"a factor on {len(twists)} twists: frames are no longer separate")
        columns = np.concatenate([_columns(key, unknowns) for key in keys])
        if twists:
            terms.setdefault(twists[0], []).append((columns, factor.augmentedInformation()))
        else:
            prior[np.ix_(columns, columns)] += factor.information()
    return prior, {twist: _marginal(found, n) for twist, found in terms.items()}


def _columns(key: int, unknowns: Unknowns) -> IntArray:
    if key not in unknowns.keys:
        return np.arange(unknowns.size, unknowns.size + 6)
    first = unknowns.column(key)
    return np.arange(first, first + (6 if first == 0 else 1))


def _marginal(terms: Sequence[tuple[IntArray, FloatArray]], n: int) -> FrameTerm:
    """What augmented information says of the columns below ``n``, with the twist marginalised out."""
    columns = np.unique(np.concatenate([columns for columns, _ in terms]))
    H, g = np.zeros((len(columns), len(columns))), np.zeros(len(columns))
    for touched, augmented in terms:
        at = np.searchsorted(columns, touched)
        H[np.ix_(at, at)] += augmented[:-1, :-1]
        g[at] += augmented[:-1, -1]
    m = int(np.searchsorted(columns, n))
    response = np.linalg.solve(H[m:, m:], H[m:, :m])
    return FrameTerm(columns[:m], H[:m, :m] - H[:m, m:] @ response, g[:m] - response.T @ g[m:])


def _part(table: MatchTable, rows: IntArray, term: FrameTerm, model: ErrorModel) -> FramePart:
    J, z = table.J[rows][:, term.columns].toarray(), table.root_weights[rows]
    sides, of_side = np.unique(table.sides[rows], return_inverse=True)
    scores = np.stack([np.bincount(of_side, z * column, len(sides)) for column in J.T], axis=1)
    in_frame = np.unique(table.side_frames[rows], return_inverse=True)[1]
    sums = np.stack([np.bincount(in_frame, z * column) for column in J.T], axis=1)
    surplus = (model.match - 1.0) * (J.T @ J) + model.side_frame * (sums.T @ sums)
    return FramePart(
        term,
        np.asarray(surplus),
        np.asarray(sides, dtype=np.intp),
        np.asarray(scores, dtype=np.float64),
    )


def _view(part: FramePart, prior_covariance: FloatArray, offset: int, side: float) -> FloatArray:
    """(6, 6) information on the extrinsic of one frame alone, the offset known, mask biases estimated."""
    keep = np.flatnonzero(part.term.columns != offset)
    columns = part.term.columns[keep]
    prior = np.linalg.inv(prior_covariance[np.ix_(columns, columns)])
    alone = Sums(
        prior + part.term.information[np.ix_(keep, keep)],
        part.surplus[np.ix_(keep, keep)],
        part.scores[:, keep],
        side,
    )
    own = np.linalg.inv(prior_covariance[:6, :6])
    return positive_part(np.linalg.inv(alone.covariance(np.arange(6))) - own)


def _entry(
    pair: PairMatches,
    matches: int,
    drives: Sequence[Drive],
    state: State,
    view: FloatArray,
    full: FloatArray,
    without: FloatArray,
    so_far: FloatArray,
) -> FrameInformation:
    """``full``, ``without``: (7, 7) covariances; ``so_far``: (7,) variances over those of all frames."""
    drive = drives[pair.drive]
    lPs = np.concatenate([m.alignment.lPs for m in pair.matches.values()])
    us = np.concatenate([m.alignment.pixels[:, 0] for m in pair.matches.values()])
    sigmas = np.sqrt(np.diag(full))
    return FrameInformation(
        FrameId(drive.name, drive.scans[pair.pair.scan].index),
        0.5 * float(_log_det(without) - _log_det(full)) / float(np.log(2.0)),
        np.sqrt(np.maximum(np.diag(without), 0.0)) / sigmas,
        np.sqrt(np.maximum(so_far, 0.0)),
        view,
        np.asarray(state.cTl.inverse().AdjointMap() @ pair.motion.c_twist),
        matches,
        sum(len(np.unique(m.objects)) for m in pair.matches.values()),
        float(np.linalg.norm(lPs, axis=1).min()),
        float((us < drive.camera.cx).mean()),
    )


def _log_det(covariance: FloatArray) -> float:
    sigmas = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(sigmas, sigmas)
    return float(np.linalg.slogdet(correlation)[1] + 2.0 * np.log(sigmas).sum())

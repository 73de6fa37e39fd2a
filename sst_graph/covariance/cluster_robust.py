"""The covariance of the estimate: cluster-robust, for neighbouring matches err together.

Matches of one side of one object share the error of the mask there: within a frame, and in part over
all frames that see the object. Each whitened residual is modelled as

    r_i = b_side + b_side,frame + e_i,

with three variances fitted from the residuals (method of moments). The information of the frozen
graph, which takes all matches for independent, becomes the bread of a sandwich whose filling is the
variance of the score under this model.

Robust weights are frozen in the graph, as if the kernel stayed as steep as it is on average to the middle;
under heavy tails it is flatter where it counts (Huber, Robust statistics, 1981, sec. 3.2), and the covariance
grows with the square of that ratio.

Some objects err as no model of the others says: two that were merged, one half hidden. Where such an
object has a direction to itself, the residuals do not show it:
see :mod:`sst_graph.covariance.jackknife`.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse import csr_array

from sst_graph.association.edge_matching import SIDES
from sst_graph.covariance.jackknife import ObjectSpread, composed, step_without
from sst_graph.factors.alignment import weighted_residuals
from sst_graph.factors.robust import RobustKernel
from sst_graph.graph.building import PairMatches, bias_groups, state_from
from sst_graph.graph.elimination import Unknowns, marginal_covariance, twist_responses
from sst_graph.graph.state import State, nuisance_key, time_offset_key, twist_key
from sst_graph.objects.tracks import ObjectId
from sst_graph.types import SemanticClass

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]


@dataclass(frozen=True)
class ErrorModel:
    """Variances of whitened residuals: of a side over all frames, of a side in one frame, of a match."""

    side: float
    side_frame: float
    match: float


@dataclass(frozen=True)
class MatchTable:
    """All weighted matches over the unknowns [extrinsic 6, offsets, biases].

    Attributes:
        J: (m, n) rows multiplied by sqrt(robust weight) / sigma, motion marginalised out: the bread times a
            row is how the answer follows the residual. Sparse: a frame sees few of a long drive's objects.
        root_weights: (m,) sqrt(robust weight).
        curvatures: (m,) second derivative of the robust loss (its slope over the residual is the weight).
        r: (m,) whitened residuals, unweighted.
        sides: (m,) number of the object's side over all frames.
        side_frames: (m,) number of the object's side in its frame.
        objects: (m,) number of the object over all frames.
        views: from how many different places a side was seen: effective number, harmonic mean over the sides.
    """

    J: csr_array
    root_weights: FloatArray
    curvatures: FloatArray
    r: FloatArray
    sides: IntArray
    side_frames: IntArray
    objects: IntArray
    views: float

    def take(self, index: IntArray) -> MatchTable:
        """Some of the matches, by position."""
        sides, side_frames, objects = (
            _numbered(labels[index]) for labels in (self.sides, self.side_frames, self.objects)
        )
        rest = self.root_weights[index], self.curvatures[index], self.r[index]
        return MatchTable(self.J[index], *rest, sides, side_frames, objects, self.views)

    def moved(self, step: FloatArray) -> MatchTable:
        """The matches after a step (n,) of the unknowns, their robust weights as they are."""
        roots = np.maximum(self.root_weights, 1e-6)
        return replace(self, r=np.where(self.root_weights > 1e-6, self.r + self.J @ step / roots, self.r))

    @property
    def flatness(self) -> float:
        """Mean robust weight over mean curvature: 1 for least squares, inf where the kernel bends over."""
        return flatness_of(float(self.root_weights @ self.root_weights), float(self.curvatures.sum()))


def match_table(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    pairs: Sequence[PairMatches],
    state: State,
    tracks: Sequence[dict[ObjectId, int]],
    unknowns: Unknowns,
) -> MatchTable:
    """All matches of the frozen graph at its optimum, with the clusters they belong to.

    Args:
        state: that the matches were made at.
        tracks: of each drive's objects.
    """
    made_at = state.nuisances
    state = state_from(values, state, pairs)
    moved = {name: value - made_at.get(name, 0.0) for name, value in state.nuisances.items()}
    motion = _Moved(values, twist_responses(graph, values, unknowns), moved)
    blocks, weights, residuals, curvatures = [], [], [], []
    sides, frames, objects, moving = [], [], [], []
    for number, pair in enumerate(pairs):
        for c, matches in pair.matches.items():
            block, root, r = _rows(pair, c, state, unknowns, motion)
            blocks.append(csr_array(block))
            weights.append(root)
            residuals.append(r)
            kernel = matches.alignment.kernel
            curvatures.append(curvatures_of(kernel, root, r))
            track = np.array([tracks[pair.drive][pair.pair.scan, c, int(o)] for o in matches.objects])
            side = (track * SIDES + matches.sides) * 64 + pair.drive
            sides.append(side)
            objects.append(track * 64 + pair.drive)
            frames.append(side + number * 1_000_000_000)
            moving.append(np.full(len(side), pair.moved))
    side_of, frame_of = _numbered(np.concatenate(sides)), _numbered(np.concatenate(frames))
    return MatchTable(
        sparse.vstack(blocks, format="csr"),
        np.concatenate(weights),
        np.concatenate(curvatures),
        np.concatenate(residuals),
        side_of,
        frame_of,
        _numbered(np.concatenate(objects)),
        views_of(side_of, frame_of, np.concatenate(moving), np.concatenate(weights) ** 2),
    )


@dataclass(frozen=True)
class _Moved:
    """What the optimum has moved beside the state.

    Attributes:
        values: with the twists at the optimum.
        responses: (6, n) how each twist follows the other unknowns, by its key.
        nuisances: steps of the assumptions' parameters since the matches were made, by name.
    """

    values: gtsam.Values
    responses: Mapping[int, FloatArray]
    nuisances: Mapping[str, float]


def _rows(
    pair: PairMatches, c: SemanticClass, state: State, unknowns: Unknowns, motion: _Moved
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Weighted Jacobian rows, roots of the weights, and whitened residuals of one class in one pair."""
    V_key = twist_key(pair.drive, pair.pair.image)
    c_twist, response = motion.values.atVector(V_key), motion.responses[V_key]
    alignment = pair.matches[c].alignment
    groups = bias_groups(pair, c)
    of_class = state.biases_px.get((pair.drive, c), 0.0)
    biases_px, columns = np.full(len(alignment), of_class), np.zeros(len(alignment), np.intp)
    for key, some in groups:
        own: slice | IntArray = slice(None) if some is None else some
        columns[own] = unknowns.column(key)
        if some is not None:
            biases_px[own] = state.object_bias_px(pair.drive, int(pair.tracks[c][some[0]]), c)
    r, J, _ = weighted_residuals(alignment, state.cTl, state.offset_s(pair.drive), c_twist, biases_px)
    roots = np.abs(J[:, 13]) * alignment.sigmas_px
    block = J[:, 7:13] @ response
    block[:, :6] += J[:, :6]
    block[:, unknowns.column(time_offset_key(state.clock(pair.drive)))] += J[:, 6]
    block[np.arange(len(alignment)), columns] += J[:, 13]
    for name, column in pair.terms.get(c, {}).items():
        block[:, unknowns.column(nuisance_key(name))] += column * J[:, 13]
        r = r + column * J[:, 13] * motion.nuisances.get(name, 0.0)
    return block, roots, unweighted(r, roots)


def unweighted(r: FloatArray, roots: FloatArray) -> FloatArray:
    """(m,) whitened residuals from those multiplied by the roots of their weights; 0 where nothing weighs."""
    return np.where(roots > 1e-6, r / np.maximum(roots, 1e-6), 0.0)


def curvatures_of(kernel: RobustKernel, roots: FloatArray, r: FloatArray) -> FloatArray:
    """(m,) second derivatives of the robust loss, weighted as matches are beside the kernel."""
    return np.asarray(roots**2 * kernel.curvature(r) / np.maximum(kernel.weight(r), 1e-12))


def flatness_of(weight: float, curvature: float) -> float:
    """Sum of robust weights over sum of curvatures; inf where the kernel bends over."""
    return weight / curvature if curvature > 0.0 else np.inf


def views_of(sides: IntArray, frames: IntArray, moving: NDArray[np.bool_], weights: FloatArray) -> float:
    """Effective number of views of a side, averaged harmonically: all its standing frames are one view."""
    first = np.unique(frames, return_index=True)[1]
    by_frame = np.asarray(np.bincount(frames, weights), np.float64)
    return effective_views(sides[first], by_frame, moving[first])


def effective_views(sides: IntArray, weights: FloatArray, moving: NDArray[np.bool_]) -> float:
    """(sum of weights)^2 / sum of squared weights of the views of a side, averaged over sides by weight.

    Args:
        sides, weights, moving: (k,) side, weight, and whether the LiDAR moved, of each side in each frame.
    """
    count = int(sides.max()) + 1 if len(sides) else 0
    standing = np.bincount(sides, np.where(moving, 0.0, weights), count)
    squares = np.bincount(sides, np.where(moving, weights**2, 0.0), count) + standing**2
    total = np.bincount(sides, weights, count)
    alone = squares / np.maximum(total, 1e-12) ** 2
    return float(total.sum() / max(float((total * alone).sum()), 1e-12))


def _numbered(labels: IntArray) -> IntArray:
    return np.unique(labels, return_inverse=True)[1].reshape(-1)


_SIDE, _VIEW, _SIDE_FRAME = 0.17, 0.42, 0.17
"""Least variances as shares of a match's own: of a side for good, of a side while it is seen from one place
(beams and mask are then the same in every frame), of a side in one frame.

The mask biases of the objects are fitted to the same residuals and swallow most of what a side has in
common, so the residuals alone would make a short drive far too sure. Where contours are rough within a
side, they are rough as a whole too: hence shares."""


def with_floors(side: float, side_frame: float, match: float, views: float) -> ErrorModel:
    """The error model with each variance at its least or above; sides were seen from so many places."""
    least = (_SIDE + _VIEW / max(views, 1.0)) * match
    return ErrorModel(max(side, least), max(side_frame, _SIDE_FRAME * match), match)


def fit_error_model(table: MatchTable) -> ErrorModel:
    """The three variances by moments of weighted means, each with a floor."""
    w = table.root_weights**2
    frame_mean, frame_w, frame_w2 = _means(table.r, w, table.side_frames)
    within = w @ (table.r - frame_mean[table.side_frames]) ** 2
    freedom = float((frame_w - frame_w2 / np.maximum(frame_w, 1e-12)).sum())
    match = max(0.05, float(within) / max(freedom, 1e-9))
    # A frame's mean varies by match / effective count, plus side_frame, around its side's mean.
    count = frame_w**2 / np.maximum(frame_w2, 1e-12)
    side_of_frame = np.zeros(len(frame_w), dtype=np.intp)
    side_of_frame[table.side_frames] = table.sides
    side_frame = spread_beyond(frame_mean, match / count, side_of_frame)
    v = 1.0 / (match / count + side_frame)
    side_mean, side_w, _ = _means(frame_mean, v, side_of_frame)
    side = spread_beyond(side_mean, 1.0 / side_w, np.zeros(len(side_mean), dtype=np.intp), centre=0.0)
    side /= freedom_of_sides(len(side_mean), len(np.unique(table.objects)))
    return with_floors(side, side_frame, match, table.views)


_LEAST_FREEDOM = 0.25
"""Least share of the sides' spread that is taken to be left."""


def freedom_of_sides(sides: int, objects: int) -> float:
    """Share of the variance of sides that is left in their residuals.

    The pose and a mask bias of each object are fitted to the same sides and swallow the rest.
    """
    return max((sides - objects - 6) / max(sides, 1), _LEAST_FREEDOM)


def _means(values: FloatArray, w: FloatArray, groups: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Weighted mean, sum of weights and of squared weights of each group."""
    total = np.bincount(groups, w)
    mean = np.bincount(groups, w * values) / np.maximum(total, 1e-12)
    return mean, np.asarray(total, np.float64), np.asarray(np.bincount(groups, w * w), np.float64)


def spread_beyond(
    means: FloatArray, variances: FloatArray, groups: IntArray, centre: float | None = None
) -> float:
    """Variance of ``means`` around their group's mean beyond what their own variances explain."""
    v = 1.0 / np.maximum(variances, 1e-9)
    group_mean, group_v, group_v2 = _means(means, v, groups)
    middle = group_mean[groups] if centre is None else np.full(len(means), centre)
    spread = float((v * (means - middle) ** 2).sum())
    lost = float(np.count_nonzero(group_v > 0)) if centre is None else 0.0
    c = float(v.sum() - (group_v2 / np.maximum(group_v, 1e-12)).sum()) if centre is None else float(v.sum())
    return max(0.0, (spread - (len(means) - lost)) / c) if c > 1e-9 else 0.0


def score_variance(table: MatchTable, model: ErrorModel) -> FloatArray:
    """(n, n) variance of J^T (root_weights r) under the error model."""
    J, z = table.J, table.root_weights
    meat = model.match * gram(J)
    for variance, groups in ((model.side_frame, table.side_frames), (model.side, table.sides)):
        if variance > 0.0:
            members = csr_array((z, groups, np.arange(len(z) + 1)))
            meat += variance * gram(members.T @ J)
    return np.asarray(meat)


def gram(J: csr_array) -> FloatArray:
    """(n, n) J^T J of sparse rows (m, n)."""
    m, n = J.shape
    some, total = max(1, _DENSE // max(n, 1)), np.zeros((n, n))
    # Rows are multiplied much faster when they are dense, and some at a time take little memory.
    for start in range(0, m, some):
        rows = J[start : start + some].toarray()
        total += rows.T @ rows
    return total


_DENSE = 500_000
"""Numbers of a dense part of the rows."""


@dataclass(frozen=True)
class RobustCovariance:
    """A cluster-robust covariance and what it was made of.

    Attributes:
        matrix: (n, n) covariance of [extrinsic 6, offsets, biases].
        bread: (n, n) the same if all matches were independent.
        model: the error model behind it.
        unknowns: its columns.
        table: the matches.
    """

    matrix: FloatArray
    bread: FloatArray
    model: ErrorModel
    unknowns: Unknowns
    table: MatchTable


def robust_covariance(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    pairs: Sequence[PairMatches],
    state: State,
    tracks: Sequence[dict[ObjectId, int]],
) -> RobustCovariance:
    """Covariance of the unknowns that are not motion, from a frozen graph and its matches."""
    unknowns = Unknowns.of(state, pairs)
    bread = marginal_covariance(graph, values, unknowns)
    table = match_table(graph, values, pairs, state, tracks, unknowns)
    model = fit_error_model(table)
    return RobustCovariance(covariance_of(bread, table, model), bread, model, unknowns, table)


def covariance_of(bread: FloatArray, table: MatchTable, model: ErrorModel) -> FloatArray:
    """(n, n) covariance under an error model of the matches; ``bread``: if all of them were independent."""
    surplus = score_variance(table, model) - gram(table.J)
    covariance = bread + bread @ surplus @ bread
    steps = steps_without_objects(table, bread)
    weights = np.asarray(np.bincount(table.objects, table.root_weights**2), np.float64)
    covariance = composed(covariance, ObjectSpread.of(steps, weights), table.flatness)
    return np.asarray(0.5 * (covariance + covariance.T))


def steps_without_objects(table: MatchTable, bread: FloatArray) -> FloatArray:
    """(objects, n) how far the linearized estimate moves when one object after the other is left out."""
    order = np.argsort(table.objects, kind="stable")
    J, r = table.J[order], (table.root_weights * table.r)[order]
    bounds = np.flatnonzero(np.diff(table.objects[order])) + 1
    root = np.asarray(np.linalg.cholesky(bread), dtype=np.float64)
    steps = []
    for start, end in itertools.pairwise([0, *bounds.tolist(), len(order)]):
        own = J[start:end].toarray()
        steps.append(step_without(root, own.T @ own, own.T @ r[start:end]))
    return np.stack(steps)

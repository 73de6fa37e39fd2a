"""What one scan's matches say: a belief, and the sums that the cluster-robust covariance needs of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sst_graph.association.edge_matching import SIDES
from sst_graph.covariance.cluster_robust import curvatures_of, unweighted
from sst_graph.covariance.static_objects import dynamic_matches
from sst_graph.drive.trajectory import camera_twist
from sst_graph.factors.alignment import weighted_residuals
from sst_graph.factors.motion import twist_ad
from sst_graph.graph.building import UNKNOWN_TWIST_SIGMAS, GraphConfig, PairMatches
from sst_graph.graph.nuisances import columns_beside
from sst_graph.graph.state import lower_edge_track
from sst_graph.objects.tracks import numbers_in, of_each
from sst_graph.tracker.sums.object_sums import ObjectInformation
from sst_graph.tracker.window.gaussian import Gaussian, Point
from sst_graph.types import SemanticClass

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]

_LEAST_BEND = 0.2
"""Least curvature, over the weight, with which the gradient of a pair is taken to follow."""


@dataclass(frozen=True)
class SideSums:
    """The matches of one side of an object in one frame, one row a side.

    Attributes:
        sides: (k,) number of the side, the same in all frames.
        scores: (k, n) sum of root weight times row of J, in the columns of the belief.
        means: (k,) weighted mean of the whitened residuals.
        weights, weights2: (k,) sums of the weights and of their squares.
        within: (k,) weighted sum of squares around the mean.
        moved: whether the LiDAR moved: sides seen while it stands are one view.
    """

    sides: IntArray
    scores: FloatArray
    means: FloatArray
    weights: FloatArray
    weights2: FloatArray
    within: FloatArray
    moved: bool = True

    @cached_property
    def rows(self) -> FloatArray:
        """(k, 6) [side, mean, weights, weights2, within, moved]."""
        moved = np.full(len(self.sides), float(self.moved))
        return np.column_stack([self.sides, self.means, self.weights, self.weights2, self.within, moved])


@dataclass(frozen=True)
class LinearizedPair:
    """What one pair says: its belief, motion marginalised out, and the sums of its matches.

    Attributes:
        belief: on [extrinsic, offset, biases, parameters, and the biases of the objects it sees]; it may hold
            parameters of assumptions.
        bent: the same with the robust loss's second derivatives in place of the weights: how the gradient of
            matches that cannot be made anew follows an estimate that moves on.
        JJ: (n, n) sum of J'J of its matches, motion marginalised out, times their common share; in the
            columns of the belief, what it holds included, as are ``sides`` and ``sums``.
        sides: by side.
        sums: (n, n) sum of squared scores by side.
        matches: number of matches.
        places: place of its class's bias for each object with a bias, by its track.
        objects: the matches of each object alone.
        weight, curvature: sums of the matches' weights, and of the robust loss's second derivatives.
        standing: the belief by objects that stand alone, where some move with a known velocity.
    """

    belief: Gaussian
    bent: Gaussian
    JJ: FloatArray
    sides: SideSums
    sums: FloatArray
    matches: int
    places: Mapping[int, int] = field(default_factory=dict)
    objects: ObjectInformation | None = None
    weight: float = 1.0
    curvature: float = 1.0
    standing: Gaussian | None = None

    @property
    def by_static_objects(self) -> Gaussian:
        """The belief by objects that stand alone."""
        return self.belief if self.standing is None else self.standing


def object_places(
    pair: PairMatches, classes: Sequence[SemanticClass], tracks: Mapping[tuple[SemanticClass, int], int]
) -> dict[int, int]:
    """Place of its class's bias for each object of a pair, if objects have a bias of their own."""
    return {
        tracks[c, number]: classes.index(c)
        for c in pair.tracks
        for number in numbers_in(pair.matches[c].objects)
    }


def with_share(pair: PairMatches, share: float) -> PairMatches:
    """The pair with all its matches' weights multiplied by ``share``."""
    matches = {
        c: replace(m, alignment=replace(m.alignment, weights=share * m.alignment.weights))
        for c, m in pair.matches.items()
    }
    return replace(pair, matches=matches)


def linearize_pair(
    pair: PairMatches,
    point: Point,
    classes: Sequence[SemanticClass],
    tracks: Mapping[tuple[SemanticClass, int], int],
    config: GraphConfig,
    share: float = 1.0,
    by_object: bool = True,
    held: Sequence[str] = (),
) -> LinearizedPair:
    """Linearize a pair at the point its matches were made at: its silhouettes and its motion.

    Args:
        tracks: number of the track of each (class, object) of the scan.
        share: factor that the weights of all matches carry beside their own.
        by_object: tell what each object alone says, too.
        held: assumptions whose parameters the belief holds.
    """
    places = object_places(pair, classes, tracks)
    point = point.seen(places)
    J, JV, r, roots = _rows(pair, point, classes, held)
    # [unknowns, held parameters, twist]: silhouettes, then the twist that odometry tells.
    A, n, m = np.concatenate([J, JV], axis=1), point.size, J.shape[1]
    H, g = A.T @ A, -A.T @ r
    curvature = _curvatures(pair, r, roots)
    weight, bend = float(roots @ roots), float(curvature.sum())
    motion = np.zeros_like(H)
    columns = [*range(7), *range(m, m + 6)]
    motion[np.ix_(columns, columns)] = _motion_information(pair, point)
    belief, gain = _without_twist(point, H + motion, g)
    bent, _ = _without_twist(point, min(max(bend / weight, _LEAST_BEND), 1.0) * H + motion, g)
    known = np.array([*range(n), *range(m, m + 6)])
    J = J - JV @ gain  # as the answer follows a residual, the twist following the answer
    track = np.concatenate([_tracks_of(pair, c, tracks) for c in pair.matches])
    side = track * SIDES + np.concatenate([m.sides for m in pair.matches.values()])
    sides = replace(_side_sums(J, r, roots, side, share), moved=pair.moved)
    return LinearizedPair(
        belief,
        bent,
        share * (J.T @ J),
        sides,
        sides.scores.T @ sides.scores,
        len(pair),
        places,
        ObjectInformation.of(J[:, :n], r, roots, track, point) if by_object else None,
        weight,
        bend,
        _by_static_objects(pair, point, A[:, known], motion[np.ix_(known, known)]),
    )


def _by_static_objects(pair: PairMatches, point: Point, A: FloatArray, motion: FloatArray) -> Gaussian | None:
    """The information of matches of objects that stand; the vector is not of interest."""
    moves = dynamic_matches(pair)
    if not moves.any():
        return None
    stands = A[~moves]
    return _without_twist(point, stands.T @ stands + motion, np.zeros(A.shape[1]))[0]


def _without_twist(point: Point, H: FloatArray, g: FloatArray) -> tuple[Gaussian, FloatArray]:
    """The belief on the unknowns and what is held, from information and vector over these and the twist;
    (6, n) what each of them takes off the twist."""
    n = len(H) - 6
    gain = np.asarray(np.linalg.solve(H[n:, n:], np.column_stack([H[n:, :n], g[n:]])), np.float64)
    information = H[:n, :n] - H[:n, n:] @ gain[:, :n]
    belief = Gaussian(point, 0.5 * (information + information.T), g[:n] - H[:n, n:] @ gain[:, n])
    return belief, gain[:, :n]


def _tracks_of(
    pair: PairMatches, c: SemanticClass, tracks: Mapping[tuple[SemanticClass, int], int]
) -> IntArray:
    """(m,) track of the object of each match of a class."""
    objects = pair.matches[c].objects
    return of_each(objects, {number: tracks[c, number] for number in numbers_in(objects)})


def _curvatures(pair: PairMatches, weighted: FloatArray, root: FloatArray) -> FloatArray:
    """(m,) the robust loss's second derivatives, each weighted as its match is beside the kernel."""
    r, parts, start = unweighted(weighted, root), [], 0
    for matches in pair.matches.values():
        some = slice(start, start + len(matches))
        start += len(matches)
        parts.append(curvatures_of(matches.alignment.kernel, root[some], r[some]))
    return np.concatenate(parts)


def _rows(
    pair: PairMatches, point: Point, classes: Sequence[SemanticClass], held: Sequence[str]
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Weighted rows of all matches by unknowns and held parameters (m, n) and twist (m, 6), residuals and
    root weights (m,)."""
    blocks, twists, residuals, roots = [], [], [], []
    for c, matches in pair.matches.items():
        alignment, place = matches.alignment, classes.index(c)
        biases: float | FloatArray = float(point.biases_px[place])
        columns = np.full(len(alignment), 7 + place)
        if c in pair.tracks:
            names, groups = pair.biased[c]
            below = 7 + len(classes) + place
            known = {track: point.core_size + k for k, track in enumerate(point.tracks)}
            columns = np.array([below if t == lower_edge_track(c) else known[t] for t in names])[groups]
            values = np.concatenate([point.biases_px, point.parameters, point.object_biases_px])
            biases = values[columns - 7]
        at = point.cTl, point.offset_s, pair.motion.c_twist
        r, J, _ = weighted_residuals(alignment, *at, biases)
        block = np.zeros((len(r), point.size + len(held)))
        block[:, :7] = J[:, :7]
        block[np.arange(len(r)), columns] = J[:, 13]
        for place, name in zip(point.parameter_columns, point.names, strict=True):
            block[:, place] = pair.terms[c][name] * J[:, 13]
        if held:
            assert pair.scene is not None
            own = columns_beside(J, alignment, pair.scene, pair.pair.base_tau_s, at, held)
            block[:, point.size :] = own
        blocks.append(block)
        twists.append(J[:, 7:13])
        residuals.append(r)
        roots.append(np.abs(J[:, 13]) * alignment.sigmas_px)
    return np.concatenate(blocks), np.concatenate(twists), np.concatenate(residuals), np.concatenate(roots)


def _motion_information(pair: PairMatches, point: Point) -> FloatArray:
    """(13, 13) information of the odometry on [extrinsic, offset, twist]; its residual at the point is 0."""
    if pair.l_twist is None:
        information = np.zeros((13, 13))
        information[7:, 7:] = np.diag(UNKNOWN_TWIST_SIGMAS**-2.0)
        return information
    Ad = np.asarray(point.cTl.AdjointMap())
    A = np.zeros((6, 13))
    A[:, :6], A[:, 7:] = Ad @ twist_ad(pair.l_twist.twist), np.eye(6)
    A[:, 6] = -Ad @ pair.l_twist.acceleration
    return np.asarray(A.T @ np.linalg.solve(camera_twist(pair.l_twist, point.cTl).covariance, A))


def _side_sums(
    J: FloatArray, weighted: FloatArray, root: FloatArray, side: IntArray, share: float
) -> SideSums:
    """Sums by side of weighted rows J (m, n), weighted residuals and root weights; side (m,)."""
    names, which = np.unique(side, return_inverse=True)
    which = which.reshape(-1)
    r = unweighted(weighted, root)
    w = root**2 / share
    weights, weights2, within = (
        np.asarray(np.bincount(which, values), np.float64) for values in (w, w * w, w * r**2)
    )
    means = np.bincount(which, w * r) / np.maximum(weights, 1e-12)
    scores = summed_rows(J * root[:, None], side)
    within = np.maximum(within - weights * means**2, 0.0)
    return SideSums(names, scores, means, weights, weights2, within)


def summed_rows(rows: FloatArray, names: IntArray) -> FloatArray:
    """(k, n) sums of rows (m, n) of the same name (m,)."""
    if len(names) == 0:
        return rows
    order = np.argsort(names, kind="stable")
    firsts = np.append(0, np.flatnonzero(np.diff(names[order])) + 1)
    return np.asarray(np.add.reduceat(rows[order], firsts))

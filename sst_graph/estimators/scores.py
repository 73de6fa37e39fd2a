"""The cluster-robust covariance, frame by frame: sums that stay small however long the drive.

The batch's model (:mod:`sst_graph.uncertainty.covariance`) needs, of all matches, the sum of J'J, the
sums of the scores over each side of an object within a frame, and over each side in all frames. A frame
that leaves the window adds to these and is forgotten; sides that were not seen lately are closed.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import gtsam
import numpy as np
from numpy.typing import NDArray

from factors import GroupedBias, frame_factor, twist_transfer_factor, velocity_factor
from factors.alignment import weighted_residuals
from factors.motion import twist_ad
from sst_graph.association.silhouettes import SIDES
from sst_graph.estimators.gaussian import Gaussian, Point, scattered
from sst_graph.estimators.object_sums import ObjectBeliefs, ObjectSums
from sst_graph.problem.graph import GraphConfig, PairMatches
from sst_graph.problem.state import object_bias_key, underside_track
from sst_graph.problem.trajectory import camera_twist
from sst_graph.types import SemanticClass
from sst_graph.uncertainty.covariance import (
    ErrorModel,
    curvatures_of,
    effective_views,
    flatness_of,
    spread_beyond,
    unweighted,
    with_floors,
)

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]

_LEAST_BEND = 0.2
"""Least curvature, over the weight, with which the gradient of a pair is taken to follow."""


@dataclass(frozen=True)
class SideSums:
    """The matches of one side of an object in one frame, one row a side.

    Attributes:
        sides: (k,) number of the side, the same in all frames.
        scores: (k, n) sum of root weight times row of J.
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
class PairScore:
    """What one pair says: its belief, motion marginalised out, and the sums of its matches.

    Attributes:
        belief: on [extrinsic, offset, biases, and the biases of the objects it sees].
        bent: the same with the robust loss's second derivatives in place of the weights: how the gradient of
            matches that cannot be made anew follows an estimate that moves on.
        JJ: (n, n) sum of J'J of its matches, times their common share.
        sides: by side.
        sums: (n, n) sum of squared scores by side.
        matches: number of matches.
        places: place of its class's bias for each object with a bias, by its track.
        objects: the matches of each object alone, the twist given.
        weight, curvature: sums of the matches' weights, and of the robust loss's second derivatives.
    """

    belief: Gaussian
    bent: Gaussian
    JJ: FloatArray
    sides: SideSums
    sums: FloatArray
    matches: int
    places: Mapping[int, int] = field(default_factory=dict)
    objects: ObjectBeliefs | None = None
    weight: float = 1.0
    curvature: float = 1.0


def object_places(
    pair: PairMatches, classes: Sequence[SemanticClass], tracks: Mapping[tuple[SemanticClass, int], int]
) -> dict[int, int]:
    """Place of its class's bias for each object of a pair, if objects have a bias of their own."""
    return {
        tracks[c, int(number)]: classes.index(c)
        for c in pair.tracks
        for number in np.unique(pair.matches[c].objects)
    }


def silhouettes_factor(
    pair: PairMatches, classes: Sequence[SemanticClass], keys: Sequence[int], V_key: int
) -> gtsam.NonlinearFactor:
    """Silhouettes of one pair, on the keys of its epoch [E, D, biases...] and its image's twist."""
    biases: list[int | float | GroupedBias | None] = []
    for c in pair.matches:
        tracks = pair.tracks.get(c)
        if tracks is None:
            biases.append(keys[2 + classes.index(c)])
            continue
        names, groups = np.unique(tracks, return_inverse=True)
        own = tuple(object_bias_key(0, int(track)) for track in names)
        biases.append(GroupedBias(own, groups.reshape(-1)))
    alignments = [matches.alignment for matches in pair.matches.values()]
    return frame_factor(alignments, keys[0], keys[1], V_key, biases)


def motion_factor(
    pair: PairMatches, point: Point, keys: Sequence[int], V_key: int, config: GraphConfig
) -> gtsam.NonlinearFactor:
    """What odometry says of the twist of a pair's image, at the point of its matches."""
    if pair.l_twist is None:
        sigmas = np.repeat(config.still_sigma, 3)
        return velocity_factor(V_key, np.zeros(6), np.diag(sigmas**2))
    covariance = camera_twist(pair.l_twist, point.cTl).covariance
    l_twist = pair.l_twist
    return twist_transfer_factor(
        V_key, keys[0], keys[1], l_twist.twist, l_twist.acceleration, point.offset_s, covariance
    )


def with_share(pair: PairMatches, share: float) -> PairMatches:
    """The pair with all its matches' weights multiplied by ``share``."""
    matches = {
        c: replace(m, alignment=replace(m.alignment, weights=share * m.alignment.weights))
        for c, m in pair.matches.items()
    }
    return replace(pair, matches=matches)


def score_pair(
    pair: PairMatches,
    point: Point,
    classes: Sequence[SemanticClass],
    tracks: Mapping[tuple[SemanticClass, int], int],
    config: GraphConfig,
    share: float = 1.0,
    by_object: bool = True,
) -> PairScore:
    """Linearize a pair at the point its matches were made at: its silhouettes and its motion.

    Args:
        tracks: number of the track of each (class, object) of the scan.
        share: factor that the weights of all matches carry beside their own.
        by_object: tell what each object alone says, too.
    """
    places = object_places(pair, classes, tracks)
    point = point.seen(places)
    J, JV, r, roots = _rows(pair, point, classes)
    # [unknowns, twist]: silhouettes, then the twist that odometry tells.
    A, n = np.concatenate([J, JV], axis=1), point.size
    H, g = A.T @ A, -A.T @ r
    curvature = _curvatures(pair, r, roots)
    weight, bend = float(roots @ roots), float(curvature.sum())
    motion = np.zeros_like(H)
    columns = [*range(7), *range(n, n + 6)]
    motion[np.ix_(columns, columns)] = _motion_information(pair, point, config)
    belief = _without_twist(point, H + motion, g)
    bent = _without_twist(point, min(max(bend / weight, _LEAST_BEND), 1.0) * H + motion, g)
    track = np.concatenate([_tracks_of(pair, c, tracks) for c in pair.matches])
    side = track * SIDES + np.concatenate([m.sides for m in pair.matches.values()])
    sides = replace(_side_sums(J, r, roots, side, share), moved=pair.moved)
    return PairScore(
        belief,
        bent,
        share * H[:n, :n],
        sides,
        sides.scores.T @ sides.scores,
        len(pair),
        places,
        ObjectBeliefs.of(J, r, track, point) if by_object else None,
        weight,
        bend,
    )


def _without_twist(point: Point, H: FloatArray, g: FloatArray) -> Gaussian:
    """The belief on the unknowns, from information and vector over [unknowns, twist]."""
    n = point.size
    gain = np.linalg.solve(H[n:, n:], np.column_stack([H[n:, :n], g[n:]]))
    information = H[:n, :n] - H[:n, n:] @ gain[:, :n]
    return Gaussian(point, 0.5 * (information + information.T), g[:n] - H[:n, n:] @ gain[:, n])


def _tracks_of(
    pair: PairMatches, c: SemanticClass, tracks: Mapping[tuple[SemanticClass, int], int]
) -> IntArray:
    """(m,) track of the object of each match of a class."""
    return np.array([tracks[c, int(number)] for number in pair.matches[c].objects], dtype=np.intp)


def _curvatures(pair: PairMatches, weighted: FloatArray, root: FloatArray) -> FloatArray:
    """(m,) the robust loss's second derivatives, each weighted as its match is beside the kernel."""
    r, parts, start = unweighted(weighted, root), [], 0
    for matches in pair.matches.values():
        some = slice(start, start + len(matches))
        start += len(matches)
        parts.append(curvatures_of(matches.alignment.kernel, root[some], r[some]))
    return np.concatenate(parts)


def _rows(
    pair: PairMatches, point: Point, classes: Sequence[SemanticClass]
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Weighted rows of all matches by unknowns (m, n) and twist (m, 6), residuals and root weights (m,)."""
    blocks, twists, residuals, roots = [], [], [], []
    for c, matches in pair.matches.items():
        alignment, place, objects = matches.alignment, classes.index(c), pair.tracks.get(c)
        biases: float | FloatArray = float(point.biases_px[place])
        columns = np.full(len(alignment), 7 + place)
        if objects is not None:
            names, groups = np.unique(objects, return_inverse=True)
            below = 7 + len(classes) + place
            own = [below if t == underside_track(c) else point.columns([int(t)])[-1] for t in names]
            columns = np.array(own)[groups.reshape(-1)]
            biases = np.concatenate([point.biases_px, point.object_biases_px])[columns - 7]
        r, J, _ = weighted_residuals(alignment, point.cTl, point.offset_s, pair.motion.c_twist, biases)
        block = np.zeros((len(r), point.size))
        block[:, :7] = J[:, :7]
        block[np.arange(len(r)), columns] = J[:, 13]
        blocks.append(block)
        twists.append(J[:, 7:13])
        residuals.append(r)
        roots.append(np.abs(J[:, 13]) * alignment.sigmas_px)
    return np.concatenate(blocks), np.concatenate(twists), np.concatenate(residuals), np.concatenate(roots)


def _motion_information(pair: PairMatches, point: Point, config: GraphConfig) -> FloatArray:
    """(13, 13) information of the odometry on [extrinsic, offset, twist]; its residual at the point is 0."""
    if pair.l_twist is None:
        information = np.zeros((13, 13))
        information[7:, 7:] = np.diag(np.repeat(config.still_sigma, 3) ** -2.0)
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
    scores = _summed_rows(J * root[:, None], side)
    within = np.maximum(within - weights * means**2, 0.0)
    return SideSums(names, scores, means, weights, weights2, within)


@dataclass
class ScoreSums:
    """The sums over all frames that have left the window, in the columns of the belief that took them in.

    Attributes:
        JJ, frames, closed: (n, n) sums of J'J, of squared scores by side and frame, by closed side.
        live: running score of each side seen lately, and the scan that saw it last.
        recent: (k, 6) [side, mean, weights, weights2, within, moved] of the latest sides.
        objects: what each object says.
        weight, curvature: sums over all matches, see :class:`PairScore`.
    """

    JJ: FloatArray
    frames: FloatArray
    closed: FloatArray
    live: dict[int, tuple[FloatArray, int]] = field(default_factory=dict)
    recent: deque[FloatArray] = field(default_factory=lambda: deque(maxlen=150))
    objects: ObjectSums = field(default_factory=lambda: ObjectSums(np.zeros((0, 0))))
    weight: float = 0.0
    curvature: float = 0.0

    @classmethod
    def empty(cls, n: int) -> ScoreSums:
        nothing = np.zeros((n, n))
        return cls(nothing, nothing, nothing, objects=ObjectSums(nothing))

    def add(
        self, score: PairScore, columns: IntArray, scan: int, memory: int = 50, by_object: bool = True
    ) -> None:
        """Take in a pair that leaves the window; sides not seen for ``memory`` scans are closed.

        Args:
            columns: where the pair's unknowns stand among those of the sums.
            by_object: keep what each object says, too.
        """
        self.JJ, self.frames = self.JJ.copy(), self.frames.copy()
        self.JJ[np.ix_(columns, columns)] += score.JJ
        self.frames[np.ix_(columns, columns)] += score.sums
        rows = np.zeros((len(score.sides.sides), len(self.JJ)))
        rows[:, columns] = score.sides.scores
        for side, row in zip(score.sides.sides.tolist(), rows, strict=True):
            before = self.live.get(side)
            self.live[side] = (row if before is None else before[0] + row, scan)
        for side in [side for side, (_, last) in self.live.items() if last < scan - memory]:
            row, _ = self.live.pop(side)
            self.closed = self.closed + np.outer(row, row)
        self.recent.append(score.sides.rows)
        if by_object and score.objects is not None:
            self.objects.add(score.objects)
        self.weight, self.curvature = self.weight + score.weight, self.curvature + score.curvature

    def flatness(self, window: Sequence[PairScore] = ()) -> float:
        """Mean robust weight over mean curvature, of all matches."""
        curvature = self.curvature + sum(score.curvature for score in window)
        weight = self.weight + sum(score.weight for score in window)
        return flatness_of(weight, curvature)

    def grow(self, n: int) -> None:
        """Make room for further unknowns, n in all."""
        self.transform(np.eye(n, len(self.JJ)))

    def transform(self, T: FloatArray) -> None:
        """Follow the belief: through a random walk (:meth:`Gaussian.transition`), or to other unknowns."""
        self.JJ, self.frames, self.closed = (T @ M @ T.T for M in (self.JJ, self.frames, self.closed))
        self.objects.transform(T)
        self.live = {side: (T @ row, last) for side, (row, last) in self.live.items()}

    def copy(self) -> ScoreSums:
        recent = deque(self.recent, self.recent.maxlen)
        return replace(self, live=dict(self.live), recent=recent, objects=self.objects.copy())

    def error_model(self, window: Iterable[PairScore]) -> ErrorModel:
        """Variances of the error model from the latest frames."""
        rows = [*self.recent, *(score.sides.rows for score in window)]
        return fit_sides(np.concatenate(rows))

    def surplus(
        self, window: Sequence[PairScore], columns: Sequence[IntArray], model: ErrorModel
    ) -> FloatArray:
        """(n, n) variance of the score beyond that of independent matches.

        Args:
            window: pairs beside those taken in.
            columns: where their unknowns stand.
        """
        n = len(self.JJ)
        JJ, frames = scattered(n, columns, [score.JJ for score in window], [score.sums for score in window])
        total = (model.match - 1.0) * (self.JJ + JJ) + model.side_frame * (self.frames + frames)
        sides = [np.array(list(self.live), dtype=np.intp), *(score.sides.sides for score in window)]
        rows = np.zeros((sum(len(part) for part in sides), n))
        for i, (row, _) in enumerate(self.live.values()):
            rows[i] = row
        start = len(self.live)
        for score, own in zip(window, columns, strict=True):
            rows[start : start + len(score.sides.sides), own] = score.sides.scores
            start += len(score.sides.sides)
        by_side = _summed_rows(rows, np.concatenate(sides))
        return np.asarray(total + model.side * (self.closed + by_side.T @ by_side))


def _summed_rows(rows: FloatArray, names: IntArray) -> FloatArray:
    """(k, n) sums of rows (m, n) of the same name (m,)."""
    if len(names) == 0:
        return rows
    order = np.argsort(names, kind="stable")
    firsts = np.append(0, np.flatnonzero(np.diff(names[order])) + 1)
    return np.asarray(np.add.reduceat(rows[order], firsts))


def fit_sides(rows: FloatArray) -> ErrorModel:
    """The batch's error model from the rows of sides, (k, 6) as in :class:`ScoreSums`."""
    sides = np.unique(rows[:, 0], return_inverse=True)[1].reshape(-1)
    means, weights, weights2, within, moved = rows[:, 1:].T
    freedom = float((weights - weights2 / np.maximum(weights, 1e-12)).sum())
    match = max(0.05, float(within.sum()) / max(freedom, 1e-9))
    count = weights**2 / np.maximum(weights2, 1e-12)
    side_frame = spread_beyond(means, match / count, sides)
    v = 1.0 / (match / count + side_frame)
    total = np.bincount(sides, v)
    side_means = np.bincount(sides, v * means) / np.maximum(total, 1e-12)
    side = spread_beyond(side_means, 1.0 / total, np.zeros(len(total), dtype=np.intp), centre=0.0)
    return with_floors(side, side_frame, match, effective_views(sides, weights, moved > 0.5))

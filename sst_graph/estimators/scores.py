"""The cluster-robust covariance, frame by frame: sums that stay small however long the drive.

The batch's model (:mod:`sst_graph.uncertainty.covariance`) needs, of all matches, the sum of J'J, the
sums of the scores over each side of an object within a frame, and over each side in all frames. A frame
that leaves the window adds to these and is forgotten; sides that were not seen lately are closed.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from factors import frame_factor, twist_transfer_factor, velocity_factor
from factors.alignment import weighted_residuals
from sst_graph.estimators.gaussian import Gaussian, Point, insert_point
from sst_graph.problem.graph import GraphConfig, PairMatches
from sst_graph.problem.trajectory import camera_twist
from sst_graph.types import SemanticClass
from sst_graph.uncertainty.covariance import SIDE_FLOOR, SIDE_FRAME_FLOOR, ErrorModel, spread_beyond

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]

_SIDES = 3


@dataclass(frozen=True)
class SideSums:
    """The matches of one side of an object in one frame, one row a side.

    Attributes:
        sides: (k,) number of the side, the same in all frames.
        scores: (k, n) sum of root weight times row of J.
        means: (k,) weighted mean of the whitened residuals.
        weights, weights2: (k,) sums of the weights and of their squares.
        within: (k,) weighted sum of squares around the mean.
    """

    sides: IntArray
    scores: FloatArray
    means: FloatArray
    weights: FloatArray
    weights2: FloatArray
    within: FloatArray


@dataclass(frozen=True)
class PairScore:
    """What one pair says: its belief, motion marginalised out, and the sums of its matches.

    Attributes:
        belief: on [extrinsic, offset, biases].
        JJ: (n, n) sum of J'J of its matches, times their common share.
        sides: by side.
        matches: number of matches.
    """

    belief: Gaussian
    JJ: FloatArray
    sides: SideSums
    matches: int


def pair_factors(
    pair: PairMatches,
    classes: Sequence[SemanticClass],
    keys: Sequence[int],
    V_key: int,
    offset_0_s: float,
    cTl: gtsam.Pose3,
    config: GraphConfig,
) -> tuple[gtsam.NonlinearFactor, gtsam.NonlinearFactor]:
    """Silhouettes and motion of one pair, on the keys of its epoch [E, D, biases...] and its twist."""
    silhouettes = frame_factor(
        [matches.alignment for matches in pair.matches.values()],
        keys[0],
        keys[1],
        V_key,
        [keys[2 + classes.index(c)] for c in pair.matches],
    )
    if pair.l_twist is None:
        sigmas = np.repeat(config.still_sigma, 3)
        return silhouettes, velocity_factor(V_key, np.zeros(6), np.diag(sigmas**2))
    covariance = camera_twist(pair.l_twist, cTl).covariance
    motion = twist_transfer_factor(
        V_key, keys[0], keys[1], pair.l_twist.twist, pair.l_twist.acceleration, offset_0_s, covariance
    )
    return silhouettes, motion


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
) -> PairScore:
    """Linearize a pair's factors at the point its matches were made at.

    Args:
        tracks: number of the track of each (class, object) of the scan.
        share: factor that the weights of all matches carry beside their own.
    """
    keys, V_key = [0, 1, *(3 + i for i in range(len(classes)))], 2
    used = [0, 1, *(keys[2 + classes.index(c)] for c in pair.matches)]
    factors = pair_factors(pair, classes, keys, V_key, point.offset_s, point.cTl, config)
    graph, values, ordering = gtsam.NonlinearFactorGraph(), gtsam.Values(), gtsam.Ordering()
    for factor in factors:
        graph.add(factor)
    insert_point(values, keys, point)
    values.insert(V_key, pair.motion.c_twist)
    for key in [*sorted(used), V_key]:
        ordering.push_back(key)
    H, g = graph.linearize(values).hessian(ordering)
    m = len(g) - 6
    gain = np.linalg.solve(H[m:, m:], np.column_stack([H[m:, :m], g[m:]]))
    small_H, small_g = H[:m, :m] - H[:m, m:] @ gain[:, :m], g[:m] - H[:m, m:] @ gain[:, m]
    columns = [*range(7), *(4 + key for key in sorted(used)[2:])]
    information, vector = np.zeros((point.size, point.size)), np.zeros(point.size)
    information[np.ix_(columns, columns)] = small_H
    vector[columns] = small_g
    JJ, sides = _side_sums(pair, point, classes, tracks, share)
    return PairScore(Gaussian(point, information, vector), JJ, sides, len(pair))


def _side_sums(
    pair: PairMatches,
    point: Point,
    classes: Sequence[SemanticClass],
    tracks: Mapping[tuple[SemanticClass, int], int],
    share: float,
) -> tuple[FloatArray, SideSums]:
    blocks, roots, residuals, sides = [], [], [], []
    JJ = np.zeros((point.size, point.size))
    for c, matches in pair.matches.items():
        place = classes.index(c)
        bias = float(point.biases_px[place])
        alignment = matches.alignment
        r, J, _ = weighted_residuals(alignment, point.cTl, point.offset_s, pair.motion.c_twist, bias)
        block = np.zeros((len(r), point.size))
        block[:, :7], block[:, 7 + place] = J[:, :7], J[:, 13]
        JJ += share * (block.T @ block)
        root = np.abs(J[:, 13]) * alignment.sigmas_px
        blocks.append(block * root[:, None])
        residuals.append(np.where(root > 1e-6, r / np.maximum(root, 1e-6), 0.0))
        roots.append(root / np.sqrt(share))
        track = np.array([tracks[c, int(number)] for number in matches.objects], dtype=np.intp)
        sides.append(track * _SIDES + matches.sides)
    names, which = np.unique(np.concatenate(sides), return_inverse=True)
    which = which.reshape(-1)
    rows, r, w = np.concatenate(blocks), np.concatenate(residuals), np.concatenate(roots) ** 2
    weights, weights2, within = (
        np.asarray(np.bincount(which, values), np.float64) for values in (w, w * w, w * r**2)
    )
    means = np.bincount(which, w * r) / np.maximum(weights, 1e-12)
    scores = np.zeros((len(names), point.size))
    np.add.at(scores, which, rows)
    within = np.maximum(within - weights * means**2, 0.0)
    return JJ, SideSums(names, scores, means, weights, weights2, within)


@dataclass
class ScoreSums:
    """The sums over all frames that have left the window.

    Attributes:
        JJ, frames, closed: (n, n) sums of J'J, of squared scores by side and frame, by closed side.
        live: running score of each side seen lately, and the scan that saw it last.
        recent: (k, 5) [side, mean, weights, weights2, within] of the latest sides, for the error model.
    """

    JJ: FloatArray
    frames: FloatArray
    closed: FloatArray
    live: dict[int, tuple[FloatArray, int]] = field(default_factory=dict)
    recent: deque[FloatArray] = field(default_factory=lambda: deque(maxlen=150))

    @classmethod
    def empty(cls, n: int) -> ScoreSums:
        return cls(np.zeros((n, n)), np.zeros((n, n)), np.zeros((n, n)))

    def add(self, score: PairScore, scan: int, memory: int = 50) -> None:
        """Take in a pair that leaves the window; sides not seen for ``memory`` scans are closed."""
        self.JJ = self.JJ + score.JJ
        self.frames = self.frames + score.sides.scores.T @ score.sides.scores
        for side, row in zip(score.sides.sides, score.sides.scores, strict=True):
            before = self.live.get(int(side))
            self.live[int(side)] = (row if before is None else before[0] + row, scan)
        for side in [side for side, (_, last) in self.live.items() if last < scan - memory]:
            row, _ = self.live.pop(side)
            self.closed = self.closed + np.outer(row, row)
        self.recent.append(_recent_rows(score.sides))

    def advance(self, A: FloatArray) -> None:
        """Follow the belief through a random walk; ``A`` as :meth:`Gaussian.transition` gives it."""
        self.JJ, self.frames, self.closed = (A @ M @ A.T for M in (self.JJ, self.frames, self.closed))
        self.live = {side: (A @ row, last) for side, (row, last) in self.live.items()}

    def copy(self) -> ScoreSums:
        return ScoreSums(
            self.JJ, self.frames, self.closed, dict(self.live), deque(self.recent, self.recent.maxlen)
        )

    def error_model(self, window: Iterable[PairScore]) -> ErrorModel:
        """Variances of the error model from the latest frames."""
        rows = [*self.recent, *(_recent_rows(score.sides) for score in window)]
        return fit_sides(np.concatenate(rows))

    def surplus(self, window: Sequence[PairScore], model: ErrorModel) -> FloatArray:
        """(n, n) variance of the score beyond that of independent matches."""
        JJ, frames, live = self.JJ, self.frames, {s: row for s, (row, _) in self.live.items()}
        for score in window:
            JJ = JJ + score.JJ
            frames = frames + score.sides.scores.T @ score.sides.scores
            for side, row in zip(score.sides.sides.tolist(), score.sides.scores, strict=True):
                live[side] = live[side] + row if side in live else row
        rows = np.stack(list(live.values())) if live else np.zeros((0, len(JJ)))
        return np.asarray(
            (model.match - 1.0) * JJ + model.side_frame * frames + model.side * (self.closed + rows.T @ rows)
        )


def _recent_rows(sides: SideSums) -> FloatArray:
    return np.column_stack([sides.sides, sides.means, sides.weights, sides.weights2, sides.within])


def fit_sides(rows: FloatArray) -> ErrorModel:
    """The batch's error model from the rows of sides, (k, 5) as in :class:`ScoreSums`."""
    sides = np.unique(rows[:, 0], return_inverse=True)[1].reshape(-1)
    means, weights, weights2, within = rows[:, 1:].T
    freedom = float((weights - weights2 / np.maximum(weights, 1e-12)).sum())
    match = max(0.05, float(within.sum()) / max(freedom, 1e-9))
    count = weights**2 / np.maximum(weights2, 1e-12)
    side_frame = spread_beyond(means, match / count, sides)
    v = 1.0 / (match / count + side_frame)
    total = np.bincount(sides, v)
    side_means = np.bincount(sides, v * means) / np.maximum(total, 1e-12)
    side = spread_beyond(side_means, 1.0 / total, np.zeros(len(total), dtype=np.intp), centre=0.0)
    return ErrorModel(max(side, SIDE_FLOOR), max(side_frame, SIDE_FRAME_FLOOR), match)

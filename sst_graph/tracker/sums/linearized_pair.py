"""The matches of one scan, linearized: their information, and the sums that the covariance needs of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np

from sst_graph.association.edge_matching import SIDES
from sst_graph.covariance.error_model import SideResiduals
from sst_graph.covariance.image_shifts import shift_moments
from sst_graph.covariance.level_edges import LevelEdges
from sst_graph.covariance.match_table import curvatures_of, unweighted
from sst_graph.covariance.static_objects import dynamic_matches
from sst_graph.covariance.sums import ScoreSums
from sst_graph.drive.twists import camera_covariances
from sst_graph.factors.motion import twist_ad
from sst_graph.graph.building import UNKNOWN_TWIST_SIGMAS
from sst_graph.graph.matching import PairMatches
from sst_graph.tracker.sums.object_sums import ObjectInformation
from sst_graph.tracker.sums.rows import PairAt, PairColumns, Rows, rows_of_pairs
from sst_graph.tracker.window.gaussian import Gaussian, Point
from sst_graph.types import FloatArray, SemanticClass

_LEAST_CURVATURE = 0.2
"""Least mean curvature, over the mean weight, in the observed information: it stays positive where most
matches lie beyond the inflection of the robust loss."""


@dataclass(frozen=True)
class LinearizedPair:
    """The matches of one pair of scan and image about a point, motion marginalised out.

    Attributes:
        information: Gaussian on [extrinsic, offset, biases, parameters, and the biases of the objects it
            sees]; behind these it may hold parameters of assumptions.
        observed: the same with the robust loss's second derivatives in place of the weights (observed
            information): the derivative of the gradient of kept matches by the estimate.
        scores: sums of the matches' scores, in the columns of the Gaussian, what it holds included.
        residuals: of the matches, by side.
        matches: number of matches.
        places: place of its class's bias for each object with a bias, by its track.
        objects: the matches object by object.
        weight, curvature: sums of the matches' weights, and of the robust loss's second derivatives.
        static: the information by static objects alone, where some are dynamic with a known velocity.
        shifts: (3, 7) moments of the shifts of the picture and of its stamp
            (:func:`~sst_graph.covariance.image_shifts.shift_moments`).
        by_shifts: (n, 3) what a unit of each does to the score, in the columns of the Gaussian, what it holds
            included.
    """

    information: Gaussian
    observed: Gaussian
    scores: ScoreSums
    residuals: SideResiduals
    matches: int
    places: Mapping[int, int] = field(default_factory=dict)
    objects: ObjectInformation | None = None
    weight: float = 1.0
    curvature: float = 1.0
    static: Gaussian | None = None
    shifts: FloatArray = field(kw_only=True)
    by_shifts: FloatArray = field(kw_only=True)

    @property
    def by_static_objects(self) -> Gaussian:
        """The information by static objects alone."""
        return self.information if self.static is None else self.static


def with_share(pair: PairMatches, share: float) -> PairMatches:
    """The pair with all its matches' weights multiplied by ``share``."""
    matches = {
        c: replace(m, alignment=replace(m.alignment, weights=share * m.alignment.weights))
        for c, m in pair.matches.items()
    }
    return replace(pair, matches=matches)


def linearize_pairs(
    pairs: Sequence[PairMatches],
    point: Point,
    columns: Sequence[PairColumns],
    share: float = 1.0,
    by_object: bool = True,
) -> list[LinearizedPair]:
    """Some pairs at the point their matches were made at: the silhouettes and the motion of each.

    Args:
        columns: of each pair.
        share: factor by which the weights of all matches have been multiplied (:func:`with_share`).
        by_object: keep the matches object by object, too.
    """
    each = [
        PairAt(pair, point.seen(own.object_places(pair)), own)
        for pair, own in zip(pairs, columns, strict=True)
    ]
    by_motion = _motion_informations(pairs, point.cTl)
    return [
        _linearized(*one, share, by_object) for one in zip(each, rows_of_pairs(each), by_motion, strict=True)
    ]


def _linearized(
    at: PairAt, rows: Rows, by_motion: FloatArray, share: float, by_object: bool
) -> LinearizedPair:
    """One pair, from its rows and the odometry's information on [extrinsic, offset, twist] (13, 13)."""
    pair, point = at.pair, at.point
    J, JV, r, roots = rows.J, rows.by_twist, rows.residuals, rows.roots
    # [unknowns, held parameters, twist]: silhouettes, then the odometry's information on the twist.
    A, n, m = np.concatenate([J, JV], axis=1), point.size, J.shape[1]
    H, g = A.T @ A, -A.T @ r
    weight, curvature = float(roots @ roots), float(_curvatures(pair, r, roots).sum())
    motion = np.zeros_like(H)
    moving = [*range(7), *range(m, m + 6)]
    motion[np.ix_(moving, moving)] = by_motion
    information, gain = _without_twist(point, H + motion, g)
    curved = min(max(curvature / weight, _LEAST_CURVATURE), 1.0)
    observed, _ = _without_twist(point, curved * H + motion, g)
    known = np.array([*range(n), *range(m, m + 6)])
    J = J - JV @ gain  # sensitivity of the estimate to a residual, the twist at its optimum
    track = np.concatenate([at.columns.tracks_of(pair, c) for c in pair.matches])
    side = track * SIDES + np.concatenate([m.sides for m in pair.matches.values()])
    own = roots / np.sqrt(share)
    # Of labels alone: edges have a covariance of their own.
    of_shifts = np.column_stack([rows.by_picture, J[:, 6]]) * (SemanticClass.OBJECT not in pair.matches)
    level = [LevelEdges.of(each.alignment, each.level_px, pair.wTl) for each in pair.matches.values()]
    scores = ScoreSums.of_frame(J, roots, side, LevelEdges.joined(level))
    return LinearizedPair(
        information,
        observed,
        # The errors are those of the matches' original weights.
        replace(scores, independent=share * scores.independent),
        SideResiduals.of(unweighted(r, roots), own**2, side),
        len(pair),
        at.columns.object_places(pair),
        ObjectInformation.of(J[:, :n], r, roots, track, point) if by_object else None,
        weight,
        curvature,
        _by_static_objects(pair, point, A[:, known], motion[np.ix_(known, known)]),
        shifts=shift_moments(of_shifts / np.sqrt(share), r / np.sqrt(share), side),
        by_shifts=J.T @ of_shifts,
    )


def _by_static_objects(pair: PairMatches, point: Point, A: FloatArray, motion: FloatArray) -> Gaussian | None:
    """The information of matches of static objects, its vector 0; None where all are static."""
    dynamic = dynamic_matches(pair)
    if not dynamic.any():
        return None
    static = A[~dynamic]
    return _without_twist(point, static.T @ static + motion, np.zeros(A.shape[1]))[0]


def _without_twist(point: Point, H: FloatArray, g: FloatArray) -> tuple[Gaussian, FloatArray]:
    """The Gaussian on the unknowns and what is held, from information and vector over these and the twist;
    (6, n) minus the derivative of the twist's optimum by them."""
    n = len(H) - 6
    gain = np.asarray(np.linalg.solve(H[n:, n:], np.column_stack([H[n:, :n], g[n:]])), np.float64)
    information = H[:n, :n] - H[:n, n:] @ gain[:, :n]
    gaussian = Gaussian(point, 0.5 * (information + information.T), g[:n] - H[:n, n:] @ gain[:, n])
    return gaussian, gain[:, :n]


def _curvatures(pair: PairMatches, weighted: FloatArray, root: FloatArray) -> FloatArray:
    """(m,) the robust loss's second derivatives, each multiplied by its match's own weight."""
    r, parts, start = unweighted(weighted, root), [], 0
    for matches in pair.matches.values():
        some = slice(start, start + len(matches))
        start += len(matches)
        parts.append(curvatures_of(matches.alignment.kernel, root[some], r[some]))
    return np.concatenate(parts)


def _motion_informations(pairs: Sequence[PairMatches], cTl: gtsam.Pose3) -> FloatArray:
    """(k, 13, 13) information of the odometry on [extrinsic, offset, twist] of each pair; its residual at the
    extrinsic is 0."""
    informations = np.zeros((len(pairs), 13, 13))
    informations[:, 7:, 7:] = np.diag(UNKNOWN_TWIST_SIGMAS**-2.0)
    measured = [(k, pair.l_twist) for k, pair in enumerate(pairs) if pair.l_twist is not None]
    if not measured:
        return informations
    numbers, samples = zip(*measured, strict=True)
    Ad = np.asarray(cTl.AdjointMap())
    A = np.zeros((len(samples), 6, 13))
    A[:, :, :6] = Ad @ np.array([twist_ad(sample.twist) for sample in samples])
    A[:, :, 6] = -np.array([sample.acceleration for sample in samples]) @ Ad.T
    A[:, :, 7:] = np.eye(6)
    covariances = camera_covariances(np.array([sample.covariance for sample in samples]), cTl)
    informations[list(numbers)] = A.transpose(0, 2, 1) @ np.linalg.solve(covariances, A)
    return informations

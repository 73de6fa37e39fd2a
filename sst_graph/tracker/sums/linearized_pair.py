"""The matches of one scan, linearized: their information, and the sums that the covariance needs of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sst_graph.association.edge_matching import SIDES, MatchConfig
from sst_graph.covariance.error_model import SideResiduals
from sst_graph.covariance.level_edges import LevelEdges
from sst_graph.covariance.match_table import curvatures_of, unweighted
from sst_graph.covariance.static_objects import dynamic_matches
from sst_graph.covariance.sums import ScoreSums
from sst_graph.drive.twists import camera_twist
from sst_graph.factors.alignment import weighted_residuals
from sst_graph.factors.motion import twist_ad
from sst_graph.graph.building import UNKNOWN_TWIST_SIGMAS
from sst_graph.graph.matching import PairMatches
from sst_graph.graph.nuisances import columns_of_jacobian
from sst_graph.graph.state import lower_edge_track
from sst_graph.objects.tracks import numbers_in, of_each
from sst_graph.tracker.sums.held import EDGE_ERRORS, edge_error_columns
from sst_graph.tracker.sums.object_sums import ObjectInformation
from sst_graph.tracker.window.gaussian import Gaussian, Point
from sst_graph.types import FloatArray, IntArray, SemanticClass

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

    @property
    def by_static_objects(self) -> Gaussian:
        """The information by static objects alone."""
        return self.information if self.static is None else self.static


@dataclass(frozen=True)
class PairColumns:
    """What the columns of a linearized pair stand for.

    Attributes:
        classes: whose mask biases are estimated, in the order of the point's.
        tracks: number of the track of each (class, object) of the scan.
        held: what is held behind the unknowns (:func:`~sst_graph.tracker.sums.held.held_names`).
        config: that the matches were made under.
    """

    classes: Sequence[SemanticClass]
    tracks: Mapping[tuple[SemanticClass, int], int]
    held: Sequence[str] = ()
    config: MatchConfig = field(default_factory=MatchConfig)

    def object_places(self, pair: PairMatches) -> dict[int, int]:
        """Place of its class's bias for each object of a pair, if objects have a bias of their own."""
        return {
            self.tracks[c, number]: self.classes.index(c)
            for c in pair.tracks
            for number in numbers_in(pair.matches[c].objects)
        }

    def tracks_of(self, pair: PairMatches, c: SemanticClass) -> IntArray:
        """(m,) track of the object of each match of a class."""
        objects = pair.matches[c].objects
        return of_each(objects, {number: self.tracks[c, number] for number in numbers_in(objects)})


def with_share(pair: PairMatches, share: float) -> PairMatches:
    """The pair with all its matches' weights multiplied by ``share``."""
    matches = {
        c: replace(m, alignment=replace(m.alignment, weights=share * m.alignment.weights))
        for c, m in pair.matches.items()
    }
    return replace(pair, matches=matches)


def linearize_pair(
    pair: PairMatches, point: Point, columns: PairColumns, share: float = 1.0, by_object: bool = True
) -> LinearizedPair:
    """A pair at the point its matches were made at: its silhouettes and its motion.

    Args:
        share: factor by which the weights of all matches have been multiplied (:func:`with_share`).
        by_object: keep the matches object by object, too.
    """
    places = columns.object_places(pair)
    point = point.seen(places)
    J, JV, r, roots = _rows(pair, point, columns)
    # [unknowns, held parameters, twist]: silhouettes, then the odometry's information on the twist.
    A, n, m = np.concatenate([J, JV], axis=1), point.size, J.shape[1]
    H, g = A.T @ A, -A.T @ r
    weight, curvature = float(roots @ roots), float(_curvatures(pair, r, roots).sum())
    motion = np.zeros_like(H)
    moving = [*range(7), *range(m, m + 6)]
    motion[np.ix_(moving, moving)] = _motion_information(pair, point)
    information, gain = _without_twist(point, H + motion, g)
    curved = min(max(curvature / weight, _LEAST_CURVATURE), 1.0)
    observed, _ = _without_twist(point, curved * H + motion, g)
    known = np.array([*range(n), *range(m, m + 6)])
    J = J - JV @ gain  # sensitivity of the estimate to a residual, the twist at its optimum
    track = np.concatenate([columns.tracks_of(pair, c) for c in pair.matches])
    side = track * SIDES + np.concatenate([m.sides for m in pair.matches.values()])
    own = roots / np.sqrt(share)
    level = [LevelEdges.of(each.alignment, each.level_px, pair.wTl) for each in pair.matches.values()]
    scores = ScoreSums.of_frame(J, roots, side, LevelEdges.joined(level))
    return LinearizedPair(
        information,
        observed,
        # The errors are those of the matches' original weights.
        replace(scores, independent=share * scores.independent),
        SideResiduals.of(unweighted(r, roots), own**2, side),
        len(pair),
        places,
        ObjectInformation.of(J[:, :n], r, roots, track, point) if by_object else None,
        weight,
        curvature,
        _by_static_objects(pair, point, A[:, known], motion[np.ix_(known, known)]),
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


def _rows(
    pair: PairMatches, point: Point, names: PairColumns
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Weighted rows of all matches by unknowns and held parameters (m, n) and twist (m, 6), residuals and
    root weights (m,)."""
    classes, held = names.classes, names.held
    assumptions = [name for name in held if name not in EDGE_ERRORS]
    blocks, twists, residuals, roots = [], [], [], []
    for c, matches in pair.matches.items():
        alignment, place = matches.alignment, classes.index(c)
        biases: float | FloatArray = float(point.biases_px[place])
        columns = np.full(len(alignment), 7 + place)
        if c in pair.tracks:
            tracks, groups = pair.biased[c]
            below = 7 + len(classes) + place
            known = {track: point.core_size + k for k, track in enumerate(point.tracks)}
            columns = np.array([below if t == lower_edge_track(c) else known[t] for t in tracks])[groups]
            values = np.concatenate([point.biases_px, point.parameters, point.object_biases_px])
            biases = values[columns - 7]
        at = point.cTl, point.time_offset_s, pair.motion.c_twist
        r, J, _ = weighted_residuals(alignment, *at, biases)
        block = np.zeros((len(r), point.size + len(held)))
        block[:, :7] = J[:, :7]
        block[np.arange(len(r)), columns] = J[:, 13]
        for place, name in zip(point.parameter_columns, point.names, strict=True):
            block[:, place] = pair.terms[c][name] * J[:, 13]
        if held:
            assert pair.scene is not None
            n = point.size + len(assumptions)
            own = columns_of_jacobian(J, alignment, pair.scene, pair.pair.base_tau_s, at, assumptions)
            block[:, point.size : n] = own
            if c == SemanticClass.OBJECT:
                block[:, n:] = edge_error_columns(J, matches, names.config)
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

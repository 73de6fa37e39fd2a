"""How each error that an estimate depends on moves it: its influence, a step of extrinsic and time offset.

The covariance of one camera's estimate (:mod:`sst_graph.covariance.sums`) is a sum over errors: of a side of
an object, of a side in one scan, of a boundary point, of a level edge between its rings, of the LiDAR's
motion at a scan, of a sample of objects (jackknife), of an assumption. With H the information and s the score
of an error, its influence is H^-1 s. Cameras on one LiDAR have such errors in common, which are found here by
their names.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sst_graph.association.edge_matching import SIDES
from sst_graph.assumptions import OF_LIDAR
from sst_graph.batch.problem import JointOutcome
from sst_graph.covariance.cluster_robust import RobustCovariance, steps_without_objects
from sst_graph.covariance.error_model import by_side_and_frame
from sst_graph.covariance.jackknife import ObjectSpread, bounded_ratio
from sst_graph.factors.velocity import transferred
from sst_graph.graph.matching import PairMatches
from sst_graph.graph.outer_loop import JointSolution
from sst_graph.graph.state import EXTRINSIC, time_offset_key, twist_key
from sst_graph.types import FloatArray

IntArray = NDArray[np.int64]

UNKNOWNS = 7
"""Of one camera: extrinsic and time offset."""

KINDS = ("side", "side_frame", "match", "level")
"""Kinds of errors of the matches, as the error model has them, and of level edges between their rings."""

_MOST_SCANS, _MOST_CLASSES, _MOST_POINTS = 1_000_000, 256, 1_000_000


@dataclass(frozen=True)
class Influence:
    """Influences of the errors of one kind.

    Attributes:
        names: (k,) numbers of the errors, rising, the same in all cameras.
        steps: (k, 7) influence of a unit error [rad, m, s].
        means: (k,) mean whitened residual beyond that of the next wider kind.
        weights: (k,) robust weight behind it.
    """

    names: IntArray
    steps: FloatArray
    means: FloatArray
    weights: FloatArray


@dataclass(frozen=True)
class CameraInfluences:
    """All errors that move the estimate of one camera.

    Attributes:
        matches: by kind of error, each step multiplied by the error's deviation.
        objects: (k,) numbers of the tracks, rising; steps_without: (k, 7) of the jackknife, scaled so that
            the sum of their squares is its part in the covariance.
        scans: (f,) numbers of the scans, rising; motion: (f, 7, 6) steps by the LiDAR's twist there, in
            deviations along fixed axes.
        assumptions: (7,) step by one deviation of each assumption about the LiDAR, by name.
    """

    matches: Mapping[str, Influence]
    objects: IntArray
    steps_without: FloatArray
    scans: IntArray
    motion: FloatArray
    assumptions: Mapping[str, FloatArray]

    @classmethod
    def of(cls, outcome: JointOutcome) -> CameraInfluences:
        """The influences on the estimate of a solved problem."""
        robust, solution = outcome.estimate.robust, outcome.estimate.solution
        scores = robust.table.scores
        # 1. How the parts of the covariance are composed.
        modelled = robust.bread + robust.bread @ scores.excess(robust.model) @ robust.bread
        left_out = steps_without_objects(robust.table, robust.bread)
        spread = ObjectSpread.of(left_out, robust.table.object_weights)
        of_model, of_objects = spread.shares(modelled)
        ratio = bounded_ratio(robust.table.weight_curvature_ratio)
        root = ratio * np.sqrt(of_model)
        # 2. Errors of the matches, of the motion, of the assumptions.
        count = len(left_out)
        scale = ratio * np.sqrt(of_objects * (count - 1) / max(count, 1))
        scans, motion = _by_motion(robust, solution)
        considered = outcome.considered
        return cls(
            _by_matches(robust, solution.pairs, root),
            np.unique(_objects(robust)),
            scale * left_out[:, :UNKNOWNS],
            scans,
            root * motion,
            {name: considered.step(name)[:UNKNOWNS] for name in OF_LIDAR if name in considered.sensitivities},
        )


def _objects(robust: RobustCovariance) -> IntArray:
    """(m,) track of each match, with its drive, as a number."""
    return np.asarray(robust.table.sides // SIDES, np.int64)


def _by_matches(robust: RobustCovariance, pairs: list[PairMatches], root: float) -> dict[str, Influence]:
    """Influences of the errors of sides, of sides in single scans, and of boundary points."""
    table, model = robust.table, robust.model
    weights = table.root_weights**2
    gain = robust.bread[:, :UNKNOWNS]
    by_match = np.asarray(table.J @ gain)
    weighted = table.root_weights[:, None] * by_match
    # 1. Names: of the scan of each match, of the side there, of the boundary point.
    scan_of = np.array([_scan_name(pair) for pair in pairs], np.int64)[table.frames]
    first, which = by_side_and_frame(table.sides, scan_of)
    points = np.concatenate([_point_names(pair) for pair in pairs])
    # 2. Means: of sides, of sides in scans beyond them, of matches beyond these.
    frame_weight, frame_mean = _means(table.r, weights, which, len(first))
    sides, side_of = np.unique(table.sides[first], return_inverse=True)
    side_of = side_of.reshape(-1)
    side_weight, side_mean = _means(frame_mean, frame_weight, side_of, len(sides))
    # 3. Steps, each error by its deviation.
    by_frame = np.zeros((len(first), UNKNOWNS))
    np.add.at(by_frame, which, weighted)
    by_side = np.zeros((len(sides), UNKNOWNS))
    np.add.at(by_side, side_of, by_frame)
    frame_names = scan_of[first] * (1 << 32) + table.sides[first]
    found = {
        "side": (sides, model.side, by_side, side_mean, side_weight),
        "side_frame": (
            frame_names,
            model.side_frame,
            by_frame,
            frame_mean - side_mean[side_of],
            frame_weight,
        ),
        "match": (points, model.match, by_match, table.r - frame_mean[which], weights),
    }
    influences = {
        kind: _of_names(np.asarray(names, np.int64), root * np.sqrt(variance) * steps, means, own)
        for kind, (names, variance, steps, means, own) in found.items()
    }
    # Where an edge lies between the rings is the LiDAR's error, whatever the masks of the cameras show.
    scores, none = table.scores, np.zeros(len(sides))
    level = root * scores.level.steps @ gain
    return influences | {"level": _of_names(np.asarray(scores.sides, np.int64), level, none, none)}


def _of_names(names: IntArray, steps: FloatArray, means: FloatArray, weights: FloatArray) -> Influence:
    """Each error once: that of a point in several images of its scan moves the estimate by all of them."""
    each, which = np.unique(names, return_inverse=True)
    which = which.reshape(-1)
    together = np.zeros((len(each), UNKNOWNS))
    np.add.at(together, which, steps)
    weight, mean = _means(means, weights, which, len(each))
    return Influence(each, together, mean, weight)


def _means(
    values: FloatArray, weights: FloatArray, groups: NDArray[np.intp], count: int
) -> tuple[FloatArray, FloatArray]:
    """(count,) sum of the weights and weighted mean of each group."""
    total = np.asarray(np.bincount(groups, weights, count), np.float64)
    return total, np.asarray(np.bincount(groups, weights * values, count) / np.maximum(total, 1e-12))


def _scan_name(pair: PairMatches) -> int:
    return pair.drive * _MOST_SCANS + pair.pair.scan


def _point_names(pair: PairMatches) -> IntArray:
    """(n,) numbers of the boundary points of a pair's matches."""
    parts = [
        (_scan_name(pair) * _MOST_CLASSES + int(c)) * _MOST_POINTS + matches.index.astype(np.int64)
        for c, matches in pair.matches.items()
    ]
    return np.concatenate(parts)


def _by_motion(robust: RobustCovariance, solution: JointSolution) -> tuple[IntArray, FloatArray]:
    """Scans (f,) and steps (f, 7, 6) by the errors of the LiDAR's twist that the images are carried by.

    The twist V at an image is measured as Ad(cTl) l_twist, l_twist with the covariance C = L L'. With A the
    rows of that measurement and dV/dx how V follows the other unknowns, L z moves the estimate by
    H^-1 (A_x + A_V dV/dx)' Ad^-T L^-T z.
    """
    values, unknowns = solution.values, robust.unknowns
    cTl = values.atPose3(EXTRINSIC)
    responses = solution.system.twist_responses()
    back = np.asarray(solution.frozen.state.cTl.inverse().AdjointMap()).T
    found: dict[int, FloatArray] = {}
    seen: set[int] = set()
    for pair in solution.pairs:
        key = twist_key(pair.drive, pair.pair.image)
        if pair.l_twist is None or key in seen:  # scans that share an image share its twist
            continue
        seen.add(key)
        clock = time_offset_key(solution.state.clock(pair.drive))
        since_s = float(values.atVector(clock)[0]) - solution.frozen.state.time_offset_s(pair.drive)
        sample = pair.l_twist
        _, by_cTl, by_offset = transferred(
            sample.twist, sample.acceleration, since_s, values.atVector(key), cTl, True
        )
        assert by_cTl is not None and by_offset is not None
        rows = responses[key].copy()
        rows[:, :6] += by_cTl
        rows[:, unknowns.column(clock)] += by_offset
        inverse_root = np.linalg.inv(np.linalg.cholesky(sample.covariance)).T
        step = robust.bread[:UNKNOWNS] @ rows.T @ back @ inverse_root
        # All images of a scan are carried by the motion at that scan.
        name = _scan_name(pair)
        found[name] = found[name] + step if name in found else step
    names = sorted(found)
    steps = np.stack([found[name] for name in names]) if names else np.zeros((0, UNKNOWNS, 6))
    return np.array(names, np.int64), steps

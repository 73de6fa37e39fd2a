"""How sure extrinsic and time offset are in a graph of the user's own.

The graph's marginal P takes all matches for independent, each with the error that its factor gives it. But
the matches of one side of one object err together, in one image and in all that show it. With J a match's
derivatives, w its weight and sigma its error in the factor, the score of an error e is w J e / sigma^2, and

    C = P + P (Var(scores) - sum w J J' / sigma^2) P,

the cluster-robust sandwich about the user's own marginal. The variances are fitted to the residuals as those
of ``calibrate`` (:func:`sst_graph.covariance.cluster_robust.fit_error_model`). They are never below what the
factors claim, for a match, and ``side_sigma_px``, for a side in all images: a short drive shows less than
there is, for pose and offset are fitted to the same sides.

A class whose mask bias is no variable keeps it in the answer. What the matches say of it is worked out as if
it were one (a score test); the larger of that and :data:`MASK_BIAS_PX` is considered in C (Schmidt).

Along a direction that the data hardly tell, as forward against later at one speed, a common error of a pixel
is many times what independent matches leave: there the two covariances differ most.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.association.edge_matching import SIDES
from sst_graph.covariance.cluster_robust import MatchTable, fit_error_model
from sst_graph.covariance.observability import limits_of_unknowns, weak_directions
from sst_graph.errors import EstimationError
from sst_graph.result import WeakDirection
from sst_graph.slam.alignment_keys import COLUMNS, AlignmentKeys, bias_column
from sst_graph.slam.alignment_term import TermMatches, TermRows
from sst_graph.slam.config import RematchConfig
from sst_graph.slam.object_sides import ObjectSides
from sst_graph.slam.term_warnings import TermWarning, WarningKind, last_warnings
from sst_graph.types import SemanticClass

FloatArray = NDArray[np.float64]

MASK_BIAS_PX = 1.0
"""Deviation of a class's mask bias that is no variable [px]: networks and people outline objects a pixel
wide or narrow of where the LiDAR's beams leave them."""
MASK_BIAS_PRIOR_PX = 3.0
"""Deviation of a mask bias beforehand where it is tested [px], as in ``calibrate``."""
MASK_BIAS_SIGMAS = 3.0
"""A mask bias farther from 0 than this many of its deviations is told."""
TIMES_TOO_SURE = 3.0
"""Ratio of the two sigmas along any direction that is told: factors scaled to the mean ratio leave up to
about 2 along some directions."""


@dataclass(frozen=True)
class CalibrationCovariance:
    """How sure extrinsic and time offset are in a graph.

    Attributes:
        covariance: (7, 7) cluster-robust; order and perturbation as :mod:`factors` has them; zeros for what
            is constant.
        marginal: (7, 7) the graph's own, which takes all matches for independent.
        times_too_sure: largest ratio of sigmas along any direction, by what matches have in common over the
            marginal's; mask biases that are considered are not in it.
        weak_directions: known worse than the limits, the weakest first.
        mask_biases_px: by class whose mask bias is no variable, its estimate and sigma [px].
        warnings: of all this, and of the matches.
    """

    covariance: FloatArray
    marginal: FloatArray
    times_too_sure: float
    weak_directions: tuple[WeakDirection, ...]
    mask_biases_px: Mapping[SemanticClass, tuple[float, float]]
    warnings: tuple[TermWarning, ...]


def calibration_covariance(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    matches: Sequence[TermMatches],
    config: RematchConfig | None = None,
) -> CalibrationCovariance:
    """Cluster-robust covariance of extrinsic and time offset in a graph that holds terms' factors.

    Args:
        graph: all factors, those of the matches among them.
        values: its optimum.
        matches: of all terms, of one camera.
        config: limits of what is told.

    Raises:
        EstimationError: no match has a factor, or the graph does not determine extrinsic and offset.
    """
    config = config or RematchConfig()
    used = [each for each in matches if each.factor is not None and each.term is not None]
    if not used or used[0].term is None:
        raise EstimationError("calibration_covariance: found no term with a factor, expected one or more")
    keys, sides = used[0].term.keys, ObjectSides()
    P = marginal(graph, values, keys)
    if not np.isfinite(P).all():
        undetermined = "a graph that does not determine extrinsic and time offset"
        raise EstimationError(f"calibration_covariance: found {undetermined}, expected priors on them")
    rows = [rows_of(each, sides, values) for each in used]
    sums = total(TermSums.of(each, m.information) for each, m in zip(rows, used, strict=True))
    found = robust_covariance(P, sums, fit_errors(rows, config), keys)
    warnings = (
        *last_warnings(matches, values, found.covariance, config),
        *told(P[:7, :7], found, keys.extrinsic(values), config),
    )
    return CalibrationCovariance(
        found.covariance,
        P[:7, :7],
        times_too_sure(P[:7, :7], found.clustered),
        weak_directions(found.covariance, keys.extrinsic(values), config.observability),
        found.mask_biases_px,
        warnings,
    )


def marginal(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, keys: AlignmentKeys) -> FloatArray:
    """(n, n) marginal covariance over :data:`COLUMNS` in a graph; zeros for what is constant.

    Infinite where the graph does not determine them.
    """
    if not keys.lasting:
        return np.zeros((COLUMNS, COLUMNS))
    try:
        joint = gtsam.Marginals(graph, values).jointMarginalCovariance(list(keys.lasting))
        return keys.placed(np.asarray(joint.fullMatrix()))
    except (RuntimeError, IndexError):  # indeterminate, or nothing in the graph tells of them
        return np.full((COLUMNS, COLUMNS), np.inf)


# --- sums over matches


@dataclass(frozen=True)
class SideErrors:
    """Errors of matches: variances that a side keeps in all images and in one [px^2], and the variance of a
    match over what its factor gives it, 1 or more."""

    side: float
    side_frame: float
    match: float


@dataclass
class TermSums:
    """Sums over the matches of one term or more, over :data:`COLUMNS` (n).

    Attributes:
        claimed: (n, n) information in the graph, sum of q w J J' / sigma^2 with q the factor's scale.
        independent: (n, n) variance of the scores in the graph if matches err as their factors say: q twice.
        side_frames: (n, n) sum of squared scores of each side in each image, for a side's error of 1 px.
        sides: (n,) score of each side over all images, by its number.
        pull: (n,) sum of q w J r / sigma^2.
    """

    claimed: FloatArray = field(default_factory=lambda: np.zeros((COLUMNS, COLUMNS)))
    independent: FloatArray = field(default_factory=lambda: np.zeros((COLUMNS, COLUMNS)))
    side_frames: FloatArray = field(default_factory=lambda: np.zeros((COLUMNS, COLUMNS)))
    sides: dict[int, FloatArray] = field(default_factory=dict)
    pull: FloatArray = field(default_factory=lambda: np.zeros(COLUMNS))

    @classmethod
    def of(cls, rows: TermRows, information: float) -> TermSums:
        """Of one term."""
        if not len(rows):
            return cls()
        scores = information * rows.J * (rows.weights / rows.sigmas_px**2)[:, None]
        claimed = scores.T @ rows.J
        numbers, own = np.unique(rows.sides, return_inverse=True)
        by_side = np.zeros((len(numbers), COLUMNS))
        np.add.at(by_side, own.reshape(-1), scores)
        return cls(
            claimed,
            information * claimed,
            by_side.T @ by_side,
            dict(zip(numbers.tolist(), by_side, strict=True)),
            scores.T @ rows.r,
        )

    def add(self, other: TermSums) -> None:
        self.claimed = self.claimed + other.claimed
        self.independent = self.independent + other.independent
        self.side_frames = self.side_frames + other.side_frames
        self.pull = self.pull + other.pull
        for side, score in other.sides.items():
            self.sides[side] = self.sides.get(side, np.zeros(COLUMNS)) + score

    def variance(self, errors: SideErrors) -> FloatArray:
        """(n, n) of the sum of all scores."""
        shared = np.array([*self.sides.values()]).reshape(-1, COLUMNS)
        return np.asarray(
            errors.match * self.independent
            + errors.side_frame * self.side_frames
            + errors.side * (shared.T @ shared)
        )


def total(parts: Iterable[TermSums]) -> TermSums:
    """All of them in one."""
    whole = TermSums()
    for part in parts:
        whole.add(part)
    return whole


def rows_of(matches: TermMatches, sides: ObjectSides, values: gtsam.Values) -> TermRows:
    """The matches as rows at the values."""
    return TermRows.none() if matches.term is None else matches.term.rows(matches, sides, values)


def least_errors(config: RematchConfig) -> SideErrors:
    """What is known of the errors before any residual."""
    return SideErrors(config.side_sigma_px**2, 0.0, 1.0)


def fit_errors(rows: Sequence[TermRows], config: RematchConfig) -> SideErrors:
    """Errors of sides and matches by the residuals, and at least as large as is known beforehand."""
    all_rows = TermRows.joined(rows)
    if not len(all_rows):
        return least_errors(config)
    precisions = all_rows.weights / all_rows.sigmas_px**2
    image = np.repeat(np.arange(len(rows)), [len(each) for each in rows])
    sides = np.unique(all_rows.sides, return_inverse=True)[1].reshape(-1)
    side_frames = np.unique(image * (sides.max() + 1) + sides, return_inverse=True)[1].reshape(-1)
    objects = np.unique(all_rows.sides // SIDES, return_inverse=True)[1].reshape(-1)
    nothing = np.zeros((len(all_rows), 0))
    table = MatchTable(
        nothing, np.sqrt(precisions), precisions, all_rows.r, sides, side_frames, objects, np.inf
    )
    model = fit_error_model(table)
    of_claimed = float((precisions / all_rows.sigmas_px**2).sum()) / max(float(precisions.sum()), 1e-300)
    if config.side_sigma_px == 0.0:  # what sides have in common is not wanted
        return SideErrors(0.0, 0.0, max(model.match * of_claimed, 1.0))
    return SideErrors(
        max(model.side, config.side_sigma_px**2), model.side_frame, max(model.match * of_claimed, 1.0)
    )


# --- the covariance


@dataclass(frozen=True)
class Robust:
    """A cluster-robust covariance.

    Attributes:
        covariance: (7, 7), mask biases that are no variables considered.
        clustered: (7, 7) without them: errors that matches share, and their own.
        independent: (7, 7) part of it by errors that no two matches share.
        mask_biases_px: estimate and sigma of each class's that is no variable.
    """

    covariance: FloatArray
    clustered: FloatArray
    independent: FloatArray
    mask_biases_px: Mapping[SemanticClass, tuple[float, float]]


def robust_covariance(P: FloatArray, sums: TermSums, errors: SideErrors, keys: AlignmentKeys) -> Robust:
    """P + P (Var(scores) - claimed) P, and what mask biases that are no variables add.

    Args:
        P: (n, n) marginal over :data:`COLUMNS` in the graph, zeros for what is constant.
        sums: of all matches in it.
        errors: of the matches.
        keys: which mask biases are variables.
    """
    rest = _by_the_rest(P, sums.claimed)
    independent, clustered = rest + P @ sums.independent @ P, rest + P @ sums.variance(errors) @ P
    considered = np.zeros_like(P)
    biases = _held_biases(P, sums, errors, keys)
    for c, (bias, _) in biases.items():
        step = max(abs(bias), MASK_BIAS_PX) * P @ sums.claimed[:, bias_column(c)]
        considered += np.outer(step, step)
    C = clustered + considered
    return Robust(_symmetric(C), _symmetric(clustered), _symmetric(independent), biases)


def _by_the_rest(P: FloatArray, claimed: FloatArray) -> FloatArray:
    """P - P claimed P: what errors of all other factors give, with the information of the matches in P.

    No part of P is taken twice: an incremental solver's P is that of an earlier linearization.
    """
    root, _ = _root(P)
    shares, axes = np.linalg.eigh(root.T @ claimed @ root)
    return np.asarray((root @ axes * np.clip(1.0 - shares, 0.0, 1.0)) @ (root @ axes).T)


def _root(P: FloatArray) -> tuple[FloatArray, FloatArray]:
    """R with R R' = P, a column for each direction that P knows, and R's pseudo-inverse."""
    scale = np.sqrt(np.maximum(np.diag(P), 1e-300))
    values, vectors = np.linalg.eigh(P / np.outer(scale, scale))
    known = values > 1e-12 * max(float(values[-1]), 1e-300)
    sizes = np.sqrt(values[known])
    return scale[:, None] * vectors[:, known] * sizes, (vectors[:, known] / sizes).T / scale


def _held_biases(
    P: FloatArray, sums: TermSums, errors: SideErrors, keys: AlignmentKeys
) -> dict[SemanticClass, tuple[float, float]]:
    """Estimate and sigma [px] of each mask bias that is no variable, each by itself beside all variables.

    At the optimum the variables' pulls are balanced by the rest of the graph; a bias b would take
    b = -pull_b / S, S its information with the variables marginalised out.
    """
    found, variance = {}, sums.variance(errors)
    for c in SemanticClass:
        column = bias_column(c)
        if isinstance(keys.biases_px.get(c), int) or sums.claimed[column, column] <= 0.0:
            continue
        response = -P @ sums.claimed[:, column]  # of the variables to the bias
        follows = response.copy()
        follows[column] = 1.0
        S = float(follows @ sums.claimed[:, column]) + MASK_BIAS_PRIOR_PX**-2
        # What the variables know beyond these matches (priors, motion) does not err with them.
        sigma = float(np.sqrt(np.maximum(follows @ variance @ follows, 0.0))) / S
        found[c] = -float(sums.pull[column]) / S, sigma
    return found


def _symmetric(C: FloatArray) -> FloatArray:
    """(7, 7) of extrinsic and offset."""
    return np.asarray(0.5 * (C + C.T)[:7, :7])


def inflation(P: FloatArray, C: FloatArray) -> float:
    """Mean ratio of two covariances over the directions that P knows, 1 or more."""
    ratios = _ratios(P, C)
    return 1.0 if ratios is None else max(1.0, float(ratios.mean()))


def times_too_sure(P: FloatArray, C: FloatArray) -> float:
    """Largest ratio of the sigmas of C and P along any direction that P knows."""
    ratios = _ratios(P, C)
    return 1.0 if ratios is None else float(np.sqrt(max(ratios.max(), 0.0)))


def _ratios(P: FloatArray, C: FloatArray) -> FloatArray | None:
    """Variances of C along the axes in which P is the unit matrix; None where P knows nothing."""
    if not np.isfinite(P).all() or not P.any():
        return None
    _, whiten = _root(P)
    return np.asarray(np.linalg.eigvalsh(whiten @ C @ whiten.T))


def told(P: FloatArray, found: Robust, cTl: gtsam.Pose3, config: RematchConfig) -> list[TermWarning]:
    """Warnings of a covariance: weak directions, a marginal (7, 7) that is too sure, mask biases."""
    warnings, C = [], found.covariance
    if not np.isfinite(C).all():
        return []
    limits = limits_of_unknowns(C, config.observability)
    for weak, value in zip(
        weak_directions(C, cTl, config.observability),
        np.sqrt(np.linalg.eigvalsh(C / np.outer(limits, limits))[::-1]),
        strict=False,
    ):
        detail = f"{weak.sentence}: {weak.advice}"
        warnings.append(TermWarning(WarningKind.WEAK_DIRECTION, float(value), 1.0, "times the limit", detail))
    times = times_too_sure(P, found.clustered)
    if times > TIMES_TOO_SURE:
        warnings.append(
            TermWarning(WarningKind.OVERCONFIDENT_MARGINAL, times, TIMES_TOO_SURE, "times the sigma")
        )
    for c, (bias, sigma) in found.mask_biases_px.items():
        if abs(bias) > MASK_BIAS_SIGMAS * sigma:
            limit, detail = MASK_BIAS_SIGMAS * sigma, f"class {c.name.lower()}, {bias:+.2f} +- {sigma:.2f} px"
            warnings.append(TermWarning(WarningKind.MASK_BIAS, abs(bias), limit, "px", detail))
    return warnings

"""Covariance of extrinsic and time offset in a graph of your own.

The graph's marginal P takes all matches for independent, each with the error that its factor gives it. But
the errors of matches on one side of one object are correlated, in one image and in all that show it. With J a
match's derivatives, w its weight and sigma its error in the factor, the score of an error e is w J e /
sigma^2, and

    C = P + P (Var(scores) - sum w J J' / sigma^2) P,

the cluster-robust sandwich about the user's own marginal. The variances are fitted to the residuals as those
of ``calibrate`` (:func:`sst_graph.covariance.error_model.fit_error_model`). They are never below what the
factors claim, for a match, and ``side_sigma_px``, for a side in all images: a short drive shows less than
there is, for pose and offset are fitted to the same sides.

The mask bias of a class for which it is no variable shifts the estimate. It is estimated from the matches as
if it were a variable (a score test); the larger of that and :data:`MASK_BIAS_PX` is considered in C
(Schmidt).

Edges of objects without a class (``OBJECT``) err together in more ways, which no residual shows. Where they
lie between the beams is considered as common to all upper edges, and to all at the sides, as in
``calibrate`` (:mod:`sst_graph.batch.by_edges.covariance`); its floor counts with their share of the estimate.

Along a direction that the data hardly determine, as forward against later at one speed, a common error of a
pixel is many times what independent matches leave: there the two covariances differ most.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np

from sst_graph.batch.by_edges.covariance import FLOOR
from sst_graph.config import expect_settings
from sst_graph.covariance.error_model import ErrorModel, SideResiduals, fit_error_model
from sst_graph.covariance.observability import limits_of_unknowns, weak_directions
from sst_graph.covariance.sums import ScoreSums
from sst_graph.errors import EstimationError
from sst_graph.factors.arguments import checked_type
from sst_graph.factors.custom.variables import checked_problem
from sst_graph.graph.linear import covariance_root
from sst_graph.result import WeakDirection
from sst_graph.slam.alignment_keys import COLUMNS, POSITIONS, AlignmentKeys, bias_column
from sst_graph.slam.alignment_term import TermMatches, TermRows
from sst_graph.slam.checked_terms import checked_terms, expect_factors_of
from sst_graph.slam.config import RematchConfig
from sst_graph.slam.object_sides import ObjectSides
from sst_graph.slam.term_warnings import TermWarning, WarningKind, last_warnings
from sst_graph.types import FloatArray, SemanticClass

MASK_BIAS_PX = 1.0
"""Deviation of a class's mask bias that is no variable [px]: networks and people outline objects a pixel
wide or narrow of where the LiDAR's beams leave them."""
MASK_BIAS_PRIOR_PX = 3.0
"""Deviation of a mask bias beforehand where it is tested [px], as in ``calibrate``."""
MASK_BIAS_SIGMAS = 3.0
"""A mask bias farther from 0 than this many of its deviations gives a warning."""
TIMES_TOO_SURE = 3.0
"""Ratio of the two sigmas along any direction that gives a warning: factors scaled to the mean ratio leave up
to about 2 along some directions."""


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
        config: limits of the warnings.

    Raises:
        EstimationError: no match has a factor, or the graph does not determine extrinsic and offset.
        FactorError: no graph, no matches, those of several cameras or one twice, a graph that does not hold
            their factors once each, and no others of the kind, or no value for a key.
        ConfigError: no settings.
    """
    config = expect_settings(config, RematchConfig)
    where = "calibration_covariance"
    checked_problem(where, graph, values)
    expected = "a list of TermMatches, as AlignmentTerm.matched gives them"
    checked_type(f"matches of {where}", matches, (list, tuple), expected)
    for each in matches:
        checked_type(f"matches of {where}", each, TermMatches, expected)
    used = [each for each in matches if each.factor is not None and each.term is not None]
    if not used or used[0].term is None:
        raise EstimationError("calibration_covariance: found no term with a factor, expected one or more")
    checked_terms(where, [each.term for each in used])
    keys, sides = used[0].term.keys, ObjectSides()
    expect_factors_of(where, graph, keys, [each.factor for each in used if each.factor is not None])
    keys.check_kinds(values)
    P = marginal(graph, values, keys)
    if not np.isfinite(P).all():
        undetermined = "a graph that does not determine extrinsic and time offset"
        raise EstimationError(f"calibration_covariance: found {undetermined}, expected priors on them")
    rows = [rows_of(each, sides, values) for each in used]
    sums = total(TermSums.of(each, m.information) for each, m in zip(rows, used, strict=True))
    found = robust_covariance(P, sums, fit_errors(rows, config), keys)
    warnings = (
        *last_warnings(matches, values, found.covariance, config),
        *covariance_warnings(P[:7, :7], found, keys.extrinsic(values), config),
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
    except (RuntimeError, IndexError):  # indeterminate, or no factor in the graph touches them
        return np.full((COLUMNS, COLUMNS), np.inf)


# --- sums over matches


@dataclass(frozen=True)
class TermSums:
    """Sums over the matches of one term or more, over :data:`COLUMNS` (n).

    Attributes:
        claimed: (n, n) information in the graph, sum of q w J J' / sigma^2 with q the factor's scale.
        by_edges: (n, n) part of it by edges of objects without a class.
        scores: of the errors of sides [px] and, over sigma / sqrt(w), of single matches.
        gradient: (n,) sum of q w J r / sigma^2.
    """

    claimed: FloatArray = field(default_factory=lambda: np.zeros((COLUMNS, COLUMNS)))
    by_edges: FloatArray = field(default_factory=lambda: np.zeros((COLUMNS, COLUMNS)))
    scores: ScoreSums = field(default_factory=lambda: ScoreSums.none(COLUMNS))
    gradient: FloatArray = field(default_factory=lambda: np.zeros(COLUMNS))

    @classmethod
    def of(cls, rows: TermRows, information: float) -> TermSums:
        """Sums over the matches of one term."""
        roots = np.sqrt(rows.weights) / rows.sigmas_px
        J = rows.J * roots[:, None]
        scores = ScoreSums.of_frame(J, roots, rows.sides, rows.level)
        gradient = np.asarray(information * (J.T @ (roots * rows.r)))
        edges = J[rows.J[:, bias_column(SemanticClass.OBJECT)] > 0.0]
        by_edges = information * (edges.T @ edges)
        return cls(information * scores.independent, by_edges, scores.scaled(information), gradient)

    def __add__(self, other: TermSums) -> TermSums:
        return TermSums(
            self.claimed + other.claimed,
            self.by_edges + other.by_edges,
            self.scores + other.scores,
            self.gradient + other.gradient,
        )


def total(parts: Iterable[TermSums]) -> TermSums:
    """All of them in one."""
    return sum(parts, TermSums())


def rows_of(matches: TermMatches, sides: ObjectSides, values: gtsam.Values) -> TermRows:
    """The matches as rows at the values."""
    return TermRows.none() if matches.term is None else matches.term.rows(matches, sides, values)


def least_errors(config: RematchConfig) -> ErrorModel:
    """Prior knowledge of the errors: variances of a side [px^2], and of a match over what
    its factor gives it."""
    return ErrorModel(config.side_sigma_px**2, 0.0, 1.0)


def fit_errors(rows: Sequence[TermRows], config: RematchConfig) -> ErrorModel:
    """Errors of sides [px^2] and matches (over what their factors give them) by the residuals, and at least
    as large as is known beforehand."""
    joined, least = TermRows.joined(rows), least_errors(config)
    if not len(joined):
        return least
    precisions = joined.weights / joined.sigmas_px**2
    image = np.repeat(np.arange(len(rows)), [len(each) for each in rows])
    model = fit_error_model(SideResiduals.of(joined.r, precisions, joined.sides, image))
    of_claimed = float((precisions / joined.sigmas_px**2).sum()) / max(float(precisions.sum()), 1e-300)
    match = max(model.match * of_claimed, least.match)
    if config.side_sigma_px == 0.0:  # what sides have in common is not wanted
        return replace(least, match=match)
    return ErrorModel(max(model.side, least.side), model.side_frame, match)


# --- the covariance


@dataclass(frozen=True)
class Robust:
    """A cluster-robust covariance.

    Attributes:
        covariance: (7, 7), mask biases that are no variables and what edges have in common considered.
        clustered: (7, 7) without them: errors that matches share, and their own.
        independent: (7, 7) part of it by errors that no two matches share.
        mask_biases_px: estimate and sigma of each class's that is no variable.
    """

    covariance: FloatArray
    clustered: FloatArray
    independent: FloatArray
    mask_biases_px: Mapping[SemanticClass, tuple[float, float]]


def robust_covariance(P: FloatArray, sums: TermSums, errors: ErrorModel, keys: AlignmentKeys) -> Robust:
    """P + P (Var(scores) - claimed) P, and what mask biases that are no variables add.

    Args:
        P: (n, n) marginal over :data:`COLUMNS` in the graph, zeros for what is constant.
        sums: of all matches in it.
        errors: of the matches.
        keys: which mask biases are variables.
    """
    rest = _by_the_rest(P, sums.claimed)
    independent, clustered = (
        rest + P @ variance @ P for variance in (sums.scores.independent, sums.scores.variance(errors))
    )
    considered = np.zeros_like(P)
    biases = _held_biases(P, sums, errors, keys)
    for c, (bias, _) in biases.items():
        step = max(abs(bias), MASK_BIAS_PX) * P @ sums.claimed[:, bias_column(c)]
        considered += np.outer(step, step)
    considered += _by_common_edges(P, sums.by_edges)
    C = clustered + considered
    return Robust(_symmetric(C), _symmetric(clustered), _symmetric(independent), biases)


def _by_the_rest(P: FloatArray, claimed: FloatArray) -> FloatArray:
    """P - P claimed P: what errors of all other factors give, with the information of the matches in P.

    No part of P is taken twice: an incremental solver's P is that of an earlier linearization.
    """
    root, _ = covariance_root(P)
    shares, axes = np.linalg.eigh(root.T @ claimed @ root)
    return np.asarray((root @ axes * np.clip(1.0 - shares, 0.0, 1.0)) @ (root @ axes).T)


def _by_common_edges(P: FloatArray, by_edges: FloatArray) -> FloatArray:
    """What all edges of objects without a class have in common: positions between the beams, and the floor
    of ``calibrate``, where they alone decide."""
    share, steps = P @ by_edges[:, :7], P @ by_edges[:, POSITIONS]
    return np.asarray(steps @ steps.T + (share * FLOOR**2) @ share.T)


def _held_biases(
    P: FloatArray, sums: TermSums, errors: ErrorModel, keys: AlignmentKeys
) -> dict[SemanticClass, tuple[float, float]]:
    """Estimate and sigma [px] of each mask bias that is no variable, each by itself beside all variables.

    At the optimum the variables' pulls are balanced by the rest of the graph; a bias b would take
    b = -pull_b / S, S its information with the variables marginalised out.
    """
    found, variance = {}, sums.scores.variance(errors)
    for c in SemanticClass:
        column = bias_column(c)
        if isinstance(keys.biases_px.get(c), int) or sums.claimed[column, column] <= 0.0:
            continue
        response = -P @ sums.claimed[:, column]  # of the variables to the bias
        follows = response.copy()
        follows[column] = 1.0
        # The information on the bias; 0 where the graph has less than the matches claim (other factors, or
        # scaled ones).
        S = max(float(follows @ sums.claimed[:, column]), 0.0) + MASK_BIAS_PRIOR_PX**-2
        # What the variables know beyond these matches (priors, motion) does not err with them.
        sigma = float(np.sqrt(np.maximum(follows @ variance @ follows, 0.0))) / S
        found[c] = -float(sums.gradient[column]) / S, sigma
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
    _, whiten = covariance_root(P)
    return np.asarray(np.linalg.eigvalsh(whiten @ C @ whiten.T))


def covariance_warnings(
    P: FloatArray, found: Robust, cTl: gtsam.Pose3, config: RematchConfig
) -> list[TermWarning]:
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

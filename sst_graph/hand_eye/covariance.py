"""The covariance of a hand-eye estimate: neighbouring pairs err together, and all pairs share some error.

A scan and an image end one pair and begin the next, so scores of neighbours are correlated: they are
summed with falling weights (Bartlett's kernel: Newey & West, Econometrica 1987), with the usual correction
for few pairs (Cameron & Miller, A practitioner's guide to cluster-robust inference, 2015, sec. VI.B).
What all pairs share, such as a principal point that is off, no residual shows: it stands in
:class:`HandEyeErrors`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.config import Settings, setting
from sst_graph.graph.linear import unit_scale, with_ridge
from sst_graph.graph.state import EXTRINSIC, time_offset_key
from sst_graph.hand_eye.graph import HandEyePriors, HandEyeTerm

FloatArray = NDArray[np.float64]


FEIGNED_MARGIN = 2.0
"""What noise feigns counts so many times: its own size is known from the same few motions."""
TAKEN_BACK = 0.5
"""Largest part of the variance that scores which cancel one another take back: few may do so by chance."""
LEAST_GENUINE = 1e-3
"""Of the information in any direction at least this part is taken for genuine, to keep it positive."""


@dataclass(frozen=True)
class HandEyeErrors(Settings):
    """Sigmas of what all pairs share, and how far neighbours go together.

    Attributes:
        direction_deg: of every direction of travel, about each axis of the camera [deg].
        turn_rate_deg_s: of every rotation, by the length of its interval [deg/s].
        lags: neighbours up to this far apart go together.
    """

    direction_deg: float = setting(0.03, at_least=0.0, at_most=90.0)
    turn_rate_deg_s: float = setting(0.02, at_least=0.0, at_most=90.0)
    lags: int = setting(3, at_least=0, at_most=1000)


def hand_eye_covariance(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    terms: Sequence[HandEyeTerm],
    errors: HandEyeErrors,
    priors: HandEyePriors,
) -> FloatArray:
    """(7, 7) covariance of [extrinsic 6, offset]: sandwich over neighbours, at most the priors' own.

    Args:
        graph: the terms' factors and the priors, at its optimum ``values``.
        terms: in the order of drive and time.
    """
    ordering = gtsam.Ordering()
    ordering.push_back(EXTRINSIC)
    ordering.push_back(time_offset_key())
    hessian = graph.linearize(values).hessian(ordering)[0]
    feigned = FEIGNED_MARGIN * np.sum([_feigned(term) for term in terms], axis=0)
    bread = _inverse_of_genuine(hessian, feigned)
    blocks, scores, shared = [], [], np.zeros((7, 6))
    for term in terms:
        J, r, root = _whitened(term, values)
        blocks.append(J.T @ J)
        scores.append(J.T @ r)
        rotation = (
            np.radians(errors.turn_rate_deg_s) * 1e-9 * (term.pair.camera.to_ns - term.pair.camera.from_ns)
        )
        shared[:, :3] += rotation * J.T @ root[:, :3]
        if term.has_direction:
            shared[:, 3:] += np.radians(errors.direction_deg) * J.T @ root[:, 3:]
    residuals = sum(5 if term.has_direction else 3 for term in terms)
    surplus = _surplus(np.stack(scores), np.sum(blocks, axis=0), _breaks(terms), errors.lags, residuals)
    covariance = _filled(bread, surplus) + bread @ shared @ shared.T @ bread
    return _capped(covariance, priors)


def _filled(bread: FloatArray, surplus: FloatArray) -> FloatArray:
    """(7, 7) bread + bread surplus bread, of which the surplus takes back no more than :data:`TAKEN_BACK`."""
    root = np.linalg.cholesky(bread)
    values, vectors = np.linalg.eigh(np.eye(len(bread)) + root.T @ surplus @ root)
    half = root @ vectors
    return np.asarray((half * np.maximum(values, 1.0 - TAKEN_BACK)) @ half.T)


def _capped(covariance: FloatArray, priors: HandEyePriors) -> FloatArray:
    """(7, 7) covariance, nowhere wider than the priors that stand in the graph."""
    sigmas = np.append(np.repeat([priors.rotation_rad, priors.translation_m], 3), priors.offset_s)
    both = np.outer(sigmas, sigmas)
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T) / both)
    return np.asarray((vectors * np.minimum(values, 1.0)) @ vectors.T * both)


def _feigned(term: HandEyeTerm) -> FloatArray:
    """(7, 7) information that the noise of the LiDAR's motion seems to bring: a turn that was none."""
    step, H = term.pair.lidar, term.rows_H_step
    weight = np.linalg.inv(term.covariance)
    result = np.zeros((7, 7))
    result[6, 6] = np.trace(weight @ H @ step.twist_covariance @ H.T)
    variances, axes = np.linalg.eigh(step.covariance)
    for variance, axis in zip(variances, axes.T, strict=True):
        J = H @ gtsam.Pose3.adjointMap(axis)
        result[:6, :6] += max(variance, 0.0) * J.T @ weight @ J
    return result


def _inverse_of_genuine(hessian: FloatArray, feigned: FloatArray) -> FloatArray:
    """(7, 7) inverse of the information without what noise feigns, which stays positive."""
    scale = unit_scale(hessian)
    both = np.outer(scale, scale)
    whitener = np.linalg.inv(np.linalg.cholesky(with_ridge(hessian * both)))
    values, vectors = np.linalg.eigh(np.eye(7) - whitener @ (feigned * both) @ whitener.T)
    root = whitener.T @ vectors
    return np.asarray((root / np.maximum(values, LEAST_GENUINE)) @ root.T * both)


def _whitened(term: HandEyeTerm, values: gtsam.Values) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Whitened Jacobian (m, 7), residual (m,), and square root of the information (m, m)."""
    matrix, negative = term.factor.linearize(values).jacobian()
    root = np.linalg.inv(np.linalg.cholesky(term.covariance))
    return np.asarray(matrix), -np.asarray(negative).reshape(-1), root


def _breaks(terms: Sequence[HandEyeTerm]) -> NDArray[np.bool_]:
    """(n,) whether a term does not go on where the one before ended."""
    cameras = [term.pair.camera for term in terms]
    return np.array([True] + [a.drive != b.drive or a.to_ns != b.from_ns for a, b in pairwise(cameras)])


def _surplus(
    scores: FloatArray, model: FloatArray, breaks: NDArray[np.bool_], lags: int, residuals: int
) -> FloatArray:
    """(7, 7) by which the scores' own long-run variance exceeds the model's, or falls short of it.

    What an image or a scan errs makes the turn before it too large and the next one too small.

    Args:
        scores: (n, 7) of the pairs.
        model: (7, 7) their variance if the model holds.
        breaks: (n,) where a pair does not go on where the one before ended.
        lags: neighbours up to this far apart go together.
        residuals: number of independent residuals behind the scores.
    """
    run = np.cumsum(breaks)
    total = scores.T @ scores
    for lag in range(1, lags + 1):
        same = run[lag:] == run[:-lag]
        product = (scores[lag:][same]).T @ scores[:-lag][same]
        total += (1.0 - lag / (lags + 1.0)) * (product + product.T)
    pairs, unknowns = len(scores), len(model)
    total *= pairs / max(pairs - 1, 1) * (residuals - 1) / max(residuals - unknowns, 1)
    return np.asarray(total - model)

"""The covariance of a hand-eye estimate: errors of neighbouring pairs are correlated, and all pairs share
some error.

A scan and an image end one pair and begin the next, so scores of neighbours are correlated: they are
summed with falling weights (Bartlett's kernel: Newey & West, Econometrica 1987). Of few pairs such a sum is
too small and uncertain: it is enlarged so that 1.96 of its sigmas hold 95 % of the errors (Kiefer &
Vogelsang, Econometric Theory 2005, table 1).
An error that all pairs share, such as that of the principal point, does not show in the residuals: it is
given by :class:`MotionErrors`. Another is what the interpolation between scans smooths away of fast motion,
such as a pitching of 3 Hz that is seen at 10 Hz: images see all of it, and an earlier or later time makes up
for it in all pairs alike. Of the rotation, no more counts as known than both sensors saw.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.graph.linear import unit_scale, with_ridge
from sst_graph.graph.state import State
from sst_graph.hand_eye.graph import PRIOR_SIGMAS, CameraStep, HandEyeTerms
from sst_graph.types import FloatArray

NOISE_INFORMATION_MARGIN = 2.0
"""Factor on the spurious information by noise, whose size is estimated from the same few motions."""
BY_CHANCE_CHI2 = 5.99
"""95 % quantile of chi-squared with 2 degrees of freedom."""
MOST_TAKEN_OFF = 0.5
"""Largest fraction of the variance that may be subtracted for neighbouring scores that cancel: a few cancel
by chance."""
LEAST_INFORMATION = 1e-3
"""In any direction at least this part of the information remains, to keep it positive."""
_AXES = 2
"""Rotation about an axis turns vectors across it, which have two components."""
_LAGS = 3
"""Neighbours up to this far apart may be correlated: a scan and an image end one pair and begin the next, and
smoothing spreads errors a little farther. More lags make the estimate noisier."""


@dataclass(frozen=True)
class MotionErrors:
    """Sigmas of the errors that all pairs share.

    Attributes:
        direction_deg: of every direction of travel, about each axis of the camera [deg]; 0.03 deg is half a
            pixel of the principal point at a focal length of 900 px.
        turn_rate_deg_s: of every rotation, by the length of its interval [deg/s]: drift of the odometry.
    """

    direction_deg: float = 0.03
    turn_rate_deg_s: float = 0.02


MOTION_ERRORS = MotionErrors()
"""Of the odometry here."""


def hand_eye_covariance(
    terms: HandEyeTerms, state: State, hessian: FloatArray, errors: MotionErrors = MOTION_ERRORS
) -> FloatArray:
    """(7, 7) covariance of [extrinsic 6, offset]: sandwich over neighbours, at most the priors' own.

    Args:
        terms: in the order of drive and time.
        state: the optimum of their graph.
        hessian: (7, 7) information there of the whole graph, the priors among it.
        errors: the errors that all pairs share.
    """
    # 1. The information, less what noise seems to bring.
    J, r = terms.linearized(state)
    cameras = terms.pairs.cameras
    by_noise = NOISE_INFORMATION_MARGIN * _noise_information(terms)
    whitener, model = _whitener(hessian), np.einsum("nki,nkj->ij", J, J)
    bread = _inverse_without(whitener, by_noise)
    # 2. Scores that correlate, and errors that all pairs share.
    scores = (np.swapaxes(J, 1, 2) @ r[..., None])[..., 0]
    # The rows of a direction that is not used are 0 in J.
    moved = np.swapaxes(J, 1, 2) @ terms.roots
    seconds = 1e-9 * np.array([camera.to_ns - camera.from_ns for camera in cameras])
    shared = np.zeros((7, 7))
    shared[:, :3] = np.radians(errors.turn_rate_deg_s) * np.tensordot(seconds, moved[:, :, :3], 1)
    shared[:, 3:6] = np.radians(errors.direction_deg) * moved[:, :, 3:].sum(axis=0)
    shared[:, 6] = np.einsum("nij,nj->i", moved, terms.smoothed_away)
    excess = _excess(scores, model, _breaks(cameras))
    covariance = _sandwich(bread, excess) + bread @ shared @ shared.T @ bread
    # 3. The rotation is known no better than by what both sensors saw. The offset is: twists are measured by
    # the LiDAR alone, and their noise is in step 1.
    by_camera = terms.roots @ terms.residuals.jacobians_by_camera(state.cTl, state.time_offsets_s[0])
    prior = hessian - model
    prior[6, 6] -= by_noise[6, 6]
    both = _seen_by_both(whitener, prior, J, by_camera)
    covariance[:3, :3] += _positive_part((both - bread)[:3, :3])
    return _capped(covariance)


def _positive_part(matrix: FloatArray) -> FloatArray:
    """(n, n) the part of a symmetric matrix with eigenvalues above 0."""
    values, vectors = np.linalg.eigh(matrix)
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)


def _sandwich(bread: FloatArray, excess: FloatArray) -> FloatArray:
    """(7, 7) bread + bread excess bread, where the excess takes off no more than :data:`MOST_TAKEN_OFF`."""
    root = np.linalg.cholesky(bread)
    values, vectors = np.linalg.eigh(np.eye(len(bread)) + root.T @ excess @ root)
    half = root @ vectors
    return np.asarray((half * np.maximum(values, 1.0 - MOST_TAKEN_OFF)) @ half.T)


def _capped(covariance: FloatArray) -> FloatArray:
    """(7, 7) covariance, nowhere wider than the priors in the graph."""
    both = np.outer(PRIOR_SIGMAS, PRIOR_SIGMAS)
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T) / both)
    return np.asarray((vectors * np.minimum(values, 1.0)) @ vectors.T * both)


def _noise_information(terms: HandEyeTerms) -> FloatArray:
    """(7, 7) information that the noise of the LiDAR's motions seems to bring, as if they were turns."""
    lidars, H = terms.pairs.lidars, terms.rows_H_step
    weights = np.linalg.inv(terms.covariances)
    back = np.swapaxes(H, 1, 2) @ weights @ H
    result = np.zeros((7, 7))
    result[6, 6] = np.einsum("nij,nji->", back, lidars.twist_covariances)
    variances, axes = np.linalg.eigh(lidars.covariances)
    # ad(axis) is linear in the axis.
    generators = np.array([gtsam.Pose3.adjointMap(unit) for unit in np.eye(6)])
    for variance, axis in zip(np.maximum(variances, 0.0).T, axes.transpose(2, 0, 1), strict=True):
        ad = np.tensordot(axis, generators, 1)
        result[:6, :6] += np.einsum("n,nki,nkl,nlj->ij", variance, ad, back, ad, optimize=True)
    return result


def _whitener(hessian: FloatArray) -> FloatArray:
    """(7, 7) W with W hessian W' = 1."""
    scale = unit_scale(hessian)
    return np.asarray(np.linalg.inv(np.linalg.cholesky(with_ridge(hessian * np.outer(scale, scale)))) * scale)


def _inverse_without(whitener: FloatArray, noise: FloatArray) -> FloatArray:
    """(7, 7) inverse of the information less that by noise, kept positive definite."""
    values, vectors = np.linalg.eigh(np.eye(7) - whitener @ noise @ whitener.T)
    root = whitener.T @ vectors
    return np.asarray((root / np.maximum(values, LEAST_INFORMATION)) @ root.T)


def _seen_by_both(
    whitener: FloatArray, prior: FloatArray, by_lidar: FloatArray, by_camera: FloatArray
) -> FloatArray:
    """(7, 7) covariance by the information in what both sensors saw, in every direction between next to none
    and the hessian.

    J' J counts what the LiDAR measured, noise and all, twice: noise looks like turns. Where the camera's
    motions stand in one of the two places only what both saw remains, however large the noise is: the
    camera's motions are the instrument (Söderström, Errors-in-variables methods in system identification,
    Automatica 2007, sec. 4). The estimate is where that is largest, also where both saw noise alone: then it
    is the length of two random components, and what one in twenty exceeds is taken off.

    Args:
        whitener: (7, 7) of the hessian.
        prior: (7, 7) the part of the hessian that is not of the motions.
        by_lidar, by_camera: (n, 6, 7) whitened Jacobians, of the LiDAR's motions and with the camera's in
            their place.
    """
    lidar, camera = by_lidar @ whitener.T, by_camera @ whitener.T
    common = np.einsum("nki,nkj->ij", lidar, camera)
    values, vectors = np.linalg.eigh(whitener @ prior @ whitener.T + 0.5 * (common + common.T))
    lidar, camera = lidar @ vectors, camera @ vectors
    # The variance of a sum of products of a signal s and two noises, (s + n) (s + m), by n - m.
    shares, noise = np.einsum("nki,nki->ni", lidar, camera), ((lidar - camera) ** 2).sum(axis=1)
    variance = (np.maximum(shares, 0.0) * noise / _AXES + noise**2 / (4.0 * _AXES)).sum(axis=0)
    total = shares.sum(axis=0)
    surely = np.sqrt(np.maximum(total**2 - BY_CHANCE_CHI2 * variance, 0.0))
    values = np.clip(values - np.maximum(total - surely, 0.0), LEAST_INFORMATION, 1.0)
    root = whitener.T @ vectors
    return np.asarray((root / values) @ root.T)


def _breaks(cameras: Sequence[CameraStep]) -> NDArray[np.bool_]:
    """(n,) whether a motion does not go on where the one before ended."""
    return np.array([True] + [a.drive != b.drive or a.to_ns != b.from_ns for a, b in pairwise(cameras)])


def _excess(scores: FloatArray, model: FloatArray, breaks: NDArray[np.bool_]) -> FloatArray:
    """(7, 7) by which the scores' own long-run variance exceeds the model's, or falls short of it.

    An error of an image or a scan makes the turn before it too large and the next one too small.

    Args:
        scores: (n, 7) of the pairs.
        model: (7, 7) their variance if the model holds.
        breaks: (n,) where a pair does not go on where the one before ended.
    """
    run = np.cumsum(breaks)
    total = scores.T @ scores
    for lag in range(1, _LAGS + 1):
        same = run[lag:] == run[:-lag]
        product = (scores[lag:][same]).T @ scores[:-lag][same]
        total += (1.0 - lag / (_LAGS + 1.0)) * (product + product.T)
    return np.asarray(few_pairs_factor(len(scores)) * total - model)


def few_pairs_factor(pairs: int) -> float:
    """By what the variance by the scores of so many pairs is enlarged.

    The critical value of 5 % of a t-statistic whose variance is summed with Bartlett's weights over a share b
    of the sample, over that of a known variance, squared: the cubic in b of Kiefer & Vogelsang, table 1.
    """
    b = min(1.0, (_LAGS + 1.0) / pairs)
    return float((np.polyval([-0.5324, 0.4160, 2.9694, 1.9600], b) / 1.96) ** 2)

"""The joint covariance of the estimates of several cameras on one LiDAR.

Cameras that see the same objects, by the same boundary points and the same motion, err alike. With u_i(e) the
influence of an error e on camera i (:mod:`sst_graph.rig.influences`), the covariance of two cameras is

    S_ij = sum_kind rho_kind sum_e u_i(e) u_j(e)',

over the errors that both have. The motion, the objects of the jackknife and the LiDAR's assumptions are the
same in both (rho = 1). The mask is each camera's own, so the errors of the matches are alike in part only:
how far, the residuals show, by their correlation over the sides, and points, that both cameras see. The
blocks of single cameras are their own covariances, unchanged.

Estimates by edges have their errors as steps of half-samples of the objects
(:class:`~sst_graph.covariance.shared_errors.SharedErrors`), which are the same in all cameras.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from sst_graph.covariance.shared_errors import SharedErrors, by_common_errors
from sst_graph.graph.linear import unit_scale
from sst_graph.rig.influences import KINDS, UNKNOWNS, CameraInfluences, Influence
from sst_graph.types import FloatArray

_LEAST_COMMON = 8
"""Fewest errors in common from which a correlation is taken; of fewer it is called complete: an error in
common that is left out makes a fused estimate too sure."""
_LEAST_EIGENVALUE = 1e-6
"""Of the joint correlation matrix: covariances of two cameras that leave less are scaled down."""


@dataclass(frozen=True)
class JointCovariance:
    """The joint covariance of n cameras.

    Attributes:
        matrix: (7 n, 7 n), camera by camera, each as a result's covariance.
        correlations: of the errors of matches, by kind; what the cameras have in common of them.
        common: number of sides of objects that at least two cameras see.
    """

    matrix: FloatArray
    correlations: Mapping[str, float]
    common: int


def joint_covariance(
    covariances: Sequence[FloatArray], errors: Sequence[CameraInfluences | SharedErrors | None]
) -> JointCovariance:
    """The joint covariance of cameras with covariances (7, 7) each.

    Args:
        errors: of each camera, by labels or by edges; None for one without an estimate, which has nothing in
            common.
    """
    n = len(covariances)
    whole = np.zeros((UNKNOWNS * n, UNKNOWNS * n))
    known = [own for own in errors if isinstance(own, CameraInfluences)]
    correlations = {kind: _correlation([own.matches[kind] for own in known]) for kind in KINDS}
    blocks = [slice(UNKNOWNS * i, UNKNOWNS * (i + 1)) for i in range(n)]
    for i, covariance in enumerate(covariances):
        whole[blocks[i], blocks[i]] = covariance
    for i, j in combinations(range(n), 2):
        one, other = errors[i], errors[j]
        if isinstance(one, CameraInfluences) and isinstance(other, CameraInfluences):
            cross = _cross(one, other, correlations)
        elif isinstance(one, SharedErrors) and isinstance(other, SharedErrors):
            cross = one.cross_covariance(other)
        else:
            continue
        whole[blocks[i], blocks[j]], whole[blocks[j], blocks[i]] = cross, cross.T
    sides = [own.matches["side"].names for own in known]
    seen = np.unique(np.concatenate([np.zeros(0, np.int64), *sides]), return_counts=True)[1]
    return JointCovariance(_positive(whole, blocks), correlations, int((seen > 1).sum()))


def _cross(one: CameraInfluences, other: CameraInfluences, correlations: Mapping[str, float]) -> FloatArray:
    """(7, 7) covariance of two cameras' estimates."""
    cross = np.zeros((UNKNOWNS, UNKNOWNS))
    for kind, rho in correlations.items():
        mine, its = one.matches[kind], other.matches[kind]
        a, b = _common(mine.names, its.names)
        cross += rho * mine.steps[a].T @ its.steps[b]
    a, b = _common(one.objects, other.objects)
    cross += one.steps_without[a].T @ other.steps_without[b]
    a, b = _common(one.scans, other.scans)
    cross += np.einsum("fij,fkj->ik", one.motion[a], other.motion[b])
    return cross + by_common_errors(one.assumptions, other.assumptions)


def _common(one: NDArray[np.int64], other: NDArray[np.int64]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Positions of the names that both have, in each."""
    _, a, b = np.intersect1d(one, other, assume_unique=True, return_indices=True)
    return a, b


def _correlation(cameras: Sequence[Influence]) -> float:
    """Correlation of the errors that two cameras have in common, over all pairs of cameras, 0 to 1."""
    product, squares, count = 0.0, 0.0, 0
    for one, other in combinations(cameras, 2):
        a, b = _common(one.names, other.names)
        weights = np.sqrt(one.weights[a] * other.weights[b])
        x, y = one.means[a], other.means[b]
        product += float(weights @ (x * y))
        squares += float(np.sqrt((weights @ x**2) * (weights @ y**2)))
        count += len(a)
    if count < _LEAST_COMMON or squares <= 0.0:
        return 1.0
    return min(max(product / squares, 0.0), 1.0)


def _positive(matrix: FloatArray, blocks: Sequence[slice]) -> FloatArray:
    """The matrix with the covariances between cameras scaled down until it is positive definite."""
    apart = np.zeros_like(matrix)
    for block in blocks:
        apart[block, block] = matrix[block, block]
    root = np.linalg.inv(np.linalg.cholesky(apart * np.outer(s := unit_scale(matrix), s)))
    relative = root @ ((matrix - apart) * np.outer(s, s)) @ root.T
    least = float(np.linalg.eigvalsh(relative)[0])
    share = min(1.0, (1.0 - _LEAST_EIGENVALUE) / max(-least, 1e-12))
    return np.asarray(apart + share * (matrix - apart))

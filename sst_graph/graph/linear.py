"""Matrices of unknowns whose units differ by orders of magnitude: scaled to a unit diagonal, then inverted;
and as factors.

With radians, metres, seconds and pixels in one information matrix, its condition number is near 1e9 although
no direction is unobservable; scaled, it is small.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import combinations, groupby

import gtsam
import numpy as np

from sst_graph.types import FloatArray, IntArray

_LEAST_DIAGONAL = 1e-300
"""Replaces a diagonal entry of 0, so that its square root can be divided by."""
_RIDGE = 1e-14
"""Added to a unit diagonal before it is factorized: above rounding, and so small that a sigma changes by more
than one in a million only where it is ten thousand times that of the unknown by itself."""


def unit_scale(matrix: FloatArray) -> FloatArray:
    """(n,) factors that bring a symmetric matrix (n, n) to a unit diagonal: matrix * outer(scale, scale)."""
    return scale_of(np.diag(matrix))


def scale_of(diagonal: FloatArray) -> FloatArray:
    """(n,) the same from the diagonal (n,) alone."""
    return np.asarray(1.0 / np.sqrt(np.maximum(diagonal, _LEAST_DIAGONAL)))


def with_ridge(unit: FloatArray) -> FloatArray:
    """(..., n, n) a matrix of unit diagonal that can be factorized although rounding has made it singular."""
    return np.asarray(unit + _RIDGE * np.eye(unit.shape[-1]))


def information_inverse(information: FloatArray) -> FloatArray:
    """(n, n) symmetric inverse of an information matrix, whatever it holds."""
    scale = unit_scale(information)
    both = np.outer(scale, scale)
    inverse = np.linalg.inv(with_ridge(information * both)) * both
    return np.asarray(0.5 * (inverse + inverse.T))


def scaled_inverse(information: FloatArray) -> FloatArray:
    """(n, n) symmetric inverse of an information matrix.

    Raises:
        np.linalg.LinAlgError: it is singular or not finite.
    """
    if not np.isfinite(information).all() or (np.diag(information) <= 0.0).any():
        raise np.linalg.LinAlgError("an information matrix that is not positive")
    return information_inverse(information)


def covariance_root(P: FloatArray) -> tuple[FloatArray, FloatArray]:
    """R (n, k) with R R' = P, a column for each direction in which P (n, n) is not 0, and R's
    pseudo-inverse."""
    scale = unit_scale(P)
    values, vectors = np.linalg.eigh(P * np.outer(scale, scale))
    known = values > 1e-12 * max(float(values[-1]), _LEAST_DIAGONAL)
    sizes = np.sqrt(values[known])
    return vectors[:, known] * sizes / scale[:, None], (vectors[:, known] / sizes).T * scale


def quadratic_factor(
    variables: Sequence[tuple[int, slice]], information: FloatArray, point: gtsam.Values
) -> gtsam.LinearContainerFactor:
    """Half of x' information x as one factor, x being the step from a point.

    Args:
        variables: key of each, and its rows of ``information``.
        information: (n, n).
        point: a value of each variable.
    """
    # gtsam's Python takes at most three keys at a time; the sum of such pieces is one factor.
    pieces = gtsam.GaussianFactorGraph()
    for key, a in variables:
        own = information[a, a]
        pieces.add(gtsam.HessianFactor(key, own, np.zeros(len(own)), 0.0))
    for (key, a), (other, b) in combinations(variables, 2):
        m, n = a.stop - a.start, b.stop - b.start
        nothing = np.zeros((m, m)), np.zeros(m), np.zeros((n, n)), np.zeros(n)
        pieces.add(
            gtsam.HessianFactor(
                key, other, nothing[0], information[a, b], nothing[1], nothing[2], nothing[3], 0.0
            )
        )
    return gtsam.LinearContainerFactor(gtsam.HessianFactor(pieces), point)


def ordering_of(keys: Iterable[int]) -> gtsam.Ordering:
    """Keys in an order, as gtsam takes it."""
    ordering = gtsam.Ordering()
    for key in keys:
        ordering.push_back(key)
    return ordering


def scattered(n: int, places: Sequence[IntArray], *blocks: Sequence[FloatArray]) -> list[FloatArray]:
    """(n, n) sums of blocks (m, m), each on its own rows and columns (m,); one sum for each sequence."""
    if not places:
        return [np.zeros((n, n)) for _ in blocks]
    # Blocks of one size together: a call for each of them would cost more than the work.
    order: list[int] = sorted(range(len(places)), key=lambda i: len(places[i]))
    groups = [list(group) for _, group in groupby(order, key=lambda i: len(places[i]))]
    columns = [np.array([places[i] for i in group]) for group in groups]
    where = np.concatenate([(own[:, :, None] * n + own[:, None, :]).reshape(-1) for own in columns])
    return [
        np.asarray(np.bincount(where, _in_a_row(some, groups), n * n).reshape(n, n), np.float64)
        for some in blocks
    ]


def _in_a_row(blocks: Sequence[FloatArray], groups: Sequence[Sequence[int]]) -> FloatArray:
    """(k,) all entries of blocks, those of each group have one shape."""
    return np.concatenate([np.array([blocks[i] for i in group]).reshape(-1) for group in groups])

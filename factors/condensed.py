"""Condensing a tall linear system to as many rows as it has columns, without loss.

A frame gives thousands of weighted rows [J r]. Cost |J d + r|^2, gradient J^T r and Gauss-Newton
Hessian J^T J depend only on the Gram matrix G = [J r]^T [J r]; any R with R^T R = G is the same
linear system in cols + 1 rows.
"""

from __future__ import annotations

import numpy as np

from .arguments import FloatArray, as_numbers, checked_array, checked_number, described
from .errors import FactorError


def gram(rows: FloatArray) -> FloatArray:
    """(cols, cols) Gram matrix of a system stored column by column, (cols, n)."""
    # With an odd number of rows, as point-to-pixel matches have, BLAS takes twice as long as with one more.
    return np.asarray(np.vecdot(rows[:, None], rows) if len(rows) % 2 else rows @ rows.T)


def square_root(G: FloatArray) -> FloatArray:
    """R (m, m) with R^T R = G for a positive semi-definite G, of any rank.

    Cholesky after scaling to a unit diagonal; where G is singular (an unobservable variable, exact
    data), the eigenvalues' square root, in which rounding below zero is taken as zero.
    """
    scale = np.sqrt(np.maximum(np.diag(G), 0.0))
    scale[scale == 0.0] = 1.0
    scaled = G / np.outer(scale, scale)
    try:
        R = np.linalg.cholesky(scaled).T
    except np.linalg.LinAlgError:
        eigenvalues, vectors = np.linalg.eigh(scaled)
        R = np.sqrt(np.maximum(eigenvalues, 0.0))[:, None] * vectors.T
    return np.asarray(R * scale)


def condense(G: FloatArray, constant: float = 0.0) -> tuple[FloatArray, FloatArray]:
    """Few rows with the same cost, gradient and Hessian as those behind the Gram matrix.

    Args:
        G: (cols + 1, cols + 1) Gram matrix of [J r], the residual last.
        constant: further sum of squares (>= 0) that does not depend on the variables to first order:
            under a robust kernel ``2 sum rho - sum w r^2``, so that the error of the factor is the
            true robust cost while its linearization carries the weights w.

    Returns:
        r (cols + 2,) and J (cols + 2, cols) with ``|r|^2 = G[-1, -1] + constant``,
        ``J^T r = G[:-1, -1]`` and ``J^T J = G[:-1, :-1]``; the last row has a zero Jacobian.

    Raises:
        FactorError: no square matrix of finite numbers, one that is not symmetric or not positive
            semi-definite, or a constant that is no number from 0 on.
    """
    G = as_numbers("Gram matrix", G, "(m, m)")
    size = max(len(G), 1) if G.ndim else 1
    G = checked_array("Gram matrix", G, (size, size))
    scale = np.sqrt(np.abs(np.diag(G)))
    unit = G / np.outer(*(np.where(scale > 0.0, scale, 1.0),) * 2)
    if (np.abs(unit - unit.T) > _ROUNDING).any():
        raise FactorError("Gram matrix", "a matrix that is not symmetric", "one that is")
    if np.linalg.eigvalsh(unit)[0] < -_ROUNDING * size:
        raise FactorError("Gram matrix", "a negative eigenvalue", "a positive semi-definite matrix")
    if checked_number("constant of condense", constant) < 0.0:
        raise FactorError("constant of condense", described(constant), "a number from 0 on")
    return condense_gram(G, constant)


_ROUNDING = 1e-6
"""What rounding may leave of a Gram matrix of unit diagonal."""


def condense_gram(G: FloatArray, constant: float) -> tuple[FloatArray, FloatArray]:
    """:func:`condense` of arguments that were made here."""
    return condense_root(square_root(G), constant)


def condense_root(R: FloatArray, constant: float) -> tuple[FloatArray, FloatArray]:
    """As :func:`condense_gram`, from a root R (k, cols + 1), R^T R = G, of no more than cols + 1 rows."""
    k, m = R.shape
    J, error = np.zeros((m + 1, m - 1)), np.zeros(m + 1)
    J[:k], error[:k], error[m] = R[:, :-1], R[:, -1], np.sqrt(max(constant, 0.0))
    return error, J


def cost_rows(cost: float, rows: int) -> FloatArray:
    """An error vector (rows,) with ``|e|^2 / 2 = cost``, for evaluations that need no Jacobian."""
    error = np.zeros(rows)
    error[0] = np.sqrt(2.0 * max(cost, 0.0))
    return error

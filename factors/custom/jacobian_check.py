"""Checks of a factor's derivatives against numerical ones, for our factors and for a user's own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import gtsam
import numpy as np

from ..arguments import FloatArray, checked_positive, checked_type
from ..errors import FactorError
from .variables import checked_values


@dataclass(frozen=True, eq=False)
class JacobianBlock:
    """One variable's derivative: the analytic and the numerical one, and their greatest difference.

    Attributes:
        key: of the variable.
        analytic, numerical: (rows, dim), whitened.
        error: greatest difference, relative to the greatest entry of the numerical block (absolute where
            all its entries are below 1e-6 of the factor's greatest).
    """

    key: int
    analytic: FloatArray
    numerical: FloatArray
    error: float

    def __str__(self) -> str:
        name = gtsam.DefaultKeyFormatter(self.key)
        row, col = np.unravel_index(np.abs(self.analytic - self.numerical).argmax(), self.analytic.shape)
        found, expected = self.analytic[row, col], self.numerical[row, col]
        return (
            f"by {name}: relative error {self.error:.2e}, worst at row {row}, column {col}: "
            f"analytic {found:.9g}, numerical {expected:.9g}"
        )


@dataclass(frozen=True, eq=False)
class JacobianReport:
    """What :func:`check_jacobians` and :func:`check_gradient` found, by variable."""

    blocks: tuple[JacobianBlock, ...]
    tolerance: float

    @property
    def error(self) -> float:
        """The greatest relative error of all blocks."""
        return max(block.error for block in self.blocks)

    @property
    def ok(self) -> bool:
        return self.error <= self.tolerance

    def __str__(self) -> str:
        return "\n".join(str(block) for block in self.blocks)


def check_jacobians(
    factor: gtsam.NoiseModelFactor, values: gtsam.Values, tolerance: float = 1e-6, step: float = 1e-3
) -> JacobianReport:
    """Compare a factor's whitened Jacobians with numerical ones.

    The numerical ones are central differences along the tangent space, with steps h, h/2, h/4
    extrapolated to zero (Richardson): for smooth factors good to about 1e-10.

    A *condensed* or robustly weighted factor has no residual whose derivative its Jacobian is: its
    linearization has the cost's gradient and Gauss-Newton Hessian. Use :func:`check_gradient`.

    Args:
        factor: any NoiseModelFactor, a CustomFactor for instance, without a robust noise model.
        values: point of comparison; take a generic one (no zero time offset, no identity).
        tolerance: greatest relative error that passes.
        step: h, in the units of the tangent space (rad, m, s).

    Raises:
        FactorError: an error above the tolerance, the message names variable, row and column; no such factor,
            or no value for one of its keys.
    """
    expected = "a gtsam.NoiseModelFactor, a CustomFactor for instance"
    checked_type("factor of check_jacobians", factor, gtsam.NoiseModelFactor, expected)
    _check(factor, values, tolerance, step)
    A, _ = factor.linearize(values).jacobian()
    numerical = _numerical(factor, values, factor.whitenedError, step)
    return _report("Jacobian", np.asarray(A), numerical, tolerance)


def check_gradient(
    factor: gtsam.NonlinearFactor, values: gtsam.Values, tolerance: float = 1e-6, step: float = 1e-3
) -> JacobianReport:
    """Compare J^T r of a factor's linearization with the numerical gradient of its error.

    Holds for every factor whose linearization is true to its cost: plain, condensed, robustly weighted.
    Arguments and errors as in :func:`check_jacobians`.
    """
    expected = "a factor of a gtsam graph"
    checked_type("factor of check_gradient", factor, gtsam.NonlinearFactor, expected)
    _check(factor, values, tolerance, step)
    A, b = factor.linearize(values).jacobian()
    gradient = -(np.asarray(A).T @ np.asarray(b))[None, :]

    def cost(x: gtsam.Values) -> FloatArray:
        return np.array([factor.error(x)])

    return _report("gradient", gradient, _numerical(factor, values, cost, step), tolerance)


def _check(factor: gtsam.NonlinearFactor, values: gtsam.Values, tolerance: float, step: float) -> None:
    checked_values("values of the comparison", values, [factor])
    checked_positive("tolerance", tolerance)
    checked_positive("step", step)


def _numerical(
    factor: gtsam.NonlinearFactor,
    values: gtsam.Values,
    function: Callable[[gtsam.Values], FloatArray],
    step: float,
) -> dict[int, FloatArray]:
    """(rows, dim) derivative of a function by each variable of a factor, in the factor's order."""
    zeros = values.localCoordinates(values)
    keys = [int(key) for key in factor.keys()]  # noqa: SIM118  (a gtsam factor, no dict)
    return {key: _derivative(function, values, key, len(zeros.at(key)), step) for key in keys}


def _report(
    what: str, analytic: FloatArray, numerical: dict[int, FloatArray], tolerance: float
) -> JacobianReport:
    """The comparison; ``analytic`` has the columns of all variables."""
    floor = 1e-6 * max(float(np.abs(block).max(initial=0.0)) for block in numerical.values())
    ends = np.cumsum([block.shape[1] for block in numerical.values()])[:-1]
    blocks = []
    for (key, expected), found in zip(numerical.items(), np.split(analytic, ends, axis=1), strict=True):
        scale = max(float(np.abs(expected).max(initial=0.0)), floor, 1e-12)
        difference = float(np.abs(found - expected).max(initial=0.0))
        blocks.append(JacobianBlock(key, found, expected, difference / scale))
    report = JacobianReport(tuple(blocks), tolerance)
    if not report.ok:
        raise FactorError(f"{what} of a factor", f"\n{report}\n", f"relative errors up to {tolerance:.1e}")
    return report


def _derivative(
    function: Callable[[gtsam.Values], FloatArray], values: gtsam.Values, key: int, dim: int, step: float
) -> FloatArray:
    """(rows, dim) derivative along a variable's tangent space."""
    columns = []
    for i in range(dim):
        table = [_central(function, values, key, np.eye(dim)[i], h) for h in (step, step / 2, step / 4)]
        finer = [(4.0 * table[j + 1] - table[j]) / 3.0 for j in range(2)]
        columns.append((16.0 * finer[1] - finer[0]) / 15.0)
    return np.stack(columns, axis=1)


def _central(
    function: Callable[[gtsam.Values], FloatArray], values: gtsam.Values, key: int, unit: FloatArray, h: float
) -> FloatArray:
    ends = []
    for sign in (1.0, -1.0):
        delta = gtsam.VectorValues()
        delta.insert(key, sign * h * unit)
        ends.append(np.asarray(function(values.retract(delta))))
    return np.asarray((ends[0] - ends[1]) / (2.0 * h))

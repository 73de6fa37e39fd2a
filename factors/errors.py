"""The exception of the package, and the shape checks that raise it."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .exceptions import SstGraphError

FloatArray = NDArray[np.float64]


class FactorError(SstGraphError, ValueError):
    """A value that a factor cannot use: what it is, what was found, what was expected."""

    def __init__(self, what: str, found: str, expected: str) -> None:
        self.what = what
        self.found = found
        self.expected = expected
        super().__init__(f"{what}: found {found}, expected {expected}")

    def __reduce__(self) -> tuple[type[FactorError], tuple[str, str, str]]:
        return FactorError, (self.what, self.found, self.expected)


def checked_array(what: str, value: ArrayLike, shape: tuple[int | None, ...]) -> FloatArray:
    """A read-only float64 copy of ``value`` with the given shape (None: any length), all finite."""
    array = np.array(value, dtype=np.float64)
    matches = array.ndim == len(shape) and all(
        n is None or n == m for n, m in zip(shape, array.shape, strict=True)
    )
    if not matches:
        wanted = "(" + ", ".join("n" if n is None else str(n) for n in shape) + ")"
        raise FactorError(what, f"shape {array.shape}", f"shape {wanted}")
    if not np.isfinite(array).all():
        raise FactorError(what, f"{np.count_nonzero(~np.isfinite(array))} values NaN or inf", "finite values")
    array.flags.writeable = False
    return array


def checked_covariance(what: str, value: ArrayLike, size: int) -> FloatArray:
    """A (size, size) symmetric positive-definite covariance."""
    covariance = checked_array(what, value, (size, size))
    scale = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    # beside the sigmas: rounding leaves 1e-25 where a zero stands, of either sign
    if (np.abs(covariance - covariance.T) > 1e-6 * np.outer(scale, scale)).any():
        raise FactorError(what, "an unsymmetric matrix", "a symmetric covariance")
    smallest = float(np.linalg.eigvalsh(covariance / np.outer(scale, scale))[0])
    if smallest <= 0.0:
        raise FactorError(
            what, f"smallest correlation eigenvalue {smallest:.3g}", "a positive-definite covariance"
        )
    return covariance


def checked_positive(what: str, value: float) -> float:
    """A finite number above zero."""
    if not (np.isfinite(value) and value > 0.0):
        raise FactorError(what, f"{value}", "a finite number above 0")
    return float(value)

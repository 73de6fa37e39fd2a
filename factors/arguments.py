"""Checks of arguments: shapes, finite numbers, covariances."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import FactorError

FloatArray = NDArray[np.float64]


def checked_array(what: str, value: ArrayLike, shape: tuple[int | None, ...]) -> FloatArray:
    """A read-only float64 copy of ``value`` with the given shape (None: any length), all finite."""
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise FactorError(what, described(value), f"numbers of shape {_wanted(shape)}") from None
    if array.ndim != len(shape) or any(n not in (None, m) for n, m in zip(shape, array.shape, strict=True)):
        raise FactorError(what, f"shape {array.shape}", f"shape {_wanted(shape)}")
    if not np.isfinite(array).all():
        raise FactorError(what, f"{np.count_nonzero(~np.isfinite(array))} values NaN or inf", "finite values")
    array.flags.writeable = False
    return array


def _wanted(shape: tuple[int | None, ...]) -> str:
    return "(" + ", ".join("n" if n is None else str(n) for n in shape) + ")"


def checked_covariance(what: str, value: ArrayLike, size: int) -> FloatArray:
    """A (size, size) symmetric positive-definite covariance."""
    covariance = checked_array(what, value, (size, size))
    scale = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    # relative to the sigmas: an entry that is zero but for rounding may be 1e-25, of either sign
    if (np.abs(covariance - covariance.T) > 1e-6 * np.outer(scale, scale)).any():
        raise FactorError(what, "an unsymmetric matrix", "a symmetric covariance")
    smallest = float(np.linalg.eigvalsh(covariance / np.outer(scale, scale))[0])
    if smallest <= 0.0:
        raise FactorError(
            what, f"smallest correlation eigenvalue {smallest:.3g}", "a positive-definite covariance"
        )
    return covariance


def checked_number(what: str, value: float) -> float:
    """A finite number."""
    return float(checked_array(what, [value], (1,))[0])


def checked_positive(what: str, value: float) -> float:
    """A finite number above zero."""
    number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
    if not (number and np.isfinite(value) and value > 0.0):
        raise FactorError(what, f"{value}" if number else described(value), "a finite number above 0")
    return float(value)


def described(value: Any) -> str:
    """A short word on a value of any type, for messages."""
    if isinstance(value, np.ndarray):
        return f"an array of shape {value.shape}"
    if value is None or isinstance(value, bool | int | float | np.number):
        return repr(value)
    name = type(value).__name__
    return f"a {name} of {len(value)}" if isinstance(value, list | tuple) else f"a {name}"

"""The root of all exceptions raised on purpose, that of the factors, and the shape checks that raise it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]


MAX_MESSAGE = 1200
"""Characters of a message; what is longer loses its middle."""


def printable(text: object, limit: int = MAX_MESSAGE) -> str:
    """``text`` as it may stand in a message: no control character, and at most ``limit`` characters.

    Line breaks, escape sequences, direction marks and lone surrogates appear as in a Python literal
    (``\\n``, ``\\x1b``), so that no file's content reaches a terminal as anything but text. What is too
    long loses its middle.
    """
    shown = _shortened(str(text), limit)
    if not shown.isprintable():
        escaped = (c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in shown)
        shown = "".join(escaped)
    return _shortened(shown, limit)


def _shortened(text: str, limit: int) -> str:
    if len(text) <= limit:
        return text
    gap = " ... "
    tail = (limit - len(gap)) // 3
    return text[: limit - len(gap) - tail] + gap + text[-tail:]


class SstGraphError(Exception):
    """Root of every error that sst_graph and factors raise on purpose.

    The message is one line without control characters; line breaks in it become spaces.
    """

    def __init__(self, message: object = "") -> None:
        text = _shortened(str(message), 4 * MAX_MESSAGE)
        super().__init__(printable(" ".join(text.split())))


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
    wanted = "(" + ", ".join("n" if n is None else str(n) for n in shape) + ")"
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise FactorError(what, described(value), f"numbers of shape {wanted}") from None
    matches = array.ndim == len(shape) and all(
        n is None or n == m for n, m in zip(shape, array.shape, strict=True)
    )
    if not matches:
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

"""Checks of arguments: types, shapes, finite numbers, poses, covariances."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterable
from typing import Any, TypeGuard

import gtsam
import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import FactorError, count_of

FloatArray = NDArray[np.float64]


def checked_type(what: str, value: Any, kind: type | tuple[type, ...], expected: str) -> None:
    """Nothing, where ``value`` is of the kind.

    Raises:
        FactorError: it is not; ``expected`` says in words what it should be.
    """
    if not isinstance(value, kind):
        raise FactorError(what, described(value), expected)


def checked_several(what: str, several: Any, kind: type, one: str, all_of_them: str) -> None:
    """Nothing, where ``several`` is a list or tuple, and each in it of the kind.

    Args:
        one, all_of_them: what each should be, and what the whole.

    Raises:
        FactorError: it is not.
    """
    checked_type(what, several, (tuple, list), all_of_them)
    for each in several:
        checked_type(f"one of {what}", each, kind, one)


def is_several(value: Any) -> bool:
    """Whether ``value`` can be walked over, as an array without dimensions cannot."""
    return isinstance(value, Iterable) and not (isinstance(value, np.ndarray) and value.ndim == 0)


def checked_callback(what: str, value: Any, parameters: tuple[str, ...]) -> None:
    """Nothing, where ``value`` is None, or can be called with these arguments.

    Raises:
        FactorError: it cannot.
    """
    if value is None:
        return
    expected = f"a function of ({', '.join(parameters)}), or None"
    if not callable(value):
        raise FactorError(what, described(value), expected)
    if (other := other_signature(value, parameters)) is not None:
        raise FactorError(what, f"one with the arguments {other}", expected)


def other_signature(
    function: Callable[..., Any], parameters: tuple[str, ...], keywords: tuple[str, ...] = ()
) -> str | None:
    """The signature of a function that cannot be called with these arguments, and these by their names."""
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):  # some that are written in C do not tell theirs
        return None
    try:
        signature.bind(*parameters, **dict.fromkeys(keywords))
    except TypeError:
        return str(signature)
    return None


def checked_gtsam(what: str, value: Any, kind: type) -> None:
    """Nothing, where ``value`` is of this class of gtsam, and its numbers are finite where it is a pose or a
    rotation, which gtsam makes of any matrix."""
    checked_type(what, value, kind, f"a gtsam.{kind.__name__}")
    if not isinstance(value, gtsam.Pose3 | gtsam.Rot3):
        return
    matrix = value.matrix()
    if not np.isfinite(matrix).all():
        raise FactorError(what, f"a {kind.__name__} that holds NaN or inf", "finite values")
    R = matrix[:3, :3]
    off = rotation_error(R)
    if off > ROTATION_TOLERANCE:
        found = f"|R R' - I| = {off:.2g}" if np.isfinite(off) else f"an entry of {np.abs(R).max():.3g}"
        raise FactorError(
            what, f"a {kind.__name__} with {found} in its rotation", "a rotation (gtsam.Rot3.ClosestTo)"
        )


def rotation_error(R: FloatArray) -> float:
    """Largest entry of |R R' - I| of a finite (3, 3) matrix; infinite where R has one above 2, which no
    rotation has and whose products may overflow."""
    return float(np.abs(R @ R.T - _EYE).max()) if np.abs(R).max() <= 2.0 else float("inf")


ROTATION_TOLERANCE = 1e-3
"""Largest :func:`rotation_error` that is put down to the digits of a file."""
_EYE = np.eye(3)


def checked_array(what: str, value: ArrayLike, shape: tuple[int | None, ...]) -> FloatArray:
    """A read-only float64 copy of ``value`` with the given shape (None: any length), all finite."""
    array = np.array(as_numbers(what, value, shape))
    if array.ndim != len(shape) or any(n not in (None, m) for n, m in zip(shape, array.shape, strict=True)):
        found = f"shape {array.shape}" if array.ndim else described(value)
        raise FactorError(what, found, f"shape {_wanted(shape)}")
    checked_finite(what, array)
    array.flags.writeable = False
    return array


def checked_number_or_array(what: str, value: ArrayLike, shape: tuple[int | None, ...]) -> float | FloatArray:
    """One finite number, or an array as of :func:`checked_array`."""
    array = as_numbers(what, value, shape, ", or one number")
    return checked_array(what, array, shape) if array.ndim else checked_number(what, float(array))


def checked_rows(what: str, value: ArrayLike, columns: int) -> FloatArray:
    """``value`` as a float64 array (n, columns), not copied where it is one; NaN may be in it."""
    array = as_numbers(what, value, (None, columns))
    if array.ndim != 2 or array.shape[1] != columns:
        found = f"shape {array.shape}" if array.ndim else described(value)
        raise FactorError(what, found, f"shape (n, {columns})")
    return array


def as_numbers(
    what: str, value: ArrayLike, shape: str | tuple[int | None, ...] = "", or_else: str = ""
) -> FloatArray:
    """``value`` as a float64 array of any shape, not copied where it is one; texts, True and False are
    no numbers.

    Args:
        shape, or_else: that is expected, for the message.
    """
    if type(value) is np.ndarray and value.dtype == np.float64:
        return value
    if (masked := masked_values(value)) > 0:
        raise FactorError(what, count_of(masked, "masked value"), "an array without a mask")
    wanted = shape if isinstance(shape, str) else _wanted(shape)
    expected = f"numbers of shape {wanted}{or_else}" if wanted else "numbers"
    try:
        array = np.asarray(value)
        if array.dtype.kind not in "iuf":
            raise TypeError
        return np.asarray(array, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        of_kind = f" of {value.dtype}" if isinstance(value, np.ndarray) else ""
        raise FactorError(what, described(value) + of_kind, expected) from None


def masked_values(value: object) -> int:
    """Number of values that the mask of a masked array hides; 0 of anything else."""
    return int(np.count_nonzero(np.ma.getmaskarray(value))) if isinstance(value, np.ma.MaskedArray) else 0


def checked_finite(what: str, array: FloatArray) -> None:
    """Nothing, where no value is NaN or inf."""
    if not np.isfinite(array).all():
        bad = count_of(int(np.count_nonzero(~np.isfinite(array))), "value")
        raise FactorError(what, f"{bad} NaN or inf", "finite values")


def _wanted(shape: tuple[int | None, ...]) -> str:
    return "(" + ", ".join("n" if n is None else str(n) for n in shape) + (",)" if len(shape) == 1 else ")")


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
    if not _is_finite(value):
        raise FactorError(what, described(value), "a finite number")
    return float(value)


def checked_positive(what: str, value: float) -> float:
    """A finite number above zero."""
    if not (_is_finite(value) and value > 0.0):
        raise FactorError(what, described(value), "a finite number above 0")
    return float(value)


def checked_count(what: str, value: int, expected: str = "a whole number above 0") -> int:
    """A whole number above zero."""
    if not is_whole(value) or not 1 <= value <= _MAX_COUNT:
        raise FactorError(what, described(value), expected)
    return int(value)


_NO_NUMBERS = (bool, np.timedelta64)
"""Kinds of whole numbers to Python and NumPy that are none to a reader."""
_MAX_COUNT = 2**31 - 1
"""gtsam counts rows and dimensions with ints of 32 bits."""


def is_whole(value: Any) -> TypeGuard[int]:
    """Whether ``value`` is of an integer type; True, False and durations of NumPy are not."""
    return isinstance(value, int | np.integer) and not isinstance(value, _NO_NUMBERS)


def _is_finite(value: Any) -> bool:
    if isinstance(value, np.ndarray) and value.ndim == 0:
        if masked_values(value):  # hides a number, and is NaN as a float
            return False
        value = value.item()
    if not isinstance(value, int | float | np.integer | np.floating) or isinstance(value, _NO_NUMBERS):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # an int past all floats
        return False


def described(value: Any) -> str:
    """A short word on a value of any type, for messages."""
    if masked_values(value) and np.ndim(value) == 0:
        return "a masked value"
    if isinstance(value, np.ndarray):
        return f"an array of shape {value.shape}"
    if isinstance(value, int) and abs(value) >= 10**_MAX_DIGITS:
        return f"an int of more than {_MAX_DIGITS} digits"
    if value is None or isinstance(value, bool | int | float | np.number | np.bool_):
        return str(value)
    if isinstance(value, str):
        return f"the text {value[:_MAX_TEXT]!r}"
    if isinstance(value, type):
        return f"the class {value.__name__}"
    name = type(value).__name__
    article = "an" if name[0] in "AEIOaeio" else "a"
    return f"{article} {name} of {len(value)}" if isinstance(value, list | tuple) else f"{article} {name}"


_MAX_DIGITS, _MAX_TEXT = 40, 40
"""Of what a message repeats."""

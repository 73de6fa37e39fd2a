"""The one way in which this package makes a ``gtsam.CustomFactor``.

gtsam 4.3 crashes the process when a callback leaves a Jacobian unset, gives one of the wrong row
count or a 1-D one, and takes NaN and a wrong column count in silence. Everything is checked here
and raised as :class:`FactorError`.

Pass a plain function or closure over frozen data. A bound method of an object that owns the factor
makes a cycle through C++ that is never freed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from .errors import FactorError

FloatArray = NDArray[np.float64]
Jacobians = Sequence[FloatArray] | None
ResidualFunction = Callable[..., tuple[FloatArray, Jacobians]]
"""``function(*values, jacobians: bool) -> (error (rows,), [H (rows, dim), ...] or None)``."""

_READERS: dict[int, tuple[str, ...]] = {
    1: ("atVector", "atDouble"),
    2: ("atVector", "atPoint2"),
    3: ("atVector", "atPoint3", "atRot3", "atPose2"),
    6: ("atPose3", "atVector"),
}


def custom_factor(
    noise: gtsam.noiseModel.Base,
    keys: Sequence[int],
    function: ResidualFunction,
    dims: Sequence[int],
    rows: int,
) -> gtsam.CustomFactor:
    """error = function(*values, jacobians=...), checked at every call.

    Args:
        noise: noise model of dimension ``rows``.
        keys: distinct keys of the variables.
        function: given the variables' values in the order of the keys (Pose3 or vector) and the
            keyword ``jacobians``; returns the unwhitened error (rows,) and, where ``jacobians`` is
            true, one Jacobian (rows, dim) for each variable (tangent space as gtsam has it).
        dims: tangent dimension of each variable.
        rows: length of the error.

    Raises:
        FactorError: here for arguments that disagree; inside an optimisation for a wrong shape, a
            missing Jacobian, NaN or inf (ISAM2 cannot go on after that: linearize first).
    """
    keys, dims = [int(key) for key in keys], [int(dim) for dim in dims]
    if not keys or len(set(keys)) != len(keys):
        raise FactorError("keys of a factor", _names(keys), "one or more distinct keys")
    if len(dims) != len(keys):
        raise FactorError("dims of a factor", f"{len(dims)} dims", f"{len(keys)}, one for each key")
    if noise.dim() != rows:
        raise FactorError("noise of a factor", f"dimension {noise.dim()}", f"dimension {rows} (rows)")

    def callback(this: gtsam.CustomFactor, values: gtsam.Values, H: list[FloatArray] | None) -> FloatArray:
        arguments = [_read(values, key, dim) for key, dim in zip(keys, dims, strict=True)]
        error, jacobians = function(*arguments, jacobians=H is not None)
        error = _checked("error of the factor on", keys, error, (rows,))
        if H is not None:
            if jacobians is None or len(jacobians) != len(keys):
                found = "None" if jacobians is None else f"{len(jacobians)}"
                raise FactorError("Jacobians of a factor", found, f"{len(keys)}, one for each key")
            for i, (key, dim) in enumerate(zip(keys, dims, strict=True)):
                H[i] = _checked("Jacobian by", [key], jacobians[i], (rows, dim), fortran=True)
        return error

    return gtsam.CustomFactor(noise, keys, callback)


def _checked(
    what: str, keys: Sequence[int], value: Any, shape: tuple[int, ...], fortran: bool = False
) -> FloatArray:
    array = np.asarray(value, dtype=np.float64, order="F" if fortran else None)
    if array.shape != shape:
        raise FactorError(f"{what} {_names(keys)}", f"shape {array.shape}", f"shape {shape}")
    if not np.isfinite(array).all():
        what = f"{what} {_names(keys)}"
        raise FactorError(what, f"{np.count_nonzero(~np.isfinite(array))} values NaN or inf", "finite values")
    return array


def _read(values: gtsam.Values, key: int, dim: int) -> Any:
    """The value of a variable, of whichever type with that tangent dimension it has."""
    if not values.exists(key):
        raise FactorError("values", f"no variable {_names([key])}", "every key of the factor")
    for reader in _READERS.get(dim, ("atVector",)):
        try:
            value = getattr(values, reader)(key)
        except RuntimeError:  # stored as another type
            continue
        if isinstance(value, np.ndarray) and value.shape != (dim,):
            raise FactorError(f"variable {_names([key])}", f"shape {value.shape}", f"shape ({dim},)")
        return value
    raise FactorError(f"variable {_names([key])}", "another type", f"a type of tangent dimension {dim}")


def _names(keys: Sequence[int]) -> str:
    return "[" + ", ".join(gtsam.DefaultKeyFormatter(key) for key in keys) + "]"

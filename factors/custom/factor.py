"""The one way in which this package makes a ``gtsam.CustomFactor``.

gtsam 4.3 crashes the process when a callback leaves a Jacobian unset, gives one of the wrong row
count or a 1-D one, and takes NaN and a wrong column count in silence. Everything is checked here
and raised as :class:`FactorError`.

Pass a plain function or closure over frozen data. A bound method of an object that owns the factor
makes a cycle through C++ that is never freed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from ..arguments import FloatArray, as_numbers, checked_count, checked_type, described, other_signature
from ..errors import FactorError, count_of
from .stored_noise import restored_noise, stored_noise
from .variables import Kind, Reader, checked_key, checked_keys, dimension, key_name

Jacobians = Sequence[FloatArray] | None
ResidualFunction = Callable[..., tuple[FloatArray, Jacobians]]
"""``function(*values, jacobians: bool) -> (error (rows,), [H (rows, dim), ...] or None)``."""


@dataclass(frozen=True, eq=False)
class FactorRecipe:
    """All that a factor of this package is made of; :func:`custom_factor` has the attributes' meanings.

    ``copy.deepcopy`` and ``pickle`` take it where they take noise and function.

    Attributes:
        keys: with the name of the argument that each came as ('' where it has none).

    Raises:
        FactorError: attributes that disagree or are of another kind.
    """

    noise: gtsam.noiseModel.Base
    keys: dict[int, str]
    function: ResidualFunction
    dims: tuple[Kind, ...]
    rows: int
    name: str

    def __post_init__(self) -> None:
        name = self.name
        checked_type("name of a factor", name, str, "a str")
        checked_type(f"keys of {name}", self.keys, dict, "a dict of keys, with a name for each")
        for key in self.keys:
            checked_key(name, "keys", key)
        checked_type(f"dims of {name}", self.dims, tuple, "one dimension or kind for each key")
        if len(self.dims) != len(self.keys):
            expected = f"{len(self.keys)}, one for each key"
            raise FactorError(f"dims of {name}", count_of(len(self.dims), "dim"), expected)
        for kind in self.dims:
            dimension(kind)
        checked_count(f"rows of {name}", self.rows)
        checked_type(f"noise of {name}", self.noise, gtsam.noiseModel.Base, "a gtsam.noiseModel")
        if self.noise.dim() != self.rows:
            found = f"dimension {self.noise.dim()}"
            raise FactorError(f"noise of {name}", found, f"dimension {self.rows} (rows)")
        if not callable(self.function):
            raise FactorError(f"function of {name}", described(self.function), "a function")

    def __reduce__(self) -> tuple[Any, ...]:
        """For copies and pickles."""
        return _recipe, (
            stored_noise(self.noise),
            *(self.keys, self.function, self.dims, self.rows, self.name),
        )

    def build(self) -> gtsam.CustomFactor:
        """A new factor."""
        readers = [
            Reader(key, kind, self.name, argument)
            for (key, argument), kind in zip(self.keys.items(), self.dims, strict=True)
        ]
        shapes = [(self.rows, dimension(kind)) for kind in self.dims]
        keys, rows, function, name = list(self.keys), self.rows, self.function, self.name

        def callback(
            this: gtsam.CustomFactor, values: gtsam.Values, H: list[FloatArray] | None
        ) -> FloatArray:
            request = _REQUEST.get()
            if request is not None:
                request.append(self)
                return np.zeros(rows)
            arguments = [reader.read(values) for reader in readers]
            error, jacobians = _returned(name, function(*arguments, jacobians=H is not None))
            error = _checked(f"error of {name} on", keys, error, (rows,))
            if H is not None:
                if not isinstance(jacobians, list | tuple | np.ndarray) or len(jacobians) != len(keys):
                    raise FactorError(
                        f"Jacobians of {name}", described(jacobians), f"{len(keys)}, one for each key"
                    )
                for i, (key, shape) in enumerate(zip(keys, shapes, strict=True)):
                    H[i] = _checked(f"Jacobian of {name} by", [key], jacobians[i], shape, fortran=True)
            return error

        return gtsam.CustomFactor(self.noise, keys, callback)


def _recipe(noise: Any, *others: Any) -> FactorRecipe:
    """A recipe that was stored."""
    return FactorRecipe(restored_noise(noise), *others)


_REQUEST: ContextVar[list[FactorRecipe] | None] = ContextVar("recipe", default=None)
"""Where a factor's callback leaves its recipe instead of doing its work; see :func:`recipe_of`."""


def recipe_of(factor: gtsam.NonlinearFactor) -> FactorRecipe | None:
    """What a factor was made of; None for one that :func:`custom_factor` did not make.

    gtsam has no accessor for the callback of a ``CustomFactor``, so the callback is called and hands out its
    recipe. That of a ``CustomFactor`` made elsewhere is called on empty values, and may raise or not.

    Raises:
        FactorError: no factor.
    """
    checked_type("factor of recipe_of", factor, gtsam.NonlinearFactor, "a factor of a gtsam graph")
    if not isinstance(factor, gtsam.CustomFactor):
        return None
    found: list[FactorRecipe] = []
    token = _REQUEST.set(found)
    try:
        factor.unwhitenedError(gtsam.Values())
    except Exception:  # a callback made elsewhere
        return None
    finally:
        _REQUEST.reset(token)
    return found[0] if found else None


def custom_factor(
    noise: gtsam.noiseModel.Base,
    keys: Sequence[int] | Mapping[str, int],
    function: ResidualFunction,
    dims: Sequence[Kind],
    rows: int,
    name: str = "a factor",
) -> gtsam.CustomFactor:
    """``error = function(*values, jacobians=...)``, checked at every call.

    Args:
        noise: noise model of dimension ``rows``.
        keys: distinct keys of the variables (int or ``gtsam.Symbol``); as a mapping with a name for each,
            which errors then tell.
        function: given the variables' values in the order of the keys and the keyword ``jacobians``;
            returns the unwhitened error (rows,) and, where ``jacobians`` is true, one Jacobian (rows, dim)
            for each variable (tangent space as gtsam has it). A value is what ``gtsam.Values`` holds: an
            object of gtsam (Pose3, NavState, ConstantBias, Unit3, Cal3_S2, ...) or an array; a ``double``
            comes as a ``Vector(1)`` does, (1,).
        dims: of each variable its tangent dimension, or a class of gtsam or
            :class:`sst_graph.factors.Vector` where nothing else will do.
        rows: length of the error.
        name: of the factor, for errors.

    Raises:
        FactorError: here for arguments that disagree; inside an optimisation for a variable of another
            kind, a wrong shape, a missing Jacobian, NaN or inf (ISAM2 cannot go on after that: linearize
            first).
    """
    factor = own_factor(noise, keys, function, dims, rows, name)
    values = tuple(f"value_{i}" for i in range(len(keys)))
    if (other := other_signature(function, values, ("jacobians",))) is not None:
        expected = f"({', '.join(values)}, *, jacobians)"
        raise FactorError(f"function of {name}", f"one with the arguments {other}", expected)
    return factor


def own_factor(
    noise: gtsam.noiseModel.Base,
    keys: Sequence[int] | Mapping[str, int],
    function: ResidualFunction,
    dims: Sequence[Kind],
    rows: int,
    name: str,
) -> gtsam.CustomFactor:
    """:func:`custom_factor` of a function of this package: its arguments need no look, which takes as long as
    all other checks."""
    checked_type("name of a factor", name, str, "a str")
    named = checked_keys(name, keys)
    kinds = tuple(dims) if isinstance(dims, list) else dims
    return FactorRecipe(noise, named, function, kinds, rows, name).build()  # type: ignore[arg-type]  # checked


def _returned(name: str, pair: Any) -> tuple[Any, Any]:
    """Error and Jacobians that a function has returned."""
    if not isinstance(pair, tuple | list) or len(pair) != 2:
        raise FactorError(
            f"what the function of {name} returns", described(pair), "(error, Jacobians or None)"
        )
    return pair[0], pair[1]


def _checked(
    what: str, keys: Sequence[int], value: Any, shape: tuple[int, ...], fortran: bool = False
) -> FloatArray:
    try:
        array = np.asarray(as_numbers(what, value), order="F" if fortran else None)
    except FactorError as error:
        raise FactorError(f"{what} {_names(keys)}", error.found, f"numbers of shape {shape}") from None
    if array.shape != shape:
        raise FactorError(f"{what} {_names(keys)}", f"shape {array.shape}", f"shape {shape}")
    if not np.isfinite(array).all():
        what = f"{what} {_names(keys)}"
        bad = count_of(int(np.count_nonzero(~np.isfinite(array))), "value")
        raise FactorError(what, f"{bad} NaN or inf", "finite values")
    return array


def _names(keys: Sequence[int]) -> str:
    return "[" + ", ".join(key_name(key) for key in keys) + "]"

"""Keys and variables of a factor: what a caller may give for one, and how its value is read.

A *kind* says what a factor wants of a variable: a tangent dimension that any type may have, a class of
gtsam (``gtsam.Pose3``), or :class:`Vector`. A scalar, ``Vector(1)``, may be kept as a ``double`` as well:
either arrives as a (1,) array.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property
from itertools import accumulate, pairwise
from typing import Any

import gtsam
import numpy as np

from ..arguments import (
    FloatArray,
    as_numbers,
    checked_count,
    checked_gtsam,
    checked_type,
    described,
    is_several,
    is_whole,
)
from ..errors import FactorError

_KEYS = 2**64
"""gtsam's keys are unsigned numbers of 64 bits."""
_FIRST_SYMBOL = 2**56
"""Keys of ``gtsam.symbol`` carry their letter above these bits."""


@dataclass(frozen=True)
class Vector:
    """Kind of a variable that is a vector of ``size`` numbers; of size 1 also a ``double``.

    Raises:
        FactorError: a size that is no whole number above 0.
    """

    size: int

    def __post_init__(self) -> None:
        checked_count("size of Vector", self.size)


Kind = int | type | Vector
"""What a factor wants of a variable: any type of this tangent dimension, this class of gtsam, or a vector."""


def checked_key(factor: str, argument: str, value: Any) -> int:
    """The key that ``value`` is: an int, ``gtsam.Symbol`` or ``gtsam.LabeledSymbol``.

    Raises:
        FactorError: anything else, and ints that gtsam has no key for.
    """
    if isinstance(value, gtsam.Symbol | gtsam.LabeledSymbol):
        return int(value.key())
    if not is_whole(value):
        raise FactorError(f"{argument} of {factor}", described(value), _A_KEY)
    if not 0 <= int(value) < _KEYS:
        raise FactorError(f"{argument} of {factor}", described(value), f"{_A_KEY} from 0 to 2^64 - 1")
    return int(value)


_A_KEY = "a key: an int, as gtsam.symbol gives it, or a gtsam.Symbol"


def is_key(value: Any) -> bool:
    """Whether ``value`` is meant as a variable's key, not as a constant."""
    return isinstance(value, int | np.integer | gtsam.Symbol | gtsam.LabeledSymbol | bool | np.bool_)


def pose_or_key(factor: str, argument: str, value: Any) -> int | gtsam.Pose3:
    """A fixed pose, or the key of one."""
    if isinstance(value, gtsam.Pose3):
        checked_gtsam(f"{argument} of {factor}", value, gtsam.Pose3)
        return value
    if is_key(value):
        return checked_key(factor, argument, value)
    raise FactorError(f"{argument} of {factor}", described(value), f"a gtsam.Pose3, or {_A_KEY}")


def body_in_lidar(factor: str, bTl: Any) -> gtsam.Pose3:
    """lTb from the pose of the LiDAR in the body; None where both are one."""
    if bTl is None:
        return gtsam.Pose3()
    if isinstance(bTl, gtsam.Pose3):
        checked_gtsam(f"bTl of {factor}", bTl, gtsam.Pose3)
        return bTl.inverse()
    raise FactorError(f"bTl of {factor}", described(bTl), "a gtsam.Pose3, or None")


def number_or_key(factor: str, argument: str, value: Any) -> int | float:
    """A fixed number, float or (1,), or the key of one.

    Raises:
        FactorError: neither; or the int 0, which is a key by its type and a constant by its look.
    """
    if is_key(value):
        key = checked_key(factor, argument, value)
        if key == 0:
            raise FactorError(
                f"{argument} of {factor}", "the int 0", "0.0 for the constant, or a key other than 0"
            )
        return key
    try:
        array = as_numbers(argument, value)
    except FactorError:
        array = np.zeros(0)
    if array.shape not in ((), (1,)) or not np.isfinite(array).all():
        raise FactorError(f"{argument} of {factor}", described(value), f"a finite float, or {_A_KEY}")
    return float(array.item())


def checked_values(
    what: str, values: Any, factors: Iterable[gtsam.NonlinearFactor], further: Iterable[int] = ()
) -> None:
    """Nothing, where ``values`` has one of its kind for each key of the factors, and the further keys.

    Raises:
        FactorError: a value is missing, or of another kind; or as the callback of a factor raises.
    """
    checked_type(what, values, gtsam.Values, "a gtsam.Values")
    factors = list(factors)
    for key in sorted({*further, *(int(key) for factor in factors for key in list(factor.keys()))}):
        if not values.exists(key):
            raise FactorError(what, f"no {key_name(key)}", "a value for each key of the graph")
    expect_kinds(what, values, factors)


def expect_kinds(what: str, values: gtsam.Values, factors: Iterable[gtsam.NonlinearFactor]) -> None:
    """Nothing, where every factor can be evaluated: its values are of the kinds that it wants.

    Raises:
        FactorError: one is not; or as the callback of a factor raises.
    """
    for factor in factors:
        try:
            factor.error(values)
        except RuntimeError as error:
            message = str(error)
            stored, wanted = _stored_type(message), _type_after("requested type was ", message)
            if not stored:  # another error than that of a kind
                raise
            stored, wanted = (name.replace("Double", "double") for name in (stored, wanted))
            raise FactorError(
                what, f"{stored} for {_key_in(message)}", f"{wanted}, as a factor wants it"
            ) from None
        except ValueError as error:
            if "NoiseModel has dimension" not in str(error):
                raise
            keys = ", ".join(key_name(int(key)) for key in list(factor.keys()))
            found = f"a size for {keys} that is not that of the noise of {type(factor).__name__}"
            raise FactorError(what, found, "the size that the factor has") from None


def factors_of(graph: gtsam.NonlinearFactorGraph) -> list[gtsam.NonlinearFactor]:
    """The factors of a graph, without its empty places."""
    return [graph.at(i) for i in range(graph.size()) if graph.exists(i)]


def checked_problem(where: str, graph: Any, values: Any, further: Iterable[int] = ()) -> None:
    """Nothing, where they are a graph and values of all its keys, and of the further keys."""
    checked_type(f"graph of {where}", graph, gtsam.NonlinearFactorGraph, "a NonlinearFactorGraph")
    checked_values(f"values of {where}", values, factors_of(graph), further)


def checked_keys(factor: str, keys: Sequence[Any] | Mapping[str, Any]) -> dict[int, str]:
    """Distinct keys of a factor, with the name of the argument that each came as ('' where it has none)."""
    if isinstance(keys, Mapping):
        named = list(keys.items())
    elif is_several(keys) and not isinstance(keys, str):
        named = [("", key) for key in keys]
    else:
        raise FactorError(
            f"keys of {factor}", described(keys), "a list of keys, or a dict with a name for each"
        )
    found: dict[int, str] = {}
    for name, value in named:
        key = checked_key(factor, name or "keys", value)
        if key in found:
            both = f" for {found[key]} and {name}" if name else ""
            raise FactorError(f"keys of {factor}", f"{key_name(key)} twice{both}", "distinct keys")
        found[key] = name
    if not found:
        raise FactorError(f"keys of {factor}", "no key", "one or more distinct keys")
    return found


def key_name(key: int) -> str:
    """As gtsam prints it: E0 for ``gtsam.symbol("E", 0)``."""
    return str(gtsam.DefaultKeyFormatter(key))


def dimension(kind: Kind) -> int:
    """Tangent dimension of a kind.

    Raises:
        FactorError: no such kind: a class without a default constructor or that ``gtsam.Values`` cannot hold.
    """
    if isinstance(kind, Vector):
        return kind.size
    if isinstance(kind, type):
        if kind in (bool, int, float):
            raise FactorError("kind of a variable", kind.__name__, "1, the dimension of a double")
        return _class_dimension(kind)
    return checked_count("kind of a variable", kind, "a dimension above 0, a class, or Vector(n)")


@cache
def _class_dimension(kind: type) -> int:
    try:
        size = _tangent_dimension(kind())
    except Exception:  # of any class that a caller may give
        size = 0
    if size == 0:
        raise FactorError("kind of a variable", kind.__name__, "a class that gtsam.Values holds")
    return size


def _tangent_dimension(value: Any) -> int:
    values = gtsam.Values()
    values.insert(0, value)
    return int(values.dim())


@dataclass(frozen=True)
class Argument:
    """One argument of a factor that brings a variable, or a constant in its place.

    Attributes:
        name: of the argument, for messages.
        value: a key, checked; anything but an int is a constant.
        kind: what the factor wants of the variable.
        shared_with: start of the names of earlier arguments whose key this one may repeat.
    """

    name: str
    value: Any
    kind: Kind
    shared_with: str | None = None


@dataclass(frozen=True)
class Variables:
    """The distinct variables of a factor, in the order of its arguments.

    Attributes:
        keys, names, kinds: of each variable; the name is that of the first argument that brought it.
    """

    keys: tuple[int, ...]
    names: tuple[str, ...]
    kinds: tuple[Kind, ...]

    @staticmethod
    def of(factor: str, arguments: Iterable[Argument]) -> Variables:
        """Collect the variables among a factor's arguments.

        Raises:
            FactorError: one key for two arguments that are no shared variable.
        """
        found: dict[int, Argument] = {}
        for new in arguments:
            if not isinstance(new.value, int):
                continue
            first = found.setdefault(new.value, new)
            may_share = new.shared_with is not None and first.name.startswith(new.shared_with)
            if first is not new and not may_share:
                both = f"{key_name(new.value)} for {first.name} and {new.name}"
                raise FactorError(f"keys of {factor}", both, "distinct keys")
        each = found.values()
        return Variables(tuple(found), tuple(a.name for a in each), tuple(a.kind for a in each))

    @property
    def named(self) -> dict[str, int]:
        """Keys by the argument that each came as."""
        return dict(zip(self.names, self.keys, strict=True))

    @cached_property
    def columns(self) -> dict[int, slice]:
        """Columns of each variable in the factor's Jacobian, by key."""
        bounds = pairwise(accumulate((dimension(kind) for kind in self.kinds), initial=0))
        return {key: slice(*bound) for key, bound in zip(self.keys, bounds, strict=True)}

    @cached_property
    def cols(self) -> int:
        """Columns of the factor's Jacobian."""
        return sum(dimension(kind) for kind in self.kinds)

    def blocks(self, J: FloatArray) -> list[FloatArray]:
        """The Jacobian (rows, cols) by variable."""
        return [J[:, columns] for columns in self.columns.values()]


@dataclass
class Reader:
    """Reads one variable of a factor from ``gtsam.Values``.

    The accessor that fitted last is tried first, so that a read costs no more than a call; gtsam names the
    stored type where it does not fit.

    Attributes:
        key: of the variable.
        kind: what the factor wants.
        factor, argument: names for messages.
    """

    key: int
    kind: Kind
    factor: str
    argument: str
    _accessor: str = field(init=False)
    _checked: str = field(init=False, default="")
    _size: int = field(init=False)

    def __post_init__(self) -> None:
        self._size = dimension(self.kind)
        if isinstance(self.kind, type):
            self._accessor = f"at{self.kind.__name__}"
        else:
            self._accessor = "atPose3" if self.kind == 6 else "atVector"

    def read(self, values: gtsam.Values) -> Any:
        """The variable's value: an object of gtsam, or an array (n,); a ``double`` as (1,).

        Raises:
            FactorError: no such variable, or one of another kind.
        """
        try:
            value = getattr(values, self._accessor)(self.key)
        except RuntimeError as error:
            value = self._read_as_stored(values, str(error))
        if isinstance(value, float):
            return np.array([value])
        if isinstance(value, np.ndarray):
            if value.shape != (self._size,):
                raise self._error(f"Vector({len(value)})" if value.ndim == 1 else f"shape {value.shape}")
        elif self._accessor != self._checked:
            if _tangent_dimension(value) != self._size:
                raise self._error(f"{type(value).__name__}, dimension {_tangent_dimension(value)}")
            self._checked = self._accessor
        return value

    def _read_as_stored(self, values: gtsam.Values, message: str) -> Any:
        if not values.exists(self.key):
            expected = self._expected()
            if self.kind == Vector(1) and self.key < _FIRST_SYMBOL:
                expected += f" (an int is a key: {self.key}.0 is the constant)"
            raise FactorError(self._place(), "no such variable in the values", expected)
        stored = _stored_type(message)
        fits = isinstance(self.kind, int | np.integer) or (
            isinstance(self.kind, Vector) and (stored == "Vector" or (stored == "Double" and self._size == 1))
        )
        accessor: Callable[[int], Any] | None = getattr(values, f"at{stored}", None)
        if not fits or accessor is None or stored == "Matrix":
            raise self._error(stored)
        self._accessor = f"at{stored}"
        return accessor(self.key)

    def _error(self, found: str) -> FactorError:
        return FactorError(self._place(), found, self._expected())

    def _place(self) -> str:
        name = f"variable {key_name(self.key)}"
        return f"{name} ({self.argument}) of {self.factor}" if self.argument else f"{name} of {self.factor}"

    def _expected(self) -> str:
        if isinstance(self.kind, Vector):
            return f"Vector({self._size})" + (" or double" if self._size == 1 else "")
        if isinstance(self.kind, type):
            return self.kind.__name__
        return f"a type of tangent dimension {self._size}"


def _stored_type(message: str) -> str:
    """The name in ``at<name>`` of the type that gtsam's message says is stored; '' where it says none."""
    return _type_after("stored in Values is ", message)


def _key_in(message: str) -> str:
    """The key that gtsam's message names."""
    found = re.search(r'with key "(.*?)"', message)
    return found.group(1) if found else "a variable"


def _type_after(words: str, message: str) -> str:
    """The type that gtsam's message names after some words, by its name in Python."""
    found = re.search(words + r"(.*?)(?: but requested type|$)", message, re.MULTILINE)
    name = found.group(1) if found else ""
    generic = re.fullmatch(r"gtsam::GenericValue<(.*?) ?>", name)
    name = generic.group(1) if generic else name
    if name == "double":
        return "Double"
    if name.startswith("Eigen::Matrix"):
        return "Matrix" if "-1, -1" in name else "Vector"
    return re.sub(r"\w+::|[<> ]", "", name)

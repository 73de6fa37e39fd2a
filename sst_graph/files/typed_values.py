"""Whether a value that was read has the type that a field declares."""

from __future__ import annotations

import collections
import collections.abc
import dataclasses
import types
from functools import cache
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np

_KINDS = {np.floating: "f", np.integer: "iu", np.bool_: "b", np.complexfloating: "c"}
_PAIRS = (dict, collections.abc.Mapping, collections.abc.MutableMapping, collections.OrderedDict)
_SEVERAL = (
    list,
    set,
    frozenset,
    collections.deque,
    collections.abc.Sequence,
    collections.abc.Set,
    collections.abc.Collection,
    collections.abc.Iterable,
)


def wrong_fields(value: Any) -> list[str]:
    """Names of a dataclass's fields whose value is of another type than declared."""
    cls: Any = type(value)
    hints = field_types(cls)
    return [name for name, hint in hints.items() if not matches(getattr(value, name), hint)]


@cache
def field_types(cls: Any) -> dict[str, Any]:
    """Declared types of a dataclass's fields; empty where a name in them cannot be resolved."""
    try:
        hints = get_type_hints(cls)
    except NameError:
        return {}
    return {field.name: hints[field.name] for field in dataclasses.fields(cls)}


def matches(value: Any, hint: Any) -> bool:
    """Whether a value is of a declared type, in its items too; arrays by kind (float, integer, bool).

    A type that says nothing that can be checked, such as a protocol or a type variable, matches everything.
    """
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        return any(matches(value, choice) for choice in arguments)
    if origin is Literal:
        return any(type(value) is type(choice) and value == choice for choice in arguments)
    if origin is np.ndarray:
        return isinstance(value, np.ndarray) and _matches_dtype(value.dtype, arguments)
    if origin is tuple:
        return _matches_tuple(value, arguments)
    if origin in _PAIRS:
        key, item = arguments
        return isinstance(value, dict) and all(
            matches(k, key) and matches(one, item) for k, one in value.items()
        )
    if origin in _SEVERAL:
        # A text is a sequence, but none that a field of many means.
        several = isinstance(value, origin) and not isinstance(value, str)
        return several and all(matches(item, arguments[0]) for item in value)
    return _matches_plain(value, hint)


def _matches_plain(value: Any, hint: Any) -> bool:
    if hint is None or hint is type(None):
        return value is None
    if hint is float:
        is_number = isinstance(value, (int, float, np.floating, np.integer))
        return is_number and not isinstance(value, bool | np.timedelta64)
    if hint is int:
        return isinstance(value, (int, np.integer)) and not isinstance(value, bool | np.timedelta64)
    if hint is bool:
        return isinstance(value, (bool, np.bool_))
    if not isinstance(hint, type) or getattr(hint, "_is_protocol", False):
        return True
    return isinstance(value, hint)


def _matches_tuple(value: Any, arguments: tuple[Any, ...]) -> bool:
    if not isinstance(value, tuple):
        return False
    if len(arguments) == 2 and arguments[1] is Ellipsis:
        return all(matches(item, arguments[0]) for item in value)
    return len(value) == len(arguments) and all(map(matches, value, arguments))


def _matches_dtype(dtype: np.dtype[Any], arguments: tuple[Any, ...]) -> bool:
    (wanted,) = get_args(arguments[1]) or (Any,)
    if not isinstance(wanted, type):
        return True
    kinds = [kinds for base, kinds in _KINDS.items() if issubclass(wanted, base)]
    return not kinds or dtype.kind in kinds[0]

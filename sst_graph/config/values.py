"""A value against its declared type and range: converted, or refused in one line."""

from __future__ import annotations

import dataclasses
import enum
import itertools
import math
import numbers
import reprlib
import types
import unicodedata
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin

from sst_graph.config.ranges import Range
from sst_graph.errors import ConfigError, count_of, printable

MOST_OF_A_NAME = 120
"""Characters of a name from outside that are shown."""


def checked(hint: Any, value: Any, place: str, limits: Range) -> Any:
    """``value`` in the type ``hint`` and within ``limits``, or a ConfigError that names both."""
    if hint in (int, float):
        return _checked_number(hint, value, place, limits)
    if hint is str:
        return _checked_text(value, place, limits)
    if isinstance(hint, type) and not get_args(hint):
        return _checked_scalar(hint, value, place)
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        return _checked_union(arguments, value, place, limits)
    if origin is Literal:
        if isinstance(value, str) and value in arguments:
            return value
        raise mismatch(place, value, "one of " + ", ".join(map(str, arguments)))
    if origin in (tuple, list, frozenset):
        return _checked_sequence(hint, value, place, limits)
    return value


def _checked_union(arguments: tuple[Any, ...], value: Any, place: str, limits: Range) -> Any:
    if value is None and type(None) in arguments:
        return None
    choices = [argument for argument in arguments if argument is not type(None)]
    for choice in choices[:-1]:
        try:
            return checked(choice, value, place, limits)
        except ConfigError:
            continue
    return checked(choices[-1], value, place, limits)


def _checked_sequence(hint: Any, value: Any, place: str, limits: Range) -> Any:
    origin, arguments = get_origin(hint), get_args(hint)
    if not isinstance(value, (list, tuple, frozenset)):
        raise mismatch(place, value, "a list")
    if origin is tuple and not (len(arguments) == 2 and arguments[1] is Ellipsis):
        fewest = most = len(arguments)
        hints: Sequence[Any] = arguments
    else:
        fewest, most = limits.length or (0, len(value))
        hints = [arguments[0]] * len(value)
    if not fewest <= len(value) <= most:
        number = count_of(fewest, "value") if fewest == most else f"{fewest} to {count_of(most, 'value')}"
        raise mismatch(place, value, f"a list of {number}")
    items = [
        checked(hint, item, f"{place}[{i}]", limits)
        for i, (hint, item) in enumerate(zip(hints, value, strict=True))
    ]
    sign = -1 if limits.order == "decreasing" else 1
    if limits.order and any(sign * (b - a) <= 0 for a, b in itertools.pairwise(items)):
        raise mismatch(place, value, f"{limits.order} values")
    return origin(items)


def _checked_number(hint: type, value: Any, place: str, limits: Range) -> int | float:
    if hint is float and isinstance(value, float) and limits.holds(value) and math.isfinite(value):
        return float(value)
    kind = numbers.Integral if hint is int else numbers.Real
    words = "a whole number" if hint is int else "a number"
    if isinstance(value, bool) or not isinstance(value, kind):
        raise mismatch(place, value, f"{words}, {limits.text()}".removesuffix(", "))
    if not isinstance(value, numbers.Integral) and not math.isfinite(value):
        raise mismatch(place, value, f"a finite number, {limits.text()}".removesuffix(", "))
    if not limits.holds(value):
        raise mismatch(place, value, limits.text())
    try:
        return hint(value)  # type: ignore[no-any-return]
    except OverflowError:
        raise mismatch(place, value, "a number below 1e308") from None


def _checked_text(value: Any, place: str, limits: Range) -> str:
    if limits.choices is not None:
        if isinstance(value, str) and value in limits.choices:
            return value
        raise mismatch(place, value, "one of " + ", ".join(limits.choices))
    if not isinstance(value, str):
        raise mismatch(place, value, "text")
    if any(unicodedata.category(character) in ("Cc", "Cs") for character in value):
        raise mismatch(place, value, "text without control characters, in UTF-8")
    return value


def _checked_scalar(hint: Any, value: Any, place: str) -> Any:
    if isinstance(value, hint):
        return value
    if dataclasses.is_dataclass(hint):
        raise mismatch(place, value, f"a table of {', '.join(f.name for f in dataclasses.fields(hint))}")
    if issubclass(hint, enum.Enum):
        names = {member.name.lower(): member for member in hint}
        if isinstance(value, str) and value.lower() in names:
            return names[value.lower()]
        raise mismatch(place, value, "one of " + ", ".join(names))
    if hint is Path and isinstance(value, str):
        return Path(_checked_text(value, place, Range()))
    raise mismatch(place, value, {bool: "true or false", Path: "a path"}.get(hint, hint.__name__))


class _Short(reprlib.Repr):
    """Values in messages: a few elements, a few characters, whatever they hold."""

    def __init__(self) -> None:
        super().__init__()
        self.maxstring = self.maxother = 60
        self.maxlevel, self.maxtuple, self.maxlist = 2, 6, 6

    def repr_int(self, x: int, level: int) -> str:
        """Digits of a small integer; the size of one that would fill the line."""
        return repr(x) if x.bit_length() <= 128 else f"an integer of {x.bit_length()} bits"


def shown(value: Any) -> str:
    """``value`` on part of a line."""
    return " ".join(_Short().repr(value).split())


def mismatch(place: str, value: Any, expected: str) -> ConfigError:
    return ConfigError(f"{printable(place, MOST_OF_A_NAME)}: found {shown(value)}, expected {expected}")

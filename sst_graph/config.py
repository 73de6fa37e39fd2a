"""Frozen dataclasses as strict configuration: from and to dictionaries, files and ``a.b=value`` overrides.

Unknown keys are refused with the nearest known one, types are checked, nesting is followed. Ranges are
the dataclass's own affair: a ``ValueError`` of its ``__post_init__`` becomes a :class:`ConfigError`.
"""

from __future__ import annotations

import dataclasses
import difflib
import enum
import math
import types
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from sst_graph.errors import ConfigError, DataError
from sst_graph.input_files import SETTINGS, parse_json, read_json, read_toml

T = TypeVar("T")


def to_dict(config: Any) -> dict[str, Any]:
    """The dataclass as a JSON-able dictionary: enums by lower-case name, tuples as lists, paths as text."""
    return {field.name: _plain(getattr(config, field.name)) for field in dataclasses.fields(config)}


def from_dict(cls: type[T], data: Mapping[str, Any], where: str = "") -> T:
    """A ``cls`` with the values of ``data``; what is not named keeps its default.

    Args:
        where: prefix of the keys in messages, such as ``paper``.

    Raises:
        ConfigError: an unknown key, a value of a wrong type or out of its range, a missing key.
    """
    hints = get_type_hints(cls)
    names = [field.name for field in dataclasses.fields(cls) if field.init]  # type: ignore[arg-type]
    for key in data:
        if key not in names:
            raise ConfigError(_unknown(_join(where, str(key)), str(key), names))
    values = {key: _checked(hints[key], value, _join(where, key)) for key, value in data.items()}
    try:
        return cls(**values)
    except (ValueError, TypeError) as error:
        raise ConfigError(f"{where or cls.__name__}: {error}") from error


def read_config(cls: type[T], path: Path) -> T:
    """A ``cls`` from a JSON or TOML file (by its suffix).

    Raises:
        DataError: the file is missing or is no JSON or TOML.
        ConfigError: its content does not fit ``cls``.
    """
    if path.suffix not in (".json", ".toml"):
        raise DataError(path, f"suffix '{path.suffix}'", ".json or .toml")
    data = read_json(path, SETTINGS) if path.suffix == ".json" else read_toml(path, SETTINGS)
    if not isinstance(data, dict):
        raise DataError(path, type(data).__name__, "a table of settings")
    try:
        return from_dict(cls, data)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error


def with_overrides(config: T, overrides: Sequence[str]) -> T:
    """``config`` with ``a.b=value`` settings applied in turn; values are read as JSON, else as text.

    Raises:
        ConfigError: no ``=``, an unknown name, a wrong type or range.
    """
    for override in overrides:
        name, equals, text = override.partition("=")
        if not equals or not name.strip():
            raise ConfigError(f"setting '{override}': expected name=value, such as max_iterations=20")
        config = _replaced(config, name.strip().split("."), _parsed(text.strip()), "")
    return config


def _replaced(config: T, path: Sequence[str], value: Any, where: str) -> T:
    """``config`` with the field at ``path`` set to ``value``."""
    fields = dataclasses.fields(config)  # type: ignore[arg-type]
    names = [field.name for field in fields if field.init]
    key, place = path[0], _join(where, path[0])
    if key not in names:
        raise ConfigError(_unknown(place, key, names))
    if len(path) > 1:
        nested = getattr(config, key)
        if not dataclasses.is_dataclass(nested):
            raise ConfigError(f"{place} is a single value: '{_join(place, path[1])}' does not exist")
        new: Any = _replaced(nested, path[1:], value, place)
    else:
        new = _checked(get_type_hints(type(config))[key], value, place)
    try:
        return dataclasses.replace(config, **{key: new})  # type: ignore[type-var]
    except ValueError as error:
        raise ConfigError(f"{place}: {error}") from error


def _parsed(text: str) -> Any:
    """``text`` as JSON where it is JSON, else as it stands."""
    try:
        return parse_json(text, "value")
    except DataError:
        return text


def _join(where: str, key: str) -> str:
    return f"{where}.{key}" if where else key


def _unknown(place: str, key: str, names: Sequence[str]) -> str:
    starts = sorted((name for name in names if name.startswith(key)), key=len)
    near = starts or difflib.get_close_matches(key, names, n=1, cutoff=0.4)
    hint = f"did you mean '{near[0]}'?" if near else f"known: {', '.join(sorted(names))}"
    return f"unknown setting '{place}'; {hint}"


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return to_dict(value)
    if isinstance(value, enum.Enum):
        return value.name.lower()
    if isinstance(value, Mapping):
        return {str(_plain(key)): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, (set, frozenset)):
        return sorted(_plain(item) for item in value)
    return str(value) if isinstance(value, Path) else value


def _checked(hint: Any, value: Any, place: str) -> Any:
    """``value`` converted to the type ``hint``, or a ConfigError that names both."""
    origin, arguments = get_origin(hint), get_args(hint)
    if hint is Any:
        return value
    if origin in (Union, types.UnionType):
        return _checked_union(arguments, value, place)
    if origin is Literal:
        if value in arguments:
            return value
        raise _mismatch(place, value, "one of " + ", ".join(map(str, arguments)))
    if origin in (tuple, list, frozenset):
        return _checked_sequence(origin, arguments, value, place)
    if origin is dict or origin is Mapping:
        if not isinstance(value, Mapping):
            raise _mismatch(place, value, "a table")
        return {
            _checked(arguments[0], key, place): _checked(arguments[1], item, _join(place, str(key)))
            for key, item in value.items()
        }
    return _checked_scalar(hint, value, place)


def _checked_union(arguments: tuple[Any, ...], value: Any, place: str) -> Any:
    if value is None and type(None) in arguments:
        return None
    choices = [argument for argument in arguments if argument is not type(None)]
    for choice in choices[:-1]:
        try:
            return _checked(choice, value, place)
        except ConfigError:
            continue
    return _checked(choices[-1], value, place)


def _checked_sequence(origin: Any, arguments: tuple[Any, ...], value: Any, place: str) -> Any:
    if not isinstance(value, (list, tuple)):
        raise _mismatch(place, value, "a list")
    if origin is tuple and not (len(arguments) == 2 and arguments[1] is Ellipsis):
        if len(value) != len(arguments):
            raise _mismatch(place, value, f"a list of {len(arguments)} values")
        hints: Sequence[Any] = arguments
    else:
        hints = [arguments[0]] * len(value)
    items = zip(hints, value, strict=True)
    return origin(_checked(hint, item, f"{place}[{i}]") for i, (hint, item) in enumerate(items))


def _checked_scalar(hint: Any, value: Any, place: str) -> Any:
    if dataclasses.is_dataclass(hint):
        if isinstance(value, Mapping):
            return from_dict(hint, value, place)  # type: ignore[arg-type]
        raise _mismatch(place, value, f"a table of {', '.join(f.name for f in dataclasses.fields(hint))}")
    if isinstance(hint, type) and issubclass(hint, enum.Enum):
        names = {member.name.lower(): member for member in hint}
        if isinstance(value, str) and value.lower() in names:
            return names[value.lower()]
        raise _mismatch(place, value, "one of " + ", ".join(names))
    if hint is float and isinstance(value, (int, float)) and not isinstance(value, bool):
        if math.isfinite(value):
            return float(value)
        raise _mismatch(place, value, "a finite number")
    if hint is int and isinstance(value, int) and not isinstance(value, bool):
        return value
    if hint is Path and isinstance(value, str):
        return Path(value)
    if hint in (bool, str) and isinstance(value, hint):
        return value
    words = {float: "a number", int: "a whole number", bool: "true or false", str: "text", Path: "a path"}
    raise _mismatch(place, value, words.get(hint, getattr(hint, "__name__", str(hint))))


def _mismatch(place: str, value: Any, expected: str) -> ConfigError:
    found = repr(value) if len(repr(value)) <= 60 else repr(value)[:57] + "..."
    return ConfigError(f"setting '{place}': found {found}, expected {expected}")

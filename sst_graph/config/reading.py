"""Settings from dictionaries, JSON and TOML files, and ``a.b=value`` overrides."""

from __future__ import annotations

import dataclasses
import difflib
import functools
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from sst_graph.config.old_names import fixed_in, new_name
from sst_graph.config.ranges import Range
from sst_graph.config.settings import expect_any_settings, join, settings_fields
from sst_graph.config.values import MOST_OF_A_NAME, checked, shown
from sst_graph.errors import ConfigError, DataError, SstGraphError, count_of, printable
from sst_graph.factors.arguments import described
from sst_graph.files.reading import SETTINGS, read_json, read_toml

T = TypeVar("T")


def from_dict(cls: type[T], data: Mapping[str, Any], base: T | None = None) -> T:
    """A ``cls`` with the values of ``data``; what is not named is as in ``base``, or keeps its default, in
    nested tables too.

    Raises:
        ConfigError: an unknown key, a value of a wrong type or out of its range, a missing key; no class of
            settings, or no table.
    """
    if not (isinstance(cls, type) and dataclasses.is_dataclass(cls)):
        raise ConfigError(f"cls: found {described(cls)}, expected a class of settings")
    if not isinstance(data, Mapping):
        raise ConfigError(f"data: found {described(data)}, expected a dict of settings by their names")
    if not (base is None or isinstance(base, cls)):
        raise ConfigError(f"base: found {described(base)}, expected a {cls.__name__}, or None")
    _refuse_unknown(cls, data, cls, "")
    return _built(cls, data, "", base)


def read_config(cls: type[T], path: Path, base: T | None = None) -> T:
    """A ``cls`` from a JSON or TOML file (by its suffix), which need not name all: see :func:`from_dict`.

    Raises:
        DataError: the file is missing, too large, or no JSON or TOML.
        ConfigError: its content does not fit ``cls``.
    """
    data = _read_table(path)
    try:
        return from_dict(cls, data, base)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error


def with_overrides(config: T, overrides: Sequence[str]) -> T:
    """``config`` with ``a.b=value`` settings, the last of a name counting; values are JSON, else text.

    Rules that span fields see all settings at once.

    Raises:
        ConfigError: no ``=``, an unknown name, a wrong type or range; no settings, or no texts.
    """
    expect_any_settings("config", config)
    if not isinstance(overrides, list | tuple):
        raise ConfigError(f"overrides: found {described(overrides)}, expected a list of name=value texts")
    cls = type(config)
    changes: dict[str, Any] = {}
    for override in overrides:
        if not isinstance(override, str):
            raise ConfigError(f"overrides: found {described(override)} in it, expected name=value texts")
        name, equals, text = override.partition("=")
        if not equals or not name.strip():
            raise ConfigError(f"setting {shown(override)}: expected name=value, such as max_iterations=20")
        path = name.strip().split(".")
        value = _parsed(name.strip(), text.strip())
        for key in reversed(path):
            value = {key: value}
        _refuse_unknown(cls, value, cls, "")
        _merge(changes, value)
    return _built(cls, changes, "", config)


def _read_table(path: Path) -> Mapping[str, Any]:
    """The table in a JSON or TOML file."""
    if path.suffix not in (".json", ".toml"):
        raise DataError(path, f"suffix '{path.suffix}'", ".json or .toml")
    data = read_json(path, SETTINGS) if path.suffix == ".json" else read_toml(path, SETTINGS)
    if not isinstance(data, dict):
        raise DataError(path, type(data).__name__, "a table of settings")
    return data


def _parsed(name: str, text: str) -> Any:
    """``text`` as JSON where it is JSON, else as it stands."""
    try:
        return json.loads(text)
    except json.JSONDecodeError:
        return text
    except (ValueError, RecursionError):  # integers of thousands of digits, lists nested thousands deep
        found = f"{shown(text)} of {count_of(len(text), 'character')}"
        raise ConfigError(
            f"{printable(name, MOST_OF_A_NAME)}: found {found}, expected a value of a few"
        ) from None


def _merge(changes: dict[str, Any], new: Mapping[str, Any]) -> None:
    """Enter ``new`` into ``changes``, tables into tables."""
    for key, value in new.items():
        old = changes.get(key)
        if isinstance(old, dict) and isinstance(value, dict):
            _merge(old, value)
        else:
            changes[key] = value


def _built(cls: type[T], data: Mapping[str, Any], where: str, base: T | None) -> T:
    """``base``, or without it the defaults of ``cls``, with the values of ``data``, whose names are known."""
    values: dict[str, Any] = {}
    for field, hint in settings_fields(cls):
        if field.name not in data:
            continue
        value, place = data[field.name], join(where, field.name)
        if dataclasses.is_dataclass(hint) and isinstance(value, Mapping):
            nested = _default(field) if base is None else getattr(base, field.name)
            values[field.name] = _built(hint, value, place, nested)  # type: ignore[arg-type]
        else:
            values[field.name] = checked(hint, value, place, Range.of(field))
    try:
        return cls(**values) if base is None else dataclasses.replace(base, **values)  # type: ignore[type-var]
    except (SstGraphError, ValueError, TypeError) as error:  # a rule that spans fields, a field left out
        raise ConfigError(join(where, str(error))) from error


def _default(field: dataclasses.Field[Any]) -> Any:
    """The default of a field, None where it has none."""
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return None if field.default is dataclasses.MISSING else field.default


def _refuse_unknown(cls: Any, data: Mapping[str, Any], root: Any, where: str) -> None:
    """Raise for a name in ``data``, values of the table ``where`` of ``root``, that ``cls`` does not have."""
    hints = {field.name: hint for field, hint in settings_fields(cls)}
    for key, value in data.items():
        place = join(where, str(key))
        if key not in hints:
            name = _first_below(place, value)
            raise ConfigError(f"unknown setting '{printable(name, MOST_OF_A_NAME)}'; {_hint(root, name)}")
        if not isinstance(value, Mapping):
            continue
        if dataclasses.is_dataclass(hints[key]):
            _refuse_unknown(hints[key], value, root, place)
        elif value:
            name = _first_below(place, value)
            raise ConfigError(
                f"{place} is a single value: '{printable(name, MOST_OF_A_NAME)}' does not exist"
            )


def _first_below(place: str, value: Any) -> str:
    """The dotted name of the first single value in a table."""
    while isinstance(value, Mapping) and value:
        key, value = next(iter(value.items()))
        place = join(place, str(key))
    return place


def _hint(root: Any, name: str) -> str:
    """The settings of ``root`` that an unknown dotted name may mean, else the names at the top; or what a
    setting of this name is called now, or what fixes it where its table has none that is spelled alike.
    """
    if new := new_name(name, _all_names(root)):
        return f"it is called '{new}'"
    near = _nearest(name, _all_names(root)) if len(name) <= 200 else []
    table = name.rpartition(".")[0]
    if fixed_in(name) and not (table and any(known.rpartition(".")[0] == table for known in near)):
        return f"it is fixed in {fixed_in(name)}, leave it out"
    if near:
        return "did you mean " + " or ".join(f"'{known}'" for known in near) + "?"
    top = ", ".join(sorted(field.name for field, _ in settings_fields(root)))
    return f"no setting has a name like it; known at the top: {top}"


@functools.cache
def _all_names(root: Any, where: str = "") -> tuple[str, ...]:
    """Dotted names of all settings and tables of ``root``."""
    names: list[str] = []
    for field, hint in settings_fields(root):
        name = join(where, field.name)
        names.append(name)
        if isinstance(hint, type) and dataclasses.is_dataclass(hint):
            names += _all_names(hint, name)
    return tuple(names)


def _nearest(name: str, names: Sequence[str]) -> list[str]:
    """Up to three of the dotted ``names`` that an unknown one may mean, the likeliest first.

    These are, in turn: what its table has that begins alike, what other tables have of the same last part,
    and what has a last part that is spelled alike.
    """
    table, _, key = name.rpartition(".")
    parts = {known: known.rpartition(".") for known in names}

    def best(found: Sequence[str], most: int) -> list[str]:
        found = [known for known in found if parts[known][0] == table] or found
        alike = {known: difflib.SequenceMatcher(None, name, known).ratio() for known in found}
        return sorted(found, key=lambda known: -alike[known])[:most]

    if len(key) >= 3:
        beside = [known for known in names if parts[known][0] == table and parts[known][2].startswith(key)]
        same = [known for known in names if parts[known][2] == key]
        if beside or same:
            return best(beside, 1) or best(same, 3)
    last = sorted({parts[known][2] for known in names})
    alike = difflib.get_close_matches(key, last, n=1, cutoff=0.75)
    return best([known for known in names if parts[known][2] in alike], 3)

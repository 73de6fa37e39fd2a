"""Settings from dictionaries, JSON and TOML files, and ``a.b=value`` overrides."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from sst_graph.config.names import refuse_unknown
from sst_graph.config.old_names import with_new_names
from sst_graph.config.ranges import Range
from sst_graph.config.settings import join, settings_fields
from sst_graph.config.values import checked, printable, shown
from sst_graph.errors import ConfigError, DataError, SstGraphError, count_of
from sst_graph.files.reading import SETTINGS, read_json, read_toml

T = TypeVar("T")


def from_dict(cls: type[T], data: Mapping[str, Any], base: T | None = None) -> T:
    """A ``cls`` with the values of ``data``; what is not named is as in ``base``, or keeps its default, in
    nested tables too.

    Old names of settings (:mod:`sst_graph.config.renamed`) are accepted with a warning in the log.

    Raises:
        ConfigError: an unknown key, a value of a wrong type or out of its range, a missing key.
    """
    data = with_new_names(cls, data)
    refuse_unknown(cls, data, cls, "")
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
        ConfigError: no ``=``, an unknown name, a wrong type or range.
    """
    cls = type(config)
    changes: dict[str, Any] = {}
    for override in overrides:
        name, equals, text = override.partition("=")
        if not equals or not name.strip():
            raise ConfigError(f"setting {shown(override)}: expected name=value, such as max_iterations=20")
        path = name.strip().split(".")
        value = _parsed(name.strip(), text.strip())
        for key in reversed(path):
            value = {key: value}
        value = with_new_names(cls, value)
        refuse_unknown(cls, value, cls, "")
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
        raise ConfigError(f"{printable(name)}: found {found}, expected a value of a few") from None


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

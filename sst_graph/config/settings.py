"""The base of all settings dataclasses, what fields they have, and how they are written out."""

from __future__ import annotations

import dataclasses
import enum
import functools
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

from sst_graph.config.ranges import Range, is_internal, unit_of
from sst_graph.config.values import checked
from sst_graph.errors import ConfigError, SstGraphError
from sst_graph.factors.arguments import described

T = TypeVar("T")


class Settings:
    """Base of the settings dataclasses: types and declared ranges are checked when an instance is built.

    Raises:
        ConfigError: by the constructor: a value of a wrong type or out of its range.
    """

    def __init_subclass__(cls, **keywords: Any) -> None:
        super().__init_subclass__(**keywords)
        own: Callable[[Any], None] | None = cls.__dict__.get("__post_init__")
        if own is not None:
            setattr(cls, "__post_init__", _checked_before(own))  # noqa: B010 (a method, to mypy)

    def __post_init__(self) -> None:
        _check_fields(self)

    def expect_at_most(self, name: str, bound: float, why: str) -> None:
        """A rule between fields: raise where the field ``name`` is above a bound, which ``why`` explains."""
        if getattr(self, name) > bound:
            raise self._outside(name, f"at most {bound:.10g}", why)

    def expect_at_least(self, name: str, bound: float, why: str) -> None:
        """A rule between fields: raise where the field ``name`` is below a bound, which ``why`` explains."""
        if getattr(self, name) < bound:
            raise self._outside(name, f"at least {bound:.10g}", why)

    def _outside(self, name: str, bound: str, why: str) -> ConfigError:
        unit = f" {unit_of(name)}".rstrip()
        return ConfigError(f"{name}: found {getattr(self, name):.10g}, expected {bound}{unit} ({why})")


def _checked_before(own: Callable[[Any], None]) -> Callable[[Any], None]:
    """``own``, a ``__post_init__``, after the check of each field."""

    @functools.wraps(own)
    def checked(self: Any) -> None:
        _check_fields(self)
        try:
            own(self)
        except SstGraphError:
            raise
        except (ValueError, TypeError) as error:
            raise ConfigError(str(error)) from error

    return checked


def _check_fields(config: Any) -> None:
    """Check every field of ``config`` and store it in its declared type (3 as 3.0, a list as a tuple)."""
    for field, hint in settings_fields(type(config)):
        place = f"{type(config).__name__}.{field.name}"
        value = checked(hint, getattr(config, field.name), place, Range.of(field))
        object.__setattr__(config, field.name, value)


def expect_settings(config: T | None, cls: type[T]) -> T:
    """Settings that are given, or the defaults where None is.

    Raises:
        ConfigError: something else is given.
    """
    if config is None:
        return cls()
    if not isinstance(config, cls):
        raise ConfigError(f"config: found a {type(config).__name__}, expected a {cls.__name__}, or None")
    return config


def expect_any_settings(what: str, config: object) -> None:
    """Refuse what is no instance of a dataclass.

    Raises:
        ConfigError: naming ``what``.
    """
    if isinstance(config, type) or not dataclasses.is_dataclass(config):
        raise ConfigError(
            f"{what}: found {described(config)}, expected settings, such as CalibrationConfig()"
        )


def settings_fields(cls: Any) -> tuple[tuple[dataclasses.Field[Any], Any], ...]:
    """The fields of a settings dataclass that can be given, each with its type."""
    return _fields(cls)


@functools.cache
def _fields(cls: Any) -> tuple[tuple[dataclasses.Field[Any], Any], ...]:
    hints = get_type_hints(cls)
    return tuple(
        (field, hints[field.name])
        for field in dataclasses.fields(cls)
        if field.init and not is_internal(field)
    )


def walk_settings(cls: Any, where: str = "") -> Iterator[tuple[str, dataclasses.Field[Any], Any]]:
    """Dotted name, field and type of every single setting below ``cls``, tables followed."""
    for field, hint in settings_fields(cls):
        name = join(where, field.name)
        if dataclasses.is_dataclass(hint):
            yield from walk_settings(hint, name)
        else:
            yield name, field, hint


def to_dict(config: Any) -> dict[str, Any]:
    """The dataclass as a JSON-able dictionary: enums by lower-case name, tuples as lists, paths as text.

    Raises:
        ConfigError: no dataclass.
    """
    expect_any_settings("config", config)
    return {
        field.name: _plain(getattr(config, field.name))
        for field in dataclasses.fields(config)
        if not is_internal(field)
    }


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


def join(where: str, key: str) -> str:
    """The dotted name of ``key`` in the table ``where``, which is empty at the top."""
    return f"{where}.{key}" if where else key

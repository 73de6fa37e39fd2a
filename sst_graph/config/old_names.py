"""Settings given by an earlier name: read under the name that they have."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from typing import Any

from sst_graph.config.renamed import FIXED, RENAMED
from sst_graph.config.settings import join, walk_settings
from sst_graph.config.values import printable, shown
from sst_graph.errors import ConfigError

_LOG = logging.getLogger(__name__)

CALIBRATION = "calibration."
"""What the names of ``calibrate``'s settings begin with in other commands; the tables leave it out."""

_MAX_DEPTH = 12
"""Levels of a table that are searched for old names: more than any name has, fewer than recursion allows."""


def with_new_names(
    cls: Any,
    data: Mapping[str, Any],
    renamed: Mapping[str, str] = RENAMED,
) -> Mapping[str, Any]:
    """Nested settings for ``cls`` under the names that they have; each old name is logged as a warning.

    A name that neither ``cls`` nor ``renamed`` has stays: whoever reads it refuses it.

    Raises:
        ConfigError: a setting that is given under two names.
    """
    known = {name for name, _, _ in walk_settings(cls)}
    old = {name: value for name, value in _leaves(data) if name not in known}
    moved: dict[str, tuple[str, Any]] = {}
    for name, value in old.items():
        short = name.removeprefix(CALIBRATION)
        prefix = name[: len(name) - len(short)]
        new = prefix + renamed.get(short, short)
        if new != name and new in known:
            _LOG.warning("setting '%s' is called '%s': use that name", name, new)
            moved[name] = (new, value)
    if not moved:
        return data
    tree = _without(data, moved)
    given: dict[str, tuple[str, Any]] = {}
    for name, (new, value) in moved.items():
        if _has(tree, new) and new not in given:
            raise ConfigError(f"'{printable(name)}' and '{new}': found both, expected the second alone")
        other, same = given.setdefault(new, (name, value))
        if same != value:
            raise ConfigError(
                f"'{printable(other)}' and '{printable(name)}', both called '{new}': found {shown(same)} and "
                f"{shown(value)}, expected one value"
            )
        _put(tree, new, value)
    return tree


def fixed_in(name: str, fixed: Mapping[str, str] = FIXED) -> str:
    """The module that fixes what an earlier setting set; empty for a name that never was one."""
    place = name.removeprefix(CALIBRATION)
    while place and place not in fixed:
        place = place.rpartition(".")[0]
    return fixed.get(place, "")


def _leaves(data: Mapping[str, Any], where: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted name and value of each single setting in a nested table."""
    for key, value in data.items():
        name = join(where, str(key))
        if isinstance(value, Mapping) and value and name.count(".") < _MAX_DEPTH:
            yield from _leaves(value, name)
        else:
            yield name, value


def _has(data: Any, name: str) -> bool:
    for key in name.split("."):
        if not isinstance(data, Mapping) or key not in data:
            return False
        data = data[key]
    return True


def _without(data: Mapping[str, Any], names: Mapping[str, Any], where: str = "") -> dict[str, Any]:
    """A copy of the table without some settings, and without the tables that held nothing else."""
    kept: dict[str, Any] = {}
    for key, value in data.items():
        name = join(where, str(key))
        if name in names:
            continue
        if isinstance(value, Mapping) and any(moved.startswith(f"{name}.") for moved in names):
            value = _without(value, names, name)
            if not value:
                continue
        kept[key] = value
    return kept


def _put(tree: dict[str, Any], name: str, value: Any) -> None:
    """Enter a value; not below a single value that stands in a table's place, which is refused later."""
    *tables, last = name.split(".")
    for key in tables:
        below = tree.setdefault(key, {})
        tree = below if isinstance(below, dict) else {}
    tree[last] = value

"""Names of settings: which there are, and what an unknown one may mean."""

from __future__ import annotations

import dataclasses
import difflib
import functools
from collections.abc import Mapping, Sequence
from typing import Any

from sst_graph.config.settings import join, settings_fields
from sst_graph.config.values import printable
from sst_graph.errors import ConfigError


def refuse_unknown(cls: Any, data: Mapping[str, Any], root: Any, where: str) -> None:
    """Raise for a name in ``data``, values of the table ``where`` of ``root``, that ``cls`` does not have."""
    hints = {field.name: hint for field, hint in settings_fields(cls)}
    for key, value in data.items():
        place = join(where, str(key))
        if key not in hints:
            name = _first_below(place, value)
            raise ConfigError(f"unknown setting '{printable(name)}'; {_hint(root, name)}")
        if not isinstance(value, Mapping):
            continue
        if dataclasses.is_dataclass(hints[key]):
            refuse_unknown(hints[key], value, root, place)
        elif value:
            name = _first_below(place, value)
            raise ConfigError(f"{place} is a single value: '{printable(name)}' does not exist")


def _first_below(place: str, value: Any) -> str:
    """The dotted name of the first single value in a table."""
    while isinstance(value, Mapping) and value:
        key, value = next(iter(value.items()))
        place = join(place, str(key))
    return place


def _hint(root: Any, name: str) -> str:
    """The settings of ``root`` that an unknown dotted name may mean, else the names at the top."""
    near = _nearest(name, _all_names(root)) if len(name) <= 200 else []
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

"""All settings below a class, one entry each: for ``sst-graph settings`` and docs/reference/settings.md."""

from __future__ import annotations

import enum
import json
import textwrap
import types
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, Union, get_args, get_origin

from sst_graph.config.ranges import Range
from sst_graph.config.settings import to_dict, walk_settings


@dataclass(frozen=True)
class SettingEntry:
    """What is known of one setting.

    Attributes:
        name: dotted, as ``--set`` takes it.
        default: as JSON.
        unit: of its numbers; empty without one.
        range: the values that are allowed, in words without the unit.
        doc: what it is, and when to change it.
    """

    name: str
    default: str
    unit: str
    range: str
    doc: str


def list_settings(root: Any, containing: str = "") -> list[SettingEntry]:
    """The settings of ``root``, a settings instance with the defaults, whose names contain a text."""
    return [
        SettingEntry(
            name,
            json.dumps(_value(to_dict(root), name), ensure_ascii=False),
            Range.of(field).unit,
            _range(hint, Range.of(field)),
            field.metadata.get("doc", ""),
        )
        for name, field, hint in walk_settings(type(root))
        if containing in name
    ]


def as_text(entries: Sequence[SettingEntry]) -> str:
    """A line of name, default, unit and range for each setting, and its text below."""
    lines = []
    for entry in entries:
        unit = f" {entry.unit}" if entry.unit else ""
        lines.append(f"{entry.name} = {entry.default}{unit}  ({entry.range})")
        if entry.doc:
            lines += textwrap.wrap(entry.doc, 100, initial_indent="    ", subsequent_indent="    ")
    return "".join(f"{line}\n" for line in lines)


def as_markdown(entries: Sequence[SettingEntry]) -> str:
    """A table with a row for each setting."""
    rows = [
        "| setting | default | unit | range | what it is, and when to change it |",
        "|---|---|---|---|---|",
    ]
    for entry in entries:
        cells = (f"`{entry.name}`", f"`{entry.default}`", entry.unit, entry.range, entry.doc)
        rows.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "".join(f"{row}\n" for row in rows)


def _value(tree: Any, name: str) -> Any:
    for key in name.split("."):
        tree = tree[key]
    return tree


def _range(hint: Any, limits: Range) -> str:
    """The allowed values of a type within limits, in words."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        kinds = [argument for argument in arguments if argument is not type(None)]
        words = " or ".join(_range(kind, limits) for kind in kinds)
        return f"{words}, or null" if type(None) in arguments else words
    if origin is Literal:
        return ", ".join(map(str, arguments))
    if origin is tuple:
        several = len(arguments) == 2 and arguments[1] is Ellipsis
        items = arguments[:1] if several else dict.fromkeys(arguments)
        number = "" if several else f"{len(arguments)} "
        return f"list of {number}({'; '.join(_range(item, limits) for item in items)})"
    if hint is bool:
        return "true, false"
    if isinstance(hint, type) and issubclass(hint, enum.Enum):
        return ", ".join(member.name.lower() for member in hint)
    if limits.choices is not None:
        return ", ".join(limits.choices)
    words = {int: "whole number", float: "number", str: "text"}.get(
        hint, getattr(hint, "__name__", str(hint))
    )
    interval = _interval(limits)
    return f"{words}, {interval}" if interval and hint is int else interval or words


def _interval(limits: Range) -> str:
    """The bounds of a number, such as "above 0 to 10"; empty without any."""
    low = "" if limits.low is None else f"{'above ' if limits.open_low else ''}{limits.low:.10g}"
    high = "" if limits.high is None else f"{'below ' if limits.open_high else ''}{limits.high:.10g}"
    if low and high:
        return f"{low} to {high}"
    return f"{low} or more" if low else f"up to {high}" if high else ""

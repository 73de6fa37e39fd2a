"""The range of a setting, declared beside its default in the metadata of a dataclass field."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Collection
from typing import Any, Literal, TypedDict, TypeVar, Unpack

T = TypeVar("T")

_UNITS = {
    "deg_per_s": "deg/s",
    "deg_s": "deg/s",
    "inverse_m": "1/m",
    "mps2": "m/s^2",
    "mps": "m/s",
    "radps": "rad/s",
    "mrad": "mrad",
    "rad": "rad",
    "deg": "deg",
    "px": "px",
    "hz": "Hz",
    "ns": "ns",
    "s": "s",
    "m": "m",
}


class Bounds(TypedDict, total=False):
    """What may limit a setting: see :func:`setting`."""

    at_least: float
    more_than: float
    at_most: float
    less_than: float
    length: tuple[int, int]
    order: Literal["increasing", "decreasing"]
    choices: Collection[str]


def setting(default: T, *, doc: str = "", unit: str | None = None, **bounds: Unpack[Bounds]) -> T:
    """A dataclass field with its default and range. For a tuple, the range is that of each element.

    Args:
        doc: what it is, and when to change it, for ``sst-graph settings``.
        unit: of the numbers, where the end of the field's name (``_px``, ``_s``, ...) does not say it.
        at_least, more_than: lower bound that is allowed, or that is not.
        at_most, less_than: upper bound that is allowed, or that is not.
        length: fewest and most elements of a tuple.
        order: each element of a tuple above ("increasing") or below ("decreasing") the one before it.
        choices: the texts that are allowed.
    """
    return dataclasses.field(default=default, metadata={**bounds, "doc": doc, "unit": unit})


def internal(default: T) -> T:
    """A field of a settings dataclass that the program sets itself: no setting, and not written out."""
    return dataclasses.field(default=default, metadata={_INTERNAL: True})


def is_internal(field: dataclasses.Field[Any]) -> bool:
    """Whether a field is :func:`internal`."""
    return bool(field.metadata.get(_INTERNAL))


_INTERNAL = "internal"


@dataclasses.dataclass(frozen=True)
class Range:
    """The declared range of a field; a bound that is None does not limit.

    Attributes:
        low, high: bounds.
        open_low, open_high: whether the bound itself is outside.
        length: fewest and most elements of a tuple.
        order: of the elements of a tuple.
        choices: the texts that are allowed.
        unit: of the numbers, as declared or by the end of the field's name.
    """

    low: float | None = None
    high: float | None = None
    open_low: bool = False
    open_high: bool = False
    length: tuple[int, int] | None = None
    order: Literal["increasing", "decreasing"] | None = None
    choices: Collection[str] | None = None
    unit: str = ""

    @staticmethod
    @functools.cache
    def of(field: dataclasses.Field[Any]) -> Range:
        """The range in the metadata of ``field``, whose keys are those of :class:`Bounds`."""
        given = field.metadata
        unit = given.get("unit")
        return Range(
            low=given.get("more_than", given.get("at_least")),
            high=given.get("less_than", given.get("at_most")),
            open_low="more_than" in given,
            open_high="less_than" in given,
            length=given.get("length"),
            order=given.get("order"),
            choices=given.get("choices"),
            unit=unit_of(field.name) if unit is None else unit,
        )

    def holds(self, number: Any) -> bool:
        """Whether a number is within the bounds."""
        low, high = self.low, self.high
        above = low is None or (number > low if self.open_low else number >= low)
        return above and (high is None or (number < high if self.open_high else number <= high))

    def text(self) -> str:
        """The bounds of a number in words, such as ``more than 0 and at most 10 s``; empty without any."""
        parts = []
        if self.low is not None:
            parts.append(f"{'more than' if self.open_low else 'at least'} {self.low:.10g}")
        if self.high is not None:
            parts.append(f"{'less than' if self.open_high else 'at most'} {self.high:.10g}")
        return f"{' and '.join(parts)} {self.unit}".strip() if parts else ""


def unit_of(name: str) -> str:
    """The unit that the name of a field ends with; empty without one."""
    return next((unit for end, unit in _UNITS.items() if name.endswith("_" + end)), "")

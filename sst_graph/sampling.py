"""Some of many items, chosen evenly."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

T = TypeVar("T")


def evenly_spread(items: Sequence[T], most: int) -> list[T]:
    """At most ``most`` of the items, evenly spread over them, from the first to the last."""
    places = np.linspace(0, len(items) - 1, min(most, len(items))).round().astype(int)
    return [items[place] for place in places.tolist()]


def step_for(count: int, most: int) -> int:
    """The step k with which ``[::k]`` keeps at most ``most`` of ``count`` items."""
    return max(1, -(-count // most))


def spread_places(places: NDArray[np.intp], most: int) -> NDArray[np.intp]:
    """At most ``most`` of some places, evenly spread over them, from the first to the last."""
    if len(places) <= most:
        return places
    return places[np.linspace(0, len(places) - 1, most).astype(np.intp)]

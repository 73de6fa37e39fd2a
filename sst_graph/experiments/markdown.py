"""Tables in Markdown, and the numbers in their cells."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import numpy as np

NONE = "–"
"""In the cell of a number that there is not."""


def lines(head: str, rows: Iterable[Sequence[str]]) -> Iterator[str]:
    """The lines of a table by its first, "| a | b |", and the cells of each row, as the rows come."""
    yield head
    yield "|" + "---|" * (head.count("|") - 1)
    for cells in rows:
        yield "| " + " | ".join(cells) + " |"


def table(head: str, rows: Iterable[Sequence[str]]) -> str:
    """A table by its first line, "| a | b |", and the cells of each row."""
    return "\n".join(lines(head, rows)) + "\n"


def median(values: Sequence[float], digits: int, unit: str = "") -> str:
    """Median of some values."""
    return f"{np.median(values):.{digits}f}{unit}" if values else NONE


def median_worst(
    values: Sequence[float], digits: int, worst: Callable[[Sequence[float]], Any] = np.max
) -> str:
    """Median and largest of some values, or ``worst`` of them in place of the largest."""
    return f"{np.median(values):.{digits}f} / {worst(values):.{digits}f}" if values else NONE


def status_counts(statuses: Sequence[str]) -> str:
    """How many are ok, unobservable and not converged."""
    return " / ".join(str(statuses.count(s)) for s in ("ok", "unobservable", "not_converged"))

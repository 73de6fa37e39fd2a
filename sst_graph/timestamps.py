"""Time stamps: decimal seconds in files, int64 nanoseconds at rest."""

from __future__ import annotations

import re
from decimal import Decimal
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sst_graph.errors import DataError, count_of
from sst_graph.files.reading import TIMES_TXT, read_text

NS_PER_S = 1_000_000_000

MAX_LENGTH = 64
"""Characters of a stamp; ten digits before the point and nine behind it say all that is kept."""
MAX_STAMPS = 2_000_000
"""Of a drive: more than a day at 20 Hz."""

LATEST_NS = 2**62
"""Stamps lie within +-146 years of zero, so that no difference of two leaves int64 [ns]."""

Span = tuple[int, int]
"""First and last stamp [ns]."""
FAR_APART_S = 5.0
"""Scans and images that are farther apart are not of one drive, or not stamped by one clock: sensors measure
every few seconds at least [s]."""

_DECIMAL = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d{1,9})?", re.ASCII)
_MAX_EXPONENT = 10


def parse_seconds(text: str, place: str | Path) -> int:
    """Nanoseconds of a decimal number of seconds, exact (no detour over binary floats).

    Raises:
        DataError: the text is no finite number, or beyond :data:`LATEST_NS`.
    """
    text = text.strip()
    if len(text) > MAX_LENGTH or not _DECIMAL.fullmatch(text):
        raise DataError(place, f"{text!r:.60}", "a number of seconds")
    seconds = Decimal(text)
    # By the exponent first: arithmetic with 1e999999999 overflows.
    stamp_ns = None if seconds.adjusted() > _MAX_EXPONENT else int((seconds * NS_PER_S).to_integral_value())
    if stamp_ns is None or abs(stamp_ns) > LATEST_NS:
        raise DataError(place, f"{text!r:.60}", f"seconds, at most {LATEST_NS // NS_PER_S} (146 years)")
    return stamp_ns


def checked_ns(stamp_ns: int, place: str | Path) -> int:
    """A stamp [ns] that a clock shows.

    Raises:
        DataError: one beyond :data:`LATEST_NS`.
    """
    if abs(stamp_ns) > LATEST_NS:
        raise DataError(place, f"a stamp of {stamp_ns} ns", f"nanoseconds, at most {LATEST_NS} (146 years)")
    return stamp_ns


def check_rising(stamps_ns: NDArray[np.int64], place: str | Path) -> None:
    """Require stamps (n,) [ns] to rise strictly.

    Raises:
        DataError: an equal or falling pair; both indices and the difference are named.
    """
    steps = np.diff(stamps_ns)
    if (steps <= 0).any():
        k = int(np.argmax(steps <= 0))
        kind = "equal" if steps[k] == 0 else "falling"
        found = f"{kind} stamps {k} and {k + 1} (step {int(steps[k]) * 1e-9:g} s)"
        raise DataError(place, found, "stamps that rise strictly")


def apart_s(one_ns: Span, other_ns: Span) -> float:
    """Time between two spans of stamps, 0 where they overlap [s]."""
    return max(one_ns[0] - other_ns[1], other_ns[0] - one_ns[1], 0) * 1e-9


def read_times(path: Path) -> NDArray[np.int64]:
    """Stamps (n,) int64 [ns] of a ``times.txt``: one number of seconds a line, strictly rising.

    Raises:
        DataError: a missing or empty file, a line that is no number, stamps that do not rise.
    """
    text = read_text(path, TIMES_TXT).rstrip()
    if text.count("\n") >= MAX_STAMPS:
        raise DataError(path, count_of(text.count(chr(10)) + 1, "line"), f"at most {MAX_STAMPS} stamps")
    if not text:
        raise DataError(path, "no stamp", "one number of seconds a line")
    lines = text.splitlines()
    stamps = [parse_seconds(line, f"{path}:{number}") for number, line in enumerate(lines, 1)]
    stamps_ns = np.array(stamps, np.int64)
    check_rising(stamps_ns, path)
    return stamps_ns

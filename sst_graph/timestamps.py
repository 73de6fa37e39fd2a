"""Time stamps: decimal seconds in files, int64 nanoseconds at rest."""

from __future__ import annotations

from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sst_graph.errors import DataError

NS_PER_S = 1_000_000_000


def parse_seconds(text: str, place: str | Path) -> int:
    """Nanoseconds of a decimal number of seconds, exact (no detour over binary floats).

    Raises:
        DataError: the text is no finite number, or does not fit into int64 nanoseconds.
    """
    try:
        seconds = Decimal(text.strip())
    except InvalidOperation:
        raise DataError(place, f"{text.strip()!r}", "a number of seconds") from None
    if not seconds.is_finite() or abs(seconds) > Decimal(2**63 - 1) / NS_PER_S:
        raise DataError(place, f"{text.strip()!r}", "a finite number of seconds")
    return int((seconds * NS_PER_S).to_integral_value())


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


def read_times(path: Path) -> NDArray[np.int64]:
    """Stamps (n,) int64 [ns] of a ``times.txt``: one number of seconds a line, strictly rising.

    Raises:
        DataError: a missing or empty file, a line that is no number, stamps that do not rise.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(path, _reason(error), "a text file with one number of seconds a line") from None
    while lines and not lines[-1].strip():
        lines.pop()
    if not lines:
        raise DataError(path, "no stamp", "one number of seconds a line")
    stamps = [parse_seconds(line, f"{path}:{number}") for number, line in enumerate(lines, 1)]
    stamps_ns = np.array(stamps, np.int64)
    check_rising(stamps_ns, path)
    return stamps_ns


def _reason(error: OSError | UnicodeDecodeError) -> str:
    if isinstance(error, FileNotFoundError):
        return "no file"
    return f"an unreadable file ({type(error).__name__})"

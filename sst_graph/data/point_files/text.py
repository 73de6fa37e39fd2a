"""Points in text: one a line, numbers between blanks."""

from __future__ import annotations

import io
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sst_graph.errors import DataError, count_of


def text_records(body: bytes, dtype: np.dtype[Any], count: int, path: Path) -> NDArray[Any]:
    """``count`` records of ``dtype`` in as many lines; NaN and inf are numbers.

    Raises:
        DataError: other lines, or fewer.
    """
    if count == 0:
        return np.zeros(0, dtype)
    found = body.count(b"\n") + (not body.endswith(b"\n"))
    if found < count:
        raise DataError(path, f"{count_of(found, 'line')} of points", f"{count}")
    lines = body.split(b"\n", count)[:count]
    flat = np.dtype(
        [(f"{k}", part) for k, part in enumerate(_parts(dtype))]
    )  # loadtxt counts a field of several values as one
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of a body without lines
            text = io.StringIO(b"\n".join(lines).decode("ascii"))
            records = np.loadtxt(text, flat, comments=None, ndmin=1)
    except (ValueError, OverflowError) as error:
        line = (str(error).splitlines() or ["?"])[0]
        raise DataError(
            path,
            f"points that are no numbers ({line})",
            f"{count_of(len(flat.names or ()), 'number')} a line",
        ) from None
    if len(records) != count:
        raise DataError(path, f"{count_of(len(records), 'line')} of points", f"{count}")
    return np.frombuffer(np.ascontiguousarray(records).tobytes(), dtype, count)


def _parts(dtype: np.dtype[Any]) -> list[np.dtype[Any]]:
    """Types of the values of a record, in turn."""
    parts: list[np.dtype[Any]] = []
    for name in dtype.names or ():
        field = dtype[name]
        parts += [field.base] * (field.itemsize // field.base.itemsize)
    return parts

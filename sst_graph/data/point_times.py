"""Times of points, in whichever way a driver counts them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

FARTHEST_S = 1.0
"""Points are measured within this of the scan's stamp."""


def seconds_after_stamp(values: NDArray[Any], stamp_ns: int) -> NDArray[np.float64] | None:
    """Times (n,) of points after their scan's stamp [s]; None where all are 0, as drivers leave the field.

    Whole numbers are nanoseconds, floats seconds, both after the stamp or on the stamp's clock; floats are
    nanoseconds on that clock, too (Livox). The first of these readings by which all points lie within
    FARTHEST_S of the stamp is taken, else that by which they lie nearest: the caller checks the distance,
    and for NaN.
    """
    if not values.any():
        return None
    seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
    readings: list[NDArray[np.float64]]
    if values.dtype.kind in "iu":
        whole = values.astype(np.int64)
        readings = [whole.astype(np.float64) * 1e-9, (whole - stamp_ns).astype(np.float64) * 1e-9]
    else:
        times = values.astype(np.float64)
        readings = [
            times,
            (times - float(seconds)) - nanoseconds * 1e-9,
            (times - float(stamp_ns)) * 1e-9,
        ]
    return min(readings, key=lambda reading: max(_farthest(reading), FARTHEST_S))


def _farthest(seconds: NDArray[np.float64]) -> float:
    """Largest distance from the stamp [s]; NaN and inf aside."""
    return float(np.abs(seconds).max(initial=0.0, where=np.isfinite(seconds)))

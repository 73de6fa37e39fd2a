"""Times of points in seconds after their scan's stamp, in whichever way a driver counts them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

FARTHEST_S = 1.0
"""Points are measured within this of the scan's stamp."""

WITHOUT_TIMES = (
    "(without them: --sweep clockwise or counterclockwise of a LiDAR that turns, compensated where its "
    "points were moved to the stamp)"
)
"""How a cloud is read whose times cannot be used."""

_SCAN_LASTS_S = (0.005, 0.5)
"""From a narrow part of a fast sweep to a slow one: less than 1000 times longer, so at most one unit fits."""
_CLEARLY_S = 0.01
"""How much nearer to its stamp a scan begins or ends by its clock than after it: returns may be missing."""
_OF_FLOATS_NS = (1_000_000_000, 1_000_000, 1_000, 1)
_OF_WHOLE_NS = (1, 1_000, 1_000_000)
"""Units in which times are counted, the usual one first."""


def tells_nothing(values: NDArray[Any]) -> bool:
    """Whether times (n,) of points are all the same: drivers leave the field at 0, or write the scan's own
    time.
    """
    return not values.any() or (len(values) > 1 and bool((values == values[0]).all()))


def likely_seconds(values: NDArray[Any], stamp_ns: int) -> NDArray[np.float64] | None:
    """Times (n,) of points after their scan's stamp [s]; None where they tell nothing.

    Drivers count seconds in floats and nanoseconds in whole numbers, and some milliseconds or microseconds,
    after the stamp or on the stamp's clock. The unit is that by which the scan lasts 5 ms to 0.5 s within
    FARTHEST_S of its stamp. In the first second of a clock it may do so either way: times are then on the
    stamp's clock where the scan begins or ends clearly nearer to its stamp by that. Where no unit fits, it is
    the usual one, or absolute nanoseconds in floats (Livox), whichever leaves the points nearest to the
    stamp: the caller checks the distance, and for NaN.
    """
    if tells_nothing(values):
        return None
    numbers, ends = counted(values)
    for unit_ns in units_ns(values):
        nearest_s = {}
        for clock_ns in (0, stamp_ns):
            first, last = read_as(ends[0], unit_ns, clock_ns), read_as(ends[-1], unit_ns, clock_ns)
            if lasts_a_scan(last - first) and _farthest(first, last) <= FARTHEST_S:
                nearest_s[clock_ns] = min(abs(first), abs(last)) + (_CLEARLY_S if clock_ns else 0.0)
        if nearest_s:
            return np.asarray(read_as(numbers, unit_ns, min(nearest_s, key=lambda clock: nearest_s[clock])))
    usual_ns = units_ns(values)[0]
    readings = [(usual_ns, 0), (usual_ns, stamp_ns), (1, stamp_ns)]
    nearest = min(readings, key=lambda r: max(_farthest(*(read_as(end, *r) for end in ends)), FARTHEST_S))
    return np.asarray(read_as(numbers, *nearest))


def counted(values: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Times (n,) as whole numbers of 64 bits or floats of 64, and the first and the last of those that are
    finite; a single NaN where none is."""
    numbers = values.astype(np.int64 if values.dtype.kind in "iu" else np.float64)
    finite = numbers[np.isfinite(numbers)]
    return numbers, np.array([finite.min(), finite.max()]) if len(finite) else numbers[:1]


def units_ns(values: NDArray[Any]) -> Sequence[int]:
    """Units in which times of this type are counted [ns], the usual one first."""
    return _OF_WHOLE_NS if values.dtype.kind in "iu" else _OF_FLOATS_NS


def lasts_a_scan(seconds: float) -> bool:
    """Whether a scan may take so long."""
    return bool(_SCAN_LASTS_S[0] <= seconds <= _SCAN_LASTS_S[1])


def read_as(numbers: Any, unit_ns: int, clock_ns: int) -> Any:
    """Seconds after an instant on the clock that counts in a unit; whole numbers are subtracted exactly."""
    count, rest_ns = divmod(clock_ns, unit_ns)
    return (numbers - numbers.dtype.type(count)) * (unit_ns * 1e-9) - rest_ns * 1e-9


def _farthest(*seconds: float) -> float:
    """Largest distance from the stamp [s]; NaN aside."""
    return float(np.nanmax(np.abs(seconds), initial=0.0))

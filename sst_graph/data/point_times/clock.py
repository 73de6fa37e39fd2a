"""Times of points by another clock than that of the scans' stamps: the LiDAR's own, say.

Its difference from the stamps is the same over the whole drive, but for a drift. It is estimated once, from
many scans: a stamp that came late, and a scan whose first return is missing, then leave the times as they
are.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sst_graph.data.point_times.seconds import (
    FARTHEST_S,
    counted,
    lasts_a_scan,
    likely_seconds,
    read_as,
    tells_nothing,
    units_ns,
)
from sst_graph.data.source import SourceOptions
from sst_graph.errors import DataError, MissingDependencyError, count_of
from sst_graph.sampling import evenly_spread
from sst_graph.spread import robust_spread
from sst_graph.sweep_timing import SweepStamp
from sst_graph.types import FloatArray

_LOOKED_AT = 3
"""Scans that show whether times are of another clock."""
FEWEST, COMPARED = 3, 48
"""Fewest and most scans that tell the difference."""
MOST_JITTER_S = 0.005
"""Standard deviation of the difference, from scan to scan, above which it tells no time offset."""
_MOST_DRIFT = 1e-3
"""Clocks of quartz drift by 1e-4 at most."""
_NEAR_THE_END = 0.1
"""Share of the scans whose first return comes before the start of the sweep that is taken: stamps jitter, and
the first return is missing in others."""
_ON_ARRIVAL = 0.7
"""Messages that arrive within this share of a sweep after their stamp have not the stamp of its start."""
_SIGNIFICANT = 3.0


@dataclass(frozen=True, eq=False)
class ScanTimes:
    """Times of a scan's points as they are stored.

    Attributes:
        stamp_ns: of the scan.
        values: (n,) in some unit; of points that are used.
        received_ns: when the recorder got the scan, where that is known apart from the stamp.
    """

    stamp_ns: int
    values: NDArray[Any]
    received_ns: int | None = None

    def are_far(self) -> bool:
        """Whether no unit brings any of them to within FARTHEST_S of the stamp."""
        seconds = seconds_after_stamp(self.values, self.stamp_ns)
        return seconds is not None and not bool((np.abs(seconds) <= FARTHEST_S).any())

    def unit_ns(self) -> int:
        """Unit by which the scan lasts as long as a scan does; 0 where none is."""
        if tells_nothing(self.values):
            return 0
        _, ends = counted(self.values)
        return next((unit for unit in units_ns(self.values) if lasts_a_scan(_seconds(ends, unit))), 0)

    def ends_ns(self, unit_ns: int) -> tuple[int, int]:
        """The first and the last time, by the clock of the points."""
        first, last = (_nanoseconds(end, unit_ns) for end in counted(self.values)[1].tolist())
        return first, last


@dataclass(frozen=True)
class PointClock:
    """The clock of the points' times.

    Attributes:
        unit_ns: in which it counts [ns].
        since_ns: a stamp.
        reads_ns: what the clock reads at that stamp [ns].
        drift: seconds that it gains a second.
        sweep_stamp: the instant of a sweep that a scan's stamp counts as.
    """

    unit_ns: int
    since_ns: int
    reads_ns: int
    drift: float = 0.0
    sweep_stamp: SweepStamp = "start"

    def at(self, stamp_ns: int) -> int:
        """What it reads at a stamp [ns]."""
        passed_ns = stamp_ns - self.since_ns
        return self.reads_ns + passed_ns + round(self.drift * passed_ns)


def seconds_after_stamp(
    values: NDArray[Any], stamp_ns: int, clock: PointClock | None = None
) -> NDArray[np.float64] | None:
    """Times (n,) of points after their scan's stamp [s]; None where they tell nothing. Without a clock they
    are as :func:`~sst_graph.data.point_times.seconds.likely_seconds` reads them."""
    if clock is None or tells_nothing(values):
        return likely_seconds(values, stamp_ns)
    return np.asarray(read_as(counted(values)[0], clock.unit_ns, clock.at(stamp_ns)))


def clock_of_points(
    read: Callable[[int], ScanTimes | None], count: int, options: SourceOptions
) -> tuple[PointClock | None, str]:
    """The clock of a drive's points, where it is another one than that of the stamps, and a sentence on it;
    without a clock, on why it is not known; empty where the times are of the stamps' clock.

    Single scans do not make it another clock: most have to be far from their stamps.

    Which instant a stamp names is a convention that no data show for certain: where scans are received within
    0.7 of a sweep after their stamps (median), these are those of the ends. Otherwise they are of the starts.

    Args:
        read: times of scan k; None where it has none. An error of the data counts as none: whoever reads the
            scan meets it.
        count: of the scans.
        options: whether stored times are taken, and the instant that a scan's stamp names.
    """
    if options.sweep != "auto":
        return None, ""

    def spread(most: int) -> list[ScanTimes]:
        """Times of some scans over the drive."""
        found = []
        for k in evenly_spread(range(count), most):
            with suppress(DataError, MissingDependencyError):
                found.append(read(k))
        return [times for times in found if times is not None]

    looked_at = spread(_LOOKED_AT)
    if not any(times.are_far() for times in looked_at):
        return None, ""
    scans = spread(COMPARED)
    telling = sum(not tells_nothing(times.values) for times in scans)
    scans = [times for times in scans if times.are_far()]
    if 2 * len(scans) <= telling:
        return None, ""
    units = Counter(unit for times in scans if (unit := times.unit_ns()))
    unit_ns = max(units, key=lambda unit: units[unit], default=0)
    scans = [times for times in scans if times.unit_ns() == unit_ns]
    if not unit_ns or len(scans) < FEWEST:
        return None, f"{OTHER_CLOCK}; {count_of(len(scans), 'scan')} cannot tell the difference"
    return _clock(scans, unit_ns, options.sweep_stamp)


OTHER_CLOCK = "times of the points are of another clock than the stamps"


def _clock(scans: Sequence[ScanTimes], unit_ns: int, stamp: SweepStamp) -> tuple[PointClock | None, str]:
    since_ns = scans[0].stamp_ns
    ends_ns = [times.ends_ns(unit_ns) for times in scans]
    passed = np.array([(times.stamp_ns - since_ns) * 1e-9 for times in scans])
    base_ns = ends_ns[0][0] - since_ns
    firsts, lasts = (
        np.array([(end - times.stamp_ns - base_ns) * 1e-9 for times, end in zip(scans, ends, strict=True)])
        for ends in zip(*ends_ns, strict=True)
    )
    # Returns are missing at one end of the sweeps or at the other: the steadier one tells drift and jitter.
    drift, jitter_s = min((_drift(passed, ahead) for ahead in (firsts, lasts)), key=lambda found: found[1])
    if abs(drift) > _MOST_DRIFT:
        return None, f"{OTHER_CLOCK}, which runs {1.0 + drift:.4g} times as fast"
    if jitter_s > MOST_JITTER_S:
        return None, f"{OTHER_CLOCK}, whose difference varies by {1e3 * jitter_s:.1f} ms from scan to scan"
    named = stamp if stamp != "forward" else _named_instant(scans, float(np.median(lasts - firsts)))
    level = float(np.quantile(firsts - drift * passed, _NEAR_THE_END))
    if named == "end":
        level = float(np.quantile(lasts - drift * passed, 1.0 - _NEAR_THE_END))
    clock = PointClock(unit_ns, since_ns, since_ns + base_ns + round(level * 1e9), drift, named)
    ahead_s = (clock.reads_ns - since_ns) * 1e-9
    facts = f"{abs(ahead_s):.3f} s {'ahead of' if ahead_s > 0.0 else 'behind'} them"
    facts += f", drift {1e6 * drift:.1f} ppm" if drift else ""
    facts += f", jitter {1e3 * jitter_s:.1f} ms"
    convention = f"a stamp counts as the {named} of its sweep (--sweep-stamp start or end)"
    return clock, f"{OTHER_CLOCK} ({facts}) and are used by their difference; {convention}"


def _drift(passed: FloatArray, ahead: FloatArray) -> tuple[float, float]:
    """Slope of ``ahead`` (n,) [s] over ``passed`` (n,) [s], 0 where it is none for certain, and the standard
    deviation about it [s]; by medians (Theil, Sen)."""
    one, other = np.triu_indices(len(passed), 1)
    slope = float(np.median((ahead[other] - ahead[one]) / (passed[other] - passed[one])))
    jitter_s = robust_spread(ahead - slope * passed)
    sigma = jitter_s / (float(np.std(passed)) * np.sqrt(len(passed)))
    if abs(slope) <= max(_SIGNIFICANT * sigma, 1e-7):
        return 0.0, robust_spread(ahead)
    return slope, jitter_s


def _named_instant(scans: Sequence[ScanTimes], sweep_s: float) -> SweepStamp:
    """The instant that stamps name, by when the scans were received."""
    after_s = [
        (times.received_ns - times.stamp_ns) * 1e-9 for times in scans if times.received_ns is not None
    ]
    return "end" if after_s and 0.0 <= float(np.median(after_s)) < _ON_ARRIVAL * sweep_s else "start"


def _seconds(ends: NDArray[Any], unit_ns: int) -> float:
    return float(ends[-1] - ends[0]) * unit_ns * 1e-9


def _nanoseconds(value: int | float, unit_ns: int) -> int:
    """Exactly, of whole numbers."""
    whole = int(value)
    return whole * unit_ns + round((value - whole) * unit_ns)

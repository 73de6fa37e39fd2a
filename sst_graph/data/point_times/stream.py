"""The clock of points in a stream of scans, whose end nobody knows."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sst_graph.data.point_times.clock import (
    COMPARED,
    FEWEST,
    MOST_JITTER_S,
    OTHER_CLOCK,
    PointClock,
    ScanTimes,
    clock_of_points,
)
from sst_graph.data.point_times.seconds import counted, tells_nothing
from sst_graph.data.source import SourceOptions
from sst_graph.sweep_timing import SweepStamp

_ENOUGH = 10
"""Scans, a second of them, from which on the difference is as steady as over many: their jitter is below 5
ms, and a quantile of ten of them is good to 2 ms."""
_SWAPPED_NS = 1_000_000_000
"""Messages arrive out of order, or twice, by less than this; stamps farther back are of a clock that was set
back, as where a bag begins again."""
_STEP_S, _STEPPED = 5.0 * MOST_JITTER_S, 3
"""Where so many scans in a row differ by more from those before, in their first and in their last points, one
of the clocks was set."""


class StreamClock:
    """The clock of the points by the latest scans, estimated again with each of them: over a few seconds no
    clock drifts by more than it can be read.

    Attributes:
        clock: None where the times are of the stamps' clock, or the difference is not known (yet).
        words: a sentence on a clock that is another one; empty where it is none.
        scans: how many were taken.
    """

    def __init__(self, stamp: SweepStamp = "forward") -> None:
        """stamp: the instant of a sweep that scans' stamps name; with ``forward`` it is found once."""
        self.clock: PointClock | None = None
        self.words = ""
        self.scans = 0
        self._stamp = stamp
        self._latest: deque[ScanTimes] = deque(maxlen=COMPARED)

    @property
    def undecided(self) -> bool:
        """Whether more scans are of use: few have told which clock it is, or it is another one."""
        return bool(self.words) or (len(self._latest) < FEWEST and self.scans < COMPARED)

    @property
    def waiting(self) -> str:
        """A sentence where scans should wait, for too few have told the difference; else empty."""
        if not self.words or self.clock is not None or len(self._latest) >= _ENOUGH:
            return ""
        return f"{OTHER_CLOCK}: {len(self._latest)} of {_ENOUGH} scans have told the difference yet"

    def add(self, stamp_ns: int, values: NDArray[Any] | None, received_ns: int) -> None:
        """Take the times of one more scan.

        Args:
            stamp_ns: of the scan.
            values: (n,) times of its points as they are stored, or None.
            received_ns: when the scan came.
        """
        self.scans += 1
        if values is None or tells_nothing(values):
            return
        if self._latest and stamp_ns <= self._latest[-1].stamp_ns:
            if self._latest[-1].stamp_ns - stamp_ns < _SWAPPED_NS:
                return
            self._latest.clear()  # Where both clocks were set back, what is known of them holds.
        self._latest.append(ScanTimes(stamp_ns, counted(values)[1], received_ns))
        if self._has_stepped():
            self.clock, self._latest = None, deque(list(self._latest)[-_STEPPED:], COMPARED)
            return
        if self.clock is not None and len(self._latest) < _ENOUGH:
            return
        options = SourceOptions(sweep_stamp=self._stamp)
        clock, self.words = clock_of_points(self._latest.__getitem__, len(self._latest), options)
        self.clock = clock if len(self._latest) >= _ENOUGH else None
        if self.clock is not None:
            self._stamp = self.clock.sweep_stamp

    def _has_stepped(self) -> bool:
        """Whether the latest scans agree on another difference than those before."""
        clock, scans = self.clock, list(self._latest)
        if clock is None or len(scans) < 2 * _STEPPED:
            return False
        ends_ns = [
            [end - clock.at(times.stamp_ns) for end in times.ends_ns(clock.unit_ns)] for times in scans
        ]
        away = 1e-9 * np.array(ends_ns, np.float64)
        moved = away[-_STEPPED:] - np.median(away[:-_STEPPED], axis=0)
        return bool((moved > _STEP_S).all() or (moved < -_STEP_S).all())

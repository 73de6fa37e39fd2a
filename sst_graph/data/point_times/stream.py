"""The clock of points in a stream of scans, whose end nobody knows."""

from __future__ import annotations

from collections import deque
from typing import Any

from numpy.typing import NDArray

from sst_graph.data.point_times.clock import COMPARED, OTHER_CLOCK, PointClock, ScanTimes, clock_of_points
from sst_graph.data.point_times.seconds import counted, tells_nothing
from sst_graph.data.source import SourceOptions
from sst_graph.sweep_timing import SweepStamp

_ENOUGH = 10
"""Scans, a second of them, from which on the difference is as steady as over many: their jitter is below 5
ms, and a quantile of ten of them is good to 2 ms."""


class StreamClock:
    """The clock of the points by the latest scans, estimated again with each of them: over a few seconds no
    clock drifts by more than it can be read.

    Attributes:
        clock: None where the times are of the stamps' clock, or the difference is not known (yet).
        words: a sentence on a clock that is another one; empty where it is none.
    """

    def __init__(self, stamp: SweepStamp = "forward") -> None:
        """stamp: the instant of a sweep that scans' stamps name; with ``forward`` it is found once."""
        self.clock: PointClock | None = None
        self.words = ""
        self._stamp = stamp
        self._latest: deque[ScanTimes] = deque(maxlen=COMPARED)

    @property
    def unsettled(self) -> str:
        """A sentence where too few scans have told the difference yet; empty where scans can be read."""
        if not self.words or len(self._latest) >= _ENOUGH:
            return ""
        return f"{OTHER_CLOCK}: {len(self._latest)} of {_ENOUGH} scans have told the difference yet"

    def add(self, stamp_ns: int, values: NDArray[Any] | None, received_ns: int) -> None:
        """Take the times of one more scan.

        Args:
            stamp_ns: of the scan.
            values: (n,) times of its points as they are stored, or None.
            received_ns: when the scan came.
        """
        if values is None or tells_nothing(values):
            return
        if self._latest and stamp_ns <= self._latest[-1].stamp_ns:
            self._latest.clear()  # A clock that was set back: what it said before holds until enough came.
        self._latest.append(ScanTimes(stamp_ns, counted(values)[1], received_ns))
        if self.clock is not None and len(self._latest) < _ENOUGH:
            return
        options = SourceOptions(sweep_stamp=self._stamp)
        self.clock, self.words = clock_of_points(self._latest.__getitem__, len(self._latest), options)
        if self.clock is not None and len(self._latest) >= _ENOUGH:
            self._stamp = self.clock.named

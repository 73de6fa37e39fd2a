"""Information that the tracker gained with each scan."""

from __future__ import annotations

from collections import deque

import numpy as np

from sst_graph.inspect.gained import Gain, Gained, bits_between
from sst_graph.result import FrameId
from sst_graph.types import FloatArray

MOST = 2000
"""Latest scans that are kept."""


class InformationLog:
    """Covariance after each scan that was used.

    Attributes:
        rows: (9,) each: number of the frame, bits gained (NaN for the first after a start), sigmas after it.
    """

    def __init__(self) -> None:
        self.rows: deque[FloatArray] = deque(maxlen=MOST)
        self._last: FloatArray | None = None

    def restart(self) -> None:
        """A new calibration begins; the information of its first scan is not known."""
        self._last = None

    def add(self, frame: int, covariance: FloatArray) -> None:
        """The scan of a frame was used; the covariance after it (7, 7)."""
        bits = np.nan if self._last is None else bits_between(self._last, covariance)
        self.rows.append(np.array([frame, bits, *np.sqrt(np.diag(covariance))]))
        self._last = covariance.copy()

    def gained(self, drive: str) -> Gained:
        """As a result keeps it."""
        gains = (
            Gain(FrameId(drive, int(row[0])), None if np.isnan(row[1]) else float(row[1]), row[2:])
            for row in self.rows
        )
        return Gained("as they came", tuple(gains))

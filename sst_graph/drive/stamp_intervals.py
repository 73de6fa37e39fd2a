"""Jumps of the sensors' stamps against their own frame interval, whatever is in view.

A camera and a LiDAR run at steady rates. Where stamps were regular, one interval is odd, and those after it
are regular again, all later stamps are off by as much: the clock behind them has jumped, or the sensor has
paused for part of a period. Labels show which of the two, once objects are seen under motion; until then the
time offset is not known. A jump by whole periods forward looks like missing frames, one back by a single
period like a doubled one: only labels show them. Where both sensors' stamps jump alike, their time offset is
what it was.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sst_graph.spread import robust_spread

_LEAST = 15
"""Regular intervals before any is odd."""
_AFTER = 2
"""Regular intervals behind an odd one that make it a jump: a stamp that is late alone comes back at once."""
_IRREGULAR = 0.05
"""Stamps whose intervals vary by more than this share of the period (one sigma) are not regular."""
_LEAST_SIGMA_S = 5e-4
_LEAST_JUMP_S = 0.01
"""Smaller jumps are not reported: labels show them [s]."""
_ALIKE_S = 0.005
"""Two sensors whose jumps differ by less than this share a clock [s]."""
_TOGETHER = 3
"""Scans within which the other sensor has to jump, too."""
_GAP = 5.0
"""After a gap of more periods than this the sensor may have restarted, out of phase with itself."""

Place = tuple[int, int]
"""Numbers that the next image and the next scan have in the window."""


@dataclass(frozen=True)
class Jump:
    """A jump of one sensor's stamps.

    Attributes:
        sensor: "image" or "scan".
        place: where it begins.
        seconds: by how much stamps are later than the intervals before predict, but for whole periods [s].
        chi2: its square over the variance of an interval.
    """

    sensor: str
    place: Place
    seconds: float
    chi2: float

    @property
    def time_offset_s(self) -> float:
        """By how much the time offset changes where the clock was set [s]."""
        return self.seconds if self.sensor == "scan" else -self.seconds

    @property
    def sentence(self) -> str:
        return f"the {self.sensor} stamps jumped by {1e3 * self.seconds:+.0f} ms against their own interval"


class FrameIntervals:
    """Intervals of one sensor's stamps.

    Attributes:
        sensor: its name.
        intervals: the latest regular ones [s].
    """

    def __init__(self, sensor: str) -> None:
        self.sensor = sensor
        self.intervals: deque[float] = deque(maxlen=60)
        self._latest: deque[int] = deque(maxlen=8)
        self._odd: list[float] = []
        self._again: list[int] = []
        self._from: Place = (0, 0)

    def add(self, stamp_ns: int, place: Place, chi2: float) -> Jump | None:
        """A further stamp; the jump that it makes certain, if any.

        Args:
            place: where it comes.
            chi2: a square beyond it, over the variance of an interval, is a jump.
        """
        newest = max(self._latest, default=stamp_ns)
        seconds = 1e-9 * (stamp_ns - newest)
        period, sigma = self._usual() if len(self.intervals) >= _LEAST else (0.0, np.inf)
        steady = sigma < _IRREGULAR * period
        least = max(float(np.sqrt(chi2)) * sigma, _LEAST_JUMP_S)
        if steady and (back := self._gone_back(stamp_ns, newest, place, period, least)) is not None:
            return back
        if seconds > 0.0 or not self._latest:  # else one that comes late
            self._latest.append(stamp_ns)
        if seconds <= 0.0 or (steady and seconds > _GAP * period):
            return None
        if not steady:
            self.intervals.append(seconds)
            return None
        # By how much the stamp is off its interval; frames may be missing.
        off = seconds - max(1, round(seconds / period)) * period
        if self._odd:
            self._odd.append(off)
            return self._jump_of(least, sigma) if len(self._odd) > _AFTER else None
        if abs(off) > least:
            self._odd, self._from = [off], place
        else:
            self.intervals.append(period + off)
        return None

    def set_clock(self, first_ns: int, stamp_ns: int, place: Place) -> Jump | None:
        """The clock was set, as stamps from the first on show; the jump, where the period is known.

        Args:
            stamp_ns: the newest of them.
            place: where it comes.
        """
        newest = max(self._latest, default=first_ns)
        self._odd, self._again = [], []
        self._latest.clear()
        self._latest.append(stamp_ns)
        if len(self.intervals) < _LEAST:
            return None
        period, sigma = self._usual()
        seconds = 1e-9 * (first_ns - newest) - period
        return Jump(self.sensor, place, seconds, (seconds / sigma) ** 2)

    def _usual(self) -> tuple[float, float]:
        """Period, and the deviation of an interval from it [s]."""
        intervals = np.array(self.intervals)
        period = float(np.median(intervals))
        return period, max(robust_spread(intervals), _LEAST_SIGMA_S)

    def _jump_of(self, least: float, sigma: float) -> Jump | None:
        """The jump that an odd interval and those behind it make, if any."""
        odd, self._odd = self._odd, []
        seconds = sum(odd)
        if abs(seconds) > least and max(abs(off) for off in odd[1:]) < 0.5 * least:
            return Jump(self.sensor, self._from, seconds, (seconds / sigma) ** 2)
        # Out of phase for a while, or at another rate from now on.
        self.intervals.extend(float(np.median(self.intervals)) + off for off in odd)
        return None

    def _gone_back(
        self, stamp_ns: int, newest: int, place: Place, period: float, least: float
    ) -> Jump | None:
        """A jump to before the newest stamp: twice in a row one comes where there is one, or out of phase.

        Images that come late are neither.
        """
        seconds = 1e-9 * (stamp_ns - newest)
        nearest = 1e-9 * min((abs(stamp_ns - other) for other in self._latest), default=0)
        in_phase = abs(seconds - round(seconds / period) * period) < least
        if seconds > 0.3 * period or (nearest > 0.3 * period and in_phase):
            self._again = []
            return None
        if not self._again:
            self._from = place
        self._again.append(stamp_ns)
        if len(self._again) < _AFTER:
            return None
        seconds = 1e-9 * (self._again[0] - newest) - period
        self._again, self._odd = [], []
        self._latest.clear()
        self._latest.append(stamp_ns)
        return Jump(self.sensor, self._from, seconds, (seconds / self._usual()[1]) ** 2)


JUMP_CHI2 = 25.0
"""A square beyond this, over the variance of an interval, is a jump: five sigmas."""


class StampMonitor:
    """Intervals of camera and LiDAR, and which of their jumps change the time offset between them."""

    def __init__(self, chi2: float = JUMP_CHI2) -> None:
        """chi2: a square beyond it, over the variance of an interval, is a jump."""
        self.chi2 = chi2
        self.images, self.scans = FrameIntervals("image"), FrameIntervals("scan")
        self._jump: Jump | None = None
        self._waited = 0

    def add_image(self, stamp_ns: int, place: Place) -> None:
        """An image's stamp, as it comes."""
        self._add(self.images.add(stamp_ns, place, self.chi2))

    def set_image_clock(self, first_ns: int, stamp_ns: int, place: Place) -> None:
        """The camera's clock was set, as stamps from the first to this one show."""
        self._add(self.images.set_clock(first_ns, stamp_ns, place))

    def add_scan(self, stamp_ns: int, place: Place) -> Jump | None:
        """A scan's stamp; a jump that changes the offset, once it is certain."""
        self._waited += 1
        self._add(self.scans.add(stamp_ns, place, self.chi2))
        if self._jump is None or self._waited < _TOGETHER:
            return None
        jump, self._jump = self._jump, None
        return jump

    def _add(self, jump: Jump | None) -> None:
        if jump is None:
            return
        other = self._jump
        if other is not None and other.sensor != jump.sensor and abs(other.seconds - jump.seconds) < _ALIKE_S:
            self._jump = None
        else:
            self._jump, self._waited = jump, 0


def jumps_of(image_stamps_ns: Sequence[int], scan_stamps_ns: Sequence[int]) -> list[Jump]:
    """The jumps of a whole drive's rising stamps that change the offset between camera and LiDAR."""
    monitor, found, images = StampMonitor(), [], 0
    for scan, stamp_ns in enumerate(scan_stamps_ns):
        while images < len(image_stamps_ns) and image_stamps_ns[images] <= stamp_ns:
            monitor.add_image(image_stamps_ns[images], (images, scan))
            images += 1
        jump = monitor.add_scan(stamp_ns, (images, scan))
        found += [] if jump is None else [jump]
    return found

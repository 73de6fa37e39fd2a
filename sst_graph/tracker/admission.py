"""Which stamps the tracker refuses, and why."""

from __future__ import annotations

from collections import deque
from typing import Any

from sst_graph.errors import DataError
from sst_graph.tracker.window.window import Window
from sst_graph.types import CameraImage

_CLOSEST_NS = 1_000_000
"""Scans that are nearer to each other are one; no LiDAR turns a thousand times a second [ns]."""
_FARTHEST_NS = 86_400 * 10**9
"""A stamp that is farther ahead of the one before is an error, not a pause: a day [ns]."""
_ELSEWHERE = 5
"""Stamps in a row, rising but far from those before, that show that the clock was set."""


class StampOrder:
    """Whether a sensor's stamps go on from those before.

    A single stamp that is out of order, or a day ahead, is refused; several in a row mean that the clock was
    set, else every later frame would be refused.

    Attributes:
        newest_ns: latest stamp that was used; None before the first.
    """

    def __init__(self, sensor: str, may_be_late: bool) -> None:
        """may_be_late: stamps before the newest are allowed."""
        self.sensor, self.may_be_late = sensor, may_be_late
        self.newest_ns: int | None = None
        self._elsewhere: deque[int] = deque(maxlen=_ELSEWHERE)

    def __getstate__(self) -> dict[str, Any]:
        """All but the stamps that were refused."""
        return {**vars(self), "_elsewhere": deque(maxlen=_ELSEWHERE)}

    def check(self, stamp_ns: int) -> int:
        """Whether a stamp may be used; nothing but a refusal is remembered.

        Returns:
            0, or by how much the clock was set [ns].

        Raises:
            DataError: it is out of place; those after it may show that the clock was set.
        """
        newest, elsewhere = self.newest_ns, self._elsewhere
        if newest is None or self._follows(stamp_ns, newest):
            return 0
        if elsewhere and not self._follows(stamp_ns, elsewhere[-1]):
            elsewhere.clear()
        elsewhere.append(stamp_ns)
        if len(elsewhere) < _ELSEWHERE:
            found = f"a stamp of {stamp_ns} ns"
            raise DataError(self.sensor, found, f"one after {newest} ns, by a day at most")
        return stamp_ns - newest

    def add(self, stamp_ns: int, restarted: bool) -> None:
        """A stamp was used; ``restarted``: the stamps go on from there."""
        newest = self.newest_ns
        self.newest_ns = stamp_ns if restarted or newest is None else max(newest, stamp_ns)
        self._elsewhere.clear()

    def _follows(self, stamp_ns: int, before_ns: int) -> bool:
        step = stamp_ns - before_ns
        return step <= _FARTHEST_NS and (self.may_be_late or step >= _CLOSEST_NS)


def check_lateness(image: CameraImage, window: Window, time_offset_s: float, late_s: float) -> None:
    """An image that is not far behind the newest scan in true time.

    Raises:
        DataError: it is.
    """
    newest = window.last_stamp_ns
    if newest is None or not window.images:
        return
    late = (newest - image.stamp_ns) * 1e-9 - time_offset_s
    if late > late_s and image.stamp_ns < window.images[-1].stamp_ns:
        raise DataError("image", f"one {late:.2f} s behind the newest scan", f"at most {late_s:g} s")

"""Messages of several sensors put in the order of their stamps."""

from __future__ import annotations

import bisect
from dataclasses import dataclass, field
from typing import Any

_SET_BACK_NS = 1_000_000_000
"""Stamps so far behind those that are due are of a clock that was set back, as where a bag begins again."""


@dataclass(frozen=True, order=True)
class Waiting:
    """A message that waits: by stamp [ns], then the image before the scan, then as it came.

    Before all that by ``setting``, the number of times that the clock was set back.
    """

    setting: int
    stamp_ns: int
    is_scan: bool
    number: int
    content: Any = field(compare=False)


class StampQueue:
    """Holds messages until later ones are there, and gives them back in the order of their stamps.

    Attributes:
        dropped: messages that were given up because too many waited.
    """

    def __init__(self, hold_s: float, most: int) -> None:
        self._hold_ns, self._most = round(1e9 * hold_s), most
        self._waiting: list[Waiting] = []
        self._count = self._setting = 0
        self._newest_ns: int | None = None
        self.dropped = 0

    def __len__(self) -> int:
        return len(self._waiting)

    def add(self, stamp_ns: int, is_scan: bool, content: Any) -> None:
        """Put a message in its place."""
        newest_ns = stamp_ns if self._newest_ns is None else self._newest_ns
        if stamp_ns < newest_ns - self._hold_ns - _SET_BACK_NS:
            self._setting += 1
            newest_ns = stamp_ns
        self._newest_ns = max(newest_ns, stamp_ns)
        bisect.insort(self._waiting, Waiting(self._setting, stamp_ns, is_scan, self._count, content))
        self._count += 1

    def peek(self) -> tuple[Waiting, ...]:
        """All that waits, the oldest first."""
        return tuple(self._waiting)

    def drop(self, one: Waiting) -> None:
        """Give up a message."""
        self._waiting.remove(one)
        self.dropped += 1

    def drop_oldest(self) -> None:
        """Give up the oldest where too many wait."""
        while len(self._waiting) > self._most:
            self._waiting.pop(0)
            self.dropped += 1

    def due(self, at_end: bool) -> list[Waiting]:
        """Messages that have waited long enough by the newest stamp, or are too many; all ``at_end``.

        Where the clock was set back, those of before have.
        """
        due = 0
        if self._newest_ns is not None and self._waiting:
            until_ns = self._newest_ns - self._hold_ns
            due = sum(one.setting < self._setting or one.stamp_ns <= until_ns for one in self._waiting)
        due = len(self._waiting) if at_end else max(due, len(self._waiting) - self._most)
        ready, self._waiting = self._waiting[:due], self._waiting[due:]
        # A clock that was set back by less goes on from there.
        if at_end or not self._waiting:
            self._newest_ns = ready[-1].stamp_ns if ready else self._newest_ns
        return ready

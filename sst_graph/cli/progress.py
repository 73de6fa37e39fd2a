"""Progress of long work on stderr: a bar where a person watches, plain lines where it goes to a file."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sized
from functools import partial
from types import TracebackType
from typing import TypeVar

from tqdm import tqdm

from sst_graph.cli.messages import complain, loudness

T = TypeVar("T")
ProgressStage = Callable[[int, int], None]
"""Called with (steps done, steps in all) of one stage."""

FIRST_S, EVERY_S = 2.0, 10.0
"""Work that takes longer than the first has a line, and another each time the second has gone by [s]."""

PREFIX = "progress: "
"""Begins every plain line, behind the program's name."""


class ProgressBar:
    """Callable ``(stage, done, total)`` that shows how far each stage is."""

    def __init__(self) -> None:
        self._bar: tqdm | None = None
        self._stage, self._total = "", 0
        began_s = time.monotonic() if loudness.began_s is None else loudness.began_s
        self._next_line_s = began_s + FIRST_S

    def __enter__(self) -> ProgressBar:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._close()

    def __call__(self, stage: str, done: int, total: int) -> None:
        """``done`` of ``total`` steps of ``stage`` are behind us; of one step, which may be told again while
        it goes on, the time is shown."""
        if self._bar is None or stage != self._stage or total != self._total:
            self._close()
            self._stage, self._total = stage, total
            hidden = True if loudness.quiet else None  # None: hidden where stderr is no terminal
            self._bar = tqdm(
                total=total,
                desc=stage,
                file=sys.stderr,
                disable=hidden,
                leave=False,
                bar_format="{desc} [{elapsed}]" if total == 1 else None,
            )
        if self._bar.disable:
            self._say_line(done)
        else:
            self._bar.update(done - self._bar.n)

    def stage(self, name: str) -> ProgressStage:
        """What shows the progress of one stage."""
        return partial(self, name)

    def _say_line(self, done: int) -> None:
        now_s = time.monotonic()
        if loudness.lines and not loudness.quiet and now_s >= self._next_line_s and self._total:
            self._next_line_s = now_s + EVERY_S
            share = round(100.0 * done / self._total)
            counted = f": {done} of {self._total} ({share} %)" if done or self._total > 1 else ""
            complain(f"{PREFIX}{self._stage}{counted}")

    def _close(self) -> None:
        if self._bar is not None:
            self._bar.close()
            self._bar = None


def counted(items: Iterable[T], sized: Sized, stage: ProgressStage) -> Iterator[T]:
    """The items, each counted when the next one is asked for.

    Args:
        sized: tells their number.
    """
    for done, item in enumerate(items, 1):
        yield item
        stage(done, len(sized))

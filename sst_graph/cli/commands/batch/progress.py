"""Where a batch stands, on stderr."""

from __future__ import annotations

import sys
import time

from tqdm import tqdm

from sst_graph.cli.messages import complain
from sst_graph.errors import count_of
from sst_graph.fleet import Progress
from sst_graph.fleet.attempt import RECORDS
from sst_graph.inspect.reasons import MOST_LETTERS, cut

_LINE_EVERY_S = 30.0
"""Between lines of progress where no person watches."""


class ProgressOnStderr:
    """Progress on stderr: a bar where a person watches, else a line now and then."""

    def __init__(self) -> None:
        self._bar: tqdm | None = None
        self._said: float | None = None

    def __enter__(self) -> ProgressOnStderr:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def __call__(self, progress: Progress) -> None:
        """Show where the batch stands; name a drive that failed."""
        if sys.stderr.isatty():
            if self._bar is None and progress.changed:
                complain(first_line(progress))
            self._draw(progress)
        elif self._said is None or time.monotonic() - self._said > _LINE_EVERY_S:
            begun = self._said is None
            self._said = time.monotonic()
            complain(first_line(progress) if begun else progress_line(progress))
        if progress.last is not None and not progress.last.has_result:
            if self._bar is not None:
                self._bar.clear()
            last = progress.last
            complain(f"{last.drive}: {last.status}: {on_terminal(last.drive, last.reason)}")

    def _draw(self, progress: Progress) -> None:
        if self._bar is None:
            self._bar = tqdm(
                total=progress.total, initial=progress.earlier, desc="drives", file=sys.stderr, leave=False
            )
        self._bar.set_postfix_str(f"{progress.without_result} without result", refresh=False)
        self._bar.update(progress.done - self._bar.n)

    def close(self) -> None:
        """Take the bar away."""
        if self._bar is not None:
            self._bar.close()
            self._bar = None


def on_terminal(drive: str, reason: str) -> str:
    """Why a drive has no result, in two lines of a terminal: of a long reason what was found, and where all
    of it stands."""
    if len(reason) <= MOST_LETTERS:
        return reason
    return f"{cut(reason.split(', expected ')[0], MOST_LETTERS)} (more in {RECORDS}/{drive}.json)"


def first_line(progress: Progress) -> str:
    """What there is to do, in words."""
    earlier = f", {progress.earlier} of them done by an earlier run" if progress.earlier else ""
    again = f", {progress.changed} run again, for their files have changed" if progress.changed else ""
    return f"{count_of(progress.total, 'drive')}{earlier}{again}"


def progress_line(progress: Progress) -> str:
    """Where a batch stands, in words."""
    left = "" if progress.left_s is None else f", {_duration(progress.left_s)} left"
    failed = f", {progress.without_result} without result" if progress.without_result else ""
    rate = "" if progress.left_s is None else f", {progress.per_hour:.0f} an hour"
    return f"{progress.done} of {count_of(progress.total, 'drive')}{failed}{rate}{left}"


def _duration(seconds: float) -> str:
    if seconds < 90.0:
        return f"{seconds:.0f} s"
    minutes = seconds / 60.0
    return f"{minutes:.0f} min" if minutes < 90.0 else f"{minutes / 60.0:.1f} h"

"""Progress of long work: a bar on stderr where a person watches, nothing elsewhere."""

from __future__ import annotations

import sys
from types import TracebackType

from tqdm import tqdm


class ProgressBar:
    """Callable ``(stage, done, total)`` that shows one bar a stage on a terminal."""

    def __init__(self) -> None:
        self._bar: tqdm | None = None
        self._stage = ""

    def __enter__(self) -> ProgressBar:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._close()

    def __call__(self, stage: str, done: int, total: int) -> None:
        """``done`` of ``total`` steps of ``stage`` are behind us."""
        if self._bar is None or stage != self._stage or total != self._bar.total:
            self._close()
            self._stage = stage
            self._bar = tqdm(total=total, desc=stage, file=sys.stderr, disable=None, leave=False)
        self._bar.update(done - self._bar.n)

    def stage(self, name: str) -> ProgressStage:
        """Callable ``(done, total)`` for one stage."""
        return ProgressStage(self, name)

    def _close(self) -> None:
        if self._bar is not None:
            self._bar.close()
            self._bar = None


class ProgressStage:
    """Callable ``(done, total)`` that shows the progress of one stage."""

    def __init__(self, bar: ProgressBar, name: str) -> None:
        self._bar, self._name = bar, name

    def __call__(self, done: int, total: int) -> None:
        self._bar(self._name, done, total)

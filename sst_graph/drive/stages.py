"""Stages of long work that have no count of their own, told as progress."""

from __future__ import annotations

from typing import TypeVar

from sst_graph.drive.preparation import Progress
from sst_graph.stepwise import Stepwise

_T = TypeVar("_T")


def begin(progress: Progress | None, stage: str) -> None:
    """A stage of one step begins, or still goes on."""
    if progress is not None:
        progress(stage, 0, 1)


def under(progress: Progress | None, stage: str) -> Progress | None:
    """Progress that tells the steps of all work under the name of one stage."""
    if progress is None:
        return None
    return lambda _, done, total: progress(stage, done, total)


def run_stage(steps: Stepwise[_T], progress: Progress | None, stage: str) -> _T:
    """Do all steps of a computation whose number is not known before; its result."""
    begin(progress, stage)
    while True:
        try:
            next(steps)
        except StopIteration as stop:
            result: _T = stop.value
            return result
        begin(progress, stage)

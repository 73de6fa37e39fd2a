"""Stages of long work that have no count of their own, told as progress: one step each, which is done at the
end."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import TypeVar

from sst_graph.drive.preparation import Progress
from sst_graph.stepwise import Stepwise, run_to_end

_T = TypeVar("_T")


def begin(progress: Progress | None, name: str) -> None:
    """Tell that a stage goes on: when it begins, and at every step of it."""
    if progress is not None:
        progress(name, 0, 1)


@contextmanager
def stage(progress: Progress | None, name: str) -> Iterator[None]:
    """Tell when a stage begins and when it is done; one that an error ends is not told to be done."""
    begin(progress, name)
    yield
    if progress is not None:
        progress(name, 1, 1)


def under(progress: Progress | None, name: str) -> Progress | None:
    """Progress for work inside a stage: at every step of it the stage is told to go on, without the count."""
    return None if progress is None else lambda *_: progress(name, 0, 1)


def run_stage(steps: Stepwise[_T], progress: Progress | None, name: str) -> _T:
    """Do all steps of a computation as one stage, which is told at every step; its result."""
    with stage(progress, name):
        return run_to_end(steps, partial(begin, progress, name))

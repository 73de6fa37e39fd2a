"""Long computations in steps of bounded cost.

Such a computation is a generator: it yields after each step what the step has cost, in units of about 4 ms
on one core of 2020, and returns its answer. The cost is a count of what was done, never a time that was
taken, so that whoever does some of it with each frame does the same with the same frames.
"""

from __future__ import annotations

from collections.abc import Generator
from typing import TypeVar

_T = TypeVar("_T")
Stepwise = Generator[int, None, _T]


def whole(steps: Stepwise[_T]) -> _T:
    """The answer, all steps at once."""
    while True:
        try:
            next(steps)
        except StopIteration as stop:
            answer: _T = stop.value
            return answer

"""Long computations in steps of bounded cost.

Such a computation is a generator: it yields after each step what the step has cost, in units of about 4 ms
on one core of 2020, and returns its result. The cost is counted, not timed, so that work that is spread over
frames is the same for the same frames.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from typing import TypeVar

_T = TypeVar("_T")
Stepwise = Generator[int, None, _T]


def run_to_end(steps: Stepwise[_T], after_step: Callable[[], None] | None = None) -> _T:
    """Do all steps; the result of the computation.

    Args:
        after_step: called after each of them.
    """
    while True:
        try:
            next(steps)
        except StopIteration as stop:
            result: _T = stop.value
            return result
        if after_step is not None:
            after_step()

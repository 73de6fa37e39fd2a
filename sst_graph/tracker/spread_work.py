"""Computations of which some is done with each frame."""

from __future__ import annotations

from abc import ABC, abstractmethod
from contextlib import suppress
from typing import Any, Generic, TypeVar

import numpy as np

from sst_graph.errors import SstGraphError
from sst_graph.factors.errors import FactorError
from sst_graph.stepwise import Stepwise

_T = TypeVar("_T")

NUMERICAL_ERRORS = (
    SstGraphError,
    FactorError,
    RuntimeError,
    ValueError,
    ArithmeticError,
    np.linalg.LinAlgError,
)
"""Errors that may come from the data; all others are errors of the program."""


class Run(Generic[_T]):
    """A computation that is spread over frames. A failed frame does not roll it back: its result is returned
    only once the requested work has reached the work done.
    """

    rolls_back = False

    def __init__(self, steps: Stepwise[_T]) -> None:
        self._steps = steps
        self._done = 0
        self._answer: _T | Exception | None = None

    def until(self, work: int | None) -> _T | None:
        """Its result, if it takes no more work than this in all (None: any).

        Raises:
            EstimationError: it has none; or another of :data:`NUMERICAL_ERRORS`.
        """
        while self._answer is None and (work is None or self._done < work):
            try:
                self._done += next(self._steps)
            except StopIteration as stop:
                self._answer = stop.value
            except NUMERICAL_ERRORS as error:
                self._answer = error
        if self._answer is None or (work is not None and self._done >= work):
            return None
        if isinstance(self._answer, Exception):
            raise self._answer
        return self._answer


class SpreadWork(ABC, Generic[_T]):
    """A computation that may be stored between two frames: what is stored is how much work was requested, and
    where it is read back the same steps are done again.

    Attributes:
        work: requested so far.
    """

    def __init__(self) -> None:
        self.work = 0
        self._run: Run[_T] | None = None

    @abstractmethod
    def steps(self) -> Stepwise[_T]:
        """The computation from its beginning."""

    def advance(self, work: int | None) -> _T | None:
        """Do more work (None: all that is left); the result, once it is complete.

        Raises:
            EstimationError: there is none; or another of :data:`NUMERICAL_ERRORS`.
        """
        if self._run is None:
            self._run = Run(self.steps())
        self.work += work or 0
        return self._run.until(None if work is None else self.work)

    def catch_up(self) -> None:
        """Repeat the work that it had done when it was stored."""
        with suppress(*NUMERICAL_ERRORS):
            self.advance(0)

    def __getstate__(self) -> dict[str, Any]:
        """All but the running computation, which follows from the work."""
        return {**vars(self), "_run": None}

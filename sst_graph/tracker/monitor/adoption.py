"""Adoption: a new estimate replaces the calibration in use where held-out frames agree."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import numpy as np

from sst_graph.tracker.window.gaussian import Point

_FRAMES = 10
"""Held-out frames on which the candidate and the calibration in use are compared."""
_MARGIN = 0.02
"""The candidate's held-out cost may exceed that of the one in use by this fraction."""


class Adoption:
    """The calibration in use, and when a candidate replaces it.

    Attributes:
        adopted: the calibration in use; None before the first.
        costs: of the latest held-out frames, under the candidate and under the one in use.
        margin: fraction by which the candidate's cost may exceed that of the one in use.
    """

    def __init__(self, frames: int = _FRAMES, margin: float = _MARGIN) -> None:
        """frames: held-out frames that are compared."""
        self.margin = margin
        self.adopted: Point | None = None
        self.costs: deque[tuple[float, float]] = deque(maxlen=frames)

    def restart(self) -> None:
        """Forget the comparison; the calibration in use stays until another one is adopted."""
        self.costs.clear()

    def add_held_out(
        self, cost: Callable[[Point], float | None], candidate: Point, guess: Point | None
    ) -> None:
        """Compare candidate and calibration in use on new frames, before these are used.

        Args:
            cost: of the frames at a point; None where no boundary point is in view.
            candidate: the estimate before them.
            guess: what is in use while nothing has been adopted.
        """
        in_use = self.adopted or guess
        ours = theirs = cost(candidate)
        if in_use is not None and float(np.abs(candidate.core().local(in_use.core())).max()) > 0.0:
            theirs = cost(in_use)
        self.compare(ours, theirs)

    def compare(self, candidate: float | None, in_use: float | None) -> None:
        """Held-out costs of one frame: of the candidate made before it, and of the one in use."""
        if candidate is not None and in_use is not None:
            self.costs.append((candidate, in_use))

    def propose(self, candidate: Point, trusted: bool) -> bool:
        """Adopt the candidate if it is trusted and explains held-out frames no worse; whether it was."""
        if not trusted or len(self.costs) < (self.costs.maxlen or 0):
            return False
        ours, theirs = np.mean(self.costs, axis=0)
        if ours > (1.0 + self.margin) * theirs:
            return False
        self.adopted = candidate
        return True

"""The whole window matched and solved again as the batch does, from a wide kernel to the narrowest.

At the end of a drive at once (:func:`relinearize_window`); while frames come, a little with each
(:class:`WindowRelinearization`).
"""

from __future__ import annotations

from collections.abc import Container
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sst_graph.batch.by_edges.optimum import CONVERGED_STEP
from sst_graph.batch.by_edges.solution import NEAR_KERNELS_PX
from sst_graph.batch.lower_edges import LowerEdgeSupport
from sst_graph.factors.robust import RobustKernel
from sst_graph.graph.outer_loop import NARROW_KERNELS_PX, step_share
from sst_graph.tracker.by_edges.kinds import by_edges
from sst_graph.tracker.window.gaussian import Point, inverted
from sst_graph.tracker.window.matcher import WindowMatcher
from sst_graph.tracker.window.smoother import WindowSmoother

FloatArray = NDArray[np.float64]

_CONVERGED_SIGMAS = 0.02
"""A step of matching and solving that is shorter, in standard deviations, has converged."""
_EDGE_STEP = CONVERGED_STEP / len(NEAR_KERNELS_PX)
"""(7,) the same where edges are aligned, a part of what a round of scales may move by [rad, m, s]."""
_INNER = 2
"""Steps of the optimisation on frozen matches, as in the batch: the next matches change it anyway."""
SCANS = 5
"""Scans matched with each frame while the window is matched again: more make these frames slower."""
_PASSES = 2
"""How often a running tracker matches the whole window when it relinearizes."""


@dataclass
class RelinearizationSchedule:
    """When a running tracker relinearizes its window: each time it has seen twice as many scans, and before
    scans first leave.

    An estimate from few scans moves, and their matches were made at earlier estimates.

    Attributes:
        first: number of the first scan.
        next: scans seen at the next time.
        window: length of the window.
    """

    first: int
    next: int
    window: int

    def reached(self, scan: int) -> bool:
        """Whether it is time at this scan; then the next time is set."""
        seen = scan + 1 - self.first
        if seen < self.next:
            return False
        while self.next <= seen:
            self.next = self.window if self.next < self.window < 2 * self.next else 2 * self.next
        return True


def relinearize_window(
    smoother: WindowSmoother,
    matcher: WindowMatcher,
    most: int,
    alive: Container[int],
    share: float,
    inflation: float,
) -> bool:
    """Match all scans, solve, and again under the next kernel; then under the last until it converges.

    Matches made frame by frame keep the estimate within one or two standard deviations of the batch's. Where
    some matches appear and disappear in turn, the estimate oscillates, and the steps are shortened as in the
    batch (:mod:`sst_graph.graph.outer_loop`). The steps are Gauss-Newton's; the graph takes the last matches
    only.

    Args:
        most: further steps under the last kernel.
        alive: tracks of objects that may be seen again.
        share: factor on the weights of all matches.
        inflation: how much larger the estimate's covariance is than that of independent matches.

    Returns:
        Whether it converged.

    Raises:
        EstimationError: a step or the update fails; the estimate stays.
    """
    at, converged = smoother.point, False
    kernels_px = NARROW_KERNELS_PX
    for i in range(len(kernels_px) + most):
        kernel = RobustKernel("geman_mcclure", kernels_px[min(i, len(kernels_px) - 1)])
        found, missing = matcher.match(at, None, kernel, share)
        window = smoother.window_with(found, at)
        P = inverted(window.information)
        step, m, last = P @ window.vector, at.core_size, i + 1 - len(kernels_px)
        if last >= 0 and _is_short(step[:m], inflation * P[:m, :m], matcher):
            converged = True
            break
        at = window.point.moved(step_share(last) * step)
    smoother.update(found, missing, 0, alive)
    smoother.optimize(_INNER)
    if not converged:
        smoother.point = at
    return converged


def _is_short(step: FloatArray, P: FloatArray, matcher: WindowMatcher) -> bool:
    """Whether a step of the estimate (m,) of covariance P (m, m) is so short that it has converged.

    Edges follow the pose, so that frozen matches are too sure: with them it is the batch's step.
    """
    if by_edges(matcher.classes):
        return bool((np.abs(step[:7]) < _EDGE_STEP).all())
    return bool(step @ np.linalg.solve(P, step) < _CONVERGED_SIGMAS**2)


class WindowRelinearization:
    """Relinearization of a running tracker's window, some scans with each frame. First the support of the
    lower edges is counted; then each scan is matched at the present estimate, the oldest first, in two
    passes.

    Attributes:
        support: of the lower edges so far; None when it is complete.
        passes: how often all are still to be matched.
        done: scans that were counted, or matched, in this pass.
    """

    def __init__(self, matcher: WindowMatcher) -> None:
        self._matcher = matcher
        self.passes = _PASSES
        never = matcher.config.calibration.lower_edges == "never"
        self.support = None if never else LowerEdgeSupport()
        self.done: set[int] = set()

    @property
    def ended(self) -> bool:
        """Whether all is done."""
        return self.passes == 0

    def advance(self, point: Point, fewer: int) -> list[int] | None:
        """The scans to match with this frame; None while the support of the lower edges is counted.

        Args:
            fewer: how many fewer than usual, for others are matched in their place; one at least.
        """
        numbers = [number for number, _ in self._matcher.window.scans]
        # The newest is matched as it comes.
        self.done.update(numbers[-1:])
        waiting = [number for number in numbers if number not in self.done]
        counting, support = self.support is not None, self.support
        # To count the support is to match twice.
        most = max(1, SCANS - fewer)
        some = waiting[: (most + 1) // 2 if counting else most]
        if support is not None:
            self.support = support.plus(self._matcher.lower_edge_support(point, some))
        self.done.update(some)
        if len(some) == len(waiting):
            self._next()
        return None if counting else some

    def _next(self) -> None:
        """All scans have been matched."""
        self.done.clear()
        if self.support is None:
            self.passes -= 1
        else:
            self._matcher.set_lower_edges(self.support)
            self.support = None

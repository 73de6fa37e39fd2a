"""Scans of the window that are matched again: some with each frame, or all as the batch does.

With each frame the newest is matched, and those whose matches are outdated (:func:`scans_to_match`). The
whole window is matched and solved again from a wide kernel to the narrowest: at the end of a drive at once
(:func:`relinearize_window`); while frames come, a little with each (:class:`WindowRelinearization`).
"""

from __future__ import annotations

from collections.abc import Collection, Container
from dataclasses import dataclass

import numpy as np

from sst_graph.batch.by_edges.optimum import CONVERGED_STEP, NEAR_KERNELS_PX
from sst_graph.batch.lower_edges import LowerEdgeSupport
from sst_graph.factors.robust import RobustKernel
from sst_graph.graph.outer_loop import INNER_ITERATIONS, NARROW_KERNELS_PX, step_share
from sst_graph.tracker.by_edges.kinds import by_edges
from sst_graph.tracker.window.gaussian import Point, core_steps, inverted
from sst_graph.tracker.window.matcher import WindowMatcher
from sst_graph.tracker.window.smoother import WindowSmoother
from sst_graph.types import FloatArray

_CONVERGED_SIGMAS = 0.02
"""A step of matching and solving that is shorter, in standard deviations, has converged."""
_EDGE_STEP = CONVERGED_STEP / len(NEAR_KERNELS_PX)
"""(7,) the same where edges are aligned, a part of what a round of scales may move by [rad, m, s]."""
SCANS = 5
"""Scans matched with each frame while the window is matched again: more make these frames slower."""
_PASSES = 2
"""How often a running tracker matches the whole window when it relinearizes."""
_FRESH_SIGMAS = 0.02
"""A scan is matched once more before it leaves the window if the estimate has moved farther since."""
_IN_TURN = 1
"""Scans matched again with each frame besides the newest, the most outdated first: each costs as much as the
newest."""
_MOST_IN_TURN = 4
"""Most scans matched again while the estimate moves."""
_STALE_SIGMAS = 0.3
"""Matches are outdated where the estimate has moved farther since, in standard deviations."""


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
        EstimationError: a step or the update fails; the smoother is to be rolled back.
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
    smoother.optimize(INNER_ITERATIONS)
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


def scans_to_match(
    number: int,
    matcher: WindowMatcher,
    smoother: WindowSmoother,
    entered: Collection[int],
    covariance: FloatArray,
    relinearization: WindowRelinearization | None,
) -> set[int]:
    """The newest, those still without a pair, those that leave next, and some in turn.

    Args:
        number: of the newest scan.
        entered: scans that have had a pair.
        covariance: (m, m) of the estimate, over [extrinsic, offset, biases].
        relinearization: of the whole window, where one is under way; it chooses what is matched in turn.
    """
    window = matcher.window
    numbers = [n for n, _ in window.scans]
    waiting = [n for n in numbers if n not in smoother.entries and n not in entered]
    # What cannot wait, and as many others as there is time for: those whose dynamic objects have changed,
    # then those matched farthest from the estimate.
    chosen = {number, *waiting[-4:], *(n for n in numbers[-2:] if n in smoother.entries)}
    staleness = _staleness(smoother, covariance)
    leaving = [n for n in window.leaving() if staleness.get(n, 1.0) > _FRESH_SIGMAS]
    if relinearization is not None:
        # Those that wait for a first match take the place of those in turn: a frame costs no more for them.
        turn = relinearization.advance(smoother.point, max(0, len(waiting[-4:]) - 1)) or ()
        # No stale scans beside these: the relinearization reaches all of the window, and its lower edges cost
        # as much as they would.
        return chosen | set(leaving) | (set(turn) & set(staleness))
    known = sorted(staleness, key=staleness.__getitem__, reverse=True)
    stale = sum([value > _STALE_SIGMAS for value in staleness.values()])
    some = known[: max(_IN_TURN - len(leaving), stale)]
    wanted = [*_with_changed_objects(matcher, smoother), *some]
    return chosen | set(list(dict.fromkeys([*leaving, *wanted]))[:_MOST_IN_TURN])


def _with_changed_objects(matcher: WindowMatcher, smoother: WindowSmoother) -> list[int]:
    """Scans with a pair in which other dynamic objects are left out now; the rest are forgotten."""
    window, found = matcher.window, []
    for number in sorted(window.dynamics.changed_scans & set(smoother.entries)):
        entry = smoother.entries[number]
        if matcher.left_out(entry.pair, number, smoother.point.time_offset_s) != entry.left_out:
            found.append(number)
        else:
            window.dynamics.changed_scans.discard(number)
    return found


def _staleness(smoother: WindowSmoother, covariance: FloatArray) -> dict[int, float]:
    """How far the estimate has moved since each pair was matched, in standard deviations."""
    if not smoother.entries:
        return {}
    points = [entry.linear.information.point for entry in smoother.entries.values()]
    steps = core_steps(points, smoother.point)
    squares = np.einsum("ij,ij->i", steps, np.linalg.solve(covariance, steps.T).T)
    return dict(zip(smoother.entries, np.sqrt(np.maximum(0.0, squares)).tolist(), strict=True))

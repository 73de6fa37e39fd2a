"""Selection of the scans that are matched again with a frame."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray

from sst_graph.tracker.window.gaussian import core_steps
from sst_graph.tracker.window.matcher import WindowMatcher
from sst_graph.tracker.window.relinearization import WindowRelinearization
from sst_graph.tracker.window.smoother import WindowSmoother

FloatArray = NDArray[np.float64]

_FRESH_SIGMAS = 0.02
"""A scan is matched once more before it leaves the window if the estimate has moved farther since."""

_IN_TURN = 1
"""Scans matched again with each frame besides the newest, the most outdated first: each costs as much as the
newest."""
_MOST_IN_TURN = 4
"""Most scans matched again while the estimate moves."""
_STALE_SIGMAS = 0.3
"""Matches are outdated where the estimate has moved farther since, in standard deviations."""


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
    # Those that wait for a first match take the place of those in turn: a frame costs no more for them.
    late = max(0, len(waiting[-4:]) - 1)
    turn = None if relinearization is None else relinearization.advance(smoother.point, late)
    if relinearization is not None:
        # No others: all of the window come in their turn, and the lower edges cost as much.
        return chosen | set(leaving) | (set(turn or ()) & set(staleness))
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

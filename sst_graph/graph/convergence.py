"""When an outer loop of matching and solving ends.

Each outer iteration matches again. Where some matches appear and disappear in turn, the estimate oscillates
about a point, which is the estimate that is wanted. So after some full steps the steps are shortened, and a
short step ends the loop.
"""

from __future__ import annotations

STEP_SIGMAS = 0.1
"""A step shorter than this many standard deviations of the frozen problem ends the loop: what is left is
small beside the uncertainty."""
OSCILLATION_SIGMAS = 1.5
"""The loop has converged if its last full step is shorter than this many standard deviations: an oscillation
of that width is covered by the uncertainty."""
FULL_STEPS = 6
"""Full steps at the last kernel scale before steps are shortened; a solution that does not oscillate
converges with fewer."""


def step_share(steps: int) -> float:
    """Share of the next step that is made, after so many at the last kernel scale: 1, ..., 1, 1/2, 1/3,
    ..."""
    return 1.0 / (1.0 + max(0, steps - FULL_STEPS))

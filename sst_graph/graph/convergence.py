"""When an outer loop of matching and solving ends.

Each outer iteration matches anew. Where matches come and go in turn the estimate goes round in a circle, and
the answer is its middle. So after some whole steps the steps are shortened, and a short step ends the loop.
"""

from __future__ import annotations

STEP_SIGMAS = 0.1
"""A step shorter than this many standard deviations of the frozen problem ends the loop: what is left is
small beside the uncertainty."""
CIRCLE_SIGMAS = 1.5
"""It has converged if the whole step there is shorter than this many standard deviations: a circle that wide
is covered by the uncertainty."""
FULL_STEPS = 6
"""Steps at the last kernel scale before they are shortened; without a circle, fewer are enough to
converge."""


def step_share(steps: int) -> float:
    """Share of the next step that is made, after so many at the last kernel scale: 1, ..., 1, 1/2, 1/3,
    ..."""
    return 1.0 / (1.0 + max(0, steps - FULL_STEPS))

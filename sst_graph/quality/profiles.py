"""Profile likelihood along each unknown, on frozen matches."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sst_graph.fit import Profile
from sst_graph.graph.frozen_problem import FrozenPoint, FrozenProblem

FloatArray = NDArray[np.float64]

_STEPS = (1.0, 2.0, 3.0, 4.0)
"""How far a profile goes to either side, in standard deviations."""
_FEW_STEPS = (2.0, 4.0)
"""The same of large problems, so that profiles take a few seconds at most."""
_LARGE = 20_000
"""Matches from which on a problem is large."""
REACH: FloatArray = np.array([np.radians(1.0)] * 3 + [0.5] * 3 + [0.1])
"""(7,) farthest step of a profile [rad, m, s]: beyond it, frozen matches say nothing."""


def profiles(
    frozen: FrozenProblem, optimum: FrozenPoint, sigmas: FloatArray, matches: int
) -> tuple[Profile, ...]:
    """Along the seven unknowns of a result, all other unknowns optimised again at every step.

    Args:
        optimum: of the frozen problem.
        sigmas: (7,) of the result, in which steps are counted [rad, m, s].
        matches: how many the problem has.
    """
    system = frozen.linearized(optimum)
    curvature = np.sqrt(np.diag(system.covariance()))
    counts = _STEPS if matches < _LARGE else _FEW_STEPS
    found = []
    for unknown in range(7):
        unit = min(float(sigmas[unknown]), float(REACH[unknown]) / counts[-1])
        steps, costs = [0.0], [system.cost]
        for sign in (-1.0, 1.0):
            for count in counts:
                step = sign * count * unit
                # The answer of the rest by the linear problem, then once more where that leads.
                point = frozen.moved(optimum, *system.step_along(unknown, step))
                point = frozen.moved(point, *frozen.linearized(point).step_along(unknown, 0.0))
                steps.append(step)
                costs.append(frozen.linearized(point).cost)
        order = np.argsort(steps)
        rising = np.array(costs)[order] - min(costs)
        found.append(Profile(unknown, np.array(steps)[order], rising, float(curvature[unknown])))
    return tuple(found)

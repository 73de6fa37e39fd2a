"""Solutions by edges, in steps."""

from __future__ import annotations

from collections.abc import Sequence

from sst_graph.drive.preparation import Progress
from sst_graph.graph.outer_loop import STEP_SIGMAS, JointProblem, JointSolution, solve_joint_steps
from sst_graph.graph.state import State
from sst_graph.stepwise import Stepwise

NEAR_KERNELS_PX = (3.0, 2.0, 2.0, 1.5, 1.2)
"""Scales of the kernel from the estimate [px]: wide enough to meet other edges, too narrow to leave it."""
WIDER_KERNEL_PX = (3.0,)
"""Scale of the kernel under which an estimate is solved once more [px]: where it moves, it hangs on which of
several edges nearby are met, and the step is a deviation of its covariance."""
_EDGES_WORK = 2
"""How many times the work of an outer iteration with contours one with edges of pictures is."""


def solution_steps(
    problem: JointProblem,
    start: State,
    kernels_px: Sequence[float],
    progress: Progress | None = None,
    step_sigmas: float = STEP_SIGMAS,
) -> Stepwise[JointSolution]:
    """As :func:`~sst_graph.graph.outer_loop.solve_joint_steps`, with the work of edges."""
    steps = solve_joint_steps(problem, start, kernels_px, progress, step_sigmas)
    while True:
        try:
            work = next(steps)
        except StopIteration as stop:
            solution: JointSolution = stop.value
            return solution
        yield _EDGES_WORK * work

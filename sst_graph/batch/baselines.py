"""The paper's method and the other baselines as methods of ``calibrate``."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from sst_graph.baselines.second_search import search_again
from sst_graph.baselines.sst_calib import NearestSolution, PaperProblem
from sst_graph.batch.config import CalibrationConfig
from sst_graph.batch.method_estimate import MethodEstimate
from sst_graph.drive.preparation import Drive, Progress
from sst_graph.errors import EstimationError
from sst_graph.types import Calibration, Guess


def baseline_method(
    solve: Callable[[PaperProblem, Calibration], NearestSolution],
    drives: Sequence[Drive],
    guess: Guess,
    config: CalibrationConfig,
    progress: Progress | None,
) -> MethodEstimate:
    """A baseline's solution, with reasons against it where a second search finds a better pose.

    Raises:
        EstimationError: no guess, or nothing to solve.
    """
    if guess.cTl is None:
        raise EstimationError(f"method {config.method} needs a guess to start from: it has no search")
    start = Calibration(guess.cTl, guess.time_offset_s)
    solution = solve(PaperProblem(drives, config.classes, config.paper, progress), start)
    at, step = solution.calibration, solution.remaining_step
    second = search_again(solution.frames, drives, config.classes, start, at, config.search)
    return MethodEstimate(
        cTl=at.cTl,
        time_offset_s=at.time_offset_s,
        covariance=solution.covariance + np.outer(step, step),
        frames=tuple(frame.id for frame in solution.frames),
        reasons=(*second.reasons, *_unfinished(solution, config)),
        remarks=solution.reasons,
        diagnostics={
            "covariance": "of the frozen matches, too small, and of the remaining step",
            "scores": {"start": second.start, "result": second.result, "best_nearby": second.best},
            **solution.diagnostics,
        },
    )


def _unfinished(solution: NearestSolution, config: CalibrationConfig) -> list[str]:
    """A sentence where the remaining step is larger than what counts as known."""
    rotation, translation = (
        np.linalg.norm(solution.remaining_step[:3]),
        np.linalg.norm(solution.remaining_step[3:6]),
    )
    offset, limits = abs(float(solution.remaining_step[6])), config.observability
    if (
        np.degrees(rotation) <= limits.rotation_deg
        and translation <= limits.translation_m
        and offset <= limits.time_offset_s
    ):
        return []
    return [
        f"it had not converged: as many steps again would make {np.degrees(rotation):.2f} deg, "
        f"{100 * translation:.1f} cm, {1e3 * offset:.1f} ms"
    ]

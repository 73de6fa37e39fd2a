"""The paper's method and other baselines as methods of ``calibrate``."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from sst_graph.baselines.nearest_pixel_frames import Calibration
from sst_graph.baselines.second_search import challenge
from sst_graph.baselines.semalign import solve_semalign
from sst_graph.baselines.sst_calib import NearestSolution, solve_paper, solve_static
from sst_graph.batch.answer import Answer, Guess
from sst_graph.batch.config import CalibrationConfig
from sst_graph.drive.preparation import Drive, Progress
from sst_graph.errors import EstimationError


def answer_paper(
    drives: Sequence[Drive], guess: Guess, config: CalibrationConfig, progress: Progress | None
) -> Answer:
    """SST-Calib, static and joint stage."""

    def solve(start: Calibration) -> NearestSolution:
        return solve_paper(drives, start, config.classes, config.paper, progress)

    return _judged(solve, drives, guess, config)


def answer_static(
    drives: Sequence[Drive], guess: Guess, config: CalibrationConfig, progress: Progress | None
) -> Answer:
    """SST-Calib's static stage alone."""

    def solve(start: Calibration) -> NearestSolution:
        return solve_static(drives, start, config.classes, config.paper, progress)

    return _judged(solve, drives, guess, config)


def answer_semalign(
    drives: Sequence[Drive], guess: Guess, config: CalibrationConfig, progress: Progress | None
) -> Answer:
    """SemAlign."""

    def solve(start: Calibration) -> NearestSolution:
        return solve_semalign(drives, start, config.classes, config.semalign, config.paper, progress)

    return _judged(solve, drives, guess, config)


def _judged(
    solve: Callable[[Calibration], NearestSolution],
    drives: Sequence[Drive],
    guess: Guess,
    config: CalibrationConfig,
) -> Answer:
    """The solution, with doubts where a second opinion finds better.

    Raises:
        EstimationError: no guess, or nothing to solve.
    """
    if guess.cTl is None:
        raise EstimationError(f"method {config.method} needs a guess to start from: it has no search")
    start = Calibration(guess.cTl, guess.offset_s)
    solution = solve(start)
    at = solution.calibration
    opinion = challenge(solution.frames, drives, config.classes, start, at, config.start.search)
    return Answer(
        at.cTl,
        at.offset_s,
        solution.covariance + np.outer(solution.creep, solution.creep),
        tuple(frame.id for frame in solution.frames),
        doubts=(*opinion.doubts(config.challenge), *_unfinished(solution, config)),
        remarks=solution.reasons,
        diagnostics={
            "covariance": "of the frozen matches, too sure, and of the way still to go",
            "scores": {"start": opinion.start, "answer": opinion.answer, "best_nearby": opinion.best},
            **solution.diagnostics,
        },
    )


def _unfinished(solution: NearestSolution, config: CalibrationConfig) -> list[str]:
    """A sentence where the last step, gone on with, would leave what counts as known."""
    rotation, translation = np.linalg.norm(solution.creep[:3]), np.linalg.norm(solution.creep[3:6])
    offset, limits = abs(float(solution.creep[6])), config.observability
    if (
        np.degrees(rotation) <= limits.rotation_deg
        and translation <= limits.translation_m
        and offset <= limits.offset_s
    ):
        return []
    return [
        f"the last step was still on its way: as many again would make {np.degrees(rotation):.2f} deg, "
        f"{100 * translation:.1f} cm, {1e3 * offset:.1f} ms"
    ]

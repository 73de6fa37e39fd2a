"""Reasons why a joint estimate may be wrong, and diagnostics of the run."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from sst_graph.batch.assumption_tests import estimated_report
from sst_graph.batch.lower_edges import WithLowerEdges
from sst_graph.batch.problem import CalibrationProblem, JointEstimate
from sst_graph.drive.preparation import Drive
from sst_graph.fit import MASK_BIAS, Fit, Profile, bias_entry
from sst_graph.graph.outer_loop import (
    JointSolution,
    agreement,
    concentration,
    explained,
    poor_fit,
    still_moved,
)
from sst_graph.graph.state import difference
from sst_graph.initialization.selection import ALTERNATIVE_RATIO, REACH
from sst_graph.inspect.frame_gains import frame_gains
from sst_graph.inspect.frame_information import KEY as FRAME_INFORMATION
from sst_graph.inspect.frame_information import to_document
from sst_graph.quality.profiles import profiles
from sst_graph.types import FloatArray

_FAR_SIGMAS = 6.0
"""Two estimates farther apart than this [standard deviations] contradict each other: no sampling error of a
calibrated covariance reaches so far, and a covariance that is half of what it should be still allows 3."""


def label_agreement(problem: CalibrationProblem, solution: JointSolution) -> dict[str, float]:
    """Share of the boundary points in view that meet a contour, and share of the matches that are close."""
    close = concentration(solution, problem.joint())
    return {"explained": explained(solution), "concentration": close}


def joint_reasons(
    problem: CalibrationProblem,
    solution: JointSolution,
    solutions: Sequence[JointSolution],
    covariance: FloatArray,
    labels: Mapping[str, float],
) -> tuple[str, ...]:
    """Reasons why the joint estimate may be wrong altogether.

    Args:
        solution: the estimate.
        solutions: from all starts, the one that agrees best with the labels first.
        covariance: (n, n) of extrinsic and offsets.
        labels: as :func:`label_agreement` gives them.
    """
    searched = problem.config.search.enabled
    return (
        *_moving(solution),
        *(_little_agreement(problem, covariance, labels) if searched else ()),
        *(_outside_search(problem, solution) if searched else ()),
        *_alternatives(solution, solutions, covariance),
    )


def assumed_motion(drives: Sequence[Drive]) -> tuple[str, ...]:
    """What was assumed of drives whose motion is not known."""
    if all(drive.lidar_motions for drive in drives):
        return ()
    return (
        "a single scan does not show how the vehicle moved; it was assumed to stand: at 1 m/s every 100 ms "
        "between scan and image would shift the translation by 10 cm; give its neighbours too, or, if it "
        "stood, say so (unknown_motion.speed_mps and unknown_motion.turn_deg_per_s 0)",
    )


def joint_diagnostics(
    problem: CalibrationProblem, estimate: JointEstimate, lower: WithLowerEdges
) -> dict[str, Any]:
    """JSON-able numbers about a joint estimate."""
    solution, model, drives = estimate.solution, estimate.robust.model, problem.drives
    frozen = solution.graph, solution.values, solution.pairs, solution.state
    return {
        "outer_iterations": solution.outer_iterations,
        "matches": sum(len(pair) for pair in solution.pairs),
        "pairs": len(solution.pairs),
        MASK_BIAS: bias_entry([drive.name for drive in drives], solution.state.biases_px),
        "lower_edge_concentration": {c.name.lower(): share for c, share in lower.concentration.items()},
        "lower_edges": [c.name.lower() for c in lower.joint.graph.lower_edges],
        "error_model": {"side": model.side, "side_frame": model.side_frame, "match": model.match},
        "estimated": estimated_report(estimate.robust, solution.state),
        FRAME_INFORMATION: to_document(frame_gains(*frozen, drives, estimate.robust)),
    }


def fit_of(
    problem: CalibrationProblem, solutions: Sequence[JointSolution], covariance: FloatArray
) -> Fit | None:
    """How the last of the solutions, each of which led to the next, fits the labels.

    Args:
        covariance: (7, 7) of the result.
    """
    last = solutions[-1]
    different = {id(solution): solution for solution in solutions}.values()
    iterations = [each for solution in different for each in solution.iterations]
    along: Sequence[Profile] = ()
    if problem.config.for_report:
        sigmas, matches = np.sqrt(np.diag(covariance)), sum(map(len, last.matches))
        along = profiles(last.frozen, last.optimum, sigmas, matches)
    return problem.fit_at(last.state, iterations, along)


def _moving(solution: JointSolution) -> Iterator[str]:
    if not solution.converged:
        yield still_moved(solution.outer_iterations)


def _little_agreement(
    problem: CalibrationProblem, covariance: FloatArray, labels: Mapping[str, float]
) -> Iterator[str]:
    """Too few points that match, or matches that are not close."""
    limit = np.radians(problem.config.observability.rotation_deg)
    vague = float(np.linalg.eigvalsh(covariance[:3, :3])[-1]) > limit**2
    yield from poor_fit(labels["explained"], labels["concentration"], not vague)


def _outside_search(problem: CalibrationProblem, solution: JointSolution) -> Iterator[str]:
    search, guess = problem.config.search, problem.guess.cTl
    away = solution.state.cTl.translation() - (np.zeros(3) if guess is None else guess.translation())
    far = float(np.linalg.norm(away))
    # A ball about the LiDAR, or a box about the guess.
    of_region = far / search.free_translation_m if guess is None else abs(away).max() / search.translation_m
    if of_region > REACH:
        what = "the guess" if guess is not None else "the LiDAR"
        yield f"the estimate lies {far:.2f} m from {what}, farther than was searched"


def _alternatives(
    solution: JointSolution, solutions: Sequence[JointSolution], covariance: FloatArray
) -> Iterator[str]:
    """Solutions elsewhere that agree with the labels almost as well."""
    best, *others = solutions
    for other in others:
        step = difference(solution.state, other.state)
        sigmas = float(np.sqrt(step @ np.linalg.solve(covariance[:7, :7], step)))
        as_good = agreement(other) > ALTERNATIVE_RATIO * agreement(best)
        if sigmas > _FAR_SIGMAS and as_good:
            yield (
                f"another start led to an estimate {np.degrees(np.linalg.norm(step[:3])):.2f} deg, "
                f"{100.0 * np.linalg.norm(step[3:6]):.1f} cm and {1e3 * abs(step[6]):.0f} ms away "
                "that explains the labels almost as well: record more varied scenes or give a closer guess"
            )

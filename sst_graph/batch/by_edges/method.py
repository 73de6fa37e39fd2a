"""``--method edges``: LiDAR edges against gradients of the pictures, in the joint method's graph; no
labels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from sst_graph.batch.by_edges.covariance import edges_covariance
from sst_graph.batch.by_edges.halves import halves_reasons
from sst_graph.batch.by_edges.lens import LENS, lens_steps
from sst_graph.batch.by_edges.optimum import (
    RESTARTS,
    best_optimum_steps,
    candidate_steps,
    farther_edges_steps,
)
from sst_graph.batch.by_edges.problem import LabelEstimate, checking_motion, edges_problem, motion_alone
from sst_graph.batch.by_edges.reasons import (
    EdgeContrast,
    edge_contrast_steps,
    edges_reasons,
    pose_reasons,
    with_lens_reasons,
)
from sst_graph.batch.config import CalibrationConfig
from sst_graph.batch.method_estimate import MethodEstimate, frames_used
from sst_graph.batch.motion_factor import offsets_held_by_motion
from sst_graph.batch.part_solver import CONTRADICTIONS
from sst_graph.batch.problem import CalibrationProblem, JointEstimate, MatchedDrives
from sst_graph.batch.total_covariance import sweep_effects
from sst_graph.drive.preparation import Drive, Progress
from sst_graph.drive.stages import run_stage, stage
from sst_graph.fit import EDGE_BIAS, Fit, Profile, bias_entry
from sst_graph.graph.outer_loop import JointSolution
from sst_graph.hand_eye.solution import MotionSolution
from sst_graph.quality.profiles import score_profiles
from sst_graph.stepwise import run_to_end
from sst_graph.types import FloatArray, Guess


def edges_method(
    drives: Sequence[Drive],
    guess: Guess,
    config: CalibrationConfig,
    progress: Progress | None,
    labels: LabelEstimate | None = None,
) -> MethodEstimate:
    """Extrinsic and time offset from edges; drives are prepared with objects without a class.

    Args:
        labels: where other frames have some.

    Raises:
        EstimationError: no start: neither a guess nor motion, or nothing in view.
    """
    labels = labels or LabelEstimate()
    # 1. What motion says, before any edge is compared.
    motion = motion_alone(drives, guess, config, progress)
    calibration = CalibrationProblem.of(drives, guess, config, progress)
    problem = edges_problem(calibration, motion, labels)
    if labels.state is None:
        # 2. Starts by a search over rotations; the best of them after refinement on a few scans.
        candidates = run_stage(candidate_steps(problem), progress, "search of the start")
        first, restarts = candidates[0][1].state, RESTARTS
    else:
        candidates, first, restarts = [], labels.state, 0
    # 3. All frames, from the best, and from small turns while one agrees better.
    solution = run_to_end(best_optimum_steps(problem, first, restarts, progress))
    # 4. Covariance, with what halves of the objects disagree by, edges that are farther away, and the lens.
    estimate, assumptions = JointEstimate.of(solution, calibration.objects), calibration.config.assumptions
    by_lens = lens_steps(problem, solution.state, calibration.objects, assumptions)
    lens = run_stage(by_lens, progress, LENS)
    farther = farther_edges_steps(problem.whole, solution.state)
    farther_step, unsettled = run_stage(farther, progress, "edges farther away")
    with stage(progress, "covariance"):
        own = edges_covariance(problem.whole, estimate, calibration.objects, assumptions, lens.findings)
        covariance = own.matrix + np.outer(farther_step, farther_step)
        sweeps = sweep_effects(calibration, solution, covariance)
    covariance = covariance + sweeps.covariance
    lens_reasons, remarks = lens.reasons(covariance), lens.remarks(covariance)
    covariance = covariance + lens.covariance
    # 5. Has it worked?
    others = [one.state for _, one in candidates]
    with stage(progress, "contrast of the edges"):
        scores = edge_contrast_steps(problem.subset_edges, solution.state, others, config.seed)
        contrast = run_to_end(scores)
    checking = checking_motion(motion, config)
    of_pose = pose_reasons(solution.state, contrast, checking, covariance)
    reasons = edges_reasons(solution, of_pose, problem.centre)
    reasons += unsettled
    if config.check_contradictions:
        all_points = replace(problem.whole, drives=calibration.drives)
        with stage(progress, CONTRADICTIONS):
            reasons += halves_reasons(all_points, solution.state, covariance)
    # 6. How it fits the pictures, point by point.
    before = [one for _, one in candidates[:1]]
    matched = replace(calibration, drives=problem.whole.drives)
    with stage(progress, "fit of the edges"):
        fit = fit_of_edges(matched, (*before, solution), covariance)
    return MethodEstimate(
        cTl=solution.state.cTl,
        time_offset_s=solution.state.time_offsets_s[0],
        covariance=covariance,
        frames=frames_used(drives, solution),
        reasons=(*with_lens_reasons(reasons, lens_reasons, of_pose), *own.reasons),
        remarks=remarks,
        by_static_objects=covariance,
        diagnostics={
            **_diagnostics(solution, contrast, motion),
            EDGE_BIAS: bias_entry([drive.name for drive in drives], solution.state.biases_px),
            "spread": {**own.sigmas, "farther_edges": np.abs(farther_step).tolist()},
            "assumptions": dict(own.assumptions),
            "estimated": dict(own.estimated),
        },
        fit=fit,
        matched=MatchedDrives(matched, solution.state),
        by_sweeps=sweeps.covariance,
        open_sweeps=sweeps.reasons,
        shared=own.shared,
        assumption_steps=own.assumption_steps,
        held_offsets=offsets_held_by_motion(drives, solution.state, config),
    )


def _diagnostics(
    solution: JointSolution, contrast: EdgeContrast, motion: MotionSolution | None
) -> dict[str, Any]:
    """JSON-able numbers about the run."""
    facts: dict[str, Any] = {
        "outer_iterations": solution.outer_iterations,
        "matches": sum(len(pair) for pair in solution.pairs),
        "pairs": len(solution.pairs),
        "contrast": contrast.to_dict(),
    }
    if motion is not None:
        sigmas = np.sqrt(np.diag(motion.covariance))
        facts["motion"] = {
            "time_offset_s": motion.state.time_offsets_s[0],
            "sigmas": sigmas.tolist(),
        }
    return facts


def fit_of_edges(
    calibration: CalibrationProblem, solutions: Sequence[JointSolution], covariance: FloatArray
) -> Fit | None:
    """How the last of the solutions, each of which led to the next, fits the pictures.

    Args:
        calibration: with the points that the last solution matched.
        covariance: (7, 7) of the result.
    """
    solution = solutions[-1]
    iterations = [each for one in solutions for each in one.iterations]
    profiles: Sequence[Profile] = ()
    if calibration.config.for_report:
        edges = calibration.fit_of_drives.edges
        frozen = solution.system.covariance()[:7, :7]
        profiles = score_profiles(edges, solution.state, frozen, np.sqrt(np.diag(covariance)))
    return calibration.fit_at(solution.state, iterations, profiles)

"""Calibration of whole drives: ``calibrate`` runs a method and says how far to trust its result."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import gtsam

from sst_graph.baselines.semalign import solve_semalign
from sst_graph.baselines.sst_calib import solve_paper, solve_static
from sst_graph.batch.assumption_tests import (
    ParameterTest,
    assumption_report,
    contradiction_sentence,
    examine_assumptions,
    untested,
    untested_remark,
)
from sst_graph.batch.baselines import baseline_method
from sst_graph.batch.by_edges.both import both_method
from sst_graph.batch.by_edges.choice import with_method_for, with_method_of
from sst_graph.batch.by_edges.lens import lens_beside_labels
from sst_graph.batch.by_edges.method import edges_method
from sst_graph.batch.causes import CAUSES, with_causes
from sst_graph.batch.config import CalibrationConfig, Method, prepared_classes
from sst_graph.batch.contradictions import Contradictions, find_contradictions, offsets_held_by_labels
from sst_graph.batch.joint_report import (
    assumed_motion,
    fit_of,
    joint_diagnostics,
    joint_reasons,
    label_agreement,
)
from sst_graph.batch.method_estimate import (
    MethodEstimate,
    drive_offsets,
    frames_used,
    guess_as_result,
    result_of,
)
from sst_graph.batch.motion_factor import may_use_motion, with_motion
from sst_graph.batch.motion_method import motion_method
from sst_graph.batch.part_solver import CONTRADICTIONS, PartSolver
from sst_graph.batch.problem import CalibrationProblem, JointEstimate, JointOutcome, MatchedDrives
from sst_graph.batch.sources import as_sources
from sst_graph.batch.total_covariance import total_covariance
from sst_graph.config import expect_settings
from sst_graph.covariance.considered import BUDGET
from sst_graph.drive.geometric_labels import GeometricallyLabelled
from sst_graph.drive.preparation import (
    TRACK_INTERVAL_S,
    Drive,
    PrepareConfig,
    Progress,
    check_progress,
    prepare_drive,
)
from sst_graph.drive.stages import stage
from sst_graph.errors import ConfigError, EstimationError
from sst_graph.floating_point import with_usual_errors
from sst_graph.marginal import MOST_SCAN_HASHES, SCAN_HASHES
from sst_graph.odometry.sweep import with_sweep
from sst_graph.result import CalibrationResult
from sst_graph.types import Guess, Source
from sst_graph.validation import checked_guess


@with_usual_errors
def calibrate(
    frames: Source | Sequence[Source],
    initial: gtsam.Pose3 | None = None,
    config: CalibrationConfig | None = None,
    *,
    initial_time_offset_s: float = 0.0,
    progress: Progress | None = None,
) -> CalibrationResult:
    """Extrinsic, time offset and covariance from one drive or several.

    Args:
        frames: a source (:func:`sst_graph.open_source`), a slice of one, or several sources, which then
            share one extrinsic.
        initial: rough guess of cTl, or None when nothing is known.
        config: settings; the defaults fit driving data.
        initial_time_offset_s: rough guess of the time offset [s].
        progress: called with (stage, steps done, steps in all).

    Returns:
        The estimate; its ``status`` says whether it may be trusted.

    Raises:
        DataError: the frames cannot be used.
        ConfigError: the settings contradict each other or the data.
        FactorError: ``progress`` cannot be called so.
    """
    check_progress(progress)
    sources = as_sources(frames)
    initial, initial_time_offset_s = checked_guess(initial, initial_time_offset_s)
    config = with_method_for(expect_settings(config, CalibrationConfig), sources)
    _check(sources, config)
    began = time.perf_counter()
    drives = prepare_drives(sources, config, progress)
    seconds = time.perf_counter() - began
    result = calibrate_prepared(
        drives, initial, config, initial_time_offset_s=initial_time_offset_s, progress=progress
    )
    timing = {"prepare": seconds, **result.diagnostics["seconds"]}
    return replace(result, diagnostics={**result.diagnostics, "seconds": timing})


def prepare_drives(
    sources: Sequence[Source], config: CalibrationConfig, progress: Progress | None = None
) -> list[Drive]:
    """Read each source once, and keep what the method needs; image features are tracked only where they are
    needed."""
    check_progress(progress)
    config = with_method_for(config, sources)
    prepare = preparation_of(config)
    with_lower_edges = config.method in ("joint", "both") and config.lower_edges != "never"
    depth = config.method in _NEED_DEPTH
    if config.method == "edges":
        sources = [GeometricallyLabelled(source) for source in sources]
    # One drive after the other, for the frames that the sweep is decided by are kept until they are read.
    swept = (with_sweep(source, config.decide_sweep, progress) for source in sources)
    return [
        prepare_drive(source, prepared_classes(config), prepare, progress, depth, with_lower_edges)
        for source in swept
    ]


def preparation_of(config: CalibrationConfig) -> PrepareConfig:
    """What the method needs of every frame."""
    prepare = config.prepare
    if config.method not in _NEED_IMAGE_TRACKS and not may_use_motion(config):
        prepare = replace(prepare, use_visual_odometry=False)
    if config.method not in _NEED_DEPTH:
        prepare = replace(prepare, track_interval_s=TRACK_INTERVAL_S)
    return prepare


@with_usual_errors
def calibrate_prepared(
    drives: Sequence[Drive],
    initial: gtsam.Pose3 | None = None,
    config: CalibrationConfig | None = None,
    *,
    initial_time_offset_s: float = 0.0,
    progress: Progress | None = None,
) -> CalibrationResult:
    """:func:`calibrate` of drives from :func:`prepare_drives`, with the same settings."""
    check_progress(progress)
    config = with_method_of(config or CalibrationConfig(), drives)
    guess = Guess(initial, initial_time_offset_s)
    method = _METHODS[config.method]
    return finished(lambda: method(drives, guess, config, progress), drives, guess, config, progress)[0]


def finished(
    run: Callable[[], MethodEstimate],
    drives: Sequence[Drive],
    guess: Guess,
    config: CalibrationConfig,
    progress: Progress | None = None,
) -> tuple[CalibrationResult, MethodEstimate | None]:
    """The result of what ``run`` estimates, and the estimate itself; None where it finds none."""
    began = time.perf_counter()
    estimate = None
    try:
        estimate = run()
        result = result_of(estimate, drives, guess, config)
    except EstimationError as error:
        result = guess_as_result(drives, guess, config, str(error))
    # Likely faults of the data become the first reasons.
    with stage(progress, CAUSES):
        result = with_causes(result, drives, guess, config, progress)
    diagnostics = {**result.diagnostics, "seconds": {"estimate": time.perf_counter() - began}}
    left_out = {drive.name: drive.left_out.counts() for drive in drives if drive.left_out.counts()}
    if left_out:
        diagnostics["left_out"] = left_out
    if hashes := scan_hashes(drives):
        diagnostics[SCAN_HASHES] = hashes
    return replace(result, diagnostics=diagnostics), estimate


def scan_hashes(drives: Sequence[Drive]) -> list[str]:
    """The smallest hashes of the drives' scans: drives with a good part of their scans in common have some of
    these in common."""
    known = [drive.statistics.scan_hashes() for drive in drives if drive.statistics is not None]
    return sorted(set().union(*known))[:MOST_SCAN_HASHES]


def _check(sources: Sequence[Source], config: CalibrationConfig) -> None:
    if not config.classes:
        raise ConfigError("classes: found none, expected one or more")
    names = [source.name for source in sources]
    if len(set(names)) < len(names) and config.time_offset_per_drive:
        raise ConfigError(f"time_offset_per_drive needs drives of different names, found {names}")
    if config.time_offset_per_drive and config.method != "joint":
        raise ConfigError(f"time_offset_per_drive needs method joint, found {config.method}")
    if config.assumptions.estimate and config.method in _ESTIMATE_NO_ASSUMPTION:
        estimate = ",".join(config.assumptions.estimate)
        raise ConfigError(
            f"assumptions.estimate={estimate} needs method joint, edges or both, found {config.method}"
        )
    if config.time_offset_per_drive and config.use_motion == "always":
        raise ConfigError("use_motion=always has one time offset only: leave out time_offset_per_drive")


def joint_method(
    drives: Sequence[Drive], guess: Guess, config: CalibrationConfig, progress: Progress | None
) -> MethodEstimate:
    """The default: a global search, then object outlines over the whole drive in one factor graph."""
    return solve_problem(CalibrationProblem.of(drives, guess, config, progress))


def solve_problem(problem: CalibrationProblem) -> MethodEstimate:
    """The steps of the joint method."""
    drives = problem.drives
    # 1. Start: a global search, whose candidates are compared on a few scans.
    start = problem.start()
    # 2. Outlines over all frames, from the best start and from others that are nearly as good.
    solutions = problem.solve_from(start)
    start_solution, agreement = solutions[0], label_agreement(problem, solutions[0])
    # 3. Lower edges of the objects, where both sensors' labels agree about them.
    lower = problem.with_lower_edges(solutions)
    config = replace(problem.config, noise=lower.joint.graph)
    problem, solutions = replace(problem, config=config), lower.solutions
    # 4. Consistency: drives against each other; stretches of a drive, and both sides of a jump of its stamps.
    parts = PartSolver(problem, solutions[0].state)
    with stage(problem.progress, CONTRADICTIONS):
        contradictions, held = find_contradictions(parts), offsets_held_by_labels(parts)
    # 5. Cluster-robust covariance; motion as a factor where the labels determine all unknowns.
    labels_alone = JointEstimate.of(solutions[0], problem.objects)
    motion = with_motion(problem, labels_alone, contradictions.stretches)
    # 6. Assumptions: tested against the data, considered in the covariance.
    tests, considered = examine_assumptions(problem, motion.estimate, lens_beside_labels)
    # 7. Total covariance: with pictures that shift, unmeasured motion and undecided sweeps.
    with stage(problem.progress, "covariance"):
        total = total_covariance(problem, motion.estimate, considered)
    # 8. How it fits the labels, point by point.
    solved = (start_solution, lower.solutions[0], motion.estimate.solution)
    with stage(problem.progress, "fit of the labels"):
        fit = fit_of(problem, solved, total.covariance)
    # 9. The estimate, and why it may be wrong.
    solution, unknowns = motion.estimate.solution, total.unknowns
    wrong = joint_reasons(problem, solution, solutions, unknowns, agreement)
    return MethodEstimate(
        cTl=solution.state.cTl,
        time_offset_s=solution.state.time_offsets_s[0],
        covariance=total.covariance,
        frames=frames_used(drives, solution),
        reasons=(*_contradicted(tests, contradictions, wrong), *motion.reasons),
        remarks=(*motion.remarks, *total.remarks, *untested_remark(untested(tests, config.assumptions))),
        assumed=assumed_motion(drives),
        by_static_objects=motion.estimate.by_static_objects[:7, :7],
        drive_offsets=drive_offsets(drives, solution.state, unknowns),
        by_drive=total.by_drive,
        diagnostics={
            **agreement,
            "start_score": start.score,
            "contradictions": contradictions.diagnostics,
            "motion": motion.diagnostics,
            "assumptions": assumption_report(considered, tests),
            **total.shifts.diagnostics,
            BUDGET: total.budget,
            **joint_diagnostics(problem, motion.estimate, lower),
        },
        solved=JointOutcome(motion.estimate, considered),
        fit=fit,
        matched=MatchedDrives(problem, solution.state),
        by_sweeps=total.by_sweeps,
        open_sweeps=total.reasons,
        held_offsets=held,
        assumption_steps=considered.steps(),
    )


def _contradicted(
    tests: Sequence[ParameterTest], contradictions: Contradictions, wrong: Sequence[str]
) -> tuple[str, ...]:
    """What the data contradict and what else is wrong, the most important first.

    A step within a drive looks like an assumption that is broken by a little at all times (a clock that was
    set, like one that runs fast), and the other way round: the one that explains more is said first. Drives
    of two mounts look like anything, and one estimate for both may not even settle.
    """
    assumptions = contradiction_sentence(tests)
    steps = max(contradictions.step_chi2 if assumptions else 0.0, contradictions.drives_chi2)
    if steps > (tests[0].score ** 2 if assumptions else 0.0):
        return (*contradictions.sentences, *assumptions, *wrong)
    return (*assumptions, *wrong, *contradictions.sentences)


_Method = Callable[[Sequence[Drive], Guess, CalibrationConfig, Progress | None], MethodEstimate]
_METHODS: dict[Method, _Method] = {
    "joint": joint_method,
    "paper": partial(baseline_method, solve_paper),
    "static": partial(baseline_method, solve_static),
    "semalign": partial(baseline_method, solve_semalign),
    "motion": motion_method,
    "edges": edges_method,
    "both": partial(both_method, joint_method),
}
_NEED_IMAGE_TRACKS = ("paper", "static", "motion", "edges", "both")
"""Methods whose camera velocity comes from visual odometry."""
_ESTIMATE_NO_ASSUMPTION = ("paper", "static", "semalign", "motion")
"""Methods whose graph has no variable for an assumption."""
_NEED_DEPTH = ("paper", "static")
"""Methods that take the metric scale of that velocity from LiDAR points."""

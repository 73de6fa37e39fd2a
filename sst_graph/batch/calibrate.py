"""Calibration of whole drives: ``calibrate`` runs a method and says how far to trust its answer."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.batch.answer import Answer, DriveKnowledge, Guess, no_answer, result_of
from sst_graph.batch.assumption_tests import (
    SolvedProblem,
    assumption_report,
    check_assumptions,
    contradiction_of,
    estimated_report,
    told_by,
)
from sst_graph.batch.baselines import answer_paper, answer_semalign, answer_static
from sst_graph.batch.causes import with_causes
from sst_graph.batch.config import CalibrationConfig, Method
from sst_graph.batch.contradictions import find_contradictions
from sst_graph.batch.lower_edges import WithUndersides, with_undersides, without_undersides
from sst_graph.batch.motion_answer import answer_motion
from sst_graph.batch.motion_factor import Labels, WithMotion, with_motion
from sst_graph.batch.parts import Parts
from sst_graph.batch.sources import as_sources
from sst_graph.batch.sweep_effect import SweepEffects, sweep_effects
from sst_graph.covariance.cluster_robust import RobustCovariance, robust_covariance
from sst_graph.covariance.considered import BUDGET, budget, consider, motion_covariance, remainder
from sst_graph.covariance.observability import weak_directions
from sst_graph.covariance.static_objects import static_covariance
from sst_graph.covariance.unknown_motion import unknown_motion_covariance
from sst_graph.drive.preparation import Drive, Progress, prepare_drive
from sst_graph.errors import ConfigError, EstimationError
from sst_graph.graph.building import PairMatches, Tracks
from sst_graph.graph.outer_loop import JointSolution, agreement, concentration, explained
from sst_graph.graph.state import State
from sst_graph.hand_eye.solution import difference
from sst_graph.initialization.selection import (
    REACH,
    Contest,
    choose_start,
    narrowed,
    prior_centre,
    rivals,
    solve_all,
)
from sst_graph.inspect.frame_gains import frame_gains
from sst_graph.inspect.frame_information import KEY as FRAME_INFORMATION
from sst_graph.inspect.frame_information import to_document
from sst_graph.objects.tracks import object_tracks
from sst_graph.odometry.sweep import with_sweep
from sst_graph.result import CalibrationResult, DriveOffset, FrameId
from sst_graph.types import Source

FloatArray = NDArray[np.float64]

_FAR_SIGMAS = 6.0
"""Two answers farther apart than this contradict each other."""


def calibrate(
    frames: Source | Sequence[Source],
    initial: gtsam.Pose3 | None = None,
    config: CalibrationConfig | None = None,
    *,
    initial_offset_s: float = 0.0,
    progress: Progress | None = None,
) -> CalibrationResult:
    """Extrinsic, time offset and covariance from one drive or several.

    Args:
        frames: a source (:func:`sst_graph.open_source`), a slice of one, or several sources, which then
            share one extrinsic.
        initial: rough guess of cTl, or None when nothing is known.
        config: settings; the defaults fit driving data.
        initial_offset_s: rough guess of the time offset [s].
        progress: called with (stage, steps done, steps in all).

    Returns:
        The estimate; its ``status`` says whether it may be trusted.

    Raises:
        DataError: the frames cannot be used.
        ConfigError: the settings contradict each other or the data.
    """
    config = config or CalibrationConfig()
    sources = as_sources(frames)
    _check(sources, config)
    began = time.perf_counter()
    drives = prepare_drives(sources, config, progress)
    seconds = time.perf_counter() - began
    result = calibrate_prepared(drives, initial, config, initial_offset_s=initial_offset_s, progress=progress)
    timing = {"prepare": seconds, **result.diagnostics["seconds"]}
    return replace(result, diagnostics={**result.diagnostics, "seconds": timing})


def prepare_drives(
    sources: Sequence[Source], config: CalibrationConfig, progress: Progress | None = None
) -> list[Drive]:
    """Of every frame what the method needs: image features are not tracked for one that does without."""
    prepare = config.prepare
    if config.method not in _NEED_IMAGE_TRACKS and not _may_hear_motion(config):
        prepare = replace(prepare, use_visual_odometry=False)
    if config.method != "joint" or config.undersides.use == "never":
        prepare = without_undersides(prepare)
    depth = config.method in _NEED_DEPTH
    # One drive after the other, for the frames that the sweep is decided by are kept until they are read.
    return [
        prepare_drive(with_sweep(source, config.sweep), config.classes, prepare, progress, depth)
        for source in sources
    ]


def calibrate_prepared(
    drives: Sequence[Drive],
    initial: gtsam.Pose3 | None = None,
    config: CalibrationConfig | None = None,
    *,
    initial_offset_s: float = 0.0,
    progress: Progress | None = None,
) -> CalibrationResult:
    """:func:`calibrate` of drives from :func:`prepare_drives`, with the same settings."""
    config = config or CalibrationConfig()
    guess = Guess(initial, initial_offset_s)
    began = time.perf_counter()
    try:
        answer = _METHODS[config.method](drives, guess, config, progress)
        result = result_of(answer, drives, guess, config)
    except EstimationError as error:
        result = no_answer(drives, guess, config, str(error))
    # What is probably wrong with the data comes first.
    result = with_causes(result, drives, guess, config)
    diagnostics = {**result.diagnostics, "seconds": {"estimate": time.perf_counter() - began}}
    left_out = {drive.name: drive.left_out.counts() for drive in drives if drive.left_out.counts()}
    if left_out:
        diagnostics["left_out"] = left_out
    return replace(result, diagnostics=diagnostics)


def _check(sources: Sequence[Source], config: CalibrationConfig) -> None:
    if not config.classes:
        raise ConfigError("classes: found none, expected one or more")
    names = [source.name for source in sources]
    if len(set(names)) < len(names) and config.delay_per_drive:
        raise ConfigError(f"delay_per_drive needs drives of different names, found {names}")
    if config.delay_per_drive and config.method != "joint":
        raise ConfigError(f"delay_per_drive needs method joint, found {config.method}")
    if config.delay_per_drive and config.use_motion == "always":
        raise ConfigError("use_motion always knows one time offset only: leave out delay_per_drive")


def _may_hear_motion(config: CalibrationConfig) -> bool:
    return config.method == "joint" and config.use_motion != "never" and not config.delay_per_drive


def answer_joint(
    drives: Sequence[Drive], guess: Guess, config: CalibrationConfig, progress: Progress | None
) -> Answer:
    """The default: a global start, then silhouettes over the whole drive."""
    config = config.estimating
    # 1. A start that needs no luck.
    tracks = Tracks(drives)
    contest = choose_start(
        drives, tracks, config.classes, guess.cTl, guess.offset_s, config.joint, config.start
    )
    # 2. Silhouettes over all frames, from the winner and from a runner-up that differs from it.
    objects = [object_tracks(drive) for drive in drives]
    by_object = config.joint.graph.object_bias_sigma_px > 0.0
    tracks = Tracks(drives, objects) if by_object else tracks
    finals = _finals(drives, tracks, contest, guess, config, progress)
    evidence = {"explained": explained(finals[0])}
    evidence["concentration"] = concentration(finals[0], drives, tracks, config.joint)
    # 3. Edges towards the ground, where the labels agree about them.
    best = rivals(finals, guess.cTl, guess.offset_s, config.start)
    below = with_undersides(drives, tracks, best, config.joint, config.undersides, progress)
    config, finals = replace(config, joint=below.joint), below.solutions
    solution = finals[0]
    # 4. Do the drives agree, and the stretches of each?
    parts = Parts(drives, tracks, objects, solution.state, config.joint, config.assumptions)
    contradictions = find_contradictions(parts, config.contradictions)
    # 5. How sure; where the labels tell everything, the motion is heard too.
    robust = robust_covariance(*_frozen(solution), objects)
    covariance, by_static = robust.matrix, static_covariance(robust, solution.pairs)
    labels = Labels(solution, covariance[:7, :7], contradictions.stretches)
    heard = _hear_motion(drives, tracks, labels, guess, config, progress)
    if heard.solution is not solution:
        solution = heard.solution
        robust = robust_covariance(*_frozen(solution), objects)
        covariance = heard.inflation * robust.matrix
        if config.use_motion == "always":
            by_static = static_covariance(robust, solution.pairs)
    # 6. What is taken for granted: considered in the covariance, and tested.
    frozen = solution.pairs, solution.values, solution.state
    centre = prior_centre(solution.state, guess.cTl, guess.offset_s)
    problem = SolvedProblem(drives, tracks, objects, solution, config.joint, centre)
    findings = check_assumptions(problem, config.assumptions)
    considered = told_by(consider(robust, *frozen, config.assumptions), findings)
    size = 6 + len(solution.state.offsets_s)
    motion = motion_covariance(robust, solution.pairs, solution.state, config.joint.graph)
    parts_of_sigma = budget(covariance, motion, considered)
    covariance = covariance[:size, :size] + considered.covariance(size)
    sweeps = _with_sweeps(drives, solution, covariance, config)
    parts_of_sigma |= remainder(sweeps.covariance, covariance)
    return Answer(
        solution.state.cTl,
        solution.state.offsets_s[0],
        sweeps.covariance,
        _frames_used(drives, solution),
        remarks=(*_remarks(drives), *heard.remarks),
        by_static=by_static[:7, :7],
        doubts=(
            *contradiction_of(findings),
            *_doubts(solution, finals, covariance, evidence, guess, config),
            *contradictions.sentences,
            *heard.doubts,
            *sweeps.doubts,
        ),
        drive_offsets=_drive_offsets(drives, solution, covariance),
        by_drive=_by_drive(drives, solution, covariance, by_static, config),
        diagnostics={
            **evidence,
            "start_score": contest.score,
            "motion": heard.diagnostics,
            "assumptions": assumption_report(considered, findings),
            BUDGET: parts_of_sigma,
            "estimated": estimated_report(robust, solution.state),
            "contradictions": contradictions.diagnostics,
            **_numbers(drives, solution, below, robust),
        },
    )


def _numbers(
    drives: Sequence[Drive], solution: JointSolution, below: WithUndersides, robust: RobustCovariance
) -> dict[str, Any]:
    """JSON-able numbers about a joint solution."""
    model = robust.model
    return {
        "outer_iterations": solution.outer_iterations,
        "matches": sum(len(pair) for pair in solution.pairs),
        "pairs": len(solution.pairs),
        "mask_bias_px": {
            f"{drives[d].name}:{c.name.lower()}": bias for (d, c), bias in solution.state.biases_px.items()
        },
        "underside_concentration": {c.name.lower(): share for c, share in below.concentration.items()},
        "undersides": [c.name.lower() for c in below.joint.graph.undersides],
        "error_model": {"side": model.side, "side_frame": model.side_frame, "match": model.match},
        FRAME_INFORMATION: to_document(frame_gains(*_frozen(solution), drives, robust)),
    }


def _frozen(
    solution: JointSolution,
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values, list[PairMatches], State]:
    """What the covariance is computed from."""
    return solution.graph, solution.values, solution.pairs, solution.state


def _hear_motion(
    drives: Sequence[Drive],
    tracks: Tracks,
    labels: Labels,
    guess: Guess,
    config: CalibrationConfig,
    progress: Progress | None,
) -> WithMotion:
    """The solution with the motion in its graph, where it is asked for and there is any."""
    solution = labels.solution
    if not _may_hear_motion(config):
        return WithMotion(solution)
    if config.use_motion == "auto":
        weak = weak_directions(labels.covariance, solution.state.cTl, config.observability)
        rolling = any(scan.offsets_s.any() for drive in drives for scan in drive.scans)
        if weak or rolling:
            why = "the labels alone leave directions open" if weak else "the scans take their time"
            return WithMotion(solution, diagnostics={"left_out": why})
    centre = prior_centre(solution.state, guess.cTl, guess.offset_s)
    return with_motion(drives, tracks, labels, centre, config, progress)


def _finals(
    drives: Sequence[Drive],
    tracks: Tracks,
    contest: Contest,
    guess: Guess,
    config: CalibrationConfig,
    progress: Progress | None,
) -> Sequence[JointSolution]:
    """Solutions of the whole problem from every finalist, the one that agrees best with the labels first.

    Raises:
        EstimationError: none of them leads anywhere.
    """
    clocks = len(drives) if config.delay_per_drive else 1
    joint = narrowed(config.joint) if config.start.enabled else config.joint
    starts = [State(cTl, (offset_s,) * clocks) for cTl, offset_s in contest.finalists]
    centred = [(start, prior_centre(start, guess.cTl, guess.offset_s)) for start in starts]
    return solve_all(drives, centred, joint, tracks, progress)


def _doubts(
    solution: JointSolution,
    finals: Sequence[JointSolution],
    covariance: FloatArray,
    evidence: Mapping[str, float],
    guess: Guess,
    config: CalibrationConfig,
) -> tuple[str, ...]:
    """Why the joint estimate may be wrong altogether."""
    doubts = []
    if not solution.converged:
        doubts.append(f"the outer loop still moved after {solution.outer_iterations} iterations")
    limit = np.radians(config.observability.rotation_deg)
    vague = float(np.linalg.eigvalsh(covariance[:3, :3])[-1]) > limit**2
    least_explained = max(config.start.min_explained, config.start.min_explained_vague if vague else 0.0)
    for share, least, what in (
        (evidence["explained"], least_explained, "of the boundary points in view meet a contour"),
        (evidence["concentration"], config.start.min_concentration, "of the matches are close ones"),
    ):
        if config.start.enabled and share < least:
            doubts.append(
                f"only {100.0 * share:.0f} % {what} (expected {100.0 * least:.0f} % or more): "
                "the pose may be wrong altogether"
            )
    if config.start.enabled:
        search, around = config.start.search, np.zeros(3) if guess.cTl is None else guess.cTl.translation()
        far = float(np.linalg.norm(solution.state.cTl.translation() - around))
        if far > (REACH * search.free_translation_m if guess.cTl is None else 1.5 * search.translation_m):
            what = "the guess" if guess.cTl is not None else "the LiDAR"
            doubts.append(f"the answer lies {far:.2f} m from {what}, farther than was searched")
    best, *others = finals
    for other in others:
        step = difference(solution.state, other.state)
        sigmas = float(np.sqrt(step @ np.linalg.solve(covariance[:7, :7], step)))
        if sigmas > _FAR_SIGMAS and agreement(other) > config.start.rival_ratio * agreement(best):
            doubts.append(
                f"another start led to an answer {np.degrees(np.linalg.norm(step[:3])):.2f} deg, "
                f"{100.0 * np.linalg.norm(step[3:6]):.1f} cm and {1e3 * abs(step[6]):.0f} ms away "
                "that explains the labels almost as well: record more varied scenes or give a closer guess"
            )
    return tuple(doubts)


def _with_sweeps(
    drives: Sequence[Drive], solution: JointSolution, covariance: FloatArray, config: CalibrationConfig
) -> SweepEffects:
    """The (7, 7) covariance with what no match shows, and doubts about sweeps that nothing tells."""
    told = covariance[:7, :7] + _beside_matches(solution, float(covariance[6, 6]), config)
    effects = sweep_effects(solution, drives, told, config.joint)
    return SweepEffects(effects.doubts, told + effects.covariance)


def _beside_matches(solution: JointSolution, variance_s2: float, config: CalibrationConfig) -> FloatArray:
    """(7, 7) covariance by what no match shows."""
    return unknown_motion_covariance(solution.pairs, solution.state, variance_s2, config.unknown_motion)


def _remarks(drives: Sequence[Drive]) -> tuple[str, ...]:
    """What was taken for granted."""
    if all(drive.lidar_motions for drive in drives):
        return ()
    return (
        "a single scan tells no motion and was taken as standing: at 1 m/s every 100 ms between scan and "
        "image would shift the translation by 10 cm; give its neighbours too, or, if it stood, say so "
        "(unknown_motion.speed_mps and unknown_motion.turn_deg_per_s 0)",
    )


def _frames_used(drives: Sequence[Drive], solution: JointSolution) -> tuple[FrameId, ...]:
    return tuple(
        FrameId(drives[pair.drive].name, drives[pair.drive].scans[pair.pair.scan].index)
        for pair in solution.pairs
    )


def _drive_offsets(
    drives: Sequence[Drive], solution: JointSolution, covariance: FloatArray
) -> tuple[DriveOffset, ...]:
    if len(solution.state.offsets_s) == 1:
        return ()
    sigmas = np.sqrt(np.diag(covariance))
    return tuple(
        DriveOffset(drive.name, solution.state.offset_s(i), float(sigmas[6 + i]))
        for i, drive in enumerate(drives)
    )


def _by_drive(
    drives: Sequence[Drive],
    solution: JointSolution,
    covariance: FloatArray,
    by_static: FloatArray,
    config: CalibrationConfig,
) -> tuple[DriveKnowledge, ...]:
    """What is known of the extrinsic and each drive's own offset, where drives have one each."""
    found = []
    for number in range(len(drives) if len(solution.state.offsets_s) > 1 else 0):
        own = [*range(6), 6 + number]
        block, standing = covariance[np.ix_(own, own)], by_static[np.ix_(own, own)]
        block = block + _beside_matches(solution, float(block[6, 6]), config)
        found.append(DriveKnowledge(drives[number].name, block, standing))
    return tuple(found)


_Method = Callable[[Sequence[Drive], Guess, CalibrationConfig, Progress | None], Answer]
_METHODS: dict[Method, _Method] = {
    "joint": answer_joint,
    "paper": answer_paper,
    "static": answer_static,
    "semalign": answer_semalign,
    "motion": answer_motion,
}
_NEED_IMAGE_TRACKS = ("paper", "static", "motion")
"""Methods whose velocity comes from visual odometry."""
_NEED_DEPTH = ("paper", "static")
"""Methods that take its length from LiDAR points."""

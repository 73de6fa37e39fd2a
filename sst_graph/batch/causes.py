"""The likely causes of a wrong or missing result, for its reasons."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Literal

from sst_graph.assumptions import held_at_zero
from sst_graph.batch.by_edges.inverted import inverted_start
from sst_graph.batch.by_edges.label_parts import split_by_labels
from sst_graph.batch.config import CalibrationConfig
from sst_graph.covariance.considered import AssumptionConfig
from sst_graph.data.info.facts import facts_of
from sst_graph.diagnosis import (
    Finding,
    Fitter,
    LabelFit,
    few_labelled,
    likely_causes,
    mirror,
    other_axes,
    other_camera,
    preflight,
    uncalibrated,
    unknown_lasers,
)
from sst_graph.drive.preparation import Drive, Progress
from sst_graph.drive.stages import begin, under
from sst_graph.errors import EstimationError
from sst_graph.graph.drive_motion import motions_of
from sst_graph.graph.outer_loop import (
    NARROW_KERNELS_PX,
    JointProblem,
    concentration,
    explained,
    solve_joint,
)
from sst_graph.graph.state import State
from sst_graph.initialization.candidates import StartProblem, prior_centre
from sst_graph.initialization.selection import select_start_steps
from sst_graph.result import LIKELY_CAUSES, CalibrationResult
from sst_graph.sampling import step_for
from sst_graph.stepwise import run_to_end
from sst_graph.types import Guess

CAUSES = "likely causes"
"""Name of this stage of a calibration."""
_AGREED = 0.3
"""Share of the outlines that meet, times that of close matches, above which no mirror is looked for: mirrored
streets have 0.1 to 0.2."""
_MOSTLY_LABELLED = 0.9
"""Share of the frames with labels of both sensors above which the others would add little."""
_SCANS, _CANDIDATES = 6, 160
"""Scans and candidates of the search in a comparison: one that agrees need not be exact."""


def with_causes(
    result: CalibrationResult,
    drives: Sequence[Drive],
    guess: Guess,
    config: CalibrationConfig,
    progress: Progress | None = None,
) -> CalibrationResult:
    """The result with what is probably wrong with the data as its first reasons; with any, it is not ok. What
    may be wrong and does not show is a remark."""
    by_labels = config.method not in ("motion", "edges", "both")
    found = preflight(drives, guess, config.classes if by_labels else ())
    causes = [*_wrong_sweeps(drives), *(finding.sentence for finding in found)]
    estimated = bool(result.frames_used)
    if not causes and result.status != "ok" and config.method != "motion":
        axes = other_axes(drives)
        causes = [] if axes is None else [axes.sentence]
    if not causes and estimated:
        camera = other_camera(guess.cTl, result.T_camera_lidar, result.covariance, by_labels)
        causes = [] if camera is None else [camera.sentence]
    if not causes and config.find_causes and config.method == "joint":
        fit = fit_labels(config, progress)
        causes = [finding.sentence for finding in _fault_hypotheses(result, drives, guess, fit)]
    if not causes and config.find_causes and result.status != "ok" and config.method in ("edges", "both"):
        by_edges = drives if config.method == "edges" else split_by_labels(drives)[1]
        inverted = inverted_start(by_edges, guess, config)
        causes = [] if inverted is None else [inverted.sentence]
    if estimated:
        of_estimate = (remark.sentence for remark in _remarks(result, drives, config))
        remarks = (*_of_data(drives, "remarks"), *of_estimate)
        result = replace(result, reasons=(*result.reasons, *remarks))
    # What the data's own names say is no measurement: it changes no status, and hides no cause that is found.
    doubts = _of_data(drives, "doubts") if causes or result.status != "ok" else []
    if causes or doubts:
        status = "not_converged" if estimated and causes else result.status
        diagnostics = {**result.diagnostics, LIKELY_CAUSES: [*causes, *doubts]}
        reasons = (*causes, *doubts, *result.reasons)
        result = replace(result, status=status, reasons=reasons, diagnostics=diagnostics)
    return _with_unlabelled_frames(result, drives, config)


def _wrong_sweeps(drives: Sequence[Drive]) -> list[str]:
    """A sentence for each drive whose scans contradict what was said of their sweep."""
    sweeps = [(drive.name, drive.sweep) for drive in drives if drive.sweep is not None]
    return [f"{name}: {sweep.contradiction}" for name, sweep in sweeps if sweep.contradiction]


def _of_data(drives: Sequence[Drive], what: Literal["remarks", "doubts"]) -> list[str]:
    """What the data of each drive have to say of themselves: a field of their facts."""
    read = [(drive.name, facts_of(drive.frames.source)) for drive in drives if drive.frames is not None]
    return [f"{name}: {one}" for name, facts in read if facts is not None for one in getattr(facts, what, ())]


def _with_unlabelled_frames(
    result: CalibrationResult, drives: Sequence[Drive], config: CalibrationConfig
) -> CalibrationResult:
    """The result with frames that it leaves out and method both would use; the same where it is ok, for edges
    may make the answer of good labels worse. It is the second reason: a terminal shows the first of many."""
    if result.status == "ok" or config.method != "joint" or config.time_offset_per_drive:
        return result
    found = few_labelled(drives, result.time_offset_s, _MOSTLY_LABELLED)
    if found is None:
        return result
    return replace(result, reasons=(*result.reasons[:1], found.sentence, *result.reasons[1:]))


def _remarks(
    result: CalibrationResult, drives: Sequence[Drive], config: CalibrationConfig
) -> Iterator[Finding]:
    """What may be wrong with the data of an estimate, and does not show."""
    if config.method != "motion" and (lasers := unknown_lasers(drives)) is not None:
        yield lasers
    stated = any(_taken_as_given(drive) for drive in drives) and _relies_on_principal_point(
        config.assumptions
    )
    if stated and (centre := uncalibrated(result.camera)) is not None:
        yield centre


def _taken_as_given(drive: Drive) -> bool:
    """Whether the camera of the pictures is that of the data, and not one to which they were rectified."""
    images = () if drive.statistics is None else drive.statistics.images
    return not any(image.rectified for image in images)


def _relies_on_principal_point(assumptions: AssumptionConfig) -> bool:
    """Whether it is neither estimated nor said how far it may be off."""
    usual, held = AssumptionConfig(), held_at_zero(assumptions.estimate)
    return all(name in held and assumptions.sigma(name) <= usual.sigma(name) for name in ("cx", "cy"))


def _fault_hypotheses(
    result: CalibrationResult, drives: Sequence[Drive], guess: Guess, fit: Fitter
) -> tuple[Finding, ...]:
    """What explains a result that is missing, may be wrong, or agrees with few of the labels."""
    if not result.frames_used:
        return likely_causes(drives, guess, fit)
    explained, concentration = (float(result.diagnostics[key]) for key in ("explained", "concentration"))
    solved = LabelFit(result.T_camera_lidar, result.time_offset_s, explained, concentration)
    if result.status == "not_converged":
        return likely_causes(drives, guess, fit, solved)
    return mirror(drives, guess, fit, solved) if explained * concentration < _AGREED else ()


def fit_labels(config: CalibrationConfig, progress: Progress | None = None) -> Fitter:
    """Search and short solution on a few scans of one drive, with a calibration's own settings."""

    def fit(drive: Drive, guess: Guess) -> LabelFit | None:
        motions = motions_of([drive])
        few = [replace(drive, scans=drive.scans[:: step_for(len(drive.scans), _SCANS)])]
        joint = replace(config.joint, max_outer=len(NARROW_KERNELS_PX))
        search = StartProblem(few, motions, config.classes, guess)
        try:
            steps = select_start_steps(search, joint.graph, config.search, _SCANS, _CANDIDATES)
            selection = run_to_end(steps, partial(begin, progress, CAUSES))
            cTl, found_s = selection.starts[0]
            start = State(cTl, (found_s,))
            problem = JointProblem(few, motions, joint, prior_centre(guess, start))
            solution = solve_joint(problem, start, NARROW_KERNELS_PX, under(progress, CAUSES))
        except EstimationError:
            return None
        return LabelFit(
            solution.state.cTl,
            solution.state.time_offsets_s[0],
            explained(solution),
            concentration(solution, problem),
        )

    return fit

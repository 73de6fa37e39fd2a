"""The report's page, part by part: verdict, advice, pictures, objects, residuals, likelihood, background."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from sst_graph.assumptions import ASSUMPTIONS
from sst_graph.cameras.estimated_camera import EstimatedCamera
from sst_graph.files.strict_json import json_able
from sst_graph.fit import CLOSE_PX, Fit, MatchedFrame
from sst_graph.inspect.budget_text import budget_rows
from sst_graph.inspect.considered import covered_errors, stored_assumptions
from sst_graph.inspect.inspection import Inspection, inspect_result, strong_correlations
from sst_graph.inspect.inspection_text import (
    MOST_SENTENCES,
    advice_sentences,
    correlation_sentence,
    general_advice,
    weakest_ratio,
)
from sst_graph.inspect.misfit import DRIVING_MPS, misfits
from sst_graph.inspect.reasons import as_sentence, capitalized, leading_reasons
from sst_graph.inspect.report import ReferenceErrors, error_lines, summary_rows
from sst_graph.inspect.verdict import RIGHT_OVER_CHANCE, figure, fit_line, is_start, verdict
from sst_graph.report.close_ups import ZOOM, close_ups
from sst_graph.report.drawn_frame import DrawnFrame, DriveReader
from sst_graph.report.html import (
    bullets,
    details,
    grid,
    lines,
    packaged,
    page,
    paragraph,
    preformatted,
    section,
    table,
)
from sst_graph.report.overlay import Placements, overlay
from sst_graph.report.residual_charts import broad_charts, residual_charts
from sst_graph.report.uncertainty_charts import (
    convergence_chart,
    correlation_table,
    ellipse_charts,
    profile_charts,
)
from sst_graph.result import CalibrationResult
from sst_graph.types import Calibration, Source

_CONTOURS_HINT = (
    "The objects that determine the calibration most, then those whose labels agree with it least; of each "
    f"the part that determines most, {ZOOM} times enlarged. Yellow: contour of the labels, moved to the "
    f"edges of the picture. Points: where the LiDAR sees the object end, green within {CLOSE_PX:g} px of the "
    "contour, red beyond; magenta joins each with its contour. Blue bars: how far ±2 sigma of the "
    "calibration would move the point, with the lens that is given. Most points should lie on the yellow "
    "line."
)
_EDGES_USED = (
    "The objects that determine the calibration most, then those whose edges agree with it least; of each "
    f"the part that determines most, {ZOOM} times enlarged."
)
_EDGES_NOT_USED = (
    "Edges of the pictures, which the estimate has not used, at the objects where an error of the "
    "calibration would show most, then at those that agree with it least; of each the part that shows most, "
    f"{ZOOM} times enlarged."
)
_EDGES_HINT = (
    " Points: where the LiDAR sees the object end, "
    f"green within {CLOSE_PX:g} px of the picture's strongest edge across it, red beyond. Yellow: that edge; "
    "magenta joins the two. Blue bars: how far ±2 sigma of the calibration would move the point, with the "
    "lens that is given. Trust your eyes more than the colours: points must run along the outline that you "
    "see. Some have a stronger edge beside them, such as a shadow or a marking, and are red under a right "
    "calibration too. A row of points beside its outline, to the same side in several pictures, is a wrong "
    "one."
)
_SIGNS = (
    " Of each side of the object the mean is given: with + the points lie outside {against}, with - inside. "
    "The number of an object is that of the chart By object below; it has none where it has too few points "
    "for that chart."
)
_CHECK = (
    f"Under a right calibration the share is {RIGHT_OVER_CHANCE} times that at random rotations. It judges "
    "all of the result: a few centimetres or a roll that motion leaves open take it down to chance. Where it "
    "is lower than at the start, the start is the better calibration."
)
_DRAG = (
    "Drag in the picture or move the slider: left of the line the cloud as the start would place it, "
    "right of it as the result does."
)
PICTURES = 3
"""Pictures with the cloud, over all drives."""
PICTURES_OF_EACH = 2
"""Pictures by labels, and as many by edges, where a result has both."""


@dataclass(frozen=True)
class ReportInputs:
    """What a report is made of.

    Attributes:
        result: with its fit, where the method measures it.
        sources: the drives, read as for the calibration.
        comparison: errors against what is known to be true, or None.
        frames: to be drawn where the result has no fit.
    """

    result: CalibrationResult
    sources: Sequence[Source]
    comparison: ReferenceErrors | None = None
    frames: Sequence[DrawnFrame] = ()


def report_html(inputs: ReportInputs, progress: Callable[[int, int], None] | None = None) -> str:
    """The page: nothing in it is loaded from elsewhere.

    Args:
        progress: called with (parts done, parts in all).

    Raises:
        DataError: the drives cannot be read again.
    """
    result, reader = inputs.result, DriveReader(inputs.sources)
    inspection = inspect_result(result)
    parts: list[Callable[[], str]] = [
        lambda: _verdict(inputs),
        lambda: _next(inspection),
        lambda: _pictures(inputs, reader),
        *(partial(_close_ups, inputs, fit, reader) for fit in result.fits),
        *(partial(_residuals, result, fit) for fit in result.fits),
        lambda: _likelihood(inspection),
        lambda: _background(inputs, inspection),
    ]
    body = []
    for done, part in enumerate(parts):
        if progress is not None:
            progress(done, len(parts))
        body.append(part())
    drives = ", ".join(sorted({frame.drive for frame in result.frames_used}))
    title = f"Calibration of {result.image_topic or result.camera_name}" + (
        f" from {drives}" if drives else ""
    )
    return page(title, body, style=packaged("page.css"), script=packaged("page.js"))


def _verdict(inputs: ReportInputs) -> str:
    result, of_start = inputs.result, is_start(inputs.result)
    fit = fit_line(result)
    return section(
        "verdict",
        "Verdict",
        paragraph(verdict(result), f"verdict {result.status}"),
        paragraph(capitalized(fit) + ".") if fit else "",
        paragraph(_CHECK) if fit and result.fit_is_check else "",
        "" if of_start or result.status == "not_converged" else _accuracy(result),
        paragraph(f"Errors {'of the start ' * of_start}against {inputs.comparison.name}:")
        if inputs.comparison
        else "",
        bullets(error_lines(inputs.comparison.errors)) if inputs.comparison else "",
    )


def _accuracy(result: CalibrationResult) -> str:
    """How far off the calibration may be at each depth, and what the figures mean."""
    found = misfits(result)
    rows = [
        (
            f"{one.depth_m:.0f} m",
            f"{figure(one.pixels)} px",
            f"{figure(one.cm)} cm",
            f"{figure(one.corner_px)} px",
            f"{figure(one.corner_driving_px)} px",
        )
        for one in found
    ]
    head = (
        "depth",
        "middle of the picture",
        "the same across the line of sight",
        "corners",
        f"corners, driving at {DRIVING_MPS:g} m/s",
    )
    return table(head, rows, "numbers") + paragraph(
        "All figures are one standard deviation of the worst axis or direction: about 19 times in 20 the "
        "error is below twice as much. In the middle: of the calibration alone; an overlay shows less where "
        "a principal point that is off moves picture and cloud alike. In the corners: with the lens as far "
        "off as it may be, and while driving with the time offset.",
        "note",
    )


def _next(inspection: Inspection) -> str:
    result = inspection.result
    weak = [
        one.reason
        for one in result.weak_directions
        if not any(one.sentence in reason for reason in result.reasons)
    ]
    reasons, others = leading_reasons(result)
    short = [as_sentence(capitalized(reason)) for reason in reasons]
    if others:
        short.append(f"{others}.")
    trusted = result.status != "not_converged"
    named = any(inspection.weakest.sentence in reason for reason in [*result.reasons, *weak])
    # Of the time offsets of several drives the inspection has the first, and another one is past its limit.
    beside = bool(result.weak_directions) and weakest_ratio(inspection) <= 1.0
    plan = inspection.plan
    advice = [] if plan is None else advice_sentences(inspection, plan)
    rule = general_advice(inspection)
    return section(
        "next",
        "What is weak, and what to record next",
        bullets(short),
        details("The reasons in full", bullets([*result.reasons, *weak])) if result.reasons else "",
        paragraph(_weakest(inspection))
        if trusted and not is_start(result) and not named and not beside
        else "",
        paragraph(
            "What to record next, by the information that the frames of this record gave "
            "(standard deviations, now -> then; x, y and z are the LiDAR's axes):"
        )
        if advice
        else "",
        bullets(capitalized(one) + "." for one in advice),
        paragraph(f"What to record next, by the rule for the weakest direction: {rule}.") if rule else "",
        paragraph("Sigmas of further frames are predicted for results of method joint only.", "note")
        if rule
        else "",
        paragraph("What to record next is predicted only from a result that can be trusted.", "note")
        if not trusted
        else "",
    )


def _weakest(inspection: Inspection) -> str:
    """A sentence about the direction that is known worst."""
    ratio = weakest_ratio(inspection)
    past, of = (
        ("No direction is past its limit. The weakest", " of") if ratio <= 1.0 else ("The weakest", " times")
    )
    return f"{past}, at {figure(ratio)}{of} its limit: {inspection.weakest.sentence}."


def _pictures(inputs: ReportInputs, reader: DriveReader) -> str:
    result, fits = inputs.result, inputs.result.fits
    pictures = []
    for one in [] if fits else inputs.frames:
        pictures.append(overlay(one, _placements(result, one.frame.drive), None, "contour"))
    for fit in fits:
        for one in _drawn(fit, reader, PICTURES if len(fits) == 1 else PICTURES_OF_EACH):
            points = fit.points.take(_points_of(fit, one.frame))
            edge_name = "edge of the picture" if fit.by_edges else "contour"
            pictures.append(overlay(one, _placements(result, one.frame.drive), points, edge_name))
    with_start = result.initial is not None
    hint = _DRAG if with_start else "The cloud as the result places it: it began without a start."
    hint += " Edges of vehicles, poles and kerbs must meet their picture."
    if fits:
        names = (
            "strongest edge nearby" if fit.by_edges else "contour of the labels (yellow)" for fit in fits
        )
        compared_with = ", in frames without labels of the ".join(names)
        hint += (
            " Coloured by residual, only boundary points are shown: green ones lie within "
            f"{CLOSE_PX:g} px of the {compared_with}."
        )
    title = "Before and after" if with_start else "The cloud in the pictures"
    return section("pictures", title, paragraph(hint), *pictures) if pictures else ""


def _drawn(fit: Fit, reader: DriveReader, most: int) -> list[DrawnFrame]:
    """So many frames spread over the drives, each the one of its part with the most near boundary points that
    agree with their contour or edge; the one with the most of all comes first."""
    near = fit.points.weights / np.linalg.norm(fit.points.lPs, axis=1)
    shown = np.bincount(fit.points.frames, near, minlength=len(fit.frames))
    parts = np.array_split(np.arange(len(fit.frames)), min(most, len(fit.frames)))
    best = sorted((int(part[shown[part].argmax()]) for part in parts), key=lambda k: -shown[k])
    found = (reader.frame(fit.frames[k]) for k in best)
    return [one for one in found if one is not None]


def _points_of(fit: Fit, frame: MatchedFrame) -> np.ndarray[Any, np.dtype[np.bool_]]:
    return np.asarray(fit.points.frames == fit.frames.index(frame))


def _placements(result: CalibrationResult, drive: str) -> Placements:
    after = Calibration(result.T_camera_lidar, result.time_offset_of(drive))
    before = None if result.initial is None else Calibration(result.initial, result.initial_time_offset_s)
    return Placements(before, after, EstimatedCamera.of(result))


def _close_ups(inputs: ReportInputs, fit: Fit, reader: DriveReader) -> str:
    figures = close_ups(fit, inputs.result, lambda drive: _placements(inputs.result, drive), reader)
    hint = _CONTOURS_HINT
    if fit.by_edges:
        hint = (_EDGES_NOT_USED if inputs.result.fit_is_check else _EDGES_USED) + _EDGES_HINT
    if not figures:
        return ""
    name, title = _named(inputs.result, fit, "objects", "Close-ups of objects")
    against = "the edge" if fit.by_edges else "the contour"
    hint += _SIGNS.format(against=against)
    return section(name, title, paragraph(hint), grid(figures, "large"))


def _named(result: CalibrationResult, fit: Fit, name: str, title: str) -> tuple[str, str]:
    """Name and title of a section about one fit of a result."""
    if len(result.fits) == 1:
        return name, title
    kind, where = ("edges", "edges, in frames without labels") if fit.by_edges else ("labels", "labels")
    return f"{name}-{kind}", f"{title}: {where}"


def _residuals(result: CalibrationResult, fit: Fit) -> str:
    return section(
        *_named(result, fit, "residuals", "Residuals"),
        grid([*residual_charts(fit), convergence_chart(fit, result), *broad_charts(fit, result)]),
    )


def _likelihood(inspection: Inspection) -> str:
    result = inspection.result
    fit = result.fit
    if fit is None or not fit.profiles:
        return ""
    by_matches = (
        "Profile likelihood: one unknown is moved by some sigmas, all others are optimised again on the "
        "matches of the result. The dashed curve is the Gaussian of the result's sigma. The profile is "
        "widened as a whole to the result's sigma, for errors of neighbouring matches are "
        "correlated. A profile that "
        "leans or has a shoulder is a sigma that holds to one side only."
    )
    by_score = (
        "One unknown is moved by some sigmas, the others follow as the matches let them, and the score of "
        "the edges is taken again: how well LiDAR edges meet those of the pictures. What it loses counts as "
        "a likelihood, widened as a whole to the result's sigma. The dashed curve is the Gaussian of that "
        "sigma. One top within a sigma of 0 is good; not at 0, for the score counts all points alike, the "
        "estimate does not. A second top is another calibration that the pictures allow. A score that hardly "
        "falls (see the captions) leaves the unknown to motion and the start."
    )
    hint = by_score if fit.by_edges else by_matches
    return section("likelihood", "Likelihood", paragraph(hint), grid(profile_charts(fit.profiles, result)))


def _background(inputs: ReportInputs, inspection: Inspection) -> str:
    result = inputs.result
    sentences = [correlation_sentence(pair) for pair in inspection.strong[:MOST_SENTENCES]]
    versions = [(name, number) for name, number in result.versions.items()]
    return section(
        "background",
        "Numbers and background",
        lines(summary_rows(result, inputs.comparison)),
        _assumptions(result),
        _budget(result),
        "<h3>Correlations (about and along the LiDAR's axes)</h3>",
        correlation_table(result),
        bullets(sentences),
        grid(ellipse_charts(result, strong_correlations(result.covariance, 0.0))),
        details("Settings", preformatted(json.dumps(json_able(result.config), indent=1))),
        details("How the drives were read", preformatted(json.dumps(json_able(result.read_as), indent=1)))
        if result.read_as
        else "",
        details("Versions", table(("package", "version"), versions)) if versions else "",
    )


def _budget(result: CalibrationResult) -> str:
    """A row a part of the covariance."""
    rows = budget_rows(result)
    head = ("the largest of each", "rotation", "translation", "time offset")
    return "<h3>Where the sigmas come from</h3>" + table(head, rows, "numbers") if rows else ""


def _assumptions(result: CalibrationResult) -> str:
    """A row an assumption: what the data say of its parameter, and the verdict."""
    stored, covered = stored_assumptions(result).items(), covered_errors(result)
    rows = [_assumption_row(name, entry, covered) for name, entry in stored if name in ASSUMPTIONS]
    if not rows:
        return ""
    head = ("assumption", "by the data", "considered", "verdict", "what it would mean if it did not hold")
    return "<h3>Assumptions</h3>" + paragraph(_CONSIDERED, "note") + table(head, rows, "stacked")


_CONSIDERED = (
    "By the data: the parameter's estimate and its standard deviation; 0 is what is assumed. Considered: how "
    "far it may be off (one standard deviation) with its effect counted in the sigmas of the result."
)


def _assumption_row(name: str, entry: Mapping[str, Any], covered: Mapping[str, float]) -> tuple[str, ...]:
    """Name, estimate, what is considered, verdict and meaning of an assumption.

    Args:
        covered: estimates of those that are off, while the sigmas have their step.
    """
    unit = ASSUMPTIONS[name].unit
    estimate, spread, considered = (entry.get(key) for key in ("estimate", "estimate_sigma", "sigma"))
    tested = isinstance(estimate, int | float) and isinstance(spread, int | float)
    found = ASSUMPTIONS[name].figure(float(estimate), float(spread)) if tested else "not tested"  # type: ignore[arg-type]
    considered = abs(covered[name]) if name in covered else considered
    part = f"±{considered:.2g} {unit}".rstrip() if isinstance(considered, int | float) else ""
    said = "holds" if tested else "its effect is in the sigmas"
    if name in covered:
        said = f"off; its step is in the sigmas. To take it out, {ASSUMPTIONS[name].remedy}"
    elif entry.get("contradicted"):
        said = f"contradicted: {ASSUMPTIONS[name].remedy}"
    return name, found, part, said, ASSUMPTIONS[name].violation

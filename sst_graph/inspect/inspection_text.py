"""An inspection in words: what ``sst-graph inspect`` prints."""

from __future__ import annotations

from collections.abc import Sequence
from textwrap import wrap

import numpy as np
from numpy.typing import NDArray

from sst_graph.covariance.observability import worst_ratio
from sst_graph.errors import count_of
from sst_graph.fit import MeasuredFit
from sst_graph.inspect.budget_text import budget_lines
from sst_graph.inspect.frame_information import FrameInformation
from sst_graph.inspect.gained_text import MOST_FRAMES, SHORT, gained_lines, short
from sst_graph.inspect.inspection import (
    HUMAN,
    NAMES,
    UNITS,
    Correlation,
    Inspection,
    telling_frames,
)
from sst_graph.inspect.planning import MOST_FRAMES as MOST_RECORDED
from sst_graph.inspect.planning import Plan, Prediction, RepeatedView
from sst_graph.inspect.planning import limits_of as limits_of_result
from sst_graph.inspect.verdict import fit_line, is_start, measured_lines, verdict
from sst_graph.result import CalibrationResult
from sst_graph.types import FloatArray

_WIDTH = 100
"""Letters of one line of the verdict."""
MOST_SENTENCES = 5
"""Correlations that are put into words."""
_NO_PLAN = ["what to record next: not predicted, for the estimate is not to be trusted (reason above)"]


def inspection_text(
    inspection: Inspection, all_frames: bool = False, measured: MeasuredFit | None = None
) -> str:
    """The whole text, block by block.

    Args:
        all_frames: every frame in the table, else a dozen.
        measured: how the calibration fits a drive, where that was measured.
    """
    blocks: list[list[str]] = [
        _head(inspection.result, measured),
        _sigma_block(inspection),
        _correlation_block(inspection),
        _weak_block(inspection),
    ]
    if budget := budget_lines(inspection.result):
        blocks.append(budget)
    if inspection.frames:
        plan = _NO_PLAN if inspection.plan is None else _plan_block(inspection, inspection.plan)
        blocks += [_frame_block(inspection, all_frames), plan]
    else:
        rule = general_advice(inspection)
        lines = gained_lines(inspection.result, inspection.gained, all_frames)
        blocks.append([*lines, f"- the rule for its weakest direction: {rule}"] if rule else lines)
    return "\n\n".join("\n".join(line.rstrip() for line in block) for block in blocks)


def correlation_sentence(pair: Correlation) -> str:
    """A sentence about two correlated unknowns."""
    i, j = pair.first, pair.second
    step = pair.slope * HUMAN[j] / HUMAN[i]
    a, b = NAMES[i], NAMES[j]
    return (
        f"{a} and {b} ({pair.value:+.3f}): {_per_unit(i, j, step)}; {a} would be known to "
        f"{_human(i, pair.first_alone)} if {b} were known, {b} to {_human(j, pair.second_alone)} if {a} were"
    )


def weakest_ratio(inspection: Inspection) -> float:
    """Largest sigma over its limit: up to 1 no direction is past it."""
    return worst_ratio(inspection.result.covariance, limits_of_result(inspection.result))


def frame_list(frames: Sequence[FrameInformation], positions: Sequence[int]) -> str:
    """Frames by number, runs of neighbours (of one drive) shortened: "0, 4-7", "a/00: 0, 4-7; b/00: 3"."""
    runs: list[list[int]] = []
    for k in sorted(positions):
        if runs and k == runs[-1][-1] + 1 and frames[k].frame.drive == frames[k - 1].frame.drive:
            runs[-1].append(k)
        else:
            runs.append([k])
    by_drive: dict[str, list[str]] = {}
    for run in runs:
        first, last = frames[run[0]].frame, frames[run[-1]].frame
        span = f"{first.frame}" if len(run) == 1 else f"{first.frame}-{last.frame}"
        by_drive.setdefault(first.drive, []).append(span)
    if len({frame.frame.drive for frame in frames}) == 1:
        return ", ".join(word for words in by_drive.values() for word in words) or "none"
    return "; ".join(f"{drive}: {', '.join(words)}" for drive, words in by_drive.items()) or "none"


def general_advice(inspection: Inspection) -> str:
    """What to record where nothing is predicted: the rule for the weakest direction.

    Empty with predictions, and of a result that is not to be trusted or holds no estimate.
    """
    result = inspection.result
    if inspection.plan is not None or result.status == "not_converged" or is_start(result):
        return ""
    return inspection.weakest.advice


def advice_sentences(inspection: Inspection, plan: Plan) -> list[str]:
    """What to record next, most useful first; every number is computed from the record.

    Figures that are the same after rounding are left out, and with them a sentence that has no other.
    """
    best, now = plan.best, plan.now
    axes = np.argsort(-np.abs(inspection.weakest.vector))[:2]
    changes = _changes(now, best, axes)
    sentences = [
        f"record {count_of(plan.count, 'frame')} {best.name}, each at another place: "
        + "; ".join(part for part in (changes, _status_after(best, plan.count, now)) if part)
    ]
    if changes := _changes(best, plan.nearer, axes):
        sentences.append(f"the same with objects half as far: {changes}")
    views = plan.views
    if len(views) > 1:
        if (sentence := _by_view(inspection, plan, axes)) is not None:
            sentences.append(sentence)
        if (sentence := _elsewhere(inspection, plan)) is not None:
            sentences.append(sentence)
    return sentences


def _by_view(inspection: Inspection, plan: Plan, axes: NDArray[np.intp]) -> str | None:
    """A sentence about the best and the worst view, where they differ."""
    first, last = plan.views[0], plan.views[-1]
    differ = _differing(first.prediction, last.prediction, axes)
    if not len(differ):
        return None

    def frames_like(view: RepeatedView) -> str:
        scene = _scene(inspection.frames[view.position])
        return f"{plan.count} like frame {_frame_name(inspection, view.position)} ({scene})"

    return (
        f"it matters what is in view: {frames_like(first)} would give {_values(first.prediction, differ)}, "
        f"but {frames_like(last)} {_values(last.prediction, differ)}"
    )


def _elsewhere(inspection: Inspection, plan: Plan) -> str | None:
    """A sentence about errors that frames share, where they dominate."""
    lost = plan.now.sigmas / plan.elsewhere.sigmas
    axes = np.argsort(-lost)[:2]
    differ = _differing(plan.elsewhere, plan.now, axes)
    if lost[axes[0]] < 1.2 or not len(differ):
        return None
    return (
        "record at other places: the outline of one object errs in the same way in every frame that shows "
        f"it; these {count_of(len(inspection.frames), 'frame')}, each taken at another place, would have "
        f"given {_values(plan.elsewhere, differ)} instead of {_values(plan.now, differ)}"
    )


def _head(result: CalibrationResult, measured: MeasuredFit | None) -> list[str]:
    drives = sorted({frame.drive for frame in result.frames_used})
    count = f"{len(result.frames_used)} frame{'s' * (len(result.frames_used) != 1)}"
    sentences = wrap(verdict(result), _WIDTH)
    lines = [
        *(f"{'' if k else 'verdict':<12} {part}" for k, part in enumerate(sentences)),
        f"{'status':<12} {result.status}",
        f"{'method':<12} {result.method}, {count}" + (f" of {', '.join(drives)}" if drives else ""),
    ]
    lines += [f"{'reason':<12} {reason}" for reason in result.reasons]
    if fit := fit_line(result):
        lines.append(f"{'fit':<12} {fit}")
    if measured is not None:
        lines.append(f"{'fit now':<12} measured with this calibration on {measured.drive}:")
        lines += [f"{'':<12} {line}" for line in measured_lines(measured)]
    for drive in result.drive_offsets:
        sigma = short(1e3 * drive.sigma_s)
        lines.append(f"{'offset':<12} {drive.drive}: {1e3 * drive.time_offset_s:+.2f} ms, sigma {sigma} ms")
    if not result.drive_offsets:
        sigma = short(result.sigmas().time_offset_ms)
        lines.append(f"{'offset':<12} {1e3 * result.time_offset_s:+.2f} ms, sigma {sigma} ms")
    return lines


def _sigma_block(inspection: Inspection) -> list[str]:
    lidar, camera = inspection.lidar, inspection.camera
    rows = [
        ("rotation about the LiDAR's axes", "deg", lidar.rotation_deg),
        ("rotation about the camera's axes", "deg", camera.rotation_deg),
        ("translation along the LiDAR's axes", "cm", lidar.translation_cm),
        ("translation along the camera's axes", "cm", camera.translation_cm),
    ]
    lines = [f"{'sigma':<36}{'':>4}{'x':>9}{'y':>9}{'z':>9}"]
    lines += [f"{name:<36}{unit:>4}" + "".join(f"{short(v):>9}" for v in xyz) for name, unit, xyz in rows]
    lines.append(f"{'time offset':<36}{'ms':>4}{short(lidar.time_offset_ms):>9}")
    lines.append("camera axes: x right (turning about it: pitch), y down (yaw), z forward (roll)")
    depths = ", ".join(f"{pixel.range_m:.0f}" for pixel in inspection.pixels)
    ahead = ", ".join(f"{short(pixel.across_px)} x {short(pixel.down_px)}" for pixel in inspection.pixels)
    corners = ", ".join(short(pixel.corner_px) for pixel in inspection.pixels)
    lens = ", where the lens counts" if any(pixel.lens_counts for pixel in inspection.pixels) else ""
    lines.append(f"in the image, at rest, at a depth of {depths} m:")
    lines.append(f"{'  straight ahead, across x down':<40}{ahead} px")
    lines.append(f"{f'  in the corners{lens}':<40}{corners} px")
    return lines


def _correlation_block(inspection: Inspection) -> list[str]:
    lines = ["correlation, about and along the LiDAR's axes"]
    lines.append(f"{'':<12}" + "".join(f"{name:>8}" for name in SHORT))
    for name, row in zip(SHORT, inspection.correlation, strict=True):
        lines.append(f"{name:<12}" + "".join(f"{value:>+8.2f}" for value in row))
    lines += [f"- {correlation_sentence(pair)}" for pair in inspection.strong[:MOST_SENTENCES]]
    if (more := len(inspection.strong) - MOST_SENTENCES) > 0:
        lines.append(
            f"- {count_of(more, 'more pair')} of {inspection.strong[-1].value:+.2f} and stronger "
            "(--json has them)"
        )
    return lines


def _weak_block(inspection: Inspection) -> list[str]:
    result = inspection.result
    ratio = weakest_ratio(inspection)
    if result.weak_directions:
        lines = ["weak directions (past the limits), the weakest first"]
        return lines + [f"- {weak.sentence}: {weak.advice}" for weak in result.weak_directions]
    past = "none named by this result, whose sigmas are past the limits"
    named = past if ratio > 1.0 else "none past the limits"
    return [
        f"weak directions: {named}",
        f"- the weakest, at {short(ratio)} of its limit: {inspection.weakest.sentence}",
    ]


def _frame_block(inspection: Inspection, all_frames: bool) -> list[str]:
    frames = inspection.frames
    order = sorted(range(len(frames)), key=lambda k: -frames[k].bits)
    shown = sorted(order if all_frames or len(frames) <= MOST_FRAMES else order[:MOST_FRAMES])
    left_out = len(frames) - len(shown)
    lines = [
        "what each frame brings: bits it adds to the others; sigma (LiDAR's axes) without it over with it"
        + (f" (the {MOST_FRAMES} that add most; {left_out} more with --all-frames)" if left_out else ""),
        f"{'frame':<16}{'bits':>7}"
        + "".join(f"{name:>8}" for name in SHORT)
        + f"{'m/s':>7}{'deg/s':>7}{'matches':>9}{'objects':>9}{'nearest':>9}",
    ]
    for k in shown:
        frame = frames[k]
        lines.append(
            f"{_frame_name(inspection, k):<16}{frame.bits:>7.2f}"
            + "".join(f"{value:>8.3f}" for value in frame.without)
            + f"{frame.speed:>7.1f}{np.degrees(frame.turn_rate):>7.1f}{frame.matches:>9}{frame.objects:>9}"
            + f"{frame.nearest_m:>7.1f} m"
        )
    if len(frames) == 1:
        return [*lines, "- one frame: without it nothing but the priors is left"]
    for unknown, name in enumerate(NAMES):
        words = ", ".join(
            f"{_frame_name(inspection, k)} ({_growth(frames[k].without[unknown])})"
            for k in telling_frames(frames, unknown)
        )
        lines.append(f"- matters most for {name} (sigma without it): {words or 'no frame by itself'}")
    share, found = 100.0 * inspection.redundant_share, frame_list(frames, inspection.redundant)
    lines.append(
        f"- redundant one at a time ({len(inspection.redundant)} of {len(frames)}: no sigma grows by more "
        f"than {share:g} % without it): {found}"
    )
    if len(frames) < len(inspection.result.frames_used):
        lines.append("- scans that share an image count as one frame, under the first one's number")
    return lines


def _plan_block(inspection: Inspection, plan: Plan) -> list[str]:
    lines = [
        f"what to record next: sigmas predicted for {count_of(plan.count, 'more frame')}, each at "
        "another place, with "
        "the record's average view",
        f"{'':<38}" + "".join(f"{name:>8}" for name in SHORT) + f"{'of limit':>10}{'bits':>7}{'enough':>8}",
        f"{'':<38}" + "".join(f"{unit:>8}" for unit in UNITS) + f"{'':>10}{'':>7}{'frames':>8}",
    ]
    for prediction in (plan.now, *plan.motions, plan.nearer):
        enough = f">{MOST_RECORDED}" if prediction.enough is None else str(prediction.enough)
        enough = "" if prediction is plan.now else enough
        lines.append(
            f"{prediction.name:<38}"
            + "".join(f"{short(value):>8}" for value in _sigmas(prediction.sigmas))
            + f"{short(prediction.worst):>10}{prediction.bits:>7.1f}{enough:>8}"
        )
    lines += [f"- {sentence}" for sentence in advice_sentences(inspection, plan)]
    if inspection.result.drive_offsets:
        lines.append(f"- the offset here is that of {inspection.result.drive_offsets[0].drive}")
    return lines


def _status_after(best: Prediction, count: int, now: Prediction) -> str:
    if now.worst <= 1.0:
        return f"the worst direction from {short(now.worst)} to {short(best.worst)} of its limit"
    if best.enough is None:
        return f"no number of such frames (up to {MOST_RECORDED}) brings every direction within its limit"
    if best.enough <= count:
        return f"all directions would be within the limits ({_such(best.enough)} would do)"
    return f"{_such(best.enough)} would bring all directions within the limits"


def _growth(ratio: float) -> str:
    return f"+{100.0 * (ratio - 1.0):.1f} %" if ratio < 2.0 else f"times {short(ratio)}"


def _such(count: int) -> str:
    return count_of(count, "such frame")


def _differing(one: Prediction, other: Prediction, axes: NDArray[np.intp]) -> NDArray[np.intp]:
    """Axes of the unknowns whose sigmas are not the same after rounding."""
    a, b = _sigmas(one.sigmas), _sigmas(other.sigmas)
    return np.array([i for i in axes if short(a[i]) != short(b[i])], np.intp)


def _changes(before: Prediction, after: Prediction, axes: NDArray[np.intp]) -> str:
    a, b = _sigmas(before.sigmas), _sigmas(after.sigmas)
    differ = _differing(before, after, axes)
    return ", ".join(f"{NAMES[i]} {short(a[i])} -> {short(b[i])} {UNITS[i]}" for i in differ)


def _values(prediction: Prediction, axes: NDArray[np.intp]) -> str:
    values = _sigmas(prediction.sigmas)
    return ", ".join(f"{NAMES[i]} {short(values[i])} {UNITS[i]}" for i in axes)


def _sigmas(sigmas: FloatArray) -> FloatArray:
    return np.asarray(HUMAN * sigmas)


def _scene(frame: FrameInformation) -> str:
    objects = f"{frame.objects} object{'s' * (frame.objects != 1)}"
    return f"{objects}, nearest {frame.nearest_m:.1f} m, {100 * frame.left:.0f} % of the matches on the left"


def _frame_name(inspection: Inspection, position: int) -> str:
    frame = inspection.frames[position].frame
    several = len({other.frame.drive for other in inspection.frames}) > 1
    return f"{frame.drive}:{frame.frame}" if several else str(frame.frame)


def _human(unknown: int, sigma: float) -> str:
    return f"{short(sigma * HUMAN[unknown])} {UNITS[unknown]}"


def _per_unit(i: int, j: int, step: float) -> str:
    unit = {"deg": 0.1, "cm": 1.0, "ms": 1.0}[UNITS[i]]
    sign = "+" if step >= 0.0 else "-"
    return f"+{unit:g} {UNITS[i]} goes with {sign}{short(abs(step) * unit)} {UNITS[j]}"

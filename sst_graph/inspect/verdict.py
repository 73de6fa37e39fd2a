"""How good a result is, in one sentence: what a person who uses it needs to know."""

from __future__ import annotations

import math
from collections.abc import Mapping

import gtsam
import numpy as np

from sst_graph.cameras.estimated_camera import EstimatedCamera
from sst_graph.errors import count_of
from sst_graph.fit import CLOSE_PX, EDGES_QUALITY, FitQuality, MeasuredFit
from sst_graph.inspect.changed import change_of
from sst_graph.inspect.misfit import MIDDLE_M, misfit_at
from sst_graph.inspect.reasons import as_sentence, leading_reasons
from sst_graph.result import CalibrationResult

CHECK_BY_EDGES = "a check by edges of the pictures, which the estimate has not used"
RIGHT_OVER_CHANCE = "1.3 to 2"
"""What the share of close edges is under a right calibration, in units of that at random rotations."""

MEASURE = "sst-graph inspect RESULT DATA measures it"
_FAR_POINTS = 4.0
"""A share so many percentage points below what labels allow is far below: right calibrations come within two
or three."""
_TOLD_BIAS_PX = 0.5
"""A smaller bias of outlines is not worth a word [px]."""
_FAR_BELOW = "wrong by a few tenths of a degree or more, or the mount moved"
_EDGES_TELL_LESS = "no measure by itself: 0.3° takes 3 to 15 points off what a right calibration has"

_FREED = "focal", "k1"
"""Parameters of the lens that a record of ordinary length can determine beside the pose."""
_MAY_FREE = "joint", "edges", "both"
"""Methods that can estimate them."""


def largest_sigmas(result: CalibrationResult) -> tuple[float, float, float]:
    """Rotation [deg], translation [cm] and time offset [ms]: one sigma of the worst axis of each, and of the
    worst drive where each has a time offset of its own."""
    covariance = result.covariance
    rotation, translation = (float(np.linalg.eigvalsh(covariance[a : a + 3, a : a + 3])[-1]) for a in (0, 3))
    offset_s = max((drive.sigma_s for drive in result.drive_offsets), default=float(covariance[6, 6]) ** 0.5)
    return float(np.degrees(np.sqrt(rotation))), 100.0 * np.sqrt(translation), 1e3 * offset_s


def is_start(result: CalibrationResult) -> bool:
    """Whether no estimate could be made: what stands in the result is the start."""
    start = gtsam.Pose3() if result.initial is None else result.initial
    return not result.frames_used and bool(result.T_camera_lidar.equals(start, 1e-12))


def verdict(result: CalibrationResult) -> str:
    """The result in one or two sentences, without terms of the trade.

    Standard deviations of the worst axis; a result that is not ok begins with what is wrong, and one whose
    calibration was changed with that.
    """
    if (change := change_of(result)) is not None:
        changed = f"This is not the calibration that was estimated ({change.words})."
        return f"{changed} The estimate itself: {_verdict(result)}"
    return _verdict(result)


def _verdict(result: CalibrationResult) -> str:
    if result.status == "not_converged":
        return f"Do not use this calibration: {_why(result, 'the estimate contradicts the data')}"
    if is_start(result):
        why = _why(result, "no frame could be used")
        return f"No estimate: {why} What stands in this result is the start."
    if result.status == "unobservable":
        return f"Not finished: {_why(result, 'the data leave a direction open')} As it is: {_known(result)}"
    return f"Good to {_known(result)}"


def _why(result: CalibrationResult, otherwise: str) -> str:
    """The first reason as a sentence, or what is said where there is none."""
    leading, _ = leading_reasons(result)
    return as_sentence(leading[0] if leading else otherwise)


def quality_line(quality: FitQuality, with_attainable: bool = True) -> str:
    """Shares of close points, as a line for a terminal.

    Args:
        with_attainable: whether to say what such labels allow.
    """
    by_labels = quality.by_chance is None
    # For edges the attainable share is not said: a wrong calibration lowers it as well.
    compared = by_labels and with_attainable
    others = {"at the start": quality.share_at_start, "at random rotations": quality.by_chance}
    shares = ", ".join(f"{name} {100.0 * share:.0f} %" for name, share in others.items() if share is not None)
    return (
        f"{100.0 * quality.share:.0f} % of {count_of(quality.points, 'boundary point')} within "
        f"{CLOSE_PX:g} px of the "
        f"{'contour' if by_labels else 'strongest edge nearby'}{f' ({shares})' if shares else ''}"
        + (f"; labels like these allow {100.0 * quality.attainable:.0f} %" if compared else "")
    )


def fit_line(result: CalibrationResult) -> str:
    """How well the result fits its data, as a line for a terminal: by labels, or by edges; else empty.

    The figures are those of the estimate, and the line says so where the result holds another calibration.
    """
    line = _fit_line(result)
    if line and change_of(result) is not None:
        return f"of the estimate, not of this calibration ({MEASURE}): {line}"
    return line


def measured_lines(measured: MeasuredFit) -> list[str]:
    """How well a calibration fits a drive that it was measured on, as lines for a terminal."""
    lines = []
    if (labels := measured.labels) is not None:
        short = 100.0 * (labels.attainable - labels.share)
        judged = f", {short:.0f} points more: {_FAR_BELOW}" if short >= _FAR_POINTS else ""
        wide = {name: bias for name, bias in measured.bias_px.items() if abs(bias) >= _TOLD_BIAS_PX}
        drawn = "".join(f"; outlines of {name} {bias:+.1f} px, taken off" for name, bias in wide.items())
        lines.append(f"labels: {quality_line(labels)}{judged}{drawn}")
    if (edges := measured.edges) is not None:
        lines.append(f"edges: {quality_line(edges)}; {_EDGES_TELL_LESS}")
    return lines or ["no boundary point has a contour or an edge of the picture nearby"]


def _fit_line(result: CalibrationResult) -> str:
    """The figures in the result."""
    quality = FitQuality.from_diagnostics(result.diagnostics)
    if quality is None:
        return edges_line(result)
    # Nor for a calibration that may be wrong: it meets few contours, by chance, and so attains its share.
    compared = result.status != "not_converged"
    of_edges = FitQuality.from_diagnostics(result.diagnostics, EDGES_QUALITY)
    if of_edges is not None:
        by_labels, by_edges = quality_line(quality, compared), quality_line(of_edges)
        return f"labels: {by_labels}; edges in frames without labels: {by_edges}"
    if result.fit_is_check:
        return f"{CHECK_BY_EDGES}: {quality_line(quality)}{_over_chance(quality)}"
    contrast = "" if quality.by_chance is None else edges_line(result)
    shares = quality_line(quality, compared)
    # The strongest edge near a point is often another object's, so the share says little: only the score has
    # a limit that right calibrations keep.
    return f"{contrast}; no measure by itself: {shares}" if contrast else shares


def _over_chance(quality: FitQuality) -> str:
    """How a share of edges is judged that no score stands beside."""
    if not quality.by_chance:
        return ""
    ratio = quality.share / quality.by_chance
    return f": {ratio:.1f} times chance, right calibrations have {RIGHT_OVER_CHANCE}"


def edges_line(result: CalibrationResult) -> str:
    """How far the score of the edges stands out; empty where it is not known."""
    stored = result.diagnostics.get("contrast")
    names = "sigmas", "least_sigmas", "score", "other", "least_over_other"
    found = [stored.get(name) for name in names] if isinstance(stored, dict) else []
    values = [float(x) for x in found if isinstance(x, int | float) and math.isfinite(x)]
    if len(values) < len(names):
        return ""
    sigmas, least_sigmas, score, other, least_over_other = values
    over_other = (
        f", {score / other:.2f} times that of the best other optimum ({least_over_other:g} or more expected)"
        if other > 0.0
        else ""
    )
    return (
        f"the score of the edges is {sigmas:.0f} standard deviations above those of random rotations "
        f"({least_sigmas:g} or more expected){over_other}"
    )


def _known(result: CalibrationResult) -> str:
    degrees, cm, ms = largest_sigmas(result)
    one = misfit_at(result, MIDDLE_M)
    # The corners are worth a line only where the result is ok: with sigmas of degrees they add nothing.
    worth_saying = one.more_in_corners and result.status == "ok"
    lens = "where the lens counts, " if one.lens_counts else ""
    corners = f"; in the corners, {lens}{figure(one.corner_px)} px" if worth_saying else ""
    return (
        f"{figure(degrees)}° and {figure(cm)} cm (one sigma): at {one.depth_m:.0f} m the cloud may be "
        f"{figure(one.pixels)} px off in the middle of the picture{corners}. "
        + (
            f"The time offsets are known to {figure(ms)} ms or better."
            if len(result.drive_offsets) > 1
            else f"The time offset is known to {figure(ms)} ms."
        )
        + (f" {_lens_advice(result)}" if worth_saying and lens else "")
    )


def _lens_advice(result: CalibrationResult) -> str:
    """What to do where the lens makes the corners worse than the calibration does."""
    advice = "For better corners calibrate the lens"
    estimated = EstimatedCamera.of(result).estimated
    free = [name for name in _FREED if name not in estimated]
    if not free or result.method not in _MAY_FREE:
        return f"{advice}."
    # With smaller sigmas a sweep that is open makes up more of them: more than it may.
    given = ", and give --sweep, which the scans leave open" if _open_sweep(result) else ""
    return f"{advice}, or estimate it too: --estimate {','.join(free)}{given}."


def _open_sweep(result: CalibrationResult) -> bool:
    """Whether the scans of a drive leave undecided how they are timed."""
    drives = result.diagnostics.get("sweep")
    entries = drives.values() if isinstance(drives, Mapping) else ()
    return any(isinstance(entry, Mapping) and entry.get("kind") == "undecided" for entry in entries)


def figure(value: float) -> str:
    """Two significant digits of small numbers, whole numbers above ten."""
    if value == 0.0 or value >= 10.0:
        return f"{value:.0f}"
    return f"{value:.{max(0, 1 - int(np.floor(np.log10(value))))}f}"

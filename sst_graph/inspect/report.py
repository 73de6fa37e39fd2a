"""A result in words: the summary on the terminal and the report beside calibration.json."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from textwrap import wrap

import gtsam
import numpy as np

from sst_graph.inspect.budget_text import budget_lines, estimated_lines
from sst_graph.inspect.reasons import MOST_REASONS, leading_in_full, leading_reasons
from sst_graph.inspect.verdict import figure, fit_line, is_start, verdict
from sst_graph.metrics import (
    CalibrationErrors,
    euler_angles_deg,
    mean_translation_difference_m,
    quaternion_angle_deg,
)
from sst_graph.result import CalibrationResult
from sst_graph.types import FloatArray

OFFSET_SIGN = "t_lidar = t_camera_stamp + offset"


_SENTENCES, _WIDTH = ("verdict", "sweep"), 100
"""Names of the lines that are sentences, and the letters of one line of them."""
_WITH_LABELS = (
    "More frames reduce matches, motion and shifts. The others are assumptions that no residual shows, such "
    "as a principal point (cx, cy) or a distortion (k1, k2) that is off by the amount named."
)
_WITHOUT_LABELS = (
    "More objects reduce matches, which objects there are and, in part, shallow upper edges. The others are "
    "shared by all frames."
)
"""What the parts of the sigmas mean."""


_ABOVE = "the start", "the data's own calibration, where there is one (the result had no start)"
"""What the upper picture of an overlay shows: of a result with a start, and of one without."""
OWN_CALIBRATION = "the data's own calibration and stamps (a reference, not the truth)"
"""Name of what a drive without a known truth is compared with."""


@dataclass(frozen=True)
class ReferenceErrors:
    """Errors against a calibration that is known.

    Attributes:
        errors: of the estimate against it.
        name: what it is, such as "the truth" or "the published calibration".
    """

    errors: CalibrationErrors
    name: str


def summary(result: CalibrationResult, comparison: ReferenceErrors | None = None) -> str:
    """The result in a dozen lines: numbers with sigmas, status, unobservable directions."""
    return _lines(summary_rows(result, comparison))


def verdict_and_summary(result: CalibrationResult, comparison: ReferenceErrors | None = None) -> str:
    """The summary of a result; of one that is ok below its verdict. What makes another one not ok is the
    summary's reason already."""
    first = [("verdict", verdict(result))] if result.status == "ok" else []
    return _lines([*first, *summary_rows(result, comparison)])


def _lines(rows: Sequence[tuple[str, str]]) -> str:
    """Rows of name and text as lines of text, sentences broken where they are long."""
    lines = []
    for name, text in rows:
        parts = wrap(text, _WIDTH) if name in _SENTENCES else [text]
        lines += [f"{'' if k else name:<15} {part}".rstrip() for k, part in enumerate(parts)]
    return "\n".join(lines)


def summary_rows(
    result: CalibrationResult, comparison: ReferenceErrors | None = None
) -> list[tuple[str, str]]:
    """The lines of the summary, each as its name and its text; a line that continues another has no name."""
    rows = [
        ("status", result.status),
        ("method", f"{result.method}, {_frames(result)}"),
        (
            "transform",
            f"p_{'camera' if result.image_topic else result.camera_name} = T_camera_lidar . p_lidar",
        ),
        *(("", " ".join(f"{x:10.6f}" for x in row)) for row in result.T_camera_lidar.matrix()[:3]),
        ("sigma", _pose_sigmas(result)),
        ("time offset", f"{_offset(result)}   ({OFFSET_SIGN})"),
        *(
            ("", f"{drive.drive}: {_milliseconds(drive.time_offset_s, drive.sigma_s)}")
            for drive in result.drive_offsets
        ),
    ]
    rows += [("estimated" if k == 0 else "", text) for k, text in enumerate(estimated_lines(result))]
    sweeps = _sweeps(result)
    rows += [("sweep" if k == 0 else "", text) for k, text in enumerate(sweeps)]
    if is_start(result):
        rows.append(("moved", "not: no estimate could be made, and this is the start"))
    elif result.initial is not None:
        rows.append(("moved", _moved(result, result.initial)))
    if comparison is not None:
        rows.append((f"{'start ' * is_start(result)}against {comparison.name}", ""))
        rows += [("", line) for line in error_lines(comparison.errors)]
    rows += [("fit", fit)] if (fit := fit_line(result)) else []
    reasons, others = leading_reasons(result)
    rows += [("reason", reason) for reason in reasons[:MOST_REASONS]]
    if len(reasons) > MOST_REASONS:
        rows.append(("", f"and {len(reasons) - MOST_REASONS} more: reasons in the result's file"))
    if others:
        rows.append(("", f"{others}: in the result's file"))
    for weak in result.weak_directions:
        if not any(weak.sentence in reason for reason in result.reasons):
            rows += [("weak", weak.sentence), ("", weak.advice)]
    return rows


def error_lines(errors: CalibrationErrors) -> list[str]:
    """The errors, one metric a line, in degrees, centimetres and milliseconds."""
    lines = [
        f"rotation     {errors.qad_deg:.3f} deg (QAD: the whole angle), "
        f"{errors.aead_deg:.3f} deg (AEAD: mean of roll, pitch and yaw)",
        f"translation  {100.0 * errors.atd_m:.2f} cm (ATD: mean of x, y and z)",
    ]
    if errors.time_offset_s is not None:
        lines.append(f"time offset  {1e3 * errors.time_offset_s:+.2f} ms")
    if errors.nees is not None:
        parts = f"rotation {errors.nees.rotation:.1f} of 3, translation {errors.nees.translation:.1f} of 3"
        if errors.nees.time_offset is not None:
            parts += f", offset {errors.nees.time_offset:.1f} of 1"
        known = 6 if errors.nees.time_offset is None else 7
        lines.append(f"NEES         {errors.nees.joint:.1f} of {known} ({parts})")
    return lines


def markdown_report(
    result: CalibrationResult,
    comparison: ReferenceErrors | None,
    pictures: Sequence[str],
    legend: str = "",
) -> str:
    """A short Markdown page.

    Args:
        pictures: file names beside it.
        legend: sentences about what is drawn in them.
    """
    _, others = leading_reasons(result)
    said = [*leading_in_full(result), *([f"{others} (below)"] if others else [])]
    blocks = [
        "# Calibration",
        verdict(result),
        f"Status: **{result.status}**{': ' * bool(said)}{'; '.join(said)}",
        _table(
            ("", "value", "sigma"),
            [
                *_euler_rows(result),
                *_offset_rows(result),
            ],
        ),
        "Roll, pitch and yaw are those of the LiDAR in the camera turned to x forward, y left, z up; "
        "translation is in the camera's axes (x right, y down, z forward). "
        f"Sign of the offset: {OFFSET_SIGN}.",
        "```\n" + summary(result, comparison) + "\n```",
    ]
    if parts := budget_lines(result):
        blocks += [
            "## Where the sigmas come from",
            "```\n" + "\n".join(parts) + "\n```",
            _WITHOUT_LABELS if result.method == "edges" else _WITH_LABELS,
        ]
    if others:
        blocks += ["## All reasons", "\n".join(f"- {reason}" for reason in result.reasons)]
    elif result.weak_directions:
        items = [f"- {weak.sentence} {weak.advice}" for weak in result.weak_directions]
        blocks += ["## What the data hardly determine", "\n".join(items)]
    if pictures:
        blocks += [
            "## Before and after",
            f"Above {_ABOVE[result.initial is None]}, below the result. {legend}".rstrip(),
            "\n\n".join(f"![{name}]({name})" for name in pictures),
        ]
    versions = ", ".join(f"{name} {number}" for name, number in result.versions.items())
    blocks.append(f"Made by {versions}." if versions else "Settings stand in calibration.json.")
    return "\n\n".join(blocks) + "\n"


def _frames(result: CalibrationResult) -> str:
    drives = sorted({frame.drive for frame in result.frames_used})
    frames, many = len(result.frames_used), len(drives)
    return f"{frames} frame{'s' * (frames != 1)} of {many} drive{'s' * (many != 1)}" + (
        f" ({', '.join(drives)})" if drives else ""
    )


def _sweeps(result: CalibrationResult) -> list[str]:
    """By drive: whether its points are as measured, and how that is known; where it was decided."""
    found = result.diagnostics.get("sweep", {})
    entries = found.items() if isinstance(found, Mapping) else ()
    decided = [(drive, entry) for drive, entry in entries if isinstance(entry, Mapping)]
    decided = [(drive, entry) for drive, entry in decided if entry.get("kind", "given") != "given"]
    return [
        f"{drive}: {entry.get('sentence', '')}" if len(decided) > 1 else str(entry.get("sentence", ""))
        for drive, entry in decided
    ]


def _pose_sigmas(result: CalibrationResult) -> str:
    sigmas = result.sigmas()
    rotation = " ".join(_short(value) for value in sigmas.rotation_deg)
    translation = " ".join(_short(value) for value in sigmas.translation_cm)
    return f"rotation {rotation} deg about, translation {translation} cm along the LiDAR's x y z"


def _offset(result: CalibrationResult) -> str:
    return f"{1e3 * result.time_offset_s:+.2f} ms +- {_sigma_ms(result)}"


def _sigma_ms(result: CalibrationResult) -> str:
    return f"{_short(result.sigmas().time_offset_ms)} ms"


def _milliseconds(time_offset_s: float, sigma_s: float) -> str:
    return f"{1e3 * time_offset_s:+.2f} ms +- {_short(1e3 * sigma_s)} ms"


def _moved(result: CalibrationResult, initial: gtsam.Pose3) -> str:
    turned = quaternion_angle_deg(result.T_camera_lidar.rotation(), initial.rotation())
    shifted = 100.0 * mean_translation_difference_m(result.T_camera_lidar, initial)
    later = 1e3 * (result.time_offset_s - result.initial_time_offset_s)
    return f"from the start by {turned:.2f} deg, {shifted:.1f} cm (mean of x y z), {later:+.1f} ms"


def _euler_rows(result: CalibrationResult) -> list[tuple[str, str, str]]:
    """Angles and translation with the sigmas of just these numbers."""
    R = result.T_camera_lidar.rotation().matrix()
    angles = euler_angles_deg(result.T_camera_lidar.rotation())
    angle_sigmas = _angle_sigmas_deg(angles, result.covariance[:3, :3])
    shift_sigmas = 100.0 * np.sqrt(np.diag(R @ result.covariance[3:6, 3:6] @ R.T))
    rows = [
        (name, f"{angle:.4f} deg", f"{_short(sigma)} deg")
        for name, angle, sigma in zip(("roll", "pitch", "yaw"), angles, angle_sigmas, strict=True)
    ]
    for name, shift, sigma in zip("xyz", result.T_camera_lidar.translation(), shift_sigmas, strict=True):
        rows.append((name, f"{100.0 * shift:.2f} cm", f"{_short(sigma)} cm"))
    return rows


def _offset_rows(result: CalibrationResult) -> list[tuple[str, str, str]]:
    """The time offset, or that of each drive."""
    if not result.drive_offsets:
        return [("time offset", f"{1e3 * result.time_offset_s:+.2f} ms", _sigma_ms(result))]
    return [
        (
            f"time offset of {drive.drive}",
            f"{1e3 * drive.time_offset_s:+.2f} ms",
            f"{_short(1e3 * drive.sigma_s)} ms",
        )
        for drive in result.drive_offsets
    ]


def _angle_sigmas_deg(angles_deg: FloatArray, covariance: FloatArray) -> FloatArray:
    """(3,) sigmas of roll, pitch and yaw, by the covariance (3, 3) of turns about the LiDAR's axes [deg].

    With R = Rz(yaw) Ry(pitch) Rx(roll) and R Exp(w): w_x = d roll - sin(pitch) d yaw, w_y = cos(roll) d pitch
    + cos(pitch) sin(roll) d yaw, w_z = -sin(roll) d pitch + cos(pitch) cos(roll) d yaw.
    """
    (sin_r, sin_p, _), (cos_r, cos_p, _) = np.sin(np.radians(angles_deg)), np.cos(np.radians(angles_deg))
    turns_H_angles = np.array([[1.0, 0.0, -sin_p], [0.0, cos_r, cos_p * sin_r], [0.0, -sin_r, cos_p * cos_r]])
    # At a pitch of 90 degrees roll and yaw are one turn, which they share.
    angles_H_turns = np.linalg.pinv(turns_H_angles)
    return np.degrees(np.sqrt(np.diag(angles_H_turns @ covariance @ angles_H_turns.T)))


def _table(head: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> str:
    lines = [head, tuple("---" for _ in head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _short(value: float) -> str:
    """Two significant digits, without an exponent below a million."""
    return f"{value:.2g}" if value >= 1e6 else figure(value)

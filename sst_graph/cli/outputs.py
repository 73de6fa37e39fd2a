"""What the commands leave behind: the files of a calibration, and the exit code of a result."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sst_graph.cli import EXIT_NOT_TRUSTED
from sst_graph.cli.messages import complain, loudness
from sst_graph.cli.pictures import ShownFrame, overlay, png, telling_positions
from sst_graph.cli.progress import ProgressBar
from sst_graph.data.frame_parts import RecentReader
from sst_graph.files import OutputKind
from sst_graph.inspect.inspection import inspect_result, to_dict
from sst_graph.inspect.reasons import first_reason
from sst_graph.inspect.report import OWN_CALIBRATION, ReferenceErrors, markdown_report
from sst_graph.inspect.verdict import is_start
from sst_graph.metrics import calibration_errors
from sst_graph.odometry.sweep import with_sweep_of
from sst_graph.report import ReportInputs, report_html
from sst_graph.result import CalibrationResult
from sst_graph.types import Source
from sst_graph.viz import Placement
from sst_graph.viz.overlay import legend_of

RESULT_NAME = "calibration.json"
REPORT_NAME = "report.html"

CALIBRATION = OutputKind("calibration")
PICTURES = 3
"""Overlays of a calibration, over all its drives."""


def comparison(result: CalibrationResult, sources: Sequence[Source]) -> ReferenceErrors | None:
    """Errors against what the first drive knows to be true, or None."""
    truth = sources[0].truth
    if truth is None:
        return None
    reference = bool(getattr(sources[0], "truth_is_reference", False))
    if is_start(result) and result.T_camera_lidar.equals(truth.cTl, 1e-9):
        return None  # the start is this very transform: no errors are found in it
    errors = calibration_errors(
        result.T_camera_lidar,
        result.time_offset_s,
        truth,
        None if reference else result.covariance,
    )
    return ReferenceErrors(errors, OWN_CALIBRATION if reference else "the truth")


def write_calibration(
    folder: Path,
    result: CalibrationResult,
    sources: Sequence[Source],
    against: ReferenceErrors | None,
    with_report: bool = True,
) -> list[str]:
    """Write the result's files into ``folder`` (which exists) and return their names.

    Args:
        with_report: write the page with pictures and charts, too.
    """
    with ProgressBar() as progress:
        return _written(folder, result, sources, against, with_report, progress)


def _written(
    folder: Path,
    result: CalibrationResult,
    sources: Sequence[Source],
    against: ReferenceErrors | None,
    with_report: bool,
    progress: ProgressBar,
) -> list[str]:
    pictures, frames, shown_frames = [], [], []
    progress("pictures", 0, PICTURES)
    read = [with_sweep_of(source, result.diagnostics) for source in sources]
    for source, swept, plain in zip(sources, read, _file_names(sources), strict=True):
        drive = RecentReader(swept)
        for position in telling_positions(drive, result, max(1, PICTURES // len(sources))):
            name = f"overlay_{plain}_{drive.number(position):06d}.png"
            shown = ShownFrame.of(drive, position, result)
            shown_frames.append(shown.frame)
            (folder / name).write_bytes(png(overlay(shown, result, placement_before(result, source)).picture))
            if with_report and result.fit is None:  # else the report chooses by the fit
                frames.append(shown.drawn())
            pictures.append(name)
            progress("pictures", len(pictures), max(PICTURES, len(pictures)))
    (folder / RESULT_NAME).write_text(result.to_json(), encoding="utf-8")
    markdown = markdown_report(result, against, pictures, legend_of(shown_frames))
    (folder / "report.md").write_text(markdown, encoding="utf-8")
    if not with_report:
        return [RESULT_NAME, "report.md", *pictures]
    drawn = [one for one in frames if one is not None]
    page = report_html(ReportInputs(result, read, against, drawn), progress.stage("report"))
    (folder / REPORT_NAME).write_text(page, encoding="utf-8")
    return [RESULT_NAME, REPORT_NAME, "report.md", *pictures]


def result_numbers(result: CalibrationResult, against: ReferenceErrors | None) -> dict[str, Any]:
    """What ``--json`` prints of a result: pose, offset, what ``inspect --json`` prints, known errors."""
    return {
        "T_camera_lidar": result.T_camera_lidar.matrix(),
        "time_offset_s": result.time_offset_s,
        **to_dict(inspect_result(result)),
        "errors": None if against is None else dataclasses.asdict(against.errors),
        "errors_against": None if against is None else against.name,
    }


def exit_code(result: CalibrationResult) -> int:
    """Exit code of a result; one line on stderr says why it is not to be trusted: the first reason.

    The summary has a line for each of the first, the report all of it.
    """
    if result.status == "ok":
        return 0
    complain(why_not_ok(result))
    return EXIT_NOT_TRUSTED


def why_not_ok(result: CalibrationResult) -> str:
    """Status and first reason of a result that is not ok, in one line."""
    return f"{result.status}: {first_reason(result, 'the report', summary=not loudness.quiet)}"


def placement_before(result: CalibrationResult, source: Source) -> Placement | None:
    """What a result is compared with: its start, else the data's nominal calibration, else nothing."""
    return start_of(result) or nominal_of(source)


def start_of(result: CalibrationResult) -> Placement | None:
    """The start of a result, if it had one."""
    if result.initial is None:
        return None
    return Placement(result.initial, result.initial_time_offset_s, "before (start)")


def nominal_of(source: Source) -> Placement | None:
    """The data's nominal calibration, if they bring one."""
    return None if source.nominal is None else Placement(source.nominal, 0.0, "before (nominal)")


def _file_names(sources: Sequence[Source]) -> list[str]:
    """A part of a file's name for each drive: letters and digits of its name, and a number where two are
    alike."""
    found: list[str] = []
    for source in sources:
        plain = re.sub(r"[\W_]+", "_", source.name).strip("_")
        free, number = plain, 2
        while free in found:
            free, number = f"{plain}_{number}", number + 1
        found.append(free)
    return found

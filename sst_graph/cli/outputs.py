"""What a calibration leaves behind: calibration.json, report.md, overlays, and a verdict on stderr."""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from pathlib import Path

from sst_graph.cli.overlay import png
from sst_graph.cli.pictures import overlay, telling_positions
from sst_graph.metrics import calibration_errors
from sst_graph.odometry.sweep import with_sweep_of
from sst_graph.report import Comparison, markdown_report
from sst_graph.result import CalibrationResult
from sst_graph.types import Source
from sst_graph.viz import Placement

MARKER = "calibration.json"
"""The file by which a folder is known as ours, and may be replaced."""

PICTURES = 3
"""Overlays of a calibration, over all its drives."""


def comparison(result: CalibrationResult, sources: Sequence[Source]) -> Comparison | None:
    """Errors against what the first drive knows to be true, or None."""
    truth = sources[0].truth
    if truth is None:
        return None
    reference = bool(getattr(sources[0], "truth_is_reference", False))
    errors = calibration_errors(
        result.T_camera_lidar,
        result.time_offset_s,
        truth,
        None if reference else result.covariance,
    )
    name = "the data's own calibration and stamps (a reference, not the truth)" if reference else "the truth"
    return Comparison(errors, name)


def write_calibration(
    folder: Path, result: CalibrationResult, sources: Sequence[Source], against: Comparison | None
) -> list[str]:
    """Write the result's files into ``folder`` (which exists) and return their names."""
    pictures = []
    for source in (with_sweep_of(source, result.diagnostics) for source in sources):
        for position in telling_positions(source, result, max(1, PICTURES // len(sources))):
            name = f"overlay_{_file_name(source.name)}_{source[position].index:06d}.png"
            picture = overlay(source, position, result, _before(result, source))
            (folder / name).write_bytes(png(picture))
            pictures.append(name)
    (folder / MARKER).write_text(result.to_json(), encoding="utf-8")
    (folder / "report.md").write_text(markdown_report(result, against, pictures), encoding="utf-8")
    return [MARKER, "report.md", *pictures]


def verdict(result: CalibrationResult) -> int:
    """Exit code of a result; one line on stderr says why it is not to be trusted."""
    if result.status == "ok":
        return 0
    reasons = "; ".join(result.reasons) or "the result carries no reason"
    print(f"sst-graph: {result.status}: {' '.join(reasons.split())}", file=sys.stderr)
    return 3


def _before(result: CalibrationResult, source: Source) -> Placement | None:
    if result.initial is not None:
        return Placement(result.initial, result.initial_offset_s, "before (start)")
    return None if source.nominal is None else Placement(source.nominal, 0.0, "before (nominal)")


def _file_name(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9]+", "_", name).strip("_")

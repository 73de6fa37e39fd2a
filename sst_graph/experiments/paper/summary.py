"""A table's runs as Markdown and as CSV."""

from __future__ import annotations

import csv
import dataclasses
import io
import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sst_graph.errors import count_of
from sst_graph.experiments.basin import binomial_bounds
from sst_graph.experiments.markdown import NONE, median, table
from sst_graph.experiments.paper.config import START, VARIANTS, PaperTableConfig
from sst_graph.experiments.paper.runs import CaseRun

OURS = "Numbering and layout are ours: they follow the questions of the paper, not its pages."


@dataclass(frozen=True)
class Printed:
    """Figures that the paper prints.

    Attributes:
        name: of the row.
        failed_percent: share of failed runs.
        qad_deg, atd_cm: mean and median.
        time_error_ms: absolute error of the time offset.
    """

    name: str
    failed_percent: float | None = None
    qad_deg: tuple[float, float] | None = None
    atd_cm: tuple[float, float] | None = None
    time_error_ms: float | None = None


@dataclass(frozen=True)
class Layout:
    """What a table looks like.

    Attributes:
        heading: its title.
        printed: rows of the paper.
        with_time: whether it has the columns of the time offset.
    """

    heading: str
    printed: tuple[Printed, ...]
    with_time: bool


def markdown(runs: Sequence[CaseRun], layout: Layout, config: PaperTableConfig) -> str:
    """The table: all streets together, or each drive on disk for itself."""
    lines = [f"**{layout.heading}.** {_conditions(layout, config)}", ""]
    columns = ["method", "failed", "of these flagged", "QAD of all, median [deg]", "QAD [deg]", "AEAD [deg]"]
    columns.append("ATD [cm]")
    if layout.with_time:
        columns[1:1] = ["images late: true / nominal [ms]"]
        columns += ["time offset, median [ms]", "true error [ms]", "nominal error [ms]"]
    for name in dict.fromkeys(run.drive if config.data else "" for run in runs):
        lines += [name, ""] if name else []
        here = [run for run in runs if name in ("", run.drive)]
        rows = []
        for late, method in itertools.product(config.images_late, (START, *config.methods)):
            own = [run for run in here if (run.images_late, run.method) == (late, method)]
            rows.append(_row(own, layout, config))
        rows += [_printed_row(row, layout) for row in layout.printed]
        lines.append(table("| " + " | ".join(columns) + " |", rows))
    return "\n".join(lines)


def csv_text(runs: Sequence[CaseRun], config: PaperTableConfig) -> str:
    """Every run in a row; times in seconds but for the two errors, in milliseconds."""
    text = io.StringIO()
    names = [field.name for field in dataclasses.fields(CaseRun)]
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*names, "failed", "true_error_ms", "nominal_error_ms"])
    for run in runs:
        values = [getattr(run, name) for name in names]
        writer.writerow([*values, run.failed(config), run.true_error_ms, run.nominal_error_ms(config)])
    return text.getvalue()


def _conditions(layout: Layout, config: PaperTableConfig) -> str:
    """The set-up in words."""
    if config.data:
        drives = f"Starts on each drive: {config.starts}"
    else:
        kind = "standing" if config.standing else f"at up to {config.speed_mps:g} m/s"
        last = config.seed + config.streets - 1
        drives = (
            f"Simulated streets: {config.streets} (seeds {config.seed} to {last}, "
            f"{count_of(config.frames, 'frame')}, "
            f"{kind}, label noise {config.label_noise:g}); starts on each: {config.starts}"
        )
    time = (
        " Errors of the time offset are absolute: the true one against the stamps, the nominal one against "
        f"{1e3 * config.nominal_period_s:g} ms a frame."
    )
    return (
        f"{drives}, within ±{config.start_deg:g}° and ±{100 * config.start_m:g} cm by axis. Failed: no "
        f"estimate, QAD above {config.failed_deg:g}° or ATD above {100 * config.failed_m:g} cm, in brackets "
        "the exact 95 % bounds of its probability (Clopper–Pearson); flagged: its "
        "status is not ok. Figures are mean / median of the runs that did not fail; QAD has the median of "
        f"all in a column of its own.{time if layout.with_time else ''} {OURS}"
    )


def _row(own: Sequence[CaseRun], layout: Layout, config: PaperTableConfig) -> list[str]:
    """The runs of one method at one delay."""
    method, late = own[0].method, own[0].images_late
    bad = [run for run in own if run.failed(config)]
    good = [run for run in own if not run.failed(config)]
    empty = sum(not run.estimated for run in own)
    flagged = sum(run.status != "ok" for run in bad)
    cells = [
        method,
        _failures(len(bad), len(own), empty),
        f"{flagged} of {len(bad)}" if bad and method != START else NONE,
        median([run.qad_deg for run in own], 2),
        _mean_median([run.qad_deg for run in good], 2),
        _mean_median([run.aead_deg for run in good], 2),
        _mean_median([100.0 * run.atd_m for run in good], 1),
    ]
    if layout.with_time:
        true = np.mean([1e3 * run.true_offset_s for run in own if run.true_offset_s is not None] or [np.nan])
        nominal = 1e3 * config.nominal_offset_s(late)
        cells[1:1] = [f"{late}: {NONE if np.isnan(true) else f'{true:.1f}'} / {nominal:.0f}"]
        timed = method != START and VARIANTS[method].has_time_offset
        offsets = [1e3 * run.time_offset_s for run in good if timed and run.time_offset_s is not None]
        cells.append(median(offsets, 1))
        cells.append(_mean_median(_absolute([run.true_error_ms for run in good]), 1))
        cells.append(_mean_median(_absolute([run.nominal_error_ms(config) for run in good]), 1))
    return cells


def _failures(count: int, of: int, empty: int) -> str:
    """Failed runs of all, the bounds of their probability, and how many found nothing."""
    low, high = (100.0 * bound for bound in binomial_bounds(count, of))
    return f"{count} of {of} ({low:.0f}–{high:.0f} %{f'; {empty} without an estimate' if empty else ''})"


def _printed_row(row: Printed, layout: Layout) -> list[str]:
    """A row of the paper."""
    cells = [
        f"*printed:* {row.name}",
        NONE if row.failed_percent is None else f"{row.failed_percent:g} %",
        NONE,
        NONE,
        _pair(row.qad_deg),
        NONE,
        _pair(row.atd_cm),
    ]
    if layout.with_time:
        cells[1:1] = ["1"]
        cells += [NONE, NONE if row.time_error_ms is None else f"{row.time_error_ms:g}", NONE]
    return cells


def _absolute(values: Sequence[float | None]) -> list[float]:
    return [abs(value) for value in values if value is not None]


def _pair(values: tuple[float, float] | None) -> str:
    return NONE if values is None else f"{values[0]:g} / {values[1]:g}"


def _mean_median(values: Sequence[float], digits: int) -> str:
    if not values:
        return NONE
    return f"{np.mean(values):.{digits}f} / {np.median(values):.{digits}f}"

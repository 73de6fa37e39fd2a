"""The table and the figure of the peers."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import Any

import numpy as np

from sst_graph.drive.preparation import Progress
from sst_graph.experiments.markdown import NONE, median, table
from sst_graph.experiments.peers.methods import OWN, PEERS
from sst_graph.experiments.peers.runs import START, PeerRun, PeersConfig, runs_of, tasks_of
from sst_graph.experiments.tasks.resumable import Work, rows_of
from sst_graph.files import output_file
from sst_graph.viz.matplotlib_figure import figure_class

_COLOURS = (
    "#d1342f",
    "#2b8a3e",
    "#1c64c8",
    "#c77700",
    "#7b4ab5",
    "#008b8b",
    "#8a6d3b",
    "#b8567f",
    "#5c5c5c",
    "#9aa2ab",
)
_PANEL_IN, _LEGEND_IN = 3.4, 1.5
"""Widths of a panel, and of the legend [in]."""


def run(config: PeersConfig, progress: Progress | None = None) -> str:
    """The tables as Markdown: simulated streets, then real drives; the figure where it is asked for.

    Raises:
        ConfigError: the records are of another kind, or the figure cannot be written.
        DataError: a drive cannot be used.
        MissingDependencyError: a figure is asked for, and matplotlib is not installed.
    """
    figure_of = figure_class() if config.figure else None
    with ExitStack() as outputs:
        # Whether it can be written is known before the runs, which take hours.
        drawn = outputs.enter_context(output_file(config.figure, overwrite=True)) if config.figure else None
        runs = rows_of(Work(runs_of, PeerRun, config.jobs, config.records), tasks_of(config), progress)
        if drawn is not None and figure_of is not None:
            drawn.write_bytes(figure(runs, config, figure_of))
    return markdown(runs, config)


def markdown(runs: Sequence[PeerRun], config: PeersConfig) -> str:
    """The tables: one of streets, one of each real drive."""
    parts = [
        f"Cells: median rotation error [deg] / median ATD [cm] / failed of all (rotation above "
        f"{config.failed_deg:g}° or ATD above {100.0 * config.failed_m:g} cm, or no result). Starts within "
        f"± the angle by axis and ±{100.0 * config.metres_a_degree:g} cm a degree. All are given the true "
        "time offset. *r*: re-implementation. Memory: peak of Python and NumPy beside the "
        "prepared drive (tracemalloc), first start on the first street and on the first drive. Seconds: of "
        "processor time, median.",
    ]
    for title, own in _groups(runs):
        parts += ["", f"**{title}**", "", _table(own, config).rstrip("\n")]
    return "\n".join(parts) + "\n"


def _table(runs: Sequence[PeerRun], config: PeersConfig) -> str:
    head = ["method", *(f"±{r:g}°" for r in config.ranges_deg), "silent", "σ of rotation", "seconds", "MB"]
    rows = []
    for method in dict.fromkeys(row.method for row in runs):
        own = [row for row in runs if row.method == method]
        label = method if method in (START, *OWN) else f"{method} *r*"
        reasons = {row.why_not for row in own}
        if "" not in reasons:
            rows.append([label, min(reasons), *[NONE] * (len(head) - 2)])
            continue
        cells = [_cell([row for row in own if row.range_deg == r], config) for r in config.ranges_deg]
        rows.append([label, *cells, *_remaining_cells(method, own, config)])
    return table("| " + " | ".join(head) + " |", rows)


def _cell(runs: Sequence[PeerRun], config: PeersConfig) -> str:
    failed = sum(row.failed(config) for row in runs)
    qad = _median([row.qad_deg for row in runs], 2)
    rotation_only = any(row.method in PEERS and PEERS[row.method].rotation_only for row in runs)
    atd = "–" if rotation_only else _median([None if r.atd_m is None else 100.0 * r.atd_m for r in runs], 1)
    return f"{qad} / {atd} / {failed}\u00a0of\u00a0{len(runs)}"  # a narrow cell is broken at a slash


def _remaining_cells(method: str, runs: Sequence[PeerRun], config: PeersConfig) -> list[str]:
    if method == START:
        return ["–"] * 4
    silent = sum(row.failed(config) and row.status == "ok" for row in runs)
    return [
        str(silent) if method in OWN else "says nothing",
        _median([row.sigma_deg for row in runs], 2, "°") if method in OWN else "none",
        _median([row.seconds for row in runs], 1),
        _median([row.peak_mb for row in runs], 0),
    ]


def _median(values: Sequence[float | None], digits: int, unit: str = "") -> str:
    return median([value for value in values if value is not None], digits, unit)


def figure(runs: Sequence[PeerRun], config: PeersConfig, figure_of: Callable[..., Any]) -> bytes:
    """SVG: median rotation error against the half width of the starts' error: streets, each real drive."""
    from matplotlib import rc_context

    groups = _groups(runs)
    width = _PANEL_IN * len(groups) + _LEGEND_IN
    drawing = figure_of(figsize=(width, 3.9))
    panels = drawing.subplots(1, len(groups), sharey=True, squeeze=False)[0]
    methods = [name for name in dict.fromkeys(row.method for row in runs) if name != START]
    for axes, (title, some) in zip(panels, groups, strict=True):
        for number, method in enumerate([START, *methods]):
            medians = [_median_error(some, method, r) for r in config.ranges_deg]
            if all(np.isnan(medians)):
                continue
            if method == START:
                style = {"color": "#000000", "ls": ":", "zorder": 3}
            else:
                solid = method in OWN
                style = {"color": _COLOURS[(number - 1) % len(_COLOURS)], "ls": "-" if solid else "--"}
            axes.plot(config.ranges_deg, medians, marker="o", ms=3, lw=1.4, label=method, **style)
        axes.axhline(config.failed_deg, color="#000000", lw=0.6)
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_xticks(config.ranges_deg, [f"±{r:g}" for r in config.ranges_deg])
        axes.minorticks_off()
        axes.tick_params(labelsize=8)
        axes.grid(color="#e6e9ec", lw=0.7)
        axes.set_title(title, fontsize=9)
        axes.set_xlabel("start [deg by axis]", fontsize=8)
        axes.yaxis.set_major_formatter("{x:g}")
    panels[0].set_ylabel("rotation error, median [deg]", fontsize=8)
    handles: dict[str, Any] = {}
    for axes in panels:
        handles |= dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
    drawing.legend(
        handles.values(),
        handles.keys(),
        fontsize=7,
        frameon=False,
        loc="center right",
        title=f"dashed: re-implemented\nabove {config.failed_deg:g}°: failed",
        title_fontsize=7,
    )
    drawing.tight_layout(rect=(0.0, 0.0, 1.0 - _LEGEND_IN / width, 1.0))
    stream = io.BytesIO()
    # No date and no random names: the same runs give the same bytes.
    with rc_context({"svg.hashsalt": "peers"}):
        drawing.savefig(stream, format="svg", metadata={"Date": None})
    return stream.getvalue()


def _groups(runs: Sequence[PeerRun]) -> list[tuple[str, list[PeerRun]]]:
    """All streets together, then each real drive, by their titles."""
    groups: dict[str, list[PeerRun]] = {}
    for row in runs:
        groups.setdefault("simulated streets" if row.simulated else row.drive, []).append(row)
    return list(groups.items())


def _median_error(runs: Sequence[PeerRun], method: str, range_deg: float) -> float:
    values = [row.qad_deg for row in runs if row.method == method and row.range_deg == range_deg]
    known = [value for value in values if value is not None]
    return float(np.median(known)) if known else float("nan")

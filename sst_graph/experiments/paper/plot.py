"""A table's runs as a plot: a dot a run. matplotlib is imported when it is drawn."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from sst_graph.experiments.paper.config import START, PaperTableConfig
from sst_graph.experiments.paper.runs import CaseRun
from sst_graph.experiments.paper.summary import Layout, Printed
from sst_graph.viz.matplotlib_figure import figure_class

_LEAST = 1e-3
"""Smaller values are drawn here, for the axes are logarithmic."""
_COLOURS = ("#9aa2ab", "#d1342f", "#c77700", "#7a4fb5", "#1c64c8", "#2b8a3e")


_OfRun = Callable[[CaseRun], float | None]
_OfPaper = Callable[[Printed], float | None]


def check_plot() -> None:
    """Refuse early where a plot cannot be drawn.

    Raises:
        MissingDependencyError, ConfigError: matplotlib is not installed, or does not start.
    """
    figure_class(", or --set plot=false")


def plot_svg(runs: Sequence[CaseRun], layout: Layout, config: PaperTableConfig) -> str:
    """The plot as SVG: rotation, translation and, where the table has it, the time offset; the paper's own
    figures, medians where it has them, as lines.

    Raises:
        MissingDependencyError, ConfigError: as :func:`check_plot`.
    """
    Figure = figure_class()
    import matplotlib as mpl

    panels: list[tuple[str, _OfRun, _OfPaper]] = [
        ("QAD [deg]", lambda run: run.qad_deg, lambda row: row.qad_deg and row.qad_deg[1]),
        ("ATD [cm]", lambda run: 100.0 * run.atd_m, lambda row: row.atd_cm and row.atd_cm[1]),
    ]
    if layout.with_time:
        title = "absolute error of the time offset, by the stamps [ms]"
        panels.append((title, _absolute_true_error_ms, lambda row: row.time_error_ms))
    text = io.StringIO()
    with mpl.rc_context({"svg.hashsalt": "sst-graph", "font.size": 9.0}):
        figure = Figure(figsize=(4.0 * len(panels), 3.6), layout="constrained")
        for axes, (title, value, printed) in zip(figure.subplots(1, len(panels)), panels, strict=True):
            _panel(axes, runs, config, value)
            for row, dashes in zip(layout.printed, ("--", ":"), strict=False):
                if (height := printed(row)) is not None:
                    axes.axhline(height, color="#1f2328", ls=dashes, lw=1, label=f"{row.name}, as printed")
            if axes.get_legend_handles_labels()[0]:
                axes.legend(fontsize=7, frameon=False)
            axes.set_title(title, fontsize=9)
        figure.suptitle(f"{layout.heading} (crosses: failed runs; bars: medians of all)", fontsize=9)
        figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None})
    return text.getvalue()


def _panel(
    axes: Any, runs: Sequence[CaseRun], config: PaperTableConfig, value: Callable[[CaseRun], float | None]
) -> None:
    """A column of dots for each method and delay."""
    methods = (START, *config.methods)
    labels: list[str] = []
    for late in config.images_late:
        for method in methods:
            own = [run for run in runs if run.method == method and run.images_late == late]
            found = [(run, value(run)) for run in own]
            shown = [(run, max(v, _LEAST)) for run, v in found if v is not None]
            if not shown:
                continue
            at, colour = len(labels), _COLOURS[methods.index(method) % len(_COLOURS)]
            labels.append(f"{method}\n{late} late" if len(config.images_late) > 1 else method)
            spread = np.linspace(-0.25, 0.25, len(shown)) if len(shown) > 1 else np.zeros(1)
            for (run, height), aside in zip(shown, spread, strict=True):
                axes.plot(at + aside, height, "x" if run.failed(config) else ".", color=colour, ms=6)
            middle = float(np.median([height for _, height in shown]))
            axes.plot([at - 0.35, at + 0.35], [middle, middle], color=colour, lw=1.5)
    axes.set_yscale("log")
    axes.set_xticks(range(len(labels)), labels, fontsize=7)
    axes.set_xlim(-0.6, max(len(labels), 1) - 0.4)
    axes.grid(axis="y", color="#e6e9ec", lw=0.7)
    axes.yaxis.set_major_formatter("{x:g}")


def _absolute_true_error_ms(run: CaseRun) -> float | None:
    error = run.true_error_ms
    return None if error is None else abs(error)

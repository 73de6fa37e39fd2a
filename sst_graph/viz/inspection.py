"""Plots of an inspection: ellipses, correlations, sigma over frames, gain by frame, what next, the graph.

matplotlib is imported when a plot is made; pyplot and its global state are left alone.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from sst_graph.errors import count_of
from sst_graph.inspect.inspection import HUMAN, NAMES, UNITS, Inspection, sigma_ellipse
from sst_graph.inspect.planning import AT_REST_MPS, Plan
from sst_graph.sampling import step_for
from sst_graph.viz.graph_plot import draw_graph
from sst_graph.viz.matplotlib_figure import figure_class

_COLOURS = ("tab:red", "tab:green", "tab:blue")
_TURNING_DEGPS = 5.0
_PAIRS = (
    ((0, 1), (0, 2), (1, 2)),
    ((3, 4), (3, 5), (4, 5)),
    ((3, 6), (4, 6), (5, 6)),
)


def inspection_plots(inspection: Inspection) -> dict[str, Any]:
    """matplotlib figures by file name; those about frames only where the result has
    several frames, what to record next where it has one.

    Raises:
        MissingDependencyError, ConfigError: matplotlib is not installed, or does not start.
    """
    Figure = figure_class()

    def figure(width: float, height: float) -> Any:
        return Figure(figsize=(width, height), layout="constrained")

    plots = {
        "ellipses.png": draw_ellipses(figure(10.0, 9.5), inspection),
        "correlation.png": draw_correlation(figure(7.5, 6.5), inspection),
        "graph.png": draw_graph(figure(12.0, 7.0), inspection),
    }
    if len(inspection.frames) > 1:
        plots["sigma_over_frames.png"] = draw_sigma_over_frames(figure(9.0, 9.0), inspection)
        plots["gain_by_frame.png"] = draw_gains(figure(12.0, 7.0), inspection)
    if inspection.plan is not None:
        plots["record_next.png"] = draw_plan(figure(10.0, 4.5), inspection.plan)
    return plots


def draw_ellipses(figure: Any, inspection: Inspection) -> Any:
    """1, 2 and 3 sigma of pairs of unknowns around the estimate, along the LiDAR's axes."""
    covariance = inspection.result.covariance * np.outer(HUMAN, HUMAN)
    axes = figure.subplots(3, 3)
    for ax, (i, j) in zip(axes.flat, (pair for row in _PAIRS for pair in row), strict=True):
        ellipse = sigma_ellipse(covariance[np.ix_((i, j), (i, j))], 181)
        for k, alpha in ((3, 0.12), (2, 0.25), (1, 0.55)):
            ax.fill(*(k * ellipse), color="tab:blue", alpha=alpha, lw=0.0)
        ax.plot(*(3.0 * ellipse), color="tab:blue", lw=0.8)
        ax.axhline(0.0, color="grey", lw=0.5)
        ax.axvline(0.0, color="grey", lw=0.5)
        ax.set_xlabel(f"{NAMES[i]} [{UNITS[i]}]")
        ax.set_ylabel(f"{NAMES[j]} [{UNITS[j]}]")
        ax.set_title(f"correlation {inspection.correlation[i, j]:+.2f}", fontsize=10)
    figure.suptitle("1, 2 and 3 sigma around the estimate, LiDAR axes (each panel has its own scale)")
    return figure


def draw_correlation(figure: Any, inspection: Inspection) -> Any:
    """The 7x7 correlations as colours and numbers."""
    ax = figure.subplots()
    picture = ax.imshow(inspection.correlation, cmap="RdBu_r", vmin=-1.0, vmax=1.0)
    ax.set_xticks(range(7), NAMES, rotation=35, ha="right")
    ax.set_yticks(range(7), NAMES)
    for i in range(7):
        for j in range(7):
            value = float(inspection.correlation[i, j])
            colour = "white" if abs(value) > 0.6 else "black"
            ax.text(j, i, f"{value:+.2f}", ha="center", va="center", color=colour, fontsize=10)
    figure.colorbar(picture, ax=ax, label="correlation")
    ax.set_title("Correlations of extrinsic (LiDAR axes) and time offset")
    return figure


def draw_sigma_over_frames(figure: Any, inspection: Inspection) -> Any:
    """Sigma as frames accumulate, in the record's order; the time offset is that of the frame's drive."""
    final = HUMAN * np.sqrt(np.diag(inspection.result.covariance))
    sigmas = np.stack([frame.so_far for frame in inspection.frames]) * final
    of_drives = {drive.drive: HUMAN[6] * drive.sigma_s for drive in inspection.result.drive_offsets}
    for k, frame in enumerate(inspection.frames):
        sigmas[k, 6] = frame.so_far[6] * of_drives.get(frame.frame.drive, final[6])
    count = np.arange(1, len(sigmas) + 1)
    panels = (("rotation [deg]", (0, 1, 2)), ("translation [cm]", (3, 4, 5)), ("time offset [ms]", (6,)))
    axes = figure.subplots(3, 1, sharex=True)
    for ax, (label, unknowns) in zip(axes, panels, strict=True):
        for unknown, colour in zip(unknowns, _COLOURS, strict=False):
            name = NAMES[unknown].removeprefix("rotation ")
            style = {"color": colour if len(unknowns) > 1 else "black", "label": name}
            ax.plot(count, sigmas[:, unknown], marker="o", ms=3.0, lw=1.2, **style)
        ax.set_yscale("log")
        _plain_ticks(ax.yaxis)
        ax.set_ylabel(f"sigma of {label}")
        ax.grid(True, which="both", alpha=0.25)
        _mark_drives(ax, inspection, 0.5)
        if len(unknowns) > 1:
            ax.legend(loc="upper right", ncols=3)
    axes[-1].set_xlabel("frames so far")
    axes[-1].xaxis.get_major_locator().set_params(integer=True)
    figure.suptitle("Sigma as frames accumulate (LiDAR axes)")
    return figure


def draw_gains(figure: Any, inspection: Inspection) -> Any:
    """Bits that each frame adds to all the others, and how much each sigma grows without it."""
    frames = inspection.frames
    x = np.arange(len(frames))
    top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(1.0, 1.2))
    kinds = [_kind(frame.speed, float(np.degrees(frame.turn_rate))) for frame in frames]
    for kind, colour in (("standing", "tab:green"), ("driving", "tab:blue"), ("turning", "tab:orange")):
        chosen = [k for k, found in enumerate(kinds) if found == kind]
        if chosen:
            top.bar(x[chosen], [frames[k].bits for k in chosen], color=colour, label=kind)
    top.axhline(0.0, color="black", lw=0.6)
    top.set_ylabel("information added\nto all other frames [bit]")
    top.legend(loc="best", ncols=3)
    growth = 100.0 * (np.stack([frame.without for frame in frames]).T - 1.0)
    reach = max(1.0, float(np.quantile(np.abs(growth), 0.98)))
    picture = bottom.imshow(
        growth, aspect="auto", cmap="RdBu_r", vmin=-reach, vmax=reach, interpolation="nearest"
    )
    bottom.set_yticks(range(7), NAMES)
    figure.colorbar(picture, ax=bottom, label="growth of sigma without the frame [%]", extend="both")
    step = step_for(len(frames), 20)
    bottom.set_xticks(x[::step], [str(frames[k].frame.frame) for k in x[::step]])
    several = len({frame.frame.drive for frame in frames}) > 1
    for ax in (top, bottom):
        _mark_drives(ax, inspection, -0.5)
    bottom.set_xlabel("frame" + (" (drives one after the other)" if several else ""))
    figure.suptitle("What each frame brings")
    return figure


def draw_plan(figure: Any, plan: Plan) -> Any:
    """The worst direction, over its limit, as it is and after each proposal."""
    ax = figure.subplots()
    predictions = (plan.now, *plan.motions, plan.nearer)[::-1]
    y = np.arange(len(predictions))
    worst = [prediction.worst for prediction in predictions]
    colours = ["tab:green" if value <= 1.0 else "tab:red" for value in worst]
    ax.barh(y, worst, color=colours)
    for at, value in zip(y, worst, strict=True):
        ax.text(value, at, f" {value:.2g}", va="center", fontsize=9)
    ax.axvline(1.0, color="black", lw=1.0, ls="--")
    ax.annotate(
        "limit", (1.0, 1.01), xycoords=("data", "axes fraction"), va="bottom", ha="center", fontsize=9
    )
    ax.set_xscale("log")
    _plain_ticks(ax.xaxis)
    ax.set_xlim(0.5 * min(0.5, *worst), 2.0 * max(2.0, *worst))
    ax.set_yticks(y, [prediction.name for prediction in predictions])
    ax.set_xlabel("sigma of the direction known worst, over its limit (left of 1: status ok)")
    ax.set_title(f"What {count_of(plan.count, 'more frame')} at other places would bring", pad=16)
    return figure


def _plain_ticks(axis: Any) -> None:
    """A logarithmic axis with ticks at 1, 2 and 5, written as plain numbers."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axis.set_major_locator(LogLocator(base=10.0, subs=(1.0, 2.0, 5.0), numticks=12))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def _mark_drives(ax: Any, inspection: Inspection, shift: float) -> None:
    """A line between drives; position k of the frames is drawn at k + shift + 0.5."""
    names = [frame.frame.drive for frame in inspection.frames]
    for k in range(1, len(names)):
        if names[k] != names[k - 1]:
            ax.axvline(k + shift, color="black", lw=0.8, ls="--")


def _kind(speed: float, turn_degps: float) -> str:
    if speed < AT_REST_MPS and turn_degps < _TURNING_DEGPS:
        return "standing"
    return "turning" if turn_degps >= _TURNING_DEGPS else "driving"

"""Plots of the calibrations in drives.csv, and of the frames in alarm.csv."""

from __future__ import annotations

import alarm
import drives
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter
from scipy.stats import chi2, norm

NAMES = {
    "standing": "standing",
    "constant": "one\nspeed",
    "no_stop": "speed\nvaries",
    "stop_and_go": "stop\nand go",
    "turning": "turning",
}
COLOURS = ("#d1342f", "#2b8a3e", "#1c64c8", "#c77700")
LIMITS = (0.5, 5.0, 10.0)
"""Largest sigma of a result that is ok [deg, cm, ms]: the defaults of ``observability``."""


def observability() -> Figure:
    """Sigma of each unknown by how the vehicle moves; a dot a street, a bar at their median."""
    rows = list(drives.read())
    figure, panels = plt.subplots(1, 3, figsize=(9.0, 3.4))
    groups = (
        ("rotation about", "deg", (0, 1, 2), np.degrees(1.0)),
        ("translation along", "cm", (3, 4, 5), 100.0),
        ("time offset", "ms", (6,), 1000.0),
    )
    for axes, (title, unit, columns, scale), limit in zip(panels, groups, LIMITS, strict=True):
        for place, motion in enumerate(NAMES):
            sigmas = scale * np.array([row.sigmas for row in rows if row.motion == motion])
            for k, column in enumerate(columns):
                at = place + 0.24 * (k - (len(columns) - 1) / 2.0)
                colour = COLOURS[k] if len(columns) > 1 else COLOURS[3]
                axes.plot(np.full(len(sigmas), at), sigmas[:, column], ".", color=colour, ms=4, alpha=0.6)
                axes.plot([at - 0.1, at + 0.1], [np.median(sigmas[:, column])] * 2, color=colour, lw=2.2)
        axes.axhline(limit, color="#9aa2ab", ls="--", lw=1, label="limit of ok")
        axes.set_yscale("log")
        axes.set_xticks(range(len(NAMES)), NAMES.values(), fontsize=7)
        axes.set_title(f"σ of {title}" + (" x, y, z" if len(columns) > 1 else "") + f" [{unit}]", fontsize=9)
        axes.grid(axis="y", color="#e6e9ec", lw=0.7)
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter(NullFormatter())
        low, high = axes.get_ylim()
        axes.set_ylim(low / 1.3, high * 2.5)
    for k, name in enumerate("xyz"):
        panels[0].plot([], [], color=COLOURS[k], lw=2.2, label=f"{name} of the LiDAR")
    for axes in panels:
        axes.legend(fontsize=7, frameon=False, loc="upper right")
    figure.tight_layout()
    return figure


def sigma() -> Figure:
    """Errors in units of the claimed sigma, and the NEES, of all drives that are not not_converged."""
    rows = [row for row in drives.read() if row.status != "not_converged"]
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.0, 3.4), width_ratios=(3, 2))
    ratios = np.array([row.errors / row.sigmas for row in rows])
    for k, name in enumerate(("rotation\nx", "y", "z", "translation\nx", "y", "z", "time\noffset")):
        spread = np.linspace(-0.25, 0.25, len(ratios))
        left.plot(k + spread, ratios[:, k], ".", color="#1c64c8", ms=6)
        left.text(k, -0.02, name, ha="center", va="top", fontsize=8, transform=left.get_xaxis_transform())
    for size, colour in ((2.0, "#eef2f7"), (1.0, "#dbe4ef")):
        left.axhspan(-size, size, color=colour, zorder=0)
    limit = max(3.6, 1.1 * float(np.abs(ratios).max()))
    left.set(xlim=(-0.6, 6.6), ylim=(-limit, limit), xticks=[], ylabel="error / claimed σ")
    within = [float((np.abs(ratios) < size).mean()) for size in (1.0, 2.0)]
    left.set_title(
        f"within 1σ {within[0]:.0%} (ideal {norm.cdf(1) - norm.cdf(-1):.0%}), "
        f"within 2σ {within[1]:.0%} (ideal {norm.cdf(2) - norm.cdf(-2):.0%})",
        fontsize=9,
    )
    nees = np.sort([row.nees for row in rows])
    right.step(nees, np.arange(1, len(nees) + 1) / len(nees), where="post", color="#1c64c8", label="drives")
    grid = np.linspace(0.0, max(22.0, nees[-1]), 200)
    right.plot(grid, chi2.cdf(grid, 7), color="#c77700", label="where σ holds (χ², 7)")
    right.set(xlabel="NEES", ylabel="share of drives below", ylim=(0.0, 1.02), xlim=(0.0, grid[-1]))
    right.set_title(f"mean NEES {nees.mean():.1f} of 7, {len(nees)} drives", fontsize=9)
    right.legend(fontsize=8, frameon=False, loc="lower right")
    figure.tight_layout()
    return figure


STATUS_COLOURS = {"ok": "#2b8a3e", "unconfirmed": "#c77700", "unobservable": "#8b949e"}


def knock() -> Figure:
    """What the tracker says of a camera that is knocked: the estimate, two sigma, the status, the alarm."""
    frames = list(alarm.read())
    figure, axes = plt.subplots(figsize=(9.0, 3.0))
    numbers = np.array([one.frame for one in frames])
    truth = np.where(numbers < alarm.KNOCK, 0.0, alarm.KNOCK_DEG)
    axes.step(numbers, truth, where="post", color="#1f2328", lw=1, label="truth")
    for status, colour in STATUS_COLOURS.items():
        own = [one for one in frames if one.status == status and np.isfinite(one.turn_deg)]
        axes.errorbar(
            [one.frame for one in own], [one.turn_deg for one in own], [2.0 * one.sigma_deg for one in own],
            fmt=".", color=colour, ms=5, elinewidth=1, label=f"estimate ± 2σ, {status}",
        )  # fmt: skip
    for one in frames:
        if one.alarm:
            axes.axvline(one.frame, color="#d1342f", lw=1.5, label=f"alarm, frame {one.frame}")
    axes.set(xlabel="frame", ylabel="turn of the camera [deg]", xlim=(0, len(frames)), ylim=(-0.6, 2.6))
    axes.legend(fontsize=8, frameon=False, loc="upper left")
    axes.grid(axis="y", color="#e6e9ec", lw=0.7)
    figure.tight_layout()
    return figure

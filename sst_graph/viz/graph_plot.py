"""A picture of the factor graph of a result, drawn from the result alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sst_graph.fit import MASK_BIAS
from sst_graph.inspect.inspection import Inspection

MOST_FRAMES = 6
"""Frames drawn; of a longer record the first ones and the last."""

_VARIABLE = {"boxstyle": "circle,pad=0.35", "fc": "white", "ec": "black", "lw": 1.2}
_TOP, _MOTION, _TWIST, _SILHOUETTE, _BIAS = 4.0, 3.0, 2.0, 1.0, 0.0


def draw_graph(figure: Any, inspection: Inspection) -> Any:
    """Circles are unknowns, squares factors. The rows: E and D; motion; V(k); silhouettes; B(class)."""
    ax = figure.subplots()
    result = inspection.result
    frames = [(frame.drive, frame.frame) for frame in result.frames_used]
    shown = frames if len(frames) <= MOST_FRAMES else [*frames[: MOST_FRAMES - 1], frames[-1]]
    n = max(1, len(shown))
    offsets = [drive.drive for drive in result.drive_offsets]
    tops = {"E": ((n - 1) * 0.5 - 0.8, _TOP)}
    for k, drive in enumerate(offsets or [""]):
        tops[f"D{drive}"] = ((n - 1) * 0.5 + 0.8 + 1.1 * k, _TOP)
    biases = _biases(result.diagnostics.get(MASK_BIAS), {drive for drive, _ in shown})
    bases = {
        key: ((n - 1) * (k + 1) / (len(biases) + 1) if n > 1 else float(k), _BIAS)
        for k, key in enumerate(biases)
    }
    twists = result.method in ("joint", "track")
    for k, (drive, frame) in enumerate(shown):
        clock = tops[f"D{drive}" if offsets else "D"]
        mine = [at for (owner, _), at in bases.items() if owner == drive]
        name = f"{drive}:{frame}" if len({owner for owner, _ in frames}) > 1 else f"frame {frame}"
        drawn = _Frame(float(k), f"V{frame}" if twists else None, name, [tops["E"], clock], mine)
        _draw_frame(ax, drawn)
    if len(shown) < len(frames):
        words = f"…\n{len(frames) - len(shown)}\nmore\n…"
        ax.text(n - 1.37, _TWIST, words, ha="center", va="center", fontsize=9)
    _draw_shared(ax, tops, bases)
    ax.set_xlim(min(-0.7, 0.5 * n - 2.5), max(n - 0.4, 0.5 * n + 1.8))
    ax.set_ylim(_BIAS - 0.6, _TOP + 0.75)
    ax.axis("off")
    ax.set_title(_caption(inspection, len(frames)), fontsize=10)
    return figure


@dataclass(frozen=True)
class _Frame:
    """A frame of the picture.

    Attributes:
        x: where its column stands.
        twist: name of its twist's variable; None where it has none.
        name: of its silhouettes.
        tops: places of its extrinsic and time offset.
        bases: places of its mask biases.
    """

    x: float
    twist: str | None
    name: str
    tops: Sequence[tuple[float, float]]
    bases: Sequence[tuple[float, float]]


def _draw_frame(ax: Any, frame: _Frame) -> None:
    """Draw a frame: its twist, its motion and its silhouettes, with their edges."""
    x, silhouette = frame.x, (frame.x, _SILHOUETTE)
    for at in frame.bases:
        _edge(ax, silhouette, at, "tab:orange")
    if frame.twist is not None:
        motion = (x, _MOTION)
        for at in frame.tops:
            _edge(ax, motion, at, "tab:green")
            _bent(ax, silhouette, at)
        _edge(ax, motion, (x, _TWIST), "tab:green")
        _edge(ax, (x, _TWIST), silhouette, "tab:blue")
        _square(ax, motion, "tab:green")
        ax.text(x, _TWIST, frame.twist, ha="center", va="center", fontsize=9, bbox=_VARIABLE, zorder=4)
    else:
        for at in frame.tops:
            _edge(ax, silhouette, at, "tab:blue")
    _square(ax, silhouette, "tab:blue")
    ax.text(x - 0.1, _SILHOUETTE + 0.08, frame.name, ha="right", fontsize=8, color="tab:blue", zorder=4)


def _draw_shared(
    ax: Any,
    tops: Mapping[str, tuple[float, float]],
    bases: Mapping[tuple[str, str], tuple[float, float]],
) -> None:
    """Extrinsic, offsets and mask biases, each with its prior."""
    for name, (x, y) in tops.items():
        _edge(ax, (x, y), (x, y + 0.45), "grey")
        _square(ax, (x, y + 0.45), "grey")
        ax.text(x, y, name[0], ha="center", va="center", fontsize=10, bbox=_VARIABLE, zorder=4)
        ax.text(x + 0.12, y + 0.22, name[1:], va="center", fontsize=8, zorder=4)
    for (drive, label), (x, y) in bases.items():
        _edge(ax, (x, y), (x, y - 0.4), "grey")
        _square(ax, (x, y - 0.4), "grey")
        words = f"B {label}" + (f"\n{drive}" if drive else "")
        ax.text(x, y, words, ha="center", va="center", fontsize=8, bbox={**_VARIABLE, "boxstyle": "round"})


def _biases(found: Any, drives: set[str]) -> list[tuple[str, str]]:
    """(drive, class) of every mask bias that the result names for the drives shown."""
    if not isinstance(found, Mapping):
        return []
    pairs = [tuple(str(name).rpartition(":")[::2]) for name in found]
    return [(drive, label) for drive, label in pairs if drive in drives]


def _caption(inspection: Inspection, frames: int) -> str:
    objects = [frame.objects for frame in inspection.frames]
    few, many = (min(objects), max(objects)) if objects else (0, 0)
    spread = f", {few if few == many else f'{few} to {many}'} objects each" if objects else ""
    own = (
        "; each object has a bias of its own between B and its silhouettes, left out here" if objects else ""
    )
    return (
        f"Factor graph of {frames} frame{'s' * (frames != 1)}{spread}\n"
        f"Circles: unknowns (E extrinsic, D time offset, V twist, B mask bias{own})\n"
        "Squares: factors (blue: silhouettes of a frame, green: motion from odometry, grey: priors)"
    )


def _edge(ax: Any, a: tuple[float, float], b: tuple[float, float], colour: str) -> None:
    ax.plot([a[0], b[0]], [a[1], b[1]], color=colour, lw=0.9, alpha=0.7, zorder=1)


def _bent(ax: Any, a: tuple[float, float], b: tuple[float, float]) -> None:
    """An edge that passes beside the motion factor and the twist above the silhouettes."""
    x = [a[0], a[0] + 0.28, a[0] + 0.28, b[0]]
    ax.plot(x, [a[1], a[1] + 0.5, _MOTION + 0.1, b[1]], color="tab:blue", lw=0.7, alpha=0.45, zorder=1)


def _square(ax: Any, at: tuple[float, float], colour: str) -> None:
    ax.plot(*at, marker="s", ms=9, color=colour, zorder=3)

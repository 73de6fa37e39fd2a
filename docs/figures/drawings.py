"""Drawings of the conventions and of the residual, from geometry alone."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyArrowPatch, Polygon, Rectangle
from numpy.typing import NDArray
from scipy.spatial import cKDTree

X, Y, Z = "#d1342f", "#2b8a3e", "#1c64c8"
"""Red, green and blue for x, y and z, as everywhere in robotics."""
GREY, DARK, AMBER = "#9aa2ab", "#30363d", "#c77700"

FloatArray = NDArray[np.float64]


def frames() -> Figure:
    """The LiDAR's and the camera's axes on a vehicle, from the side and from above."""
    figure, (side, above) = plt.subplots(1, 2, figsize=(9.0, 2.9))
    _vehicle_from_the_side(side)
    lidar, camera = np.array([1.55, 1.95]), np.array([2.15, 1.42])
    _axes(side, lidar, {"x": (1, 0), "z": (0, 1)}, ("y", "into"))
    _axes(side, camera, {"z": (1, 0), "y": (0, -1)}, ("x", "out"))
    side.annotate("LiDAR  l", lidar, (0.05, 2.45), arrowprops=_leader(), ha="left")
    side.annotate("camera  c", camera, (2.3, 2.3), arrowprops=_leader(), ha="left")
    point = np.array([5.35, 0.95])
    side.plot(*point, "o", color=DARK, ms=5)
    side.text(point[0], point[1] - 0.32, "P", ha="center")
    for origin, name, lift in ((lidar, "lP", 0.16), (camera, "cP", -0.3)):
        side.add_patch(_arrow(origin, point, DARK, dashed=True))
        middle = 0.35 * origin + 0.65 * point
        side.text(middle[0] + 0.1, middle[1] + lift, name, ha="center", color=DARK)
    side.set_title("from the side (the vehicle drives to the right)", fontsize=9)
    _frame(side, (-0.2, 5.8), (-0.2, 2.95))

    _vehicle_from_above(above)
    lidar, camera = np.array([1.55, 0.0]), np.array([2.15, -0.35])
    _axes(above, lidar, {"x": (1, 0), "y": (0, 1)}, ("z", "out"))
    _axes(above, camera, {"z": (1, 0), "x": (0, -1)}, ("y", "into"))
    above.text(1.5, -0.42, "l", ha="center", weight="bold")
    above.text(2.45, -0.68, "c", ha="center", weight="bold")
    above.set_title("from above", fontsize=9)
    _frame(above, (-0.2, 6.3), (-1.6, 1.6))
    above.text(3.65, -0.9, "cP = cTl · lP\np_camera = T_camera_lidar · p_lidar", ha="left", va="top")
    above.text(
        3.65, 1.2, "x red, y green, z blue\n⊙ towards you, ⊗ away from you", ha="left", va="top", color=DARK
    )
    figure.tight_layout()
    return figure


def clocks() -> Figure:
    """Stamps of both sensors on the LiDAR's clock, and what the offset does to a pair."""
    period, offset = 100.0, 70.0
    figure, axes = plt.subplots(figsize=(9.0, 2.9))
    axes.set(xlim=(-75.0, 372.0), ylim=(-0.95, 2.35))
    axes.axis("off")
    for height, text in ((1.6, "LiDAR's clock"), (0.4, "camera's clock")):
        axes.add_patch(_arrow(np.array([-12.0, height]), np.array([365.0, height]), DARK))
        axes.text(-72.0, height, text, va="center", weight="bold")
    for k in range(4):
        stamp = k * period
        axes.plot([stamp] * 2, [1.5, 1.7], color=Z, lw=2.5)
        axes.text(stamp, 1.83, f"scan\n{stamp:.0f} ms", ha="center", color=Z)
        if stamp + offset < 360.0:
            axes.plot([stamp + offset] * 2, [0.3, 0.5], color=AMBER, lw=2.5)
            axes.text(stamp + offset, 0.17, f"image\n{stamp:.0f} ms", ha="center", va="top", color=AMBER)
    shown, scan = period + offset, 2.0 * period
    axes.plot([shown] * 2, [0.5, 1.6], color=AMBER, ls=":", lw=1.4)
    for stamp in (period, scan):
        axes.plot([stamp] * 2, [0.7, 1.5], color=Z, ls=":", lw=1.2)
    axes.add_patch(_arrow(np.array([period, 0.82]), np.array([shown, 0.82]), DARK))
    axes.text(period - 4.0, 0.82, "time_offset_s = +70 ms", va="center", ha="right")
    axes.add_patch(_arrow(np.array([scan, 1.15]), np.array([shown, 1.15]), X))
    axes.text(scan + 5.0, 1.15, "τ = (t_image + offset) − t_point = −30 ms", va="center", ha="left", color=X)
    axes.text(
        150.0, -0.5,
        "The image stamped 100 ms shows the world at LiDAR time 170 ms; the scan at 200 ms is nearest.",
        ha="center", va="top",
    )  # fmt: skip
    figure.tight_layout()
    return figure


def matches() -> Figure:
    """The matches of SST-Calib, and those of the joint method, on the same displaced points."""
    outline = _car()
    shift = np.array([11.0, 6.0])
    interior, boundary = _points(outline)
    figure, (paper, ours) = plt.subplots(1, 2, figsize=(9.0, 2.9), sharex=True, sharey=True)
    pixels = np.array([uv for uv in _grid(13.0) if _inside(outline, uv)])
    points = interior + shift
    for axes in (paper, ours):
        axes.add_patch(Polygon(outline, fc="#e8edf3", ec=DARK, lw=1.3))
        axes.set_aspect("equal")
        axes.axis("off")
        axes.set(xlim=(-16.0, 242.0), ylim=(106.0, -22.0))
    outside = np.array([not _inside(outline, uv) for uv in points])
    _, nearest = cKDTree(_dense(outline)).query(points)
    paper.plot(*points.T, ".", color=Z, ms=4)
    for k in np.flatnonzero(outside):
        paper.add_patch(_arrow(points[k], _dense(outline)[nearest[k]], Z, thin=True))
    distance, nearest = cKDTree(points).query(pixels)
    for k in np.flatnonzero(distance > 7.0):
        paper.add_patch(_arrow(pixels[k], points[nearest[k]], AMBER, thin=True))
    paper.set_title("SST-Calib: points of the class ↔ pixels of the class", fontsize=9)
    paper.text(0.0, -12.0, "point to pixel", color=Z)
    paper.text(80.0, -12.0, "pixel to point", color=AMBER)

    edge = boundary + shift
    dense, normals = _dense(outline), _normals(outline)
    _, nearest = cKDTree(dense).query(edge)
    ours.plot(*edge.T, ".", color=Z, ms=6)
    for uv, k in zip(edge, nearest, strict=True):
        along = normals[k] @ (uv - dense[k])
        ours.plot(*zip(uv, uv - along * normals[k], strict=True), color=X, lw=1.4)
    ours.set_title("joint: boundary points → contour, across it", fontsize=9)
    ours.text(0.0, -12.0, "boundary point", color=Z)
    ours.text(90.0, -12.0, "r = n · (uv − q) + bias", color=X)
    figure.tight_layout()
    return figure


def _axes(axes: Axes, at: FloatArray, directions: dict[str, tuple[int, int]], third: tuple[str, str]) -> None:
    """Two axes in the plane of the drawing, and the one that points out of it or into it."""
    colours = {"x": X, "y": Y, "z": Z}
    for name, direction in directions.items():
        end = at + 0.75 * np.array(direction)
        axes.add_patch(_arrow(at, end, colours[name]))
        axes.text(*(at + 0.93 * np.array(direction)), name, color=colours[name], ha="center", va="center")
    name, sense = third
    axes.add_patch(Circle((at[0], at[1]), 0.11, fc="white", ec=colours[name], lw=1.6, zorder=4))
    mark = {"out": ".", "into": "x"}[sense]
    axes.plot(*at, mark, color=colours[name], ms=5, zorder=5)
    axes.text(at[0] - 0.22, at[1] - 0.2, name, color=colours[name], ha="center", va="center")


def _vehicle_from_the_side(axes: Axes) -> None:
    body = [
        (0.1, 0.25),
        (0.1, 0.85),
        (0.75, 0.95),
        (1.05, 1.45),
        (2.2, 1.45),
        (2.7, 0.95),
        (3.4, 0.82),
        (3.45, 0.25),
    ]
    axes.add_patch(Polygon(body, fc="#edf0f3", ec=GREY))
    for x in (0.8, 2.75):
        axes.add_patch(Circle((x, 0.22), 0.3, fc="white", ec=GREY))
    axes.plot([-0.2, 5.8], [-0.08, -0.08], color=GREY, lw=1)
    axes.add_patch(Rectangle((1.42, 1.45), 0.26, 0.5, fc="#d7dce2", ec=GREY))


def _vehicle_from_above(axes: Axes) -> None:
    axes.add_patch(Rectangle((0.1, -0.85), 3.35, 1.7, fc="#edf0f3", ec=GREY))
    axes.add_patch(Rectangle((0.95, -0.7), 1.4, 1.4, fc="#f7f8fa", ec=GREY))


def _frame(axes: Axes, across: tuple[float, float], up: tuple[float, float]) -> None:
    axes.set(xlim=across, ylim=up)
    axes.set_aspect("equal")
    axes.axis("off")


def _arrow(
    start: FloatArray, end: FloatArray, colour: str, *, dashed: bool = False, thin: bool = False
) -> FancyArrowPatch:
    return FancyArrowPatch(
        (start[0], start[1]), (end[0], end[1]), arrowstyle="-|>", mutation_scale=6 if thin else 11,
        shrinkA=0, shrinkB=0, color=colour, lw=0.8 if dashed or thin else 1.8, ls="--" if dashed else "-",
    )  # fmt: skip


def _leader() -> dict[str, object]:
    return {"arrowstyle": "-", "color": GREY, "lw": 0.8}


def _car() -> FloatArray:
    """Outline of a car in the image [px], clockwise as seen (y down)."""
    return np.array([
        (6.0, 62.0), (14.0, 44.0), (52.0, 36.0), (78.0, 8.0), (142.0, 4.0), (172.0, 34.0), (214.0, 42.0),
        (222.0, 64.0), (220.0, 84.0), (196.0, 88.0), (182.0, 98.0), (164.0, 88.0), (64.0, 88.0), (50.0, 98.0),
        (34.0, 88.0), (8.0, 84.0),
    ])  # fmt: skip


def _dense(outline: FloatArray) -> FloatArray:
    """Points of the outline, half a pixel apart."""
    return np.concatenate([_edge(a, b) for a, b in zip(outline, np.roll(outline, -1, axis=0), strict=True)])


def _edge(a: FloatArray, b: FloatArray) -> FloatArray:
    share = np.linspace(0.0, 1.0, int(2.0 * np.hypot(*(b - a))), endpoint=False)[:, None]
    return np.asarray(a + share * (b - a))


def _normals(outline: FloatArray) -> FloatArray:
    """Outward normals at the points of :func:`_dense`."""
    normals = []
    for a, b in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        along = (b - a) / np.hypot(*(b - a))
        normals.append(np.repeat([[along[1], -along[0]]], len(_edge(a, b)), axis=0))
    return np.concatenate(normals)


def _inside(outline: FloatArray, uv: FloatArray) -> bool:
    a, b = outline, np.roll(outline, -1, axis=0)
    crosses = (a[:, 1] > uv[1]) != (b[:, 1] > uv[1])
    with np.errstate(divide="ignore", invalid="ignore"):
        at = a[:, 0] + (uv[1] - a[:, 1]) / (b[:, 1] - a[:, 1]) * (b[:, 0] - a[:, 0])
    return bool((crosses & (uv[0] < at)).sum() % 2)


def _grid(step: float) -> FloatArray:
    u, v = np.meshgrid(np.arange(4.0, 230.0, step), np.arange(2.0, 100.0, step))
    return np.stack([u.ravel(), v.ravel()], axis=1)


def _points(outline: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Where scan lines 9 px apart meet the car: points 9 px apart, and the first and last of each line."""
    interior, boundary = [], []
    for v in np.arange(9.0, 88.0, 9.0):
        along = [u for u in np.arange(0.0, 230.0, 1.0) if _inside(outline, np.array([u, v]))]
        interior += [(u, v) for u in along[::9]]
        boundary += [(along[0], v), (along[-1], v)]
    return np.array(interior), np.array(boundary)

"""Charts of the residuals: by frame, by object, over the picture, over range and azimuth."""

from __future__ import annotations

import gtsam
import numpy as np

from sst_graph.errors import count_of
from sst_graph.factors.camera import PinholeCamera
from sst_graph.fit import CLOSE_PX, Fit, PointResiduals
from sst_graph.report.chart import BROAD, Chart
from sst_graph.report.html import figure, numbered
from sst_graph.report.overlay import CLASS_NAMES
from sst_graph.result import CalibrationResult
from sst_graph.types import BoolArray, FloatArray, IntArray, SemanticClass

_MOST_OBJECTS = 30
"""Objects of the chart: those with the most points."""
_LEAST_POINTS = 15
"""Fewest points whose mean is drawn."""
_BINS = 12
_CELLS = 9, 4
"""Cells of the vector field across and down the picture."""
_LEAST_IN_CELL, _LEAST_IN_CELL_BY_EDGES = 12, 40
"""Fewest points of a cell that is drawn: where their strongest edge is often another one, a few tell nothing.
"""
_RIDGE = 0.05
"""Share of a cell's points whose contours must run in another direction for a shift along them to count."""
_MOST_PX = 6.0
"""Residuals farther out are drawn at the border [px]."""


def residual_charts(fit: Fit) -> list[str]:
    """Charts that stand beside each other, as figures."""
    points = fit.points
    return [
        _histogram(fit),
        _by_frame(fit),
        _binned(
            points, np.linalg.norm(points.lPs, axis=1), "range [m]", "Over the range", _range_caption(fit)
        ),
        _binned(
            points,
            _azimuths_deg(points.lPs),
            "azimuth of the LiDAR [deg], left is positive",
            "Over the azimuth",
            _AZIMUTH,
        ),
    ]


def broad_charts(fit: Fit, result: CalibrationResult) -> list[str]:
    """Charts that are as wide as the page, as figures."""
    return [_by_object(fit, result.T_camera_lidar), _over_picture(fit, result.camera)]


def _azimuths_deg(lPs: FloatArray) -> FloatArray:
    """(n,) azimuths of points (n, 3) without a step among them: past 180 deg where a camera looks back."""
    x, y, _ = lPs.T
    azimuths, middle = np.arctan2(y, x), np.arctan2(y.mean(), x.mean())
    return np.asarray(np.degrees(middle + (azimuths - middle + np.pi) % (2.0 * np.pi) - np.pi))


_AZIMUTH = (
    "Median and middle half of the residuals. Steps or slopes that are wider than the band speak of a wrong "
    "focal length, a distortion or a sweep that is not compensated."
)


def _range_caption(fit: Fit) -> str:
    also = "" if fit.by_edges else " (or of masks)"
    return (
        "Median and middle half of the residuals. A trend towards near points is an error of the "
        f"translation; one at all ranges alike is one of the rotation{also}."
    )


def _histogram(fit: Fit) -> str:
    points = fit.points
    edges = np.arange(-_MOST_PX, _MOST_PX + 0.25, 0.5)
    counts, _ = np.histogram(points.residuals_px, edges)
    shares = 100.0 * counts / max(1, len(points))
    chart = Chart(
        (-_MOST_PX, _MOST_PX),
        (0.0, 1.1 * float(shares.max())),
        (f"distance to the {_edge_name(fit)} [px], outside is positive", "points [%]"),
        "Histogram of the residuals",
    )
    middles = 0.5 * (edges[1:] + edges[:-1])
    for close, colour in ((True, "good"), (False, "bad")):
        chosen = (np.abs(middles) < CLOSE_PX) == close
        titles = [
            f"{m - 0.25:g} to {m + 0.25:g} px: {s:.1f} %"
            for m, s in zip(middles[chosen], shares[chosen], strict=True)
        ]
        chart.bars(middles[chosen], shares[chosen], 0.46, colour, titles)
    caption = (
        f"One peak about 0, most of it within {CLOSE_PX:g} px (green), is what a right calibration shows."
    )
    if fit.by_edges:
        caption = (
            f"A sharp peak about 0 (green: within {CLOSE_PX:g} px) is what a right calibration shows. It "
            "stands on points whose strongest edge nearby is another one: those are spread over all "
            "distances, and under a wrong calibration they are all there is."
        )
    return figure(chart.svg(), "Residuals of all boundary points", caption)


def _by_frame(fit: Fit) -> str:
    points, count = fit.points, len(fit.frames)
    if count < 2:
        return ""
    close = np.full(count, np.nan)
    for k, own in enumerate(_groups(points.frames, count)):
        if len(own) >= _LEAST_POINTS:
            close[k] = 100.0 * np.mean(np.abs(points.residuals_px[own]) < CLOSE_PX)
    chart = Chart(
        (0, count - 1),
        (0.0, 100.0),
        ("frame, in order", "close points [%]"),
        "Share of close points by frame",
    )
    titles = [
        f"{frame.drive}, frame {frame.scan}: {value:.0f} %"
        for frame, value in zip(fit.frames, close, strict=True)
    ]
    known = np.flatnonzero(np.isfinite(close))
    if fit.quality.by_chance is None:
        chart.level(100.0 * fit.quality.attainable, "what the labels allow")
    else:
        chart.level(100.0 * fit.quality.share, "all frames")
        chart.level(100.0 * fit.quality.by_chance, "at random rotations", "b")
    chart.line(known, close[known], "a")
    chart.dots(known, close[known], "a", titles=[titles[k] for k in known], size=3.0)
    return figure(
        chart.svg(),
        "By frame",
        f"Share of the points within {CLOSE_PX:g} px. A step that stays is a mount that moved or a lost "
        f"image; single dips are frames with poor {'pictures' if fit.by_edges else 'labels'}.",
    )


def _by_object(fit: Fit, cTl: gtsam.Pose3) -> str:
    points = fit.points
    ordered = _objects(points)
    if not ordered:
        return ""
    groups, middles = [own for own, _ in ordered], [middle for _, middle in ordered]
    names = [f"{_name(points.take(own), cTl)}: {middle:+z.2f} px" for own, middle in ordered]
    most = max(1.0, float(np.abs(middles).max()))
    chart = Chart(
        (0.5, len(groups) + 0.5),
        (-1.1 * most, 1.1 * most),
        (
            "object, by its residual" if fit.by_edges else "object, from drawn too large to drawn too small",
            "mean residual [px]",
        ),
        "Mean residual of each object",
    )
    chart.count_along_x()
    chart.level(0.0)
    chart.bars(np.arange(1, len(groups) + 1), np.array(middles), 0.8, "a", names)
    return figure(
        chart.svg(),
        "By object",
        f"The {count_of(len(groups), 'object')} with the most points. "
        + (
            "Points far off are weighed down. Most err by less than 1 px; an object far out moves, or has a "
            "strong edge beside its outline."
            if fit.by_edges
            else "Most labels err by less than 1 px; an object far out is drawn badly, or moves."
        ),
        below=numbered(names),
        kind="listed",
    )


def object_numbers(points: PointResiduals) -> dict[int, int]:
    """Number under which the chart by object has each track; only those that it shows."""
    return {int(points.tracks[own[0]]): k for k, (own, _) in enumerate(_objects(points), start=1)}


def _objects(points: PointResiduals) -> list[tuple[IntArray, float]]:
    """Positions of the points of the objects with the most of them, and their mean residual [px], by which
    they are ordered; none of a single object."""
    tracks, numbers = np.unique(points.tracks, return_inverse=True)
    groups = [own for own in _groups(numbers.reshape(-1), len(tracks)) if len(own) >= _LEAST_POINTS]
    groups = sorted(groups, key=len, reverse=True)[:_MOST_OBJECTS]
    if len(groups) < 2:
        return []
    middles = [mean_residual_px(points, own) for own in groups]
    return [(groups[k], middles[k]) for k in np.argsort(middles)]


def mean_residual_px(points: PointResiduals, chosen: IntArray | BoolArray | slice) -> float:
    """Mean residual of some points, those that are far off weighed down [px]."""
    return float(np.average(points.residuals_px[chosen], weights=points.weights[chosen] + 1e-9))


def _name(points: PointResiduals, cTl: gtsam.Pose3) -> str:
    """What an object is, how far from the LiDAR and where before the camera, and in how many frames."""
    right, _, forward = cTl.transformFrom(np.median(points.lPs, axis=0))
    aside = round(float(np.degrees(np.arctan2(right, forward))))
    side = f"{abs(aside)}° {'right' if aside > 0 else 'left'}" if aside else "ahead"
    class_name = CLASS_NAMES[SemanticClass(int(points.classes[0]))]
    frames = count_of(len(np.unique(points.frames)), "frame")
    return (
        f"{class_name} at {np.median(np.linalg.norm(points.lPs, axis=1)):.0f} m, {side}, "
        f"{count_of(len(points), 'point')} in {frames}"
    )


def _over_picture(fit: Fit, camera: PinholeCamera) -> str:
    points = fit.points
    columns, rows = _CELLS
    uvs = points.pixels
    cell = (
        (uvs * [columns / camera.width, rows / camera.height])
        .astype(np.intp)
        .clip(0, [columns - 1, rows - 1])
    )
    numbers = cell[:, 1] * columns + cell[:, 0]
    least = _LEAST_IN_CELL_BY_EDGES if fit.by_edges else _LEAST_IN_CELL
    places, shifts, titles = [], [], []
    for own in _groups(numbers, columns * rows):
        if len(own) < least:
            continue
        n, w = points.normals[own], points.weights[own]
        H = n.T @ (w[:, None] * n)
        H += _RIDGE * np.trace(H) * np.eye(2)
        shift = np.linalg.solve(H, n.T @ (w * points.residuals_px[own]))
        places.append(uvs[own].mean(axis=0))
        shifts.append(shift)
        titles.append(f"{shift[0]:+z.2f} px right, {shift[1]:+z.2f} px down, {count_of(len(own), 'point')}")
    if not places:
        return ""
    at, by = np.array(places), np.array(shifts)
    longest = max(0.5, float(np.linalg.norm(by, axis=1).max()))
    enlarged = float(f"{0.09 * camera.width / longest:.1g}")
    (left, top), (right, bottom) = _around(camera, at + enlarged * by).tolist()
    chart = Chart(
        (left, right),
        (top, bottom),
        ("column [px]", "row [px]"),
        f"Mean shift of the points against the {_edge_name(fit)}, over the picture",
        down=True,
        square=True,
    )
    chart.arrows(at[:, 0], at[:, 1], enlarged * by[:, 0], enlarged * by[:, 1], titles)
    drawn = f'<div class="broad">{chart.svg(BROAD)}</div><div class="narrow">{chart.svg()}</div>'
    return figure(
        drawn,
        "Over the picture",
        f"Where the points lie against the {_edge_name(fit)}s, {enlarged:g} times enlarged (longest "
        f"{longest:.2f} px). Short arrows in all directions are good; a common direction, a swirl or a star "
        "is a calibration or a lens that is wrong. Where there is no arrow, there are fewer than "
        f"{least} points.",
        kind="wide",
    )


def _around(camera: PinholeCamera, ends: FloatArray) -> FloatArray:
    """(2, 2) first and last column and row of a picture, farther out where ends (n, 2) of arrows leave it."""
    margin, size = _BESIDE_PX, np.array([camera.width, camera.height], np.float64)
    low, high = ends.min(axis=0) - margin, ends.max(axis=0) + margin
    return np.array([np.minimum(0.0, low), np.maximum(size, high)])


_BESIDE_PX = 6.0
"""Room around the ends of arrows, which have heads [px]."""


def _binned(points: PointResiduals, values: FloatArray, label: str, title: str, caption: str) -> str:
    edges = np.unique(np.quantile(values, np.linspace(0.0, 1.0, _BINS + 1)))
    if len(edges) < 3 or len(values) < 4 * _LEAST_POINTS:
        return ""
    numbers = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, len(edges) - 2)
    quartiles, middles = [], []
    for own in _groups(numbers, len(edges) - 1):
        if len(own) >= _LEAST_POINTS:
            quartiles.append(np.quantile(points.residuals_px[own], (0.25, 0.5, 0.75)))
            middles.append(float(np.median(values[own])))
    if not middles:
        return ""
    low, middle, high = np.array(quartiles).T
    most = min(_MOST_PX, max(2.0, 1.1 * float(np.abs([low, high]).max())))
    chart = Chart(
        (min(middles), max(middles)), (-most, most), (label, "residual [px]"), f"Residuals: {title}"
    )
    chart.level(0.0)
    chart.band(middles, low, high, "a", "middle half")
    chart.line(middles, middle, "a", "median")
    return figure(chart.svg(), title, caption)


def _edge_name(fit: Fit) -> str:
    """What points are compared with."""
    return "strongest edge" if fit.by_edges else "contour"


def _groups(numbers: IntArray, count: int) -> list[IntArray]:
    """Positions of each number 0 ... count - 1."""
    order = np.argsort(numbers, kind="stable")
    return np.split(order, np.searchsorted(numbers[order], np.arange(1, count)))

"""A picture with the cloud before and after the calibration, as data that the page's script draws."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sst_graph.factors.camera import PinholeCamera
from sst_graph.features.mask_contour import ContourMap
from sst_graph.fit import PointResiduals
from sst_graph.report.drawn_frame import DrawnFrame
from sst_graph.report.html import jpeg, packed, text
from sst_graph.sampling import step_for
from sst_graph.types import Calibration, FloatArray, SemanticClass

_MOST_WIDTH = 1600
"""Wider pictures are made smaller [px]."""
_MOST_POINTS = 14_000
"""Points of the scan that are drawn: with more, every second, third, ... is."""
_HIDDEN = 65535
"""Column and row of a point that is not in the picture."""
_NO_RESIDUAL = -128
_RESIDUAL_STEPS = 8.0
"""Residuals are stored in steps of 1/8 px, up to 15.9 px."""
CLASS_NAMES = {c: c.name.lower().replace("_", " ") for c in SemanticClass}


@dataclass(frozen=True)
class Placements:
    """Where the cloud is drawn: before and after.

    Attributes:
        before: at the start; None without a start.
        after: in the result.
        camera: of the result, with what was estimated of its lens.
    """

    before: Calibration | None
    after: Calibration
    camera: PinholeCamera


def overlay(drawn: DrawnFrame, placements: Placements, points: PointResiduals | None, edge_name: str) -> str:
    """A picture with the cloud of one frame, for the page's script.

    Args:
        points: the frame's boundary points, where residuals are known.
        edge_name: what they are compared with.
    """
    picture, scale = _fitted(drawn.image.pixels)
    columns = _cloud(drawn, placements)
    of_cloud = np.unique(columns[3])
    if points is not None and len(points):
        columns = [
            np.concatenate(pair) for pair in zip(columns, _boundary(drawn, placements, points), strict=True)
        ]
    before, after, depths, classes, before_px, after_px = columns
    size = picture.shape[1], picture.shape[0]
    data = {
        "width": size[0],
        "height": size[1],
        "before": None if placements.before is None else _pixels(before, scale, size),
        "after": _pixels(after, scale, size),
        "depth": packed(np.clip(100.0 * depths, 0, 65534).astype(np.uint16)),
        "class": packed(classes.astype(np.uint8)),
        "residualBefore": packed(_steps(before_px)),
        "residual": packed(_steps(after_px)),
        "contours": _contours(drawn, classes_of(points), scale),
        "classes": {str(int(c)): CLASS_NAMES[c] for c in sorted(SemanticClass(int(c)) for c in of_cloud)},
        "edge": edge_name,
    }
    frame = drawn.frame
    alt = f"Image {frame.image} of {frame.drive} with the LiDAR's points of scan {frame.scan} drawn over it"
    return (
        f'<div class="overlay"><canvas width="{size[0]}" height="{size[1]}" role="img" '
        f'aria-label="{text(alt)}"></canvas><img hidden alt="" src="{jpeg(picture)}">'
        f'<script type="application/json">{_in_script(data)}</script>'
        f"<noscript>{text(alt)}: this picture needs JavaScript.</noscript></div>"
    )


def classes_of(points: PointResiduals | None) -> list[SemanticClass]:
    """Classes that are matched; vehicles where no point says."""
    if points is None or not len(points):
        return [SemanticClass.VEHICLE]
    return [SemanticClass(int(c)) for c in np.unique(points.classes)]


def project_points(
    drawn: DrawnFrame, points: PointResiduals, placement: Calibration
) -> tuple[FloatArray, FloatArray]:
    """(n, 2) pixels of boundary points of the frame [px], NaN behind the camera, and depths (n,) [m]."""
    cTl, time_offset_s = placement
    taus_s = time_offset_s + points.base_taus_s
    return drawn.placed(points.lPs + taus_s[:, None] * points.l_velocities, taus_s, cTl)


def _cloud(drawn: DrawnFrame, placements: Placements) -> list[FloatArray]:
    """Pixels before and after, depths, classes and (no) residuals of points in one of the pictures."""
    after, depths = drawn.through(placements.camera).projected(*placements.after)
    before = after if placements.before is None else drawn.projected(*placements.before)[0]
    seen = np.flatnonzero(drawn.camera.in_image(after) | drawn.camera.in_image(before))
    seen = seen[:: step_for(len(seen), _MOST_POINTS)]
    seen = seen[np.argsort(-depths[seen])]
    none = np.full(len(seen), np.nan)
    classes = drawn.scan.classes[seen].astype(np.float64)
    return [before[seen], after[seen], depths[seen], classes, none, none]


def _boundary(drawn: DrawnFrame, placements: Placements, points: PointResiduals) -> list[FloatArray]:
    after, depths = project_points(drawn.through(placements.camera), points, placements.after)
    before = after if placements.before is None else project_points(drawn, points, placements.before)[0]
    # The contour stays, so the residual changes by the pixel's step across it.
    change = ((before - after) * points.normals).sum(axis=1)
    before_px = points.residuals_px + np.where(np.isfinite(change), change, np.inf)
    return [before, after, depths, points.classes.astype(np.float64), before_px, points.residuals_px]


def _fitted(pixels: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], float]:
    scale = min(1.0, _MOST_WIDTH / pixels.shape[1])
    if scale == 1.0:
        return pixels, 1.0
    size = round(scale * pixels.shape[1]), round(scale * pixels.shape[0])
    return np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), np.uint8), scale


def _pixels(uvs: FloatArray, scale: float, size: tuple[int, int]) -> str:
    """Columns, then rows, as fractions of the picture's size in 16 bit."""
    places = (scale * (uvs + 0.5)) / size
    inside = np.asarray(((places >= 0.0) & (places <= 1.0)).all(axis=1))
    stored = np.where(inside[:, None], np.round(np.nan_to_num(places) * 65534.0), _HIDDEN)
    return packed(stored.astype(np.uint16).T.copy())


def _steps(residuals_px: FloatArray) -> NDArray[np.int8]:
    steps = np.clip(np.round(_RESIDUAL_STEPS * np.nan_to_num(residuals_px, posinf=1e3)), -127, 127)
    return np.where(np.isnan(residuals_px), _NO_RESIDUAL, steps).astype(np.int8)


def _contours(drawn: DrawnFrame, classes: Sequence[SemanticClass], scale: float) -> list[list[int]]:
    """Outlines of the classes, column and row in turn [px of the drawn picture]."""
    found = []
    for c in classes:
        contour = ContourMap.in_image(drawn.image, c)
        if contour is None:
            continue
        inside = (contour.distance < 0.0).astype(np.uint8)
        outlines, _ = cv2.findContours(inside, cv2.RETR_LIST, cv2.CHAIN_APPROX_TC89_L1)
        for outline in outlines:
            places = scale * (outline[:, 0] + [contour.left + 0.5, contour.top + 0.5])
            found.append(np.round(places).astype(int).reshape(-1).tolist())
    return found


def _in_script(data: object) -> str:
    """JSON that cannot end the script it stands in."""
    return json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")

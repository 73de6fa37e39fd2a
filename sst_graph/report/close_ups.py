"""Close-ups of single objects: points, contour or edges of the picture, and how far the calibration's
uncertainty moves them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from sst_graph.errors import count_of
from sst_graph.factors import residuals
from sst_graph.factors.matches import Alignment
from sst_graph.features.mask_contour import ContourMap
from sst_graph.fit import CLOSE_PX, Fit, PointResiduals
from sst_graph.graph.linear import covariance_root
from sst_graph.inspect.misfit import LENS_COUNTS
from sst_graph.inspect.pixels import covariance_of_given_lens, drawn_covariance
from sst_graph.report.drawn_frame import DrawnFrame, DriveReader
from sst_graph.report.html import jpeg, text
from sst_graph.report.overlay import CLASS_NAMES, Placements, project_points
from sst_graph.report.residual_charts import mean_residual_px, object_numbers
from sst_graph.result import CalibrationResult
from sst_graph.types import FloatArray, IntArray, SemanticClass

COUNT = 10
"""Close-ups of a report."""
_WORST = 3
"""How many of them, at most, are those whose labels, or edges, agree least."""
_PARTS = 3
"""Parts of the record in each of which an object may be shown."""
_APART_PX = 120.0
"""Close-ups of one part of the record lie farther apart than this [px]: tracks of objects break."""
_LEAST_POINTS, _LEAST_SHOWN = 12, 3
"""Fewest boundary points of an object that is shown, and of its part in the close-up."""
ZOOM = 8
"""Enlargement: of an object that is larger, the part that determines most is shown."""
_WIDTH, _HEIGHT = 416, 312
"""Size of a close-up [px of the page]."""
_SIZE_PX = np.array([_WIDTH, _HEIGHT]) // ZOOM
"""What it shows of the picture [px]."""
_MARGIN_PX = 4.0
"""Picture around the points that are shown [px]."""
_DARK_AND_BRIGHT = 1.0, 99.0
"""Percentiles of the grey levels that become black, and :data:`_WHITE`."""
_WHITE, _MOST_GAIN = 230.0, 3.0
"""Grey level of what is bright, and most that contrast is raised: more would show noise."""
_EDGE_PX = 0.8
"""Half the length at which an edge of the picture is drawn [px]."""
_SIDE_NAMES = ("left", "right", "top", "bottom")


@dataclass(frozen=True)
class ObjectInFrame:
    """An object in one frame.

    Attributes:
        points: positions of its boundary points.
        share: of the information that the whole drive gives, on average over the unknowns.
        worst: whether it is shown because its labels, or edges, agree least.
        number: in the chart by object; None where that leaves it out.
    """

    points: IntArray
    share: float
    worst: bool = False
    number: int | None = None


def telling_detections(points: PointResiduals, covariance: FloatArray) -> list[ObjectInFrame]:
    """Objects of which what is shown determines most, then those that agree least, worse than half of all;
    with few of them, the same in other frames.

    Args:
        covariance: (7, 7) of the result.
    """
    leverages = _leverages(points, covariance)
    total = max(float(leverages.sum()), 1e-12)
    frames = 1 + int(points.frames.max(initial=0))
    best: dict[tuple[int, int], tuple[float, ObjectInFrame]] = {}
    for own in _by_detection(points):
        shown = own[_shown(points.pixels[own], leverages[own])]
        if len(own) < _LEAST_POINTS or len(shown) < _LEAST_SHOWN:
            continue
        track, frame = int(points.tracks[own[0]]), int(points.frames[own[0]])
        key, found = (track, frame * _PARTS // frames), float(leverages[shown].sum())
        if key not in best or found > best[key][0]:
            best[key] = found, ObjectInFrame(own, float(leverages[own].sum()) / total)
    seen: set[int] = set()
    firsts: list[ObjectInFrame] = []
    again: list[ObjectInFrame] = []
    for (track, _), (_, detection) in sorted(best.items(), key=lambda item: -item[1][0]):
        (again if track in seen else firsts).append(detection)
        seen.add(track)
    parts = points.frames * _PARTS // frames
    ranked = _apart([*firsts, *again], points, parts)
    misfits = [_misfit_px(points.take(one.points)) for one in ranked]
    usual = float(np.median(misfits)) if misfits else 0.0
    off = [k for k in range(COUNT - _WORST, len(ranked)) if misfits[k] > usual]
    least = sorted(off, key=lambda k: -misfits[k])[:_WORST]
    strong = [one for k, one in enumerate(ranked) if k not in least][: COUNT - len(least)]
    return [*strong, *(replace(ranked[k], worst=True) for k in least)]


def _apart(ranked: Sequence[ObjectInFrame], points: PointResiduals, parts: IntArray) -> list[ObjectInFrame]:
    """Detections that are not beside a better one in the same part (n,) of the record, which come last."""
    places = [points.pixels[one.points].mean(axis=0) for one in ranked]
    first: list[int] = []
    for k, one in enumerate(ranked):
        near = (
            float(np.linalg.norm(places[k] - places[other])) < _APART_PX
            and parts[one.points[0]] == parts[ranked[other].points[0]]
            for other in first
        )
        if not any(near):
            first.append(k)
    return [ranked[k] for k in first] + [one for k, one in enumerate(ranked) if k not in first]


def _misfit_px(points: PointResiduals) -> float:
    """How far an object is off [px]: single edges of pictures often are, the mean of an object's is not."""
    if _has_contours(points):
        return float(np.median(np.abs(points.residuals_px)))
    return abs(mean_residual_px(points, slice(None)))


def close_ups(
    fit: Fit, result: CalibrationResult, placements: Callable[[str], Placements], reader: DriveReader
) -> list[str]:
    """Figures of the objects that tell most; frames that cannot be read are left out.

    Args:
        placements: where the cloud of a drive is drawn, by its name.
    """
    found, numbers = [], object_numbers(fit.points)
    for detection in telling_detections(fit.points, result.covariance):
        points = fit.points.take(detection.points)
        drawn = reader.frame(fit.frames[int(points.frames[0])])
        if drawn is not None:
            number = numbers.get(int(points.tracks[0]))
            of_object = replace(detection, number=number)
            found.append(_close_up(drawn, points, of_object, placements(drawn.frame.drive), result))
    return found


def _by_detection(points: PointResiduals) -> list[IntArray]:
    order = np.lexsort((points.tracks, points.frames))
    frames, tracks = points.frames[order], points.tracks[order]
    new = (np.diff(frames, prepend=-1) != 0) | (np.diff(tracks, prepend=-1) != 0)
    return np.split(order, np.flatnonzero(new)[1:])


def _leverages(points: PointResiduals, covariance: FloatArray) -> FloatArray:
    """(n,) part of each point in the information, in units of the result's."""
    root, _ = covariance_root(covariance)
    return np.asarray(points.weights * ((points.J @ root) ** 2).sum(axis=1) / points.sigmas_px**2)


def _close_up(
    drawn: DrawnFrame,
    points: PointResiduals,
    detection: ObjectInFrame,
    placements: Placements,
    result: CalibrationResult,
) -> str:
    uvs, _ = project_points(drawn.through(placements.camera), points, placements.after)
    A = _uv_H_unknowns(drawn, points, placements)
    moves = _two_sigma_moves(A, covariance_of_given_lens(result))
    crop = _Crop.around(uvs, _leverages(points, result.covariance), drawn.image.pixels)
    picture = crop.enlarged(drawn.image.pixels)
    class_name = CLASS_NAMES[SemanticClass(int(points.classes[0]))]
    r = points.residuals_px
    size = float(np.median(np.abs(r)))
    reach = float(np.median(np.linalg.norm(moves, axis=1)))
    range_m = float(np.median(np.linalg.norm(points.lPs, axis=1)))
    by_edges = not _has_contours(points)
    worst = "edges agree least" if by_edges else "labels agree least"
    telling = "tells most" if result.fit_is_check else "determines most"
    name = class_name if detection.number is None else f"{class_name} {detection.number}"
    title = f"{name} at {range_m:.0f} m, {worst if detection.worst else telling}"
    of_kind = f" of the {'edges' if by_edges else 'labels'}" if len(result.fits) > 1 else ""
    information = f"{100.0 * detection.share:.1f} % of the information{of_kind}. "
    if result.fit_is_check:
        information = ""
    sides = ", ".join(
        f"{_SIDE_NAMES[side]} {mean_residual_px(points, points.sides == side):+z.1f} px"
        for side in np.unique(points.sides)
    )
    column, row = (0.5 * np.array([crop.left + crop.right, crop.top + crop.bottom])).astype(int)
    caption = (
        f"{size:.1f} px from the {'edges' if by_edges else 'contour'} (median of "
        f"{count_of(len(r), 'point')}; {sides}), "
        f"{100.0 * np.mean(np.abs(r) < CLOSE_PX):.0f} % within {CLOSE_PX:g} px. ±2 sigma of the calibration "
        f"moves it by ±{reach:.1f} px{_by_lens(A, points, uvs, result, reach)}. {information}"
        f"{drawn.frame.drive}, image {drawn.frame.image}, about column {column}, row {row}."
    )
    width, height = picture.shape[1], picture.shape[0]
    lines = _picture_edges(points, crop) if by_edges else _contour_path(drawn, points, crop)
    marks = [f'<path class="contour" d="{lines}"/>']
    for (u, v), (du, dv), (x, y), value in zip(
        crop.places(uvs), ZOOM * moves, crop.places(points.pixels), r, strict=True
    ):
        colour = "good" if abs(value) < CLOSE_PX else "bad"
        marks.append(f'<path class="spread" d="M{u - du:.1f} {v - dv:.1f}L{u + du:.1f} {v + dv:.1f}"/>')
        marks.append(f'<path class="residual" d="M{u:.1f} {v:.1f}L{x:.1f} {y:.1f}"/>')
        marks.append(
            f'<circle class="point {colour}" cx="{u:.1f}" cy="{v:.1f}" r="3">'
            f"<title>{value:+z.1f} px</title></circle>"
        )
    return (
        f'<figure><h3>{text(title)}</h3><svg class="closeup" viewBox="0 0 {width} {height}" role="img" '
        f'aria-label="{text(title)}"><image width="{width}" height="{height}" href="{jpeg(picture)}"/>'
        + "".join(marks)
        + f"</svg><figcaption>{text(caption)}</figcaption></figure>"
    )


def _has_contours(points: PointResiduals) -> bool:
    """Whether an object is compared with a contour; else with edges of the picture, point by point."""
    return int(points.classes[0]) != SemanticClass.OBJECT


def _uv_H_unknowns(drawn: DrawnFrame, points: PointResiduals, placements: Placements) -> FloatArray:
    """(n, 2, 7) derivative of the pixels by extrinsic and time offset."""
    cTl, time_offset_s = placements.after
    alignment = Alignment(
        drawn.camera,
        points.lPs,
        points.base_taus_s,
        points.pixels,
        np.ones(()),
        c_acceleration=drawn.frame.c_acceleration,
        l_velocities=points.l_velocities,
    )
    _, J = residuals(alignment, cTl, time_offset_s, drawn.frame.c_twist)
    return np.stack([J[: len(points), :7], J[len(points) :, :7]], axis=1)


def _two_sigma_moves(A: FloatArray, covariance: FloatArray) -> FloatArray:
    """(n, 2) how two sigma of a calibration with a covariance (7, 7) move each point, along what moves the
    object most [px].

    Args:
        A: (n, 2, 7) derivative of the pixels by extrinsic and time offset.
    """
    root, _ = covariance_root(covariance)
    reaches = A.reshape(-1, 7) @ root
    _, directions = np.linalg.eigh(reaches.T @ reaches)
    return np.asarray(2.0 * A @ (root @ directions[:, -1]))


def _by_lens(
    A: FloatArray, points: PointResiduals, uvs: FloatArray, result: CalibrationResult, reach_px: float
) -> str:
    """What the lens adds to two sigma, in words; empty where it adds little.

    Args:
        A: (n, 2, 7) derivative of the pixels (n, 2) by extrinsic and time offset.
        reach_px: two sigma of the calibration with the lens that is given [px].
    """
    largest = [
        float(np.linalg.eigvalsh(drawn_covariance(result, lP, uv, J))[-1])
        for lP, uv, J in zip(points.lPs, uvs, A, strict=True)
    ]
    both_px = 2.0 * float(np.sqrt(max(0.0, np.median(largest))))
    if both_px < LENS_COUNTS * reach_px:
        return ""
    return f", or by ±{both_px:.1f} px where the lens is off, too, as far as is assumed"


def _shown(uvs: FloatArray, importance: FloatArray) -> NDArray[np.bool_]:
    """(n,) which of points (n, 2) are in the close-up: all, or where they are more than it holds, those
    around one of them that are most important (n,)."""
    near = np.asarray((np.abs(uvs[:, None] - uvs[None]) <= 0.5 * _SIZE_PX - _MARGIN_PX).all(axis=2))
    return np.asarray(near[int(np.argmax(near @ importance))])


@dataclass(frozen=True)
class _Crop:
    """A part of a picture, enlarged.

    Attributes:
        left, top, right, bottom: columns and rows, the last ones not included.
    """

    left: int
    top: int
    right: int
    bottom: int

    @classmethod
    def around(cls, uvs: FloatArray, importance: FloatArray, pixels: NDArray[np.uint8]) -> _Crop:
        """Points (n, 2) with what is around them, in the size of a close-up; the most important (n,) where
        they are more than that."""
        size, shown = _SIZE_PX, uvs[_shown(uvs, importance)]
        last = np.maximum(np.array(pixels.shape[1::-1]) - size, 0)
        middle = 0.5 * (np.nanmin(shown, axis=0) + np.nanmax(shown, axis=0))
        left, top = np.clip(np.round(middle - 0.5 * size).astype(int), 0, last).tolist()
        right, bottom = np.minimum(np.array([left, top]) + size, pixels.shape[1::-1]).tolist()
        return cls(left, top, right, bottom)

    def enlarged(self, pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The part, as bright as a picture can be."""
        part = pixels[self.top : self.bottom, self.left : self.right]
        low, high = np.percentile(part, _DARK_AND_BRIGHT).tolist()
        gain = min(_WHITE / max(high - low, 1.0), _MOST_GAIN)
        fine = cv2.resize(part, None, fx=ZOOM, fy=ZOOM, interpolation=cv2.INTER_CUBIC).astype(np.float64)
        return np.asarray(np.clip(gain * (fine - low), 0.0, 255.0), np.uint8)

    def places(self, uvs: FloatArray) -> FloatArray:
        """(n, 2) where pixels lie in the close-up."""
        return np.asarray(ZOOM * (uvs + 0.5 - [self.left, self.top]))


def _picture_edges(points: PointResiduals, crop: _Crop) -> str:
    """The picture's edge that each point is compared with, as the path of an SVG."""
    along = _EDGE_PX * np.stack([-points.normals[:, 1], points.normals[:, 0]], axis=1)
    ends = zip(crop.places(points.pixels - along), crop.places(points.pixels + along), strict=True)
    return "".join(f"M{a:.1f} {b:.1f}L{c:.1f} {d:.1f}" for (a, b), (c, d) in ends)


def _contour_path(drawn: DrawnFrame, points: PointResiduals, crop: _Crop) -> str:
    """The contour of the object's class within the crop, below a pixel, as the path of an SVG."""
    semantic_class = SemanticClass(int(points.classes[0]))
    contour = ContourMap.in_image(drawn.image, semantic_class)
    if contour is None:
        return ""
    rows, columns = contour.distance.shape
    top, left = max(0, crop.top - contour.top), max(0, crop.left - contour.left)
    bottom, right = min(rows, crop.bottom - contour.top), min(columns, crop.right - contour.left)
    if bottom <= top or right <= left:
        return ""
    times = 4
    part = contour.distance[top:bottom, left:right]
    fine = cv2.resize(part, None, fx=times, fy=times, interpolation=cv2.INTER_LINEAR)
    outlines, _ = cv2.findContours((fine < 0.0).astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_TC89_L1)
    found = []
    for outline in outlines:
        at = outline[:, 0]
        cut = np.asarray(((at <= 1) | (at >= np.array(fine.shape[1::-1]) - 2)).any(axis=1))
        found.append(_path((at + 0.5) / times - 0.5 + [left + contour.left, top + contour.top], crop, cut))
    return "".join(found)


def _path(uvs: FloatArray, crop: _Crop, cut: NDArray[np.bool_]) -> str:
    """A closed line through points (n, 2), without what runs along the crop's border: cut (n,)."""
    places, gone = crop.places(uvs), cut & np.roll(cut, 1)
    moves = ["M" if skip or k == 0 else "L" for k, skip in enumerate(gone.tolist())]
    line = "".join(f"{move}{u:.1f} {v:.1f}" for move, (u, v) in zip(moves, places, strict=True))
    return line if gone[0] else f"{line}L{places[0, 0]:.1f} {places[0, 1]:.1f}"

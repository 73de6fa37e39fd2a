"""LiDAR points and the masks' contours drawn over the camera image, before and after a calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Any

import cv2
import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.errors import DataError
from sst_graph.factors.camera import PinholeCamera
from sst_graph.factors.motion import CameraTwist, moved_points
from sst_graph.features.mask_contour import ContourMap
from sst_graph.points import transformed_points
from sst_graph.types import Calibration, CameraImage, FloatArray, Frame, Scan, SemanticClass

Picture = NDArray[np.uint8]
Colour = tuple[int, int, int]

IN_MASK: Colour = (80, 220, 60)
OUT_OF_MASK: Colour = (60, 60, 255)
CONTOUR: Colour = (0, 230, 255)
NOT_MATCHED: Colour = (0, 110, 200)
CLASS_COLOURS: dict[SemanticClass, Colour] = {
    SemanticClass.GROUND: (160, 90, 130),
    SemanticClass.TERRAIN: (110, 150, 110),
    SemanticClass.BUILDING: (190, 170, 110),
    SemanticClass.FENCE: (150, 130, 170),
    SemanticClass.VEGETATION: (70, 140, 60),
    SemanticClass.POLE: (60, 190, 230),
    SemanticClass.SIGN: (60, 190, 230),
    SemanticClass.PERSON: (90, 90, 240),
    SemanticClass.TWO_WHEELER: (180, 60, 200),
}
"""BGR of the points by class; a class that is not named here is grey."""
OTHER_COLOUR: Colour = (150, 150, 150)
_DEPTHS_M = 3.0, 60.0
"""Depths at the ends of the colours of a scan without labels [m]."""
_LEGEND_DEPTHS_M = 3, 10, 30, 60

MIN_WIDTH_PX = 720
"""Smaller pictures are enlarged by a whole factor to at least this width."""

_LEAST_SCALE = 0.1
"""Of letters: smaller ones cannot be read."""


@dataclass(frozen=True, eq=False)
class Placement(Calibration):
    """One way to place the LiDAR in the camera, and a caption.

    Attributes:
        caption: words over the picture, such as "before".
    """

    caption: str = ""


def draw_overlay(
    frame: Frame,
    camera: PinholeCamera,
    cTl: gtsam.Pose3,
    time_offset_s: float,
    c_twist: FloatArray | None = None,
    caption: str = "",
) -> Picture:
    """The image with the scan's points and the contours of the vehicle mask -> (h + strip, w, 3) BGR.

    Vehicle points are green inside the vehicle mask and red outside; the others take the colour of
    their class. Those of a scan without labels take the colour of their depth. Contours follow the
    picture, as they do in a calibration by default, and are darker where it shows no edge and nothing is
    matched. Points are moved to the image's instant by ``c_twist`` (6,) [rad/s, m/s], the camera's twist in
    its own frame; None leaves them where they were at their own time.

    Raises:
        DataError: the frame lacks its scan or its image, or the image has another size than the camera.
    """
    contour = None if frame.image is None else ContourMap.in_image(frame.image, SemanticClass.VEHICLE)
    return draw_placement(frame, contour, camera, Placement(cTl, time_offset_s, caption), c_twist)


def draw_placement(
    frame: Frame,
    contour: ContourMap | None,
    camera: PinholeCamera,
    at: Placement,
    c_twist: FloatArray | None = None,
) -> Picture:
    """As :func:`draw_overlay`, where the contour of the image's vehicles is known.

    Raises:
        DataError: the frame lacks its scan or its image, or the image has another size than the camera.
    """
    scan, image = _both(frame, camera)
    uvs, classes, depths_m = _projected(scan, image, camera, at.cTl, at.time_offset_s, c_twist)
    zoom = -(-MIN_WIDTH_PX // camera.width)
    picture = _enlarged(_backdrop(image), zoom)
    _draw_contours(picture, contour, zoom)
    mask_class = _at(image.mask, uvs)[classes == SemanticClass.VEHICLE]
    uvs = (uvs + 0.5) * zoom - 0.5
    if not scan.has_labels:
        _draw_points(picture, uvs, _depth_colours(depths_m), 2)
        return np.vstack([_strip(picture.shape[1], _by_depth(at.caption)), picture])
    _draw_classes(picture, uvs, classes)
    vehicles = uvs[classes == SemanticClass.VEHICLE]
    inside = mask_class == SemanticClass.VEHICLE
    outside = ~inside & (mask_class != SemanticClass.IGNORE)
    _draw_points(picture, vehicles[inside], IN_MASK, 2)
    _draw_points(picture, vehicles[outside], OUT_OF_MASK, 2)
    words = _by_class(at.caption, int(inside.sum()), int(outside.sum()))
    return np.vstack([_strip(picture.shape[1], words), picture])


def legend_of(frames: Sequence[Frame]) -> str:
    """What :func:`draw_overlay` draws of some frames, in sentences."""
    labelled = [frame.scan.has_labels for frame in frames if frame.scan is not None]
    masks = [frame.image.mask for frame in frames if frame.image is not None]
    outlined = any((mask == SemanticClass.VEHICLE).any() for mask in masks)
    sentences = []
    if any(labelled):
        sentences.append(
            "Vehicle points: green inside the image's vehicle mask, red outside; others by their class."
        )
    if not all(labelled):
        whose = "Scans without labels: points" if any(labelled) else "Points"
        sentences.append(f"{whose} by depth, red near, blue far.")
    if outlined:
        sentences.append("The contour is that of the vehicle mask.")
    return " ".join(sentences)


def stacked(above: Picture, below: Picture) -> Picture:
    """Two pictures of the same width, one above the other."""
    return np.vstack([above, np.full((6, above.shape[1], 3), 255, np.uint8), below])


def _both(frame: Frame, camera: PinholeCamera) -> tuple[Scan, CameraImage]:
    if frame.scan is None or frame.image is None:
        missing = "scan" if frame.scan is None else "image"
        raise DataError(f"frame {frame.index}", f"no {missing}", "a scan and an image to draw")
    height, width = frame.image.mask.shape
    if (width, height) != (camera.width, camera.height):
        raise DataError(
            f"frame {frame.index}", f"an image of {width}x{height}", f"{camera.width}x{camera.height}"
        )
    return frame.scan, frame.image


def _projected(
    scan: Scan,
    image: CameraImage,
    camera: PinholeCamera,
    cTl: gtsam.Pose3,
    time_offset_s: float,
    c_twist: FloatArray | None,
) -> tuple[FloatArray, NDArray[np.uint8], FloatArray]:
    """Pixels (m, 2), classes (m,) and depths (m,) [m] of the points on the image, far ones first."""
    lPs = scan.points.astype(np.float64)
    if c_twist is None:
        cPs = transformed_points(cTl, lPs)
    else:
        taus_s = np.full(len(lPs), (image.stamp_ns - scan.stamp_ns) * 1e-9 + time_offset_s)
        if scan.offsets_s is not None:
            taus_s -= scan.offsets_s
        cPs = moved_points(cTl, lPs.T, taus_s, CameraTwist(c_twist, np.zeros(6)), "se3", None).cPs.T
    uvs = camera.project(cPs)
    seen = np.flatnonzero(camera.in_front(cPs))
    seen = seen[camera.in_image(uvs[seen])]
    seen = seen[np.argsort(-cPs[seen, 2])]
    return uvs[seen], scan.classes[seen], cPs[seen, 2]


def _backdrop(image: CameraImage) -> Picture:
    """The picture at 70 % brightness and half its colour, so that the points stand out; grey without one."""
    if not image.has_picture:
        return np.full((*image.mask.shape, 3), 60, np.uint8)
    grey = cv2.cvtColor(cv2.cvtColor(image.pixels, cv2.COLOR_BGR2GRAY), cv2.COLOR_GRAY2BGR)
    return np.asarray(cv2.addWeighted(image.pixels, 0.35, grey, 0.35, 0.0), dtype=np.uint8)


def _enlarged(picture: NDArray[Any], times: int) -> NDArray[Any]:
    """The picture or mask with each pixel repeated, so that points keep apart and the legend fits."""
    return picture.repeat(times, axis=0).repeat(times, axis=1)


def _draw_classes(picture: Picture, uvs: FloatArray, classes: NDArray[np.uint8]) -> None:
    for label in np.unique(classes):
        if label not in (SemanticClass.VEHICLE, SemanticClass.IGNORE):
            colour = CLASS_COLOURS.get(SemanticClass(label), OTHER_COLOUR)
            _draw_points(picture, uvs[classes == label], colour, 1)


def _depth_colours(depths_m: FloatArray) -> NDArray[np.uint8]:
    """(n, 3) BGR, from red (near) to blue."""
    near, far = np.log(_DEPTHS_M)
    steps = np.clip(230.0 - 210.0 * (np.log(depths_m) - near) / (far - near), 20.0, 230.0).astype(np.uint8)
    table = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], cv2.COLORMAP_TURBO)
    return np.asarray(table.reshape(256, 3)[steps], dtype=np.uint8)


def _draw_points(picture: Picture, uvs: FloatArray, colour: Colour | NDArray[np.uint8], size_px: int) -> None:
    """Squares of ``size_px`` at pixels (n, 2), in one colour or in (n, 3) BGR."""
    height, width = picture.shape[:2]
    columns, rows = np.floor(uvs + 0.5).astype(np.int64).T
    for right in range(size_px):
        for down in range(size_px):
            picture[np.minimum(rows + down, height - 1), np.minimum(columns + right, width - 1)] = colour


def _draw_contours(picture: Picture, contour: ContourMap | None, zoom: int) -> None:
    """The contour that points are matched to, as it follows the picture; darker where nothing is matched."""
    if contour is None:
        return
    outlines, _ = cv2.findContours(
        (_enlarged(contour.distance, zoom) < 0.0).astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE
    )
    for columns, rows in (outline[:, 0].T for outline in outlines):
        unknown = contour.unknown[rows // zoom, columns // zoom] > 0
        colours = np.where(unknown[:, None], NOT_MATCHED, CONTOUR)
        picture[rows + contour.top * zoom, columns + contour.left * zoom] = colours


def _at(mask: NDArray[np.uint8], uvs: FloatArray) -> NDArray[np.uint8]:
    """(n,) mask values at the pixels (n, 2) that lie on the image."""
    columns, rows = np.floor(uvs + 0.5).astype(np.int64).T
    return np.asarray(mask[rows, columns])


def _by_class(caption: str, inside: int, outside: int) -> list[tuple[str, Colour]]:
    """The legend of a scan with labels."""
    # No share: of all points, it hardly falls where a calibration is a few tenths of a degree off.
    return [
        (caption, (255, 255, 255)),
        (f"vehicle points: {inside} in the mask", IN_MASK),
        (f"{outside} outside", OUT_OF_MASK),
        ("contour", CONTOUR),
        ("not matched", NOT_MATCHED),
    ]


def _by_depth(caption: str) -> list[tuple[str, Colour]]:
    """The legend of a scan without labels."""
    colours = _depth_colours(np.array(_LEGEND_DEPTHS_M, dtype=np.float64)).tolist()
    shown = [
        (f"{depth_m} m", (int(blue), int(green), int(red)))
        for depth_m, (blue, green, red) in zip(_LEGEND_DEPTHS_M, colours, strict=True)
    ]
    return [(caption, (255, 255, 255)), ("points by depth:", (255, 255, 255)), *shown]


def _strip(width: int, legend: list[tuple[str, Colour]]) -> Picture:
    """A strip of ``width`` pixels with words in their colours, in letters that fit."""
    parts = [(f"{words}   ", colour) for words, colour in legend if words]
    font, scale = cv2.FONT_HERSHEY_SIMPLEX, 0.6
    height = cv2.getTextSize("".join(words for words, _ in parts), font, scale, 1)[0][1]

    def ends() -> list[int]:
        widths = [cv2.getTextSize(words, font, scale, 1)[0][0] for words, _ in parts]
        return list(accumulate(widths, initial=8))

    # As they are drawn, part by part: widths are whole pixels, and do not shrink quite as the scale does.
    while (over := ends()[-1] / (width - 8)) > 1.0 and scale > _LEAST_SCALE:
        scale /= max(over, 1.01)
    strip = np.full((height + 14, width, 3), 30, np.uint8)
    for (words, colour), left in zip(parts, ends(), strict=False):
        cv2.putText(strip, words, (left, height + 6), font, scale, colour, 1, cv2.LINE_AA)
    return strip

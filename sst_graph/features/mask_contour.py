"""Signed distance to the contour of a class in an image mask, below a pixel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from sst_graph.features.image_edges import FloatMap, Picture, PictureEdges, find_picture_edges
from sst_graph.features.sampling import sampled
from sst_graph.files.array_store import ArrayStore, shape_of, storable
from sst_graph.types import CameraImage, FloatArray, IntArray, PixelStretch, SemanticClass

_SMOOTHING_PX = 1.0
"""Gaussian smoothing of the distances [px]: a mask's contour is a staircase of pixels."""
BORDER_PX = 3.0
"""Nothing is matched this close to the image's border [px]: objects are cut there."""
REACH_PX = 64
"""The field ends this far around the class [px]: beyond the farthest match, three times the widest kernel."""
MIN_GRADIENT = 0.3
"""A distance field whose gradient is shorter than this has no clear nearest contour (a ridge)."""
_CROSS = np.array([[0.0, 1.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0, -1.0]])[:, None, :]
"""A pixel and its neighbours: columns and rows, (2, 1, 5)."""


@dataclass(frozen=True)
class ContourFeet:
    """Nearest contour of each queried pixel.

    Attributes:
        distances: (n,) signed distance, negative inside the mask [px].
        normals: (n, 2) unit normal of the contour, towards the outside.
        feet: (n, 2) nearest point of the contour [px].
        valid: (n,) False at ridges of the distance, beside ``IGNORE`` pixels, off the image, and beyond the
            field of the class, where the distance is not known.
    """

    distances: FloatArray
    normals: FloatArray
    feet: FloatArray
    valid: NDArray[np.bool_]


_BESIDE = np.ones((5, 5), np.uint8)
"""Pixels beside one: a contour within two pixels of one that is unknown is no object's."""


@storable("distance", "unknown")
@dataclass(frozen=True)
class ContourMap:
    """Signed distance field of one class in one mask; in an array store it is read at every access.

    Attributes:
        distance: (h, w) signed distance to the contour, negative inside, lightly smoothed, in a box around
            the class that reaches :data:`REACH_PX` beyond it; as at the box's border farther out [px].
        left, top: the box's first column and row in the image.
        width, height: of the image.
        unknown: 1 near ``IGNORE`` pixels, where a contour is not the object's, and where the picture shows no
            edge along it; in the same box.
        edges: what the picture shows along the contour, if it was used; in ``distance`` already.
        stretch: of the image's pixels, where it was rectified.
    """

    distance: FloatMap
    left: int
    top: int
    width: int
    height: int
    unknown: NDArray[np.uint8]
    edges: PictureEdges | None = None
    stretch: PixelStretch | None = None

    @classmethod
    def in_image(cls, image: CameraImage, semantic_class: SemanticClass) -> ContourMap | None:
        """The field of a class in an image, whose contours follow its picture; None as of :meth:`of`."""
        return cls.of(image.mask, semantic_class, image.pixels, valid=image.valid)

    @classmethod
    def of(
        cls,
        mask: NDArray[np.uint8],
        semantic_class: SemanticClass,
        picture: Picture | None = None,
        edges: PictureEdges | None = None,
        valid: NDArray[np.bool_] | None = None,
        stretch: PixelStretch | None = None,
    ) -> ContourMap | None:
        """The field of a class in a mask (h, w); None where the class is absent or fills the image.

        Args:
            picture: (h, w, 3) BGR that the contour follows; by default, or where it has another size, none.
            edges: what was found in the picture before, instead of the picture.
            valid: (h, w) whether the lens shows anything there; beside pixels where it does not, the contour
                does not follow the picture. None: everywhere.
            stretch: of the mask's pixels, where it was rectified.
        """
        # Compared with a plain int: compared with an enum, all pixels are converted to int64.
        inside = (mask == int(semantic_class)).view(np.uint8)
        if cv2.countNonZero(inside) in (0, inside.size):
            return None
        # Only near the class: elsewhere nothing is matched, and the field takes most of an image's time.
        x, y, width, height = cv2.boundingRect(inside)
        top, left = max(0, y - REACH_PX), max(0, x - REACH_PX)
        part = slice(top, y + height + REACH_PX), slice(left, x + width + REACH_PX)
        box = np.ascontiguousarray(inside[part])
        distance = signed_distance(box)
        cv2.GaussianBlur(distance, (0, 0), _SMOOTHING_PX, dst=distance)
        ignored = (mask[part] == int(SemanticClass.IGNORE)).view(np.uint8)
        unknown = np.asarray(cv2.dilate(ignored, _BESIDE), np.uint8)
        if edges is None and picture is not None and picture.shape[:2] == mask.shape:
            outside = None
            if valid is not None:
                outside = np.asarray(cv2.dilate((~valid[part]).view(np.uint8), _BESIDE), np.uint8)
            edges = find_picture_edges(box, distance, picture[part], outside)
        if edges is not None:
            shifts, unseen = edges.fields(box)
            distance -= shifts
            unknown |= unseen
        return cls(distance, left, top, mask.shape[1], mask.shape[0], unknown, edges, stretch)

    @property
    def contour_px(self) -> int:
        """Pixels along the contour, on both sides of it."""
        return int(np.count_nonzero(np.abs(self.distance) < 1.0))

    @property
    def box(self) -> tuple[int, int]:
        """Columns and rows of the box."""
        rows, columns = shape_of(self, "distance")
        return columns, rows

    def stored_in(self, store: ArrayStore) -> ContourMap:
        """The map with its fields in an array store."""
        return replace(self, distance=store.put(self.distance), unknown=store.put(self.unknown))

    def look_up(self, uvs: FloatArray) -> ContourFeet:
        """Nearest contour of pixels uvs (n, 2); rows with NaN are not valid."""
        return nearest_contours([self], [(0, len(uvs))], uvs)


def nearest_contours(
    contours: Sequence[ContourMap], spans: Sequence[tuple[int, int]], uvs: FloatArray
) -> ContourFeet:
    """Nearest contour of pixels uvs (n, 2) of several images; rows with NaN are not valid.

    Args:
        contours: at least one.
        spans: where the pixels of each begin and end, one after the other.
    """
    n, counts = len(uvs), [b - a for a, b in spans]
    if n == 0:
        return ContourFeet(np.zeros(0), uvs, uvs, np.zeros(0, np.bool_))
    # All at once: with few points, a call for each would cost more than the work.
    sizes = {(contour.width, contour.height) for contour in contours}
    width, height = (
        next(iter(sizes))
        if len(sizes) == 1
        else np.repeat([(contour.width, contour.height) for contour in contours], counts, axis=0).T
    )
    valid = well_inside(uvs[:, 0], uvs[:, 1], width, height)
    corners = np.array([(contour.left, contour.top) for contour in contours])
    corner = corners.T if len(contours) == 1 else corners.repeat(counts, axis=0).T
    safe = np.where(valid, uvs.T, BORDER_PX + 1.0)
    places = safe - corner
    sides = np.array([contour.box for contour in contours])
    sides = sides.T if len(contours) == 1 else sides.repeat(counts, axis=0).T
    valid &= ((places >= 0.0) & (places <= sides - 1)).all(axis=0)
    u, v = (places[:, :, None] + _CROSS).astype(np.float32)
    samples = np.empty((n, 5), np.float32)
    for contour, (a, b) in zip(contours, spans, strict=True):
        if b > a:
            own = sampled(contour.distance, u[a:b].reshape(1, -1), v[a:b].reshape(1, -1))
            samples[a:b] = own.reshape(-1, 5)
    centre, right, left, below, above = samples.T.astype(np.float64)
    gradient = 0.5 * np.array([right - left, below - above])
    length = np.sqrt(gradient[0] ** 2 + gradient[1] ** 2)
    steep = length > 1e-6
    normals = np.where(steep, gradient / np.where(steep, length, 1.0), [[1.0], [0.0]])
    feet = safe - centre * normals
    valid &= length > MIN_GRADIENT
    valid &= ~are_unknown(contours, spans, feet - corner)
    return ContourFeet(centre, normals.T, feet.T, valid)


def stretches(
    contours: Sequence[object], spans: Sequence[tuple[int, int]], found: ContourFeet
) -> FloatArray | None:
    """(n,) stretch of the images across the contours that were found; None where no mask was rectified.

    Args:
        contours: of masks or of pictures; these have none.
        spans: as in :func:`nearest_contours`.
    """
    own = [contour.stretch if isinstance(contour, ContourMap) else None for contour in contours]
    if not any(own):
        return None
    across = np.ones(len(found.feet))
    # The images of a drive share one, so that few are different.
    numbers = np.repeat([id(stretch) for stretch in own], [b - a for a, b in spans])
    for stretch in {id(one): one for one in own if one is not None}.values():
        some = np.flatnonzero(numbers == id(stretch))
        across[some] = stretch.across(found.feet[some], found.normals[some])
    return across


def are_unknown(
    contours: Sequence[ContourMap], spans: Sequence[tuple[int, int]], places: FloatArray
) -> NDArray[np.bool_]:
    """(n,) whether nothing is known of the contours at columns and rows (2, n) of their boxes; spans as in
    :func:`nearest_contours`."""
    boxes = np.array([contour.box for contour in contours]).repeat([b - a for a, b in spans], axis=0).T
    column, row = np.minimum(np.maximum(np.rint(places).astype(np.intp), 0), boxes - 1)
    at = row * boxes[0] + column
    found = np.empty(places.shape[1], np.uint8)
    for contour, (a, b) in zip(contours, spans, strict=True):
        if b > a:
            found[a:b] = contour.unknown.take(at[a:b])
    return found > 0


def well_inside(
    u: FloatArray, v: FloatArray, width: IntArray | int, height: IntArray | int
) -> NDArray[np.bool_]:
    """Whether columns u and rows v are on an image and not close to its border; False for NaN."""
    with np.errstate(invalid="ignore"):
        inside = (u > BORDER_PX) & (u < width - 1 - BORDER_PX)
        inside &= (v > BORDER_PX) & (v < height - 1 - BORDER_PX)
    return np.asarray(inside)


def signed_distance(inside: NDArray[np.uint8]) -> FloatMap:
    """(h, w) distance of pixel centres to the border of the region [px], negative inside.

    The border runs half way between an inside pixel's centre and its outside neighbour's.
    """
    distance = np.asarray(cv2.distanceTransform(1 - inside, cv2.DIST_L2, cv2.DIST_MASK_5), np.float32)
    distance -= 0.5
    # Distances inside, one run of occupied columns after the other: the nearest pixel outside lies beside the
    # same run.
    occupied = np.concatenate([[False], inside.any(axis=0), [False]])
    for start, end in np.flatnonzero(occupied[1:] != occupied[:-1]).reshape(-1, 2).tolist():
        left = max(0, start - 1)
        _, y, _, height = cv2.boundingRect(np.ascontiguousarray(inside[:, start:end]))
        box = (slice(max(0, y - 1), y + height + 1), slice(left, end + 1))
        region = np.ascontiguousarray(inside[box])
        inner = cv2.distanceTransform(region, cv2.DIST_L2, cv2.DIST_MASK_5)
        np.subtract(0.5, inner, out=distance[box], where=region.view(np.bool_))
    return distance

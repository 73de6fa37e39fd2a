"""Statistics of a drive's raw frames, before anything is assumed about them: sizes, the ground, repeats.

Everything here is in the data's own units and axes, so that wrong units and wrong axes can be seen.
"""

from __future__ import annotations

import hashlib
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sst_graph.features.lidar_beams import rings_belong
from sst_graph.features.lidar_origin import some_points
from sst_graph.features.mask_shift import ContourProfile, contour_profiles
from sst_graph.sampling import step_for
from sst_graph.types import CameraImage, FloatArray, Frame, Scan, SemanticClass

_SCANS, _IMAGES = 12, 12
"""Scans and images with the expensive statistics (geometry, contours), spread over the drive."""
_CLOUDS = 3
"""Scans of which points are kept, about."""
_LEAST_POINTS = 200
"""Labelled points of the ground from which a plane is fitted; points of a scan whose rounding is told."""
_RESOLUTION = 1e-6
"""Of a coordinate in float32, as a share of the largest, with what is lost in computing it."""
_GROUND_TOLERANCE = 0.02
"""Distance from the plane, as a share of the median range of the points, within which a point lies on it."""
_STEEPEST, _AROUND = 0.3, 8
"""Steepest slope between a point of the ground and half of so many points around it."""
_OBJECT_POINTS = 60
"""Points of a vehicle from which its size is taken."""
_CELL = 0.02
"""Grid cell that splits points into objects, as a share of their median range: free of the unit."""


@dataclass(frozen=True)
class Ground:
    """The plane of the points labelled ground: up . p + height = 0, in the cloud's axes and unit.

    Attributes:
        up: (3,) unit normal, from the ground towards the LiDAR.
        height: of the LiDAR above it.
        share: of the points that lie on it.
        smooth: share of the points that lie on a slope of :data:`_STEEPEST` at most with those around them,
            as on hills.
    """

    up: FloatArray
    height: float
    share: float
    smooth: float


@dataclass(frozen=True)
class ScanStatistics:
    """What is measured of a scan.

    Attributes:
        index: of its frame.
        stamp_ns: LiDAR clock [ns].
        digest: of its points: equal ones are the same scan; 0 of a scan without points.
        sweep_s: between its first and last point [s]; 0 where the points carry no times.
        labelled: number of points by class.
        ground: None where too few points are labelled so, or the scan is not one of the chosen ones.
        vehicle_heights: (k,) from the ground to the top of its vehicles.
        sample: (s,) sorted numbers of some points, chosen and numbered by their coordinates: a point that is
            equal to the last bit in two scans is in both samples or in none.
        step: that its coordinates were rounded to, in the cloud's unit; 0 where it has few points or is not
            one of the chosen ones.
        median_range: of its points, in the cloud's unit; 0 of a scan without points.
        lasers: whether the data tell by which laser each point was measured; of a scan without points, too.
        some_points: (m, 3) of its points, evenly in their order; of few scans of a drive.
    """

    index: int
    stamp_ns: int
    digest: int
    sweep_s: float
    labelled: Mapping[int, int]
    ground: Ground | None = None
    vehicle_heights: FloatArray = field(default_factory=lambda: np.zeros(0))
    sample: NDArray[np.uint64] = field(default_factory=lambda: np.zeros(0, np.uint64))
    step: float = 0.0
    median_range: float = 0.0
    lasers: bool = True
    some_points: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 3), np.float32))

    def hash(self) -> str:
        """Hash of its points: 16 hexadecimal digits, the same wherever the scan is read."""
        own = hashlib.blake2b(self.digest.to_bytes(4, "little"), digest_size=8)
        own.update(self.sample.astype("<u8").tobytes())
        return own.hexdigest()


@dataclass(frozen=True)
class ImageStatistics:
    """What is measured of an image.

    Attributes:
        index: of its frame.
        stamp_ns: camera clock [ns].
        picture_digest: equal ones are the same; a picture that is missing or of a single colour shows
            nothing, and has that of the mask; 0 of an image without picture and mask.
        labelled: number of pixels by class.
        rows: mean row of each class's pixels, as a share of the image's height.
        profiles: what the picture shows along the mask's contours, and beside them.
        brightest: largest value of the picture, 0 to 255; None where there is none.
        rectified: whether it was taken by a lens, and its camera is the pinhole that this package chose.
    """

    index: int
    stamp_ns: int
    picture_digest: int
    labelled: Mapping[int, int]
    rows: Mapping[int, float]
    profiles: tuple[ContourProfile, ...] = ()
    brightest: int | None = None
    rectified: bool = False


@dataclass(frozen=True)
class InputStatistics:
    """Statistics of a whole drive, in the order of its scans and images."""

    scans: tuple[ScanStatistics, ...]
    images: tuple[ImageStatistics, ...]

    def scan_hashes(self) -> set[str]:
        """Hashes of the scans' points, 16 hexadecimal digits each; scans without points have none."""
        return {scan.hash() for scan in self.scans if scan.digest}


class StatisticsCollector:
    """Input statistics, collected frame by frame.

    Args:
        total: number of frames; the expensive statistics are computed of some, spread over the drive.
    """

    def __init__(self, total: int) -> None:
        self._scans: list[ScanStatistics] = []
        self._images: list[ImageStatistics] = []
        self._every_scan, self._every_image = step_for(total, _SCANS), step_for(total, _IMAGES)
        self._every_cloud = max(1, total // _CLOUDS)

    def add(self, frame: Frame) -> None:
        """Add one frame, checked by :mod:`sst_graph.validation`."""
        if frame.scan is not None:
            closely = len(self._scans) % self._every_scan == 0
            found = scan_statistics(frame.index, frame.scan, closely)
            if len(self._scans) % self._every_cloud == 0:
                found = replace(found, some_points=some_points(frame.scan.points).copy())
            self._scans.append(found)
        if frame.image is not None:
            closely = len(self._images) % self._every_image == 0
            self._images.append(image_statistics(frame.index, frame.image, closely))

    def statistics(self) -> InputStatistics:
        return InputStatistics(tuple(self._scans), tuple(self._images))


def scan_statistics(index: int, scan: Scan, closely: bool = True) -> ScanStatistics:
    """Statistics of a scan; ground, vehicles and the step of the coordinates only with ``closely``."""
    points = np.asarray(scan.points, np.float64)
    ranges = np.linalg.norm(points, axis=1)
    median_range = float(np.median(ranges)) if len(ranges) else 0.0
    sweep = 0.0
    if scan.offsets_s is not None and len(scan.offsets_s):
        sweep = float(np.ptp(np.asarray(scan.offsets_s, np.float64)))
    ground, heights, step = None, np.zeros(0), 0.0
    if closely:
        step = _step(points)
        on_ground = _labelled_ground(scan.classes)
        ground = _ground(points[on_ground], points[~on_ground])
        member = (scan.classes == int(SemanticClass.VEHICLE)) & (ranges < 2.0 * median_range)
        instances = None if scan.instances is None else scan.instances[member]
        heights = _heights(points[member], instances, ground)
    labelled = _counts(scan.classes)
    digest = zlib.crc32(np.ascontiguousarray(scan.points).tobytes())
    sample = _sample(scan.points)
    lasers = not len(points) or (scan.rings is not None and rings_belong(points, scan.rings))
    return ScanStatistics(
        index,
        scan.stamp_ns,
        digest,
        sweep,
        labelled,
        ground,
        heights,
        sample,
        step,
        median_range,
        lasers,
    )


def _step(points: FloatArray) -> float:
    """The least distance between two values of a coordinate of the points (n, 3), beyond the resolution of
    float32: of so many points it is next to nothing, unless the coordinates were rounded."""
    if len(points) < _LEAST_POINTS:
        return 0.0
    steps = []
    for values in points.T:
        gaps = np.diff(np.unique(values))
        gaps = gaps[gaps > _RESOLUTION * float(np.abs(values).max())]
        steps += [float(gaps.min())] if len(gaps) else []
    return min(steps, default=0.0)


_FACTORS = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)
"""Odd numbers whose multiples spread over 64 bits."""
_SAMPLED_BITS = 5
"""One point in 2^5 is in a sample."""


def _sample(points: NDArray[np.float32]) -> NDArray[np.uint64]:
    """(s,) sorted hashes of the points (n, 3) whose hash begins with :data:`_SAMPLED_BITS` zeros."""
    bits = np.ascontiguousarray(points, np.float32).view(np.uint32).astype(np.uint64)
    mixed = (bits * _FACTORS).sum(axis=1, dtype=np.uint64)
    mixed = (mixed ^ (mixed >> np.uint64(29))) * _FACTORS[0]
    return np.unique(mixed[mixed >> np.uint64(64 - _SAMPLED_BITS) == 0])


def image_statistics(index: int, image: CameraImage, closely: bool = True) -> ImageStatistics:
    """Statistics of an image; the picture along the contours only with ``closely``."""
    labelled = _counts(image.mask)
    height, width = image.mask.shape
    # Sums of the places of each class's pixels: whole numbers below 2^53, which are exact.
    places = np.bincount(image.mask.ravel(), _places(image.mask.size), minlength=1)
    rows = {c: float(places[c] / count // width) for c, count in labelled.items()}
    shows = shows_something(image)
    known = image.pixels if shows else image.mask
    nothing = not image.has_picture and not image.has_mask
    return ImageStatistics(
        index,
        image.stamp_ns,
        0 if nothing else zlib.crc32(np.ascontiguousarray(known).tobytes()),
        labelled,
        {c: row / height for c, row in rows.items()},
        contour_profiles(image.mask, image.pixels, SemanticClass.VEHICLE) if closely and shows else (),
        int(image.pixels.max()) if image.has_picture else None,
        image.stretch is not None,
    )


def shows_something(image: CameraImage) -> bool:
    """Whether the picture is there and not of a single colour."""
    return image.has_picture and (_varies(image.pixels[::_FEW, ::_FEW]) or _varies(image.pixels))


_FEW = 16
"""One of so many rows and columns shows of nearly every picture that it is not of one colour."""


def _varies(pixels: NDArray[np.uint8]) -> bool:
    return bool((pixels != pixels[0, 0]).any())


@lru_cache(maxsize=1)
def _places(count: int) -> FloatArray:
    return np.arange(float(count))


def _counts(classes: NDArray[np.uint8]) -> dict[int, int]:
    counts = np.bincount(classes.ravel(), minlength=1)
    return {int(c): int(counts[c]) for c in np.flatnonzero(counts)}


def _labelled_ground(classes: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """(n,) the points labelled ground; where these are few, with terrain, which may be a bank or rocks."""
    ground = np.asarray(classes == int(SemanticClass.GROUND))
    if np.count_nonzero(ground) >= _LEAST_POINTS:
        return ground
    return np.asarray(ground | (classes == int(SemanticClass.TERRAIN)))


def _ground(points: FloatArray, others: FloatArray) -> Ground | None:
    """The plane that most of the points (n, 3) lie on (RANSAC, then least squares). Where the LiDAR itself
    lies on it, the other points (m, 3) tell what is up."""
    if len(points) < _LEAST_POINTS:
        return None
    points = points[:: max(1, len(points) // 2000)]
    tolerance = _GROUND_TOLERANCE * float(np.median(np.linalg.norm(points, axis=1)))
    rng = np.random.default_rng(0)
    triples = points[rng.integers(0, len(points), (100, 3))]
    normals = np.cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1), 1e-12)[:, None]
    levels = np.einsum("ij,ij->i", normals, triples[:, 0])
    near = np.abs(normals @ points.T - levels[:, None]) < tolerance
    on = near[int(near.sum(axis=1).argmax())]
    for _ in range(2):
        if np.count_nonzero(on) < 3:
            return None
        centre = points[on].mean(axis=0)
        normal = np.linalg.svd(points[on] - centre, full_matrices=False)[2][2]
        on = np.abs((points - centre) @ normal) < tolerance
    height = -float(normal @ centre)
    up = normal if height >= 0.0 else -normal
    if abs(height) < tolerance and np.count_nonzero(others @ up < 0.0) > 0.5 * len(others):
        up = -up
    return Ground(up, abs(height), float(on.mean()), _smooth(points, up, 0.5 * tolerance))


def _smooth(points: FloatArray, up: FloatArray, tolerance: float) -> float:
    """Share of the points (n, 3) that lie on a slope with half of those around them."""
    levels, flat = points @ up, points @ np.linalg.svd(up[None])[2][1:].T
    distances, around = cKDTree(flat).query(flat, _AROUND + 1)
    steps = np.abs(levels[around] - levels[:, None])[:, 1:]
    on = steps < _STEEPEST * distances[:, 1:] + tolerance
    return float((on.mean(axis=1) >= 0.5).mean())


def _heights(points: FloatArray, instances: NDArray[np.uint16] | None, ground: Ground | None) -> FloatArray:
    """(k,) heights of the objects that many of the points (n, 3) belong to, above the ground where known."""
    if len(points) < _OBJECT_POINTS:
        return np.zeros(0)
    up = np.array([0.0, 0.0, 1.0]) if ground is None else ground.up
    numbers = _objects(points, up, instances)
    found = []
    for number in np.flatnonzero(np.bincount(numbers) >= _OBJECT_POINTS):
        levels = points[numbers == number] @ up
        bottom, top = np.quantile(levels, (0.02, 0.98))
        # The ground where the object stands may be some way off the plane: the lower of the two counts.
        found.append(top - (bottom if ground is None else max(bottom - 0.3 * (top - bottom), -ground.height)))
    return np.array(found)


def _objects(points: FloatArray, up: FloatArray, instances: NDArray[np.uint16] | None) -> NDArray[np.intp]:
    """(n,) number of each point's object: instances, else connected cells of a grid seen from above."""
    if instances is not None and bool((instances > 0).all()):
        return instances.astype(np.intp)
    across = np.linalg.svd(up[None])[2][1:]
    flat = points @ across.T
    cells = np.floor(flat / (_CELL * max(float(np.median(np.linalg.norm(flat, axis=1))), 1e-9)))
    cells = np.clip(cells - np.quantile(cells, 0.001, axis=0) + 1, 0, 1000).astype(np.intp)
    grid = np.zeros(cells.max(axis=0) + 2, np.uint8)
    grid[cells[:, 0], cells[:, 1]] = 1
    regions = cv2.connectedComponents(cv2.dilate(grid, np.ones((3, 3), np.uint8)), connectivity=4)[1]
    return np.asarray(regions[cells[:, 0], cells[:, 1]], np.intp)

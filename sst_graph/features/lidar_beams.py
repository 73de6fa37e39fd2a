"""Beam geometry of a spinning LiDAR, fitted from a scan.

A laser of a spinning scanner does not sit in the origin of the LiDAR frame: its ring lies on the cone

    z = slope * rho + height,        rho = sqrt(x^2 + y^2)

with ``height`` about 0.1-0.2 m for an HDL-64E. Comparing the elevation angles of a near and a far return
as if both left the origin is then wrong by ``height * (1/rho_near - 1/rho_far)``, up to a degree; the
silhouette's vertical position needs the cone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sst_graph.sampling import step_for
from sst_graph.types import FloatArray, IntArray

_CONE_NOISE_M = 0.02
"""Distance from its cone at which a point has a quarter of its weight [m]: the range noise of an HDL-64E."""
_ROUNDS = 6
"""Rounds of the robust regression."""
_MIN_CONE_POINTS = 30
"""Fewest points of a ring whose cone is fitted."""
_CONE_POINTS = 256
"""Points of a ring that its cone is fitted to."""
_STEPS = 8_000
"""Steps between neighbours of which the median is taken, about."""
_APART = 10.0
"""Distance of two rings among the keys that points are sorted by; azimuths differ by less [rad]."""
_FAR_STRIP, _FAR_SHARE = np.radians(1.0), 0.1
"""Strips of elevations [rad] in which less than this share of the points is far show their rings by all."""
_HEIGHTS_M = np.linspace(-0.3, 0.4, 36)
"""Heights that are tried for the tips of all cones [m]: 0.2 of an HDL-64E."""
_NEAREST_M, _HEIGHT_POINTS = 3.0, 20_000
"""The height is looked for with points beyond so many metres, about so many of them."""
PARTS_OF_RINGS, STRIPS_OF_RINGS = 400, 20
"""Shares of the points that are less than a ring, and some rings, of 16 to 128."""
_MIXED = 0.7
"""Laser numbers that leave more of the variance of the directions than this are not those of the points. They
leave less than 0.005 of it for spinning scanners, 0.2 to 0.55 seen from the vehicle's origin, and 0.9 or more
where they are random."""
_COMPARED, _LEAST_RANGE_M = 3_000, 0.5
"""Points that are compared so, about, and how far away they are: returns that were lost are at the origin."""
_COMPARED_OF_EACH = 16
"""Points of each laser among these, about: any three lie in a plane."""
_MOST_LASERS = 2_048
"""No scanner has as many. More numbers are those of something else, such as columns or returns."""
_FLAT = 1e-6
"""Variance of directions across a plane, of a milliradian, in which all lie."""
_LEAST_GAP = 1e-5
"""Slopes are not told apart below this: float32 of points far away."""
_MIN_RHO_RATIO = 1.5
"""A cone's height is fitted only where the ring's far points are this much farther than its near ones."""


@dataclass(frozen=True)
class Beams:
    """The points of a scan in beam order.

    Attributes:
        order: (n,) indices of the points sorted by (ring, azimuth).
        keys: (n,) the same order as numbers that rise, see :meth:`key`.
        ring: (n,) ring of each point, 0 the lowest, rising with elevation.
        azimuth: (n,) azimuth of each point, counter-clockwise from the x axis [rad].
        rho: (n,) distance of each point from the z axis [m].
        height: (rings,) height of each ring's cone tip [m].
        step: median azimuth step between neighbours of one ring [rad].
        elevation: (rings,) median elevation angle of each ring [rad].
    """

    order: IntArray
    keys: FloatArray
    ring: IntArray
    azimuth: FloatArray
    rho: FloatArray
    height: FloatArray
    step: float
    elevation: FloatArray

    @staticmethod
    def key(ring: IntArray, azimuth: FloatArray) -> FloatArray:
        """Where a ring and an azimuth [rad] stand among ``keys``."""
        return np.asarray(ring * _APART + azimuth)


def arrange_beams(points: FloatArray, rings: NDArray[np.integer] | None) -> Beams:
    """Order points (n, 3) [m] by laser and azimuth and fit the cones.

    Args:
        rings: (n,) laser of each point, or None: then rings are recovered from the elevations, as seen from
            where most cones have their tip. So they are where the numbers do not belong to the points.
    """
    rho = np.sqrt(points[:, 0] ** 2 + points[:, 1] ** 2)
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    slope = points[:, 2] / np.maximum(rho, 1e-6)
    if rings is None or not rings_belong(points, rings):
        above = points[:, 2] - common_height(points[:, 2], rho)
        rings = recover_rings(np.arctan(above / np.maximum(rho, 1e-6)), rho)
    ring, counts, median_slope = _rank_by_slope(rings, slope)
    keys = Beams.key(ring, azimuth)
    order = np.argsort(keys, kind="stable")  # points come nearly in order
    in_order = keys[order]
    steps = np.diff(in_order)
    steps = steps[steps < _APART - 2.0 * np.pi]
    step = float(np.median(steps[:: 1 + len(steps) // _STEPS])) if len(steps) else 0.0
    some = order[_evenly_from_each(counts)]
    height = _cone_heights(points[some, 2], rho[some], counts)
    return Beams(order, in_order, ring, azimuth, rho, height, step, np.arctan(median_slope))


def rings_belong(points: FloatArray, rings: NDArray[np.integer]) -> bool:
    """Whether laser numbers (n,) are those of the points (n, 3).

    The directions in which one laser measures lie on a cone, and their unit vectors in a plane, whatever the
    axes. How far off such planes they are is compared with how far off one plane all of them are.
    """
    lasers = int(np.count_nonzero(np.bincount(rings))) if len(rings) else 0
    if lasers > _MOST_LASERS:
        return False
    # An odd step: columns of a file have an even number of lasers.
    step = step_for(len(points), max(_COMPARED, _COMPARED_OF_EACH * lasers)) | 1
    some, numbers = points[::step], rings[::step]
    ranges = np.linalg.norm(some, axis=1)
    seen = np.isfinite(ranges) & (ranges > _LEAST_RANGE_M)
    some, numbers, ranges = some[seen], numbers[seen], ranges[seen]
    if len(some) < PARTS_OF_RINGS:
        return True
    directions = some / ranges[:, None]
    ring = np.unique(numbers, return_inverse=True)[1]
    counts = np.bincount(ring)
    means = np.stack([np.bincount(ring, axis) for axis in directions.T], axis=1) / counts[:, None]
    off = directions - means[ring]
    squares = np.zeros((len(counts), 3, 3))
    for i, j in zip(*np.tril_indices(3), strict=True):  # all that eigvalsh looks at
        squares[:, i, j] = np.bincount(ring, off[:, i] * off[:, j])
    within = float(np.linalg.eigvalsh(squares)[:, 0].sum()) / len(some)
    # All in one plane: one laser, or two that tell nothing.
    together = float(np.linalg.eigvalsh(np.cov(directions.T))[0])
    return len(counts) == 1 or together < _FLAT or within < _MIXED * together


def common_height(z: FloatArray, rho: FloatArray) -> float:
    """Height of the cones' tips, one for all, from which rings stand out most [m]; z, rho: (n,) [m]."""
    some = np.flatnonzero(rho > _NEAREST_M)
    some = some[:: 1 + len(some) // _HEIGHT_POINTS]
    if len(some) < PARTS_OF_RINGS:
        return 0.0
    return float(max(_HEIGHTS_M, key=lambda height: clearness((z[some] - height) / rho[some])))


def clearness(slopes: FloatArray, parts: int = PARTS_OF_RINGS) -> float:
    """How clearly rings stand out of the slopes z / rho of points (n,), ``parts`` or more.

    Along the sorted slopes, points of a ring are close together in comparison with points some rings apart.
    Gaps are compared by their logarithms, so that no scale of the slopes is preferred; without rings it is
    log(parts / STRIPS_OF_RINGS).
    """
    rising = np.sort(slopes)
    near, apart = len(rising) // parts, len(rising) // STRIPS_OF_RINGS
    gaps = (np.maximum(rising[step:] - rising[:-step], _LEAST_GAP) for step in (apart, near))
    wide, narrow = (float(np.log(gap).mean()) for gap in gaps)
    return wide - narrow


def recover_rings(elevation: FloatArray, rho: FloatArray) -> IntArray:
    """(n,) ring numbers from elevation angles [rad]: peaks of their histogram over far points.

    Lasers off the origin smear the angle of near points, so the peaks come from points beyond 8 m. Rings that
    look down meet the ground before: at elevations with hardly a far point, and where too few are that far at
    all, the peaks come from all points. A sensor without rings gets strips of 0.4 degrees.
    """
    if len(elevation) == 0:
        return np.zeros(0, dtype=np.intp)
    resolution = np.radians(0.04)
    far = rho > 8.0
    low = float(elevation.min())
    strip = ((elevation - low) / _FAR_STRIP).astype(np.intp)
    share = np.bincount(strip, far) / np.maximum(np.bincount(strip), 1)
    sample = elevation[far | (share < _FAR_SHARE)[strip]] if np.count_nonzero(far) > 1000 else elevation
    bins = int((float(elevation.max()) - low) / resolution) + 2
    histogram = np.bincount(((sample - low) / resolution).astype(np.intp), minlength=bins).astype(float)
    smooth = np.convolve(histogram, [0.25, 0.5, 0.25], mode="same")
    inner = smooth[1:-1]
    is_peak = (inner >= smooth[:-2]) & (inner > smooth[2:]) & (inner > 0.25 * np.median(smooth[smooth > 0]))
    peaks = low + (np.flatnonzero(is_peak) + 1.5) * resolution
    occupied = np.count_nonzero(histogram) / max(1, bins)
    if len(peaks) < 8 or occupied > 0.9:
        return np.asarray(((elevation - low) / np.radians(0.4)).astype(np.intp))
    borders = 0.5 * (peaks[1:] + peaks[:-1])
    return np.asarray(np.searchsorted(borders, elevation).astype(np.intp))


def _rank_by_slope(labels: NDArray[np.integer], slope: FloatArray) -> tuple[IntArray, IntArray, FloatArray]:
    """Ring numbers (n,) that rise with elevation; points (rings,) of each ring, and its median slope."""
    lowest = int(labels.min()) if len(labels) else 0
    shifted = labels.astype(np.intp) - lowest
    used = np.bincount(shifted) > 0
    ring = (np.cumsum(used) - 1)[shifted]
    counts = np.bincount(ring, minlength=np.count_nonzero(used))
    # Small integers are sorted by their digits, which costs next to nothing.
    together = np.argsort(ring.astype(np.uint16) if len(counts) < 2**16 else ring, kind="stable")
    # Of all points: medians of a part of them would swap rings that are close to one another.
    by_ring, starts = slope[together], np.cumsum(counts) - counts
    for start, count in zip(starts.tolist(), counts.tolist(), strict=True):
        by_ring[start : start + count].partition(count // 2)
    medians = by_ring[starts + counts // 2]
    rank = np.argsort(medians, kind="stable")
    place = np.empty_like(rank)
    place[rank] = np.arange(len(rank))
    return place[ring], counts[rank], medians[rank]


def _evenly_from_each(counts: IntArray) -> IntArray:
    """(rings, _CONE_POINTS) places evenly over each ring of ``counts`` points that come ring by ring.

    Places repeat in rings of fewer points.
    """
    starts = np.cumsum(counts) - counts
    return np.asarray(starts[:, None] + np.arange(_CONE_POINTS) * counts[:, None] // _CONE_POINTS)


def _cone_heights(z: FloatArray, rho: FloatArray, counts: IntArray) -> FloatArray:
    """(rings,) heights of the cone tips by robust regression of z on rho; 0 where not determined.

    Args:
        z, rho: (rings, n) of points of each ring [m].
        counts: (rings,) how many points each ring has.
    """
    terms = np.stack([np.ones_like(rho), rho, rho**2, z, z * rho], axis=1)
    base = 1.0 / np.maximum(rho, 1.0)
    weight, tip = base, np.zeros(len(rho))
    for _ in range(_ROUNDS):
        s = (terms @ (weight * weight)[:, :, None])[:, :, 0].T
        det = s[0] * s[2] - s[1] ** 2
        safe = np.where(det > 1e-9 * np.maximum(s[0] * s[2], 1e-12), det, np.inf)
        slope, tip = (s[0] * s[4] - s[1] * s[3]) / safe, (s[2] * s[3] - s[1] * s[4]) / safe
        error = slope[:, None] * rho
        np.subtract(z, error, out=error)
        error -= tip[:, None]
        error /= _CONE_NOISE_M
        error *= error
        error += 1.0
        weight = base / error
    trusted = (counts >= _MIN_CONE_POINTS) & (np.abs(tip) < 0.6)
    if rho.size:
        trusted &= rho.max(axis=1) > _MIN_RHO_RATIO * rho.min(axis=1)
    return np.where(trusted, tip, 0.0)

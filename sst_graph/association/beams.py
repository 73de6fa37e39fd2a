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

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]

_CONE_NOISE_M = 0.02
_ROUNDS = 6
_MIN_RING_POINTS = 30
_CONE_POINTS = 500
"""Points of a ring that its cone is fitted to, about."""
_APART = 10.0
"""Distance of two rings among the keys that points are sorted by; azimuths differ by less [rad]."""
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
        rings: (n,) laser of each point, or None: then rings are recovered from the elevations.
    """
    rho = np.hypot(points[:, 0], points[:, 1])
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    elevation = np.arctan2(points[:, 2], np.maximum(rho, 1e-6))
    labels = recover_rings(elevation, rho) if rings is None else rings
    ring, median_elevation = _rank_by_elevation(labels, elevation)
    keys = Beams.key(ring, azimuth)
    order = np.argsort(keys, kind="stable")  # points come nearly in order
    steps = np.diff(keys[order])
    steps = steps[steps < _APART - 2.0 * np.pi]
    step = float(np.median(steps)) if len(steps) else 0.0
    some = order[:: max(1, len(order) // max(1, _CONE_POINTS * len(median_elevation)))]
    height = _cone_heights(points[some, 2], rho[some], ring[some], len(median_elevation))
    return Beams(order, keys[order], ring, azimuth, rho, height, step, median_elevation)


def recover_rings(elevation: FloatArray, rho: FloatArray) -> IntArray:
    """(n,) ring numbers from elevation angles [rad]: peaks of their histogram over far points.

    Lasers off the origin smear the angle of near points, so the peaks come from points beyond 8 m
    (from all points where too few are that far). A sensor without rings gets strips of 0.4 degrees.
    """
    if len(elevation) == 0:
        return np.zeros(0, dtype=np.intp)
    resolution = np.radians(0.04)
    far = rho > 8.0
    sample = elevation[far] if np.count_nonzero(far) > 1000 else elevation
    low = float(elevation.min())
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


def _rank_by_elevation(labels: NDArray[np.integer], elevation: FloatArray) -> tuple[IntArray, FloatArray]:
    """Ring numbers that rise with elevation, and each ring's median elevation."""
    lowest = int(labels.min()) if len(labels) else 0
    shifted = labels.astype(np.intp) - lowest
    used = np.bincount(shifted) > 0
    ring = (np.cumsum(used) - 1)[shifted]
    # A sorted key that holds the ring before the point and the elevation behind it.
    by_ring = np.sort(ring * _APART + elevation)
    starts = np.searchsorted(by_ring, np.arange(np.count_nonzero(used) + 1) * _APART - 0.5 * _APART)
    middle = (starts[:-1] + starts[1:]) // 2
    medians = by_ring[middle] - np.arange(len(middle)) * _APART
    rank = np.argsort(medians, kind="stable")
    place = np.empty_like(rank)
    place[rank] = np.arange(len(rank))
    return place[ring], medians[rank]


def _cone_heights(z: FloatArray, rho: FloatArray, ring: IntArray, rings: int) -> FloatArray:
    """(rings,) heights of the cone tips by robust regression of z on rho; 0 where a ring cannot tell.

    The points come ring by ring.
    """
    counts = np.bincount(ring, minlength=rings)
    some = np.flatnonzero(counts)
    lengths = counts[some]
    starts = np.cumsum(lengths) - lengths
    terms = np.stack([np.ones_like(rho), rho, rho**2, z, z * rho])
    base = 1.0 / np.maximum(rho, 1.0)
    weight, weighted = base, np.empty_like(terms)
    height = np.zeros(rings)
    for _ in range(_ROUNDS if len(some) else 0):
        np.multiply(terms, weight**2, out=weighted)
        s = np.add.reduceat(weighted, starts, axis=1)
        det = s[0] * s[2] - s[1] ** 2
        safe = np.where(det > 1e-9 * np.maximum(s[0] * s[2], 1e-12), det, np.inf)
        slope, tip = (s[0] * s[4] - s[1] * s[3]) / safe, (s[2] * s[3] - s[1] * s[4]) / safe
        height[some] = tip
        error = np.repeat(slope, lengths)
        error *= rho
        np.subtract(z, error, out=error)
        error -= np.repeat(tip, lengths)
        error /= _CONE_NOISE_M
        error *= error
        error += 1.0
        weight = base / error
    nearest, farthest = np.full(rings, np.inf), np.zeros(rings)
    if len(some):
        nearest[some] = np.minimum.reduceat(rho, starts)
        farthest[some] = np.maximum.reduceat(rho, starts)
    trusted = (counts >= _MIN_RING_POINTS) & (farthest > _MIN_RHO_RATIO * nearest) & (np.abs(height) < 0.6)
    return np.where(trusted, height, 0.0)

"""Exact nearest surfaces for all pixels of a camera and all rays of a spinning LiDAR.

Both casters cut each triangle with the scan lines of the sensor (pixel rows, LiDAR columns) and
find the rays between the two cuts, half-open, so that neighbouring triangles share every ray
without gap or overlap: a ray belongs to the nearest triangle that its very centre hits.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factors.camera import PinholeCamera
from sst_graph.types import FloatArray

NEAR_M = 0.1
"""Faces are clipped this far in front of the camera [m]."""

IndexArray = NDArray[np.intp]


def _runs(counts: IndexArray) -> tuple[IndexArray, IndexArray]:
    """For runs of given lengths: the run each element belongs to, and its place in the run."""
    run = np.repeat(np.arange(len(counts)), counts)
    first = np.cumsum(counts) - counts
    return run, np.arange(len(run)) - first[run]


def _nearest(
    size: int, ray: IndexArray, closeness: FloatArray, face: IndexArray
) -> tuple[IndexArray, FloatArray]:
    """(size,) face of greatest closeness at each ray (-1: none) and that closeness.

    The bits of a positive float32 grow with its value, so one integer holds closeness and face.
    """
    bits = np.maximum(closeness, 0.0).astype(np.float32).view(np.int32).astype(np.int64)
    best = np.full(size, -1, np.int64)
    np.maximum.at(best, ray, (bits << 32) | face)
    winner = np.where(best < 0, -1, best & 0xFFFFFFFF)
    near = np.where(best < 0, 0, best >> 32).astype(np.int32).view(np.float32)
    return winner, near.astype(np.float64)


def clip_near(triangles: FloatArray) -> tuple[FloatArray, IndexArray]:
    """Camera-frame triangles (n, 3, 3) cut at z = NEAR_M: the pieces (m, 3, 3), the face of each (m,)."""
    front = triangles[:, :, 2] >= NEAR_M
    count = front.sum(axis=1)
    pieces, faces = [triangles[count == 3]], [np.flatnonzero(count == 3)]
    for inside in (1, 2):
        index = np.flatnonzero(count == inside)
        if not len(index):
            continue
        # Turn the odd corner to the first place; the cyclic order keeps the face's orientation.
        odd = np.argmax(front[index] if inside == 1 else ~front[index], axis=1)
        order = (odd[:, None] + np.arange(3)) % 3
        a, b, c = np.moveaxis(np.take_along_axis(triangles[index], order[:, :, None], axis=1), 1, 0)
        ab = a + (b - a) * ((NEAR_M - a[:, 2]) / (b[:, 2] - a[:, 2]))[:, None]
        ac = a + (c - a) * ((NEAR_M - a[:, 2]) / (c[:, 2] - a[:, 2]))[:, None]
        new = [(a, ab, ac)] if inside == 1 else [(ab, b, c), (ab, c, ac)]
        for corners in new:
            pieces.append(np.stack(corners, axis=1))
            faces.append(index)
    return np.concatenate(pieces), np.concatenate(faces)


def plane_of(triangles: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Planes n . p = d of triangles (n, 3, 3): outward normals (n, 3), not normalised, and d (n,)."""
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    return normal, np.einsum("ij,ij->i", normal, triangles[:, 0])


def cast_image(triangles: FloatArray, camera: PinholeCamera) -> tuple[IndexArray, FloatArray]:
    """Nearest face (h, w) at every pixel centre (-1: none), and its depth z (h, w) [m] (inf: none).

    triangles: (n, 3, 3) corners in the camera frame [m]; faces seen from behind are left out.
    """
    normal, d = plane_of(triangles)
    keep = np.flatnonzero((d < 0.0) & (triangles[:, :, 2].max(axis=1) > NEAR_M))
    pieces, source = clip_near(triangles[keep])
    face = keep[source]
    x = camera.fx * pieces[:, :, 0] / pieces[:, :, 2] + camera.cx
    y = camera.fy * pieces[:, :, 1] / pieces[:, :, 2] + camera.cy
    top = np.clip(np.ceil(y.min(axis=1)), 0, camera.height)
    bottom = np.clip(np.floor(y.max(axis=1)), -1, camera.height - 1)
    rows = np.maximum(bottom - top + 1, 0).astype(np.intp)
    rows[(x.max(axis=1) < 0) | (x.min(axis=1) > camera.width - 1)] = 0
    piece, offset = _runs(rows)
    v = top[piece] + offset
    left, right = _row_cuts(x, y, piece, v)
    u0 = np.clip(np.ceil(left), 0, camera.width)
    counts = np.maximum(np.clip(np.ceil(right), 0, camera.width) - u0, 0).astype(np.intp)
    span, step = _runs(counts)
    # 1/z = (n . K^-1 [u v 1]) / d is linear in the pixel.
    n, dd = normal[face], d[face]
    by_u, by_v = n[:, 0] / (camera.fx * dd), n[:, 1] / (camera.fy * dd)
    base = n[:, 2] / dd - by_u * camera.cx - by_v * camera.cy
    start = base[piece] + by_v[piece] * v + by_u[piece] * u0
    pixel = (v * camera.width + u0).astype(np.intp)[span] + step
    inverse = start[span] + by_u[piece][span] * step
    best, closeness = _nearest(camera.width * camera.height, pixel, inverse, face[piece][span])
    depth = np.where(best >= 0, 1.0 / np.maximum(closeness, 1e-9), np.inf)
    shape = (camera.height, camera.width)
    return best.reshape(shape), depth.reshape(shape)


def _row_cuts(
    x: FloatArray, y: FloatArray, piece: IndexArray, v: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Where the rows v (m,) enter and leave the triangles ``piece`` (m,) with corners x, y (n, 3)."""
    left, right = np.full(len(v), np.inf), np.full(len(v), -np.inf)
    for a, b in ((0, 1), (1, 2), (2, 0)):
        # From the upper corner down, so that both triangles at an edge compute the same cut.
        up = y[:, a] <= y[:, b]
        xa, ya = np.where(up, x[:, a], x[:, b]), np.where(up, y[:, a], y[:, b])
        xb, yb = np.where(up, x[:, b], x[:, a]), np.where(up, y[:, b], y[:, a])
        slope = (xb - xa) / np.where(yb > ya, yb - ya, 1.0)
        hit = (ya[piece] <= v) & (v < yb[piece])
        cut = xa[piece] + (v - ya[piece]) * slope[piece]
        left = np.where(hit, np.minimum(left, cut), left)
        right = np.where(hit, np.maximum(right, cut), right)
    return left, right


@dataclass(frozen=True)
class Columns:
    """The firing directions of a spinning LiDAR.

    Attributes:
        azimuth0, step: azimuth of column 0, and between columns [rad]; columns fill the circle.
        count: number of columns.
        slopes: (r,) tangent of each ring's elevation, ascending.
    """

    azimuth0: float
    step: float
    count: int
    slopes: FloatArray

    @property
    def azimuths(self) -> FloatArray:
        """(count,) azimuths, counter-clockwise from forward, within -pi to pi [rad]."""
        azimuth = self.azimuth0 + self.step * np.arange(self.count)
        return np.asarray(np.mod(azimuth + np.pi, 2 * np.pi) - np.pi)


@dataclass(frozen=True)
class SweepMotion:
    """How the sensor moves while it sweeps, relative to its pose at the scan's stamp.

    Attributes:
        rotations, positions: (count, 3, 3) and (count, 3) [m] of the sensor at each column's time.
        seconds: (count,) each column's time after the stamp [s].
        reach_m, reach_rad: bounds of the displacement (that of moving things included) and rotation.
    """

    rotations: FloatArray
    positions: FloatArray
    seconds: FloatArray
    reach_m: float
    reach_rad: float


def cast_lidar(
    triangles: FloatArray,
    columns: Columns,
    velocities: FloatArray | None = None,
    motion: SweepMotion | None = None,
) -> tuple[IndexArray, FloatArray]:
    """Nearest face (r, count) along every ray (-1: none), and its horizontal range [m] (inf: none).

    triangles: (n, 3, 3) corners in the LiDAR frame at the stamp [m]; velocities: (n, 3, 3) of the
    corners in that frame [m/s], used with ``motion``: each column then sees its own instant.
    """
    normal, d = plane_of(triangles)
    size = np.maximum(np.linalg.norm(normal, axis=1), 1e-12)
    slack = 0.0 if motion is None else motion.reach_m
    kept = np.flatnonzero(d / size < slack)
    face, column = _candidate_pairs(triangles[kept], columns, motion)
    face = kept[face]
    corners = triangles[face]
    if motion is not None and velocities is not None:
        corners = corners + velocities[face] * motion.seconds[column][:, None, None]
        corners = np.einsum(
            "nij,nik->njk",
            (corners - motion.positions[column][:, None]).transpose(0, 2, 1),
            motion.rotations[column],
        )
        n, dd = plane_of(corners)
    else:
        n, dd = normal[face], d[face]
    azimuth = columns.azimuths[column]
    cos, sin = np.cos(azimuth), np.sin(azimuth)
    low, high = _column_cuts(corners, cos, sin)
    first, last = np.searchsorted(columns.slopes, low), np.searchsorted(columns.slopes, high)
    counts = np.where(dd < 0.0, np.maximum(last - first, 0), 0)
    pair, step = _runs(counts)
    ring = first[pair] + step
    # 1/r = (n . [cos sin slope]) / d with r the horizontal range.
    level = (n[:, 0] * cos + n[:, 1] * sin) / np.where(dd < 0.0, dd, -1.0)
    climb = n[:, 2] / np.where(dd < 0.0, dd, -1.0)
    inverse = level[pair] + climb[pair] * columns.slopes[ring]
    ray = ring * columns.count + column[pair]
    shape = (len(columns.slopes), columns.count)
    best, closeness = _nearest(shape[0] * shape[1], ray, inverse, face[pair])
    reach = np.where(best >= 0, 1.0 / np.maximum(closeness, 1e-9), np.inf)
    return best.reshape(shape), reach.reshape(shape)


def _candidate_pairs(
    triangles: FloatArray, columns: Columns, motion: SweepMotion | None
) -> tuple[IndexArray, IndexArray]:
    """All pairs (face, column) whose half-plane may cut the face."""
    x, y, z = triangles[:, :, 0], triangles[:, :, 1], triangles[:, :, 2]
    azimuth = np.arctan2(y, x)
    turn = np.mod(azimuth[:, 1:] - azimuth[:, :1] + np.pi, 2 * np.pi) - np.pi
    low, high = np.minimum(turn.min(axis=1), 0.0), np.maximum(turn.max(axis=1), 0.0)
    nearest = np.maximum(_axis_distance(x, y), 1e-6)
    if motion is not None:
        pad = motion.reach_rad + np.arcsin(np.minimum(motion.reach_m / nearest, 1.0))
        low, high = low - pad, high + pad
        nearest = np.maximum(nearest - motion.reach_m, 1e-6)
    everywhere = (high - low > 0.9 * np.pi) | (nearest < 1e-5)
    # Faces wholly above or below the rings are never hit.
    lift = 0.0 if motion is None else motion.reach_m * 0.2 + 0.02 * nearest
    farthest = np.hypot(x, y).max(axis=1) + (0.0 if motion is None else motion.reach_m)
    top, bottom = z.max(axis=1) + lift, z.min(axis=1) - lift
    highest = np.where(top > 0, top / nearest, top / farthest)
    lowest = np.where(bottom < 0, bottom / nearest, bottom / farthest)
    seen = (highest >= columns.slopes[0]) & (lowest <= columns.slopes[-1])
    start = np.ceil((azimuth[:, 0] + low - columns.azimuth0) / columns.step - 1e-6)
    stop = np.floor((azimuth[:, 0] + high - columns.azimuth0) / columns.step + 1e-6)
    counts = np.clip(stop - start + 1, 0, columns.count)
    counts = np.where(everywhere, columns.count, counts) * seen
    face, offset = _runs(counts.astype(np.intp))
    return face, (start[face].astype(np.intp) + offset) % columns.count


def _axis_distance(x: FloatArray, y: FloatArray) -> FloatArray:
    """(n,) horizontal distance of the z axis from the outlines of triangles (n, 3) [m]."""
    best = np.full(len(x), np.inf)
    for a, b in ((0, 1), (1, 2), (2, 0)):
        dx, dy = x[:, b] - x[:, a], y[:, b] - y[:, a]
        t = np.clip(-(x[:, a] * dx + y[:, a] * dy) / np.maximum(dx**2 + dy**2, 1e-12), 0.0, 1.0)
        best = np.minimum(best, np.hypot(x[:, a] + t * dx, y[:, a] + t * dy))
    return best


def _column_cuts(corners: FloatArray, cos: FloatArray, sin: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Slopes between which the half-planes at azimuths (cos, sin) (m,) cut the triangles (m, 3, 3).

    A triangle that the axis itself pierces is cut once; it then reaches straight down (or up).
    """
    x, y, z = corners[:, :, 0], corners[:, :, 1], corners[:, :, 2]
    side = cos[:, None] * y - sin[:, None] * x
    along = cos[:, None] * x + sin[:, None] * y
    low, high = np.full(len(x), np.inf), np.full(len(x), -np.inf)
    hits = np.zeros(len(x), np.intp)
    for a, b in ((0, 1), (1, 2), (2, 0)):
        crosses = (side[:, a] <= 0.0) != (side[:, b] <= 0.0)
        # From the right-hand corner to the left-hand one, the same for both triangles at an edge.
        swap = side[:, a] > side[:, b]
        s0, s1 = np.where(swap, side[:, b], side[:, a]), np.where(swap, side[:, a], side[:, b])
        r0, r1 = np.where(swap, along[:, b], along[:, a]), np.where(swap, along[:, a], along[:, b])
        z0, z1 = np.where(swap, z[:, b], z[:, a]), np.where(swap, z[:, a], z[:, b])
        t = s0 / np.where(crosses, s0 - s1, 1.0)
        reach = r0 + t * (r1 - r0)
        valid = crosses & (reach > 1e-9)
        slope = (z0 + t * (z1 - z0)) / np.where(valid, reach, 1.0)
        low = np.where(valid, np.minimum(low, slope), low)
        high = np.where(valid, np.maximum(high, slope), high)
        hits += valid
    below = z.mean(axis=1) < 0.0
    once = hits == 1
    return np.where(once & below, -np.inf, low), np.where(once & ~below, np.inf, high)

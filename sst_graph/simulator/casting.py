"""Exact nearest surfaces at all pixel centres of a camera.

This caster and that of the LiDAR (:mod:`sst_graph.simulator.sweep`) cut each triangle with the
scan lines of the sensor (pixel rows, LiDAR columns) and find the rays between the two cuts,
half-open, so that neighbouring triangles share every ray without gap or overlap: a ray belongs to
the nearest triangle that its very centre hits.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sst_graph.factors.camera import PinholeCamera
from sst_graph.types import FloatArray

NEAR_M = 0.1
"""Faces are clipped this far in front of the camera [m]."""

IndexArray = NDArray[np.intp]

AT_ONCE = 8192
"""Faces, or pairs of a face and a column, that are looked at together: they stay in the processor's cache."""


def runs(counts: IndexArray) -> tuple[IndexArray, IndexArray]:
    """For runs of given lengths: the run each element belongs to, and its place in the run."""
    run = np.repeat(np.arange(len(counts)), counts)
    first = np.cumsum(counts) - counts
    return run, np.arange(len(run)) - first[run]


def compact(numbers: IndexArray) -> tuple[IndexArray, IndexArray]:
    """The distinct numbers, ascending, and each number's place among them (none below -1)."""
    present = np.zeros(numbers.max(initial=-1) + 2, np.bool_)
    present[numbers + 1] = True
    place = np.cumsum(present) - 1
    return np.flatnonzero(present) - 1, place[numbers + 1]


def nearest_faces(
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
    piece, offset = runs(rows)
    v = top[piece] + offset
    left, right = _row_cuts(x, y, piece, v)
    u0 = np.clip(np.ceil(left), 0, camera.width)
    counts = np.maximum(np.clip(np.ceil(right), 0, camera.width) - u0, 0).astype(np.intp)
    span, step = runs(counts)
    # 1/z = (n . K^-1 [u v 1]) / d is linear in the pixel.
    n, dd = normal[face], d[face]
    by_u, by_v = n[:, 0] / (camera.fx * dd), n[:, 1] / (camera.fy * dd)
    base = n[:, 2] / dd - by_u * camera.cx - by_v * camera.cy
    start = base[piece] + by_v[piece] * v + by_u[piece] * u0
    pixel = (v * camera.width + u0).astype(np.intp)[span] + step
    inverse = start[span] + by_u[piece][span] * step
    best, closeness = nearest_faces(camera.width * camera.height, pixel, inverse, face[piece][span])
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

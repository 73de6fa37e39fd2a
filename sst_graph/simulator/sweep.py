"""Exact nearest surfaces along all rays of a spinning LiDAR, at rest or moving while it turns.

A column of rays lies in a vertical half-plane; each triangle is cut with the half-planes that may
meet it, and the rings between the two cuts hit it. See :mod:`sst_graph.simulator.casting`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sst_graph.simulator.casting import AT_ONCE, IndexArray, nearest_faces, runs
from sst_graph.types import FloatArray


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
        velocities: (n, 3, 3) of the corners of all faces, in the sensor's frame at the stamp [m/s].
        cut: azimuth at which the turn begins and ends: the times of the columns jump there [rad].
    """

    rotations: FloatArray
    positions: FloatArray
    seconds: FloatArray
    velocities: FloatArray
    cut: float = np.pi

    @cached_property
    def moving(self) -> NDArray[np.bool_]:
        """(n,) which faces move."""
        return np.asarray(np.any(self.velocities, axis=(1, 2)))

    def seen(self, corners: FloatArray, face: IndexArray, column: IndexArray) -> FloatArray:
        """(3, 3, m) corners (corner, axis, pair) of faces in the sensor's frame at the columns' times.

        corners: (3, 3, n) of all faces (corner, axis, face) in its frame at the stamp [m].
        """
        at = corners.take(face, axis=2)
        pairs = np.flatnonzero(self.moving[face])
        if len(pairs):
            speed = self.velocities[face[pairs]].transpose(1, 2, 0)
            at[:, :, pairs] += speed * self.seconds[column[pairs]]
        at -= self.positions.T.take(column, axis=1)
        # p = R^T (w - t), written out: rows of R^T are columns of R.
        turn = self.rotations.transpose(1, 2, 0).take(column, axis=2)
        return np.stack(
            [at[:, 0] * turn[0, k] + at[:, 1] * turn[1, k] + at[:, 2] * turn[2, k] for k in range(3)], axis=1
        )

    @cached_property
    def reach(self) -> tuple[FloatArray, float]:
        """Bounds: (n,) displacement of each face relative to the sensor [m], the sensor's rotation [rad]."""
        half = float(np.abs(self.seconds).max())
        fastest = np.linalg.norm(self.velocities, axis=2).max(axis=1, initial=0.0)
        cosine = (np.trace(self.rotations, axis1=1, axis2=2) - 1.0) / 2.0
        turn = float(np.arccos(np.clip(cosine, -1.0, 1.0)).max())
        return np.linalg.norm(self.positions, axis=1).max() + fastest * half + 1e-3, turn + 1e-5


def cast_lidar(
    triangles: FloatArray,
    columns: Columns,
    shifts: tuple[float, ...] = (0.0,),
    motion: SweepMotion | None = None,
) -> list[tuple[IndexArray, FloatArray]]:
    """Nearest face (r, count) along every ray (-1: none), and its horizontal range [m] (inf: none).

    triangles: (n, 3, 3) corners in the LiDAR frame at the stamp [m]. One answer for each of
    ``shifts``: a turn of all columns [rad], small against their step. With ``motion`` each column
    sees the world at its own instant.
    """
    below = np.arange(len(triangles)) if motion is not None else _not_above(triangles, columns.slopes)
    corners = np.ascontiguousarray(triangles.take(below, axis=0).transpose(1, 2, 0))
    normal = _normals(corners)
    d = (normal * corners[0]).sum(axis=0)
    size = np.maximum(np.sqrt((normal**2).sum(axis=0)), 1e-12)
    slack: FloatArray | float = 0.0 if motion is None else motion.reach[0]
    kept = np.flatnonzero(d / size < slack)
    face, column = _candidate_pairs(corners, kept, columns, max(abs(shift) for shift in shifts), motion)
    planes = normal / np.where(d < 0.0, d, -1.0)
    beams = [_Beam(columns.azimuths + shift, columns.slopes) for shift in shifts]
    for begin in range(0, len(face), AT_ONCE):
        some, by = face[begin : begin + AT_ONCE], column[begin : begin + AT_ONCE]
        if motion is None:  # all that was kept is seen from its front
            at, n = corners.take(some, axis=2), planes.take(some, axis=1)
        else:
            at = motion.seen(corners, some, by)
            n = _normals(at)
            dd = (n * at[0]).sum(axis=0)
            front = np.flatnonzero(dd < 0.0)
            at, n = at.take(front, axis=2), n.take(front, axis=1) / dd[front]
            some, by = some[front], by[front]
        for beam in beams:
            beam.add(at, n, below[some], by)
    return [beam.nearest() for beam in beams]


class _Beam:
    """What the rays of one firing direction a column hit, collected from pairs of faces and columns."""

    def __init__(self, azimuths: FloatArray, slopes: FloatArray) -> None:
        self.cos, self.sin, self.slopes = np.cos(azimuths), np.sin(azimuths), slopes
        self.hits: list[tuple[IndexArray, FloatArray, IndexArray]] = []

    def add(self, at: FloatArray, n: FloatArray, face: IndexArray, column: IndexArray) -> None:
        """Pairs: corners (3, 3, m), planes n . p = 1 (3, m), faces and columns (m,)."""
        cos, sin = self.cos[column], self.sin[column]
        low, high = _column_cuts(at, cos, sin)
        first, last = np.searchsorted(self.slopes, low), np.searchsorted(self.slopes, high)
        hit = np.flatnonzero(last > first)
        pair, step = runs((last - first)[hit])
        pair = hit[pair]
        ring = first[pair] + step
        # 1/r = n . [cos sin slope] with r the horizontal range.
        level = n[0] * cos + n[1] * sin
        inverse = level[pair] + n[2][pair] * self.slopes[ring]
        self.hits.append((ring * len(self.cos) + column[pair], inverse, face[pair]))

    def nearest(self) -> tuple[IndexArray, FloatArray]:
        """Nearest face (r, count) along every ray (-1: none), and its horizontal range [m] (inf: none)."""
        shape = (len(self.slopes), len(self.cos))
        none = (np.zeros(0, np.intp), np.zeros(0), np.zeros(0, np.intp))
        ray, inverse, face = (np.concatenate(parts) for parts in zip(*(self.hits or [none]), strict=True))
        best, closeness = nearest_faces(shape[0] * shape[1], ray, inverse, face)
        reach = np.where(best >= 0, 1.0 / np.maximum(closeness, 1e-9), np.inf)
        return best.reshape(shape), reach.reshape(shape)


def _not_above(triangles: FloatArray, slopes: FloatArray) -> IndexArray:
    """Which of the triangles (n, 3, 3) are not wholly above all rings."""
    bottom = _of_three(np.minimum, triangles[:, :, 2])
    far = _of_three(np.maximum, np.hypot(triangles[:, :, 0], triangles[:, :, 1]))
    # A little less strict than the quotient of :func:`_within_rings`, which decides.
    return np.flatnonzero((bottom < 0.0) | (bottom <= slopes[-1] * far * (1.0 + 1e-9)))


def _of_three(choice: np.ufunc, values: FloatArray) -> FloatArray:
    """(n,) least or greatest of each row of ``values`` (n, 3)."""
    return np.asarray(choice(choice(values[:, 0], values[:, 1]), values[:, 2]))


def _normals(corners: FloatArray) -> FloatArray:
    """(3, n) outward normals, not normalised, of triangles (corner, axis, n)."""
    (ax, ay, az), (bx, by, bz) = corners[1] - corners[0], corners[2] - corners[0]
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def _candidate_pairs(
    corners: FloatArray, kept: IndexArray, columns: Columns, widen: float, motion: SweepMotion | None
) -> tuple[IndexArray, IndexArray]:
    """All pairs (face, column) of the faces ``kept`` whose half-plane may cut the face."""
    seen = corners.take(kept, axis=2)
    start, low, high, distance = _extent(seen)
    pad: FloatArray | float = 0.0
    shift: FloatArray | float = 0.0
    if motion is not None:
        reach, turn = motion.reach
        reach = reach[kept]
        wide = turn + np.arcsin(np.minimum(reach / distance, 1.0))
        # Look again at the time at which the beam passes; what moves from then on is less by the
        # share of the sweep that the face and its shift cover. At the seam, and near by, all of it.
        middle = np.mod(start + 0.5 * (low + high) + np.pi, 2 * np.pi) - np.pi
        for _ in range(2):
            column = np.rint((middle - columns.azimuth0) / columns.step).astype(np.intp) % columns.count
            seen = motion.seen(corners, kept, column)
            start, low, high, distance = _extent(seen)
            shift, middle = middle, np.mod(start + 0.5 * (low + high) + np.pi, 2 * np.pi) - np.pi
        share = np.minimum(2.0 * ((high - low) + np.abs(middle - shift)) / np.pi + 0.03, 2.0)
        from_cut = np.abs(np.mod(middle - motion.cut + np.pi, 2 * np.pi) - np.pi)
        seam = from_cut < 0.5 * (high - low) + wide
        pad = np.where(seam | (distance < 3.0 * reach), 2.0 * wide, share * wide)
    low, high = low - pad - widen, high + pad + widen
    everywhere = (high - low > 0.9 * np.pi) | (distance < 1e-5)
    first = np.ceil((start + low - columns.azimuth0) / columns.step - 1e-6)
    last = np.floor((start + high - columns.azimuth0) / columns.step + 1e-6)
    counts = np.where(everywhere, columns.count, np.clip(last - first + 1, 0, columns.count))
    counts = counts * _within_rings(seen, distance, columns.slopes, 0.0 if motion is None else 0.3)
    face, offset = runs(counts.astype(np.intp))
    return kept[face], (first[face].astype(np.intp) + offset) % columns.count


def _extent(corners: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Of triangles (3, 3, n): azimuth of the first corner, least and greatest turn from it [rad],
    horizontal distance of the z axis from the outline [m]."""
    x, y = corners[:, 0], corners[:, 1]
    azimuth = np.arctan2(y, x)
    turn = np.mod(azimuth[1:] - azimuth[:1] + np.pi, 2 * np.pi) - np.pi
    low, high = np.minimum(turn.min(axis=0), 0.0), np.maximum(turn.max(axis=0), 0.0)
    nearest = np.full(x.shape[1], np.inf)
    for a, b in ((0, 1), (1, 2), (2, 0)):
        dx, dy = x[b] - x[a], y[b] - y[a]
        t = np.clip(-(x[a] * dx + y[a] * dy) / np.maximum(dx**2 + dy**2, 1e-12), 0.0, 1.0)
        nearest = np.minimum(nearest, np.hypot(x[a] + t * dx, y[a] + t * dy))
    return azimuth[0], low, high, np.maximum(nearest, 1e-6)


def _within_rings(
    corners: FloatArray, nearest: FloatArray, slopes: FloatArray, slack: float
) -> NDArray[np.bool_]:
    """(n,) False for triangles wholly above or below all rings; ``slack``: what they may still move [m]."""
    z = corners[:, 2]
    top, bottom = z.max(axis=0) + slack, z.min(axis=0) - slack
    near = np.maximum(nearest - slack, 1e-6)
    far = np.hypot(corners[:, 0], corners[:, 1]).max(axis=0) + slack
    highest = np.where(top > 0, top / near, top / far)
    lowest = np.where(bottom < 0, bottom / near, bottom / far)
    return np.asarray((highest >= slopes[0]) & (lowest <= slopes[-1]))


def _column_cuts(corners: FloatArray, cos: FloatArray, sin: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Slopes between which the half-planes at azimuths (cos, sin) (m,) cut the triangles (3, 3, m).

    A triangle that the axis itself pierces is cut once; it then reaches straight down (or up).
    """
    x, y, z = corners[:, 0], corners[:, 1], corners[:, 2]
    side, along = cos * y - sin * x, cos * x + sin * y
    count = len(cos)
    low, high = np.full(count, np.inf), np.full(count, -np.inf)
    right = side <= 0.0
    pairs = np.flatnonzero((right[0] != right[1]) | (right[0] != right[2]))
    # One corner is on the other side than two: its edges are cut, from the right-hand corner to the left-hand
    # one, the same for both triangles at an edge.
    right = right.take(pairs, axis=1)
    odd = np.where(right[0] == right[1], 2, np.where(right[0] == right[2], 1, 0))
    odd_is_right = right[odd, np.arange(len(pairs))]
    slopes, cut = np.empty((2, len(pairs))), np.empty((2, len(pairs)), np.bool_)
    for k in (0, 1):
        a, b = odd * count + pairs, (odd + 1 + k) % 3 * count + pairs
        a, b = np.where(odd_is_right, a, b), np.where(odd_is_right, b, a)
        s, r, h = side.take(a), along.take(a), z.take(a)
        t = s / (s - side.take(b))
        reach = r + t * (along.take(b) - r)
        cut[k] = reach > 1e-9
        slopes[k] = (h + t * (z.take(b) - h)) / np.where(cut[k], reach, 1.0)
    low[pairs] = np.where(cut, slopes, np.inf).min(axis=0)
    high[pairs] = np.where(cut, slopes, -np.inf).max(axis=0)
    once = cut[0] != cut[1]
    if once.any():
        pierced = pairs[once]
        below = z[:, pierced].mean(axis=0) < 0.0
        low[pierced[below]], high[pierced[~below]] = -np.inf, np.inf
    return low, high

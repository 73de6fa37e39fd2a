"""The silhouettes of one drive under many poses at once: normal equations for one Gauss-Newton step each.

Matches are those of :func:`~sst_graph.association.edge_matching.match_edges`, made by the same rules. The
differences are for speed, because the search matches some hundred poses where the graph matches one: points
that are far out of view are sorted out first; motion is of second order in the interval; the contours'
distances and normals come from one bilinear cell; objects are taken as static, points as measured; pixels
that rectification enlarged count like others, and level edges share no error along a ring. The unknowns are
pose, time offset and one mask bias a class; twists are fixed, and so a step costs a hundredth of that of
:class:`~sst_graph.graph.frozen_problem.FrozenProblem`, which gives the estimate itself.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sst_graph.association.edge_matching import (
    GATE,
    faces,
    match_sigmas,
    of_matched_objects,
    side_weights,
    sides_of,
)
from sst_graph.association.time_pairing import nearest_images
from sst_graph.drive.preparation import ImageFeatures
from sst_graph.factors.camera import PinholeCamera
from sst_graph.factors.motion import cross
from sst_graph.factors.robust import RobustKernel
from sst_graph.features.mask_contour import MIN_GRADIENT, ContourMap, are_unknown, well_inside
from sst_graph.graph.matching import DriveEdges
from sst_graph.initialization.label_agreement import States
from sst_graph.types import FloatArray, IntArray, SemanticClass

_MIN_DEPTH_M = 0.5
"""Nearer points are not projected: no object is so close [m]."""
_REACH_M = 3.0
"""Farthest that a point moves between its scan and its image [m]: 30 m/s for a tenth of a second."""
_MIN_OBJECT_SHARE = 0.3
"""Of an object's boundary that must meet a contour. More than in the graph: under a wrong pose many objects
cross some contour, and a pose must not gain by them."""
_KEPT_FIELDS = 80
"""Most contours that are kept in memory: of ten scans, with offsets of a third of a second to both sides."""
_NEAR_NS = 4_000_000
"""Twists this close in time are one [ns]: at 5 m/s^2 they differ by 2 cm/s, and less is looked up."""


@dataclass(frozen=True)
class Poses(States):
    """States with mask biases (m, classes) [px]."""

    biases: FloatArray


@dataclass(frozen=True)
class BatchEquations:
    """Normal equations H x = -g of every pose, and how well the labels agree with it.

    Attributes:
        H: (m, k, k), g: (m, k), over [camera-side rotation, translation, offset, bias of each class]:
            cP' = Exp(rotation) cP + translation.
        support: (m,) matches, each counted by its robust weight.
        seen: (m,) boundary points that fall into an image.
    """

    H: FloatArray
    g: FloatArray
    support: FloatArray
    seen: FloatArray

    @property
    def agreements(self) -> FloatArray:
        """(m,) as :func:`sst_graph.graph.outer_loop.agreement`."""
        return np.asarray(self.support**2 / np.maximum(self.seen, 1.0))


@dataclass(frozen=True)
class _Pairing:
    """Which image each scan is compared with, under each pose.

    Attributes:
        images: (m, scans) number of the image; -1 for none.
        base_taus_s: (m, scans) image stamp minus scan stamp [s].
        twists, accelerations: (m, scans, 6) of the LiDAR at the image's instant, or None where it stands
            in all of them [rad/s, m/s].
    """

    images: IntArray
    base_taus_s: FloatArray
    twists: FloatArray | None
    accelerations: FloatArray | None


@dataclass(frozen=True)
class _InImage:
    """Boundary points in an image at its instant, pose by pose.

    Attributes:
        pose, point: (k,) which.
        lPs, cPs: (3, k) points in the LiDAR frame and in the camera [m].
        uvs: (2, k) pixels.
    """

    pose: IntArray
    point: IntArray
    lPs: FloatArray
    cPs: FloatArray
    uvs: FloatArray

    def take(self, index: IntArray) -> _InImage:
        """Some of the points, by position."""
        return _InImage(
            self.pose[index],
            self.point[index],
            self.lPs.take(index, axis=1),
            self.cPs.take(index, axis=1),
            self.uvs.take(index, axis=1),
        )


class _Fields:
    """Contours in memory, those that were needed last: every pose is compared with the same few images."""

    def __init__(self) -> None:
        self._kept: dict[tuple[int, SemanticClass], ContourMap | None] = {}

    def of(self, image: ImageFeatures, kind: SemanticClass) -> ContourMap | None:
        """The contours of a class in an image; None where it has none."""
        key = image.stamp_ns, kind
        if key not in self._kept:
            if len(self._kept) >= _KEPT_FIELDS:
                self._kept.pop(next(iter(self._kept)))
            field = image.contours.get(kind)
            self._kept[key] = (
                replace(field, distance=field.distance, unknown=field.unknown)
                if isinstance(field, ContourMap)
                else None
            )
        return self._kept[key]


class PoseBatch:
    """The boundary points of a drive, by columns, to be matched under many poses."""

    def __init__(self, edges: DriveEdges, fields: _Fields | None = None) -> None:
        """fields: contours that are in memory already."""
        self.edges = edges
        self._fields = fields or _Fields()
        self.camera: PinholeCamera = edges.drive.camera
        self.classes = sorted(set(edges.classes))
        points = edges.points
        # (3, n) points, and the step from each to its neighbour outside the object [m].
        self._lPs = np.ascontiguousarray(points.lPs.T)
        self._steps = np.ascontiguousarray((points.outward - points.lPs).T)
        self._scans = np.array(edges.scans)[edges.group_of]
        self._classes = np.array([self.classes.index(c) for c in edges.classes])[edges.group_of]

    def __len__(self) -> int:
        return len(self.edges)

    def thinned(self, most: int) -> PoseBatch:
        """Evenly spread points, at most so many."""
        return PoseBatch(self.edges.thinned(most), self._fields)

    def equations(self, poses: Poses, kernel: RobustKernel) -> BatchEquations:
        """Match every pose's boundary points to the nearest contours; the kernel's scale is in pixels."""
        config, owners = self.edges.config, self.edges.owners
        pairing = self._pairing(poses.offsets)
        seen = self._in_image(poses, pairing)
        owner = seen.pose * (int(owners.max(initial=-1)) + 1) + owners[seen.point]
        # 1. Keep contours that are near and face outward, of objects of which enough points have one.
        near, r, normals = self._near_contours(seen, poses, pairing, GATE * kernel.scale)
        R = _by_row(poses.rotations)
        close = seen.take(near)
        turns = R.take(close.pose, axis=1)
        direction, length = _directions(
            self.camera, close.cPs, _rotated(turns, self._steps.take(close.point, axis=1))
        )
        cosine = direction[0] * normals[0] + direction[1] * normals[1]
        seen_owners = np.bincount(owner, minlength=1)
        matched = of_matched_objects(faces(cosine), owner[near], seen_owners, _MIN_OBJECT_SHARE)
        on = np.flatnonzero(matched)
        close, owner, r = close.take(on), owner[near[on]], r[on]
        # 2. Their weights.
        sigma = match_sigmas(length[on], cosine[on], config)
        sides = sides_of(self.edges.points.edges[close.point], direction[0, on])
        robust = kernel.weight(r / sigma)
        weight = robust * side_weights(owner, sides, sigma, config) / sigma**2
        # 3. Normal equations.
        rows = self._rows(close, normals[:, on], poses.biases.shape[1])
        motion = self._motion(poses, pairing, close.pose, close.point)
        if motion is not None:
            last = motion[1] - motion[2]
            rates = -(cross(last[:3], close.lPs) + last[3:])
            rows[6] = (rows[3:6] * _rotated(turns[:, on], rates)).sum(axis=0)
        H, g = _normal_equations(rows, r, weight, close.pose, len(poses))
        support = np.bincount(close.pose, robust, len(poses)).astype(np.float64)
        in_image = np.bincount(seen.pose, minlength=len(poses)).astype(np.float64)
        return BatchEquations(H, g, support, in_image)

    def _pairing(self, offsets: FloatArray) -> _Pairing:
        """The image of each scan under each offset, and the LiDAR's motion then."""
        drive = self.edges.drive
        stamps = np.array(drive.image_stamps_ns)
        images, taus = nearest_images(
            drive.scan_stamps_ns, drive.image_stamps_ns, offsets, drive.image_period_s
        )
        seen = images >= 0
        # Twists that are near enough in time are one.
        shifts = np.rint(1e9 * offsets).astype(np.int64)[:, None]
        near, which = np.unique((stamps[images] + shifts)[seen] // _NEAR_NS, return_inverse=True)
        instants = (near * _NEAR_NS + _NEAR_NS // 2).tolist()
        samples = self.edges.motion.at_all(instants)
        if samples is None or not samples.twists.any():
            return _Pairing(images, taus, None, None)
        twists, accelerations = np.zeros((2, *images.shape, 6))
        twists[seen] = samples.twists[which.reshape(-1)]
        accelerations[seen] = samples.accelerations[which.reshape(-1)]
        return _Pairing(images, taus, twists, accelerations)

    def _in_image(self, poses: Poses, pairing: _Pairing) -> _InImage:
        """The points that fall into their image."""
        camera = self.camera
        # 1. Where nothing moved: most points are far from the image.
        pose, point = np.nonzero(self._roughly_in_view(poses, pairing))
        lPs = self._moved(poses, pairing, pose, point)
        cPs = _rotated(_by_row(poses.rotations).take(pose, axis=1), lPs)
        cPs += _by_row(poses.translations).take(pose, axis=1)
        # 2. Where they are at the image's instant.
        ahead = np.maximum(cPs[2], _MIN_DEPTH_M)
        uvs = np.stack([camera.fx * cPs[0] / ahead + camera.cx, camera.fy * cPs[1] / ahead + camera.cy])
        inside = np.flatnonzero((cPs[2] > _MIN_DEPTH_M) & camera.in_image(uvs.T))
        return _InImage(pose, point, lPs, cPs, uvs).take(inside)

    def _roughly_in_view(self, poses: Poses, pairing: _Pairing) -> NDArray[np.bool_]:
        """(m, n) whether a point that moves by less than :data:`_REACH_M` may fall into its image."""
        camera = self.camera
        margin = 0.0 if pairing.twists is None else _REACH_M
        side = max(camera.cx + 0.5, camera.width - camera.cx - 0.5) / camera.fx
        across, ahead = (
            poses.rotations[:, row] @ self._lPs + poses.translations[:, row, None] for row in (0, 2)
        )
        near = (ahead > _MIN_DEPTH_M - margin) & (np.abs(across) <= side * (ahead + margin) + margin)
        return np.asarray(near & (pairing.images[:, self._scans] >= 0))

    def _moved(self, poses: Poses, pairing: _Pairing, pose: IntArray, point: IntArray) -> FloatArray:
        """Points (3, k) at their images' instant, in the LiDAR frame.

        lP' = Exp(-tau w) lP to second order, w the LiDAR's mean twist over the interval.
        """
        lPs, motion = self._lPs.take(point, axis=1), self._motion(poses, pairing, pose, point)
        if motion is None:
            return lPs
        taus, now, change = motion
        mean = now - 0.5 * change
        step = taus * (cross(mean[:3], lPs) + mean[3:])
        return np.asarray(lPs - step + 0.5 * taus * cross(mean[:3], step))

    def _motion(
        self, poses: Poses, pairing: _Pairing, pose: IntArray, point: IntArray
    ) -> tuple[FloatArray, FloatArray, FloatArray] | None:
        """Intervals from points to their images' instants (k,) [s], the LiDAR's twists then (6, k) and by how
        much they changed over the intervals (6, k) [rad/s, m/s]; None where nothing moves."""
        if pairing.twists is None or pairing.accelerations is None:
            return None
        scan = self._scans[point]
        taus = poses.offsets[pose] + pairing.base_taus_s[pose, scan] - self.edges.points.offsets_s[point]
        number = pose * pairing.images.shape[1] + scan
        now, change = (
            _by_row(each.reshape(-1, 6)).take(number, axis=1)
            for each in (pairing.twists, pairing.accelerations)
        )
        change *= taus
        return taus, now, change

    def _near_contours(
        self, seen: _InImage, poses: Poses, pairing: _Pairing, gate_px: float
    ) -> tuple[IntArray, FloatArray, FloatArray]:
        """Positions (k,) of points with a clear contour nearby, residuals (k,) [px], normals (2, k)."""
        kinds = self._classes[seen.point]
        biases = poses.biases[seen.pose, kinds]
        key = pairing.images[seen.pose, self._scans[seen.point]] * len(self.classes) + kinds
        # Small numbers are sorted many times faster.
        order = np.argsort(key.astype(np.int16) if key.max(initial=0) < 2**15 else key, kind="stable")
        names, starts = np.unique(key[order], return_index=True)
        images, classes, count = self.edges.drive.images, self.classes, len(self.classes)
        contours, parts = [], [order[:0]]
        for name, part in zip(names.tolist(), np.split(order, starts[1:]), strict=False):
            contour = self._fields.of(images[name // count], classes[name % count])
            if contour is not None:
                contours.append(contour)
                parts.append(part)
        if not contours:
            return order[:0], np.zeros(0), np.zeros((2, 0))
        some = np.concatenate(parts)
        found, r, normals = _nearest_contours(
            contours, list(map(len, parts[1:])), seen.uvs.take(some, axis=1), biases[some], gate_px
        )
        near = some[found]
        order = np.argsort(near)
        return near[order], r[order], normals[:, order]

    def _rows(self, seen: _InImage, normals: FloatArray, classes: int) -> FloatArray:
        """(7 + classes, k) derivatives of the residuals, by the time offset those of points at rest."""
        X, Y, Z = seen.cPs
        rows = np.zeros((7 + classes, len(X)))
        a, b = normals[0] * self.camera.fx / Z, normals[1] * self.camera.fy / Z
        c = -(a * X + b * Y) / Z
        rows[0], rows[1], rows[2] = Y * c - Z * b, Z * a - X * c, X * b - Y * a
        rows[3], rows[4], rows[5] = a, b, c
        rows[7 + self._classes[seen.point], np.arange(len(X))] = 1.0
        return rows


def _rotated(R: FloatArray, x: FloatArray) -> FloatArray:
    """(3, k) vectors x turned by a matrix each, (9, k) row by row."""
    return np.stack([R[i] * x[0] + R[i + 1] * x[1] + R[i + 2] * x[2] for i in (0, 3, 6)])


def _by_row(each: FloatArray) -> FloatArray:
    """(k, m) numbers of m matrices or vectors: rows that lie together are worked on faster."""
    return np.ascontiguousarray(each.reshape(len(each), -1).T)


def _directions(camera: PinholeCamera, cPs: FloatArray, steps: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(2, k) unit outward directions of the objects in the image, and the lengths (k,) of the steps [px].

    Args:
        cPs, steps: (3, k) points, and the steps to their neighbours outside the objects, in the camera [m].
    """
    X, Y, Z = cPs
    dX, dY, dZ = steps
    farther = np.maximum(Z + dZ, _MIN_DEPTH_M)
    step = np.stack([camera.fx * (dX - dZ * X / Z), camera.fy * (dY - dZ * Y / Z)]) / farther
    length = np.sqrt(step[0] ** 2 + step[1] ** 2)
    return step / np.maximum(length, 1e-9), length


def _nearest_contours(
    contours: Sequence[ContourMap],
    counts: Sequence[int],
    uvs: FloatArray,
    biases: FloatArray,
    gate_px: float,
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Contours near pixels (2, n) on their images: of which pixels (k,), residuals (k,) [px], normals (2, k).

    As :func:`~sst_graph.features.mask_contour.nearest_contours`, but distance and gradient are those of one
    bilinear cell: four values are read for a pixel where central differences read twenty. Ridges are left
    out.

    Args:
        counts: pixels of each contour, one contour's after the other's.
        biases: (n,) that are added to the distances [px].
        gate_px: a contour is near where its residual is smaller.
    """
    borders = np.cumsum([0, *counts])
    boxes = np.array([(c.left, c.top, *c.box, c.width, c.height) for c in contours]).T
    left, top, columns, rows, width, height = np.repeat(boxes, counts, axis=1)
    u, v = uvs
    column, row = u.astype(np.intp), v.astype(np.intp)
    x0, y0 = column - left, row - top
    valid = well_inside(u, v, width, height) & (x0 >= 0) & (y0 >= 0) & (x0 < columns - 1) & (y0 < rows - 1)
    inside = np.flatnonzero(valid)
    x0, y0, columns = x0[inside], y0[inside], columns[inside]
    at = y0 * columns + x0
    corners = np.stack([at, at + 1, at + columns, at + columns + 1])
    values = np.empty(corners.shape, np.float32)
    for contour, (a, b) in zip(contours, itertools.pairwise(np.searchsorted(inside, borders)), strict=True):
        values[:, a:b] = contour.distance.take(corners[:, a:b])
    a, b, c, d = values.astype(np.float64)
    x, y = u[inside] - column[inside], v[inside] - row[inside]
    above, below = a + x * (b - a), c + x * (d - c)
    distance = above + y * (below - above)
    r = distance + biases[inside]
    # What follows is for the near ones only.
    near = np.flatnonzero(np.abs(r) < gate_px)
    inside = inside[near]
    a, b, c, d, x, y, above, below = (each[near] for each in (a, b, c, d, x, y, above, below))
    gradient = np.stack([(1.0 - y) * (b - a) + y * (d - c), below - above])
    length = np.sqrt(gradient[0] ** 2 + gradient[1] ** 2)
    normals = gradient / np.maximum(length, MIN_GRADIENT)
    feet = uvs.take(inside, axis=1) - distance[near] * normals - [left[inside], top[inside]]
    spans = list(itertools.pairwise(np.searchsorted(inside, borders).tolist()))
    clear = np.flatnonzero((length > MIN_GRADIENT) & ~are_unknown(contours, spans, feet))
    return inside[clear], r[near[clear]], normals[:, clear]


def _normal_equations(
    rows: FloatArray, r: FloatArray, weight: FloatArray, pose: IntArray, poses: int
) -> tuple[FloatArray, FloatArray]:
    """H (m, k, k) and g (m, k) from rows (k, n) that come pose by pose."""
    k = len(rows)
    H, g = np.zeros((poses, k, k)), np.zeros((poses, k))
    weighted = rows * weight
    borders = np.searchsorted(pose, np.arange(poses + 1))
    for i, (a, b) in enumerate(itertools.pairwise(borders)):
        H[i] = weighted[:, a:b] @ rows[:, a:b].T
        g[i] = weighted[:, a:b] @ r[a:b]
    return H, g

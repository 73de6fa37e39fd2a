"""Many poses against the silhouettes of one drive at once, with one Gauss-Newton step each.

The matches and residuals are those of :mod:`~sst_graph.association.edge_matching`; what a graph would hold as
variables beside pose, offset and mask biases (the twists) is fixed. So candidates can be told apart at
a hundredth of what their graphs would cost; the answer itself comes from a graph.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sst_graph.association.edge_matching import SIDE_OF, SIDES, MatchConfig
from sst_graph.factors.camera import PinholeCamera
from sst_graph.factors.motion import cross
from sst_graph.factors.robust import RobustKernel
from sst_graph.features.lidar_edges import Boundaries, Edge
from sst_graph.features.mask_contour import MIN_GRADIENT, ContourMap, are_unknown, well_inside
from sst_graph.types import SemanticClass

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]

_MIN_DEPTH_M = 0.5
_REACH_M = 3.0
"""Farthest that a point moves between its scan and its image [m]."""


@dataclass(frozen=True)
class Poses:
    """Rotations (m, 3, 3), translations (m, 3) [m], offsets (m,) [s] and mask biases (m, classes) [px]."""

    rotations: FloatArray
    translations: FloatArray
    offsets: FloatArray
    biases: FloatArray

    def __len__(self) -> int:
        return len(self.offsets)

    def take(self, index: IntArray) -> Poses:
        """Some of the poses, by position."""
        return Poses(self.rotations[index], self.translations[index], self.offsets[index], self.biases[index])


@dataclass(frozen=True)
class Views:
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
class Steps:
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


@dataclass(frozen=True)
class _Seen:
    """Boundary points in an image, pose by pose.

    Attributes:
        pose, point: (k,) which.
        cPs, ways: (3, k) point, and the step to its neighbour outside the object, in the camera [m].
        uvs: (2, k) pixels.
        rates: (3, k) of the points by the time offset, in the camera [m/s]; None where nothing moves.
    """

    pose: IntArray
    point: IntArray
    cPs: FloatArray
    ways: FloatArray
    uvs: FloatArray
    rates: FloatArray | None

    def take(self, index: IntArray) -> _Seen:
        return _Seen(
            self.pose[index],
            self.point[index],
            self.cPs[:, index],
            self.ways[:, index],
            self.uvs[:, index],
            None if self.rates is None else self.rates[:, index],
        )


@dataclass(frozen=True)
class Outlines:
    """The boundary points of some scans of a drive, and the contours of its images.

    Attributes:
        camera: of all images.
        contours: of each image, by class.
        classes: all classes.
        lPs, ways: (3, n) boundary points, and the step from each to its neighbour outside the object [m].
        offsets_s: (n,) time of each point relative to its scan's stamp [s].
        scans, kinds, objects: (n,) number of its scan, of its class, of its object in all scans.
        edges: (n,) kind of edge.
    """

    camera: PinholeCamera
    contours: Sequence[Mapping[SemanticClass, ContourMap]]
    classes: Sequence[SemanticClass]
    lPs: FloatArray
    ways: FloatArray
    offsets_s: FloatArray
    scans: IntArray
    kinds: IntArray
    objects: IntArray
    edges: NDArray[np.uint8]

    @classmethod
    def gather(
        cls,
        scans: Sequence[Mapping[SemanticClass, Boundaries]],
        contours: Sequence[Mapping[SemanticClass, ContourMap]],
        classes: Sequence[SemanticClass],
        camera: PinholeCamera,
    ) -> Outlines:
        """All boundary points of the classes."""
        parts: list[Boundaries] = []
        numbers: list[tuple[int, int]] = []
        objects, first = [np.zeros(0, np.intp)], 0
        for number, boundaries in enumerate(scans):
            for kind, c in enumerate(classes):
                if c not in boundaries or len(boundaries[c]) == 0:
                    continue
                parts.append(boundaries[c])
                numbers.append((number, kind))
                own = np.unique(boundaries[c].objects, return_inverse=True)[1].reshape(-1)
                objects.append(own + first)
                first += int(own.max()) + 1
        counts = [len(part) for part in parts]
        scan_of, kind_of = np.array(numbers, np.intp).reshape(-1, 2).T
        lPs = np.concatenate([np.zeros((0, 3)), *(part.lPs for part in parts)])
        outward = np.concatenate([np.zeros((0, 3)), *(part.outward for part in parts)])
        return cls(
            camera,
            contours,
            classes,
            np.ascontiguousarray(lPs.T),
            np.ascontiguousarray((outward - lPs).T),
            np.concatenate([np.zeros(0), *(part.offsets_s for part in parts)]),
            np.repeat(scan_of, counts),
            np.repeat(kind_of, counts),
            np.concatenate(objects),
            np.concatenate([np.zeros(0, np.uint8), *(part.edges for part in parts)]),
        )

    def __len__(self) -> int:
        return len(self.offsets_s)

    def thinned(self, most: int) -> Outlines:
        """Evenly spread points, at most so many."""
        some = np.arange(0, len(self), max(1, -(-len(self) // most)))
        return replace(
            self,
            lPs=self.lPs[:, some],
            ways=self.ways[:, some],
            offsets_s=self.offsets_s[some],
            scans=self.scans[some],
            kinds=self.kinds[some],
            objects=self.objects[some],
            edges=self.edges[some],
        )

    def steps(self, poses: Poses, views: Views, kernel: RobustKernel, config: MatchConfig) -> Steps:
        """Match every pose's boundary points to the nearest contours; the kernel's scale is in pixels."""
        seen = self._seen(poses, views, config)
        image = views.images[seen.pose, self.scans[seen.point]]
        distance, normals = self._look_up(seen, image)
        kind = self.kinds[seen.point]
        r = distance + poses.biases[seen.pose, kind]
        # 1. The contour faces the way out of the object, and is near.
        way, length = _directions(self.camera, seen)
        cosine = way[0] * normals[0] + way[1] * normals[1]
        matched = (cosine > config.min_cosine) & (np.abs(r) < config.gate * kernel.scale)
        # 2. Enough of the object's boundary meets one.
        count = int(self.objects.max(initial=-1)) + 1
        owner = seen.pose * count + self.objects[seen.point]
        whole = np.bincount(owner, minlength=1)
        matched &= (np.bincount(owner, matched, len(whole)) >= config.min_object_share * whole)[owner]
        on = np.flatnonzero(matched)
        # 3. A side of an object has a voice that grows little with its points.
        sigma = np.hypot(config.mask_sigma_px, 0.5 * length[on] * cosine[on] / np.sqrt(3.0))
        point = seen.point[on]
        side = owner[on] * SIDES + SIDE_OF[self.edges[point], (way[0, on] > 0.0).astype(np.intp)]
        information = np.bincount(side, sigma**-2.0, 1)[side]
        robust = kernel.weight(r[on] / sigma)
        weight = robust / (sigma**2 * (1.0 + information * config.side_sigma_px**2))
        # 4. Normal equations.
        rows = self._rows(seen.take(on), normals[:, on], kind[on], poses.biases.shape[1])
        H, g = _normal_equations(rows, r[on], weight, seen.pose[on], len(poses))
        support = np.bincount(seen.pose[on], robust, len(poses)).astype(np.float64)
        return Steps(H, g, support, np.bincount(seen.pose, minlength=len(poses)).astype(np.float64))

    def _seen(self, poses: Poses, views: Views, config: MatchConfig) -> _Seen:
        """The points that fall into their image."""
        camera = self.camera
        # 1. Where nothing moved: most points are far from the image.
        near = self._roughly_in_view(poses, views, config)
        pose, point = np.nonzero(near)
        # By row, for rows that lie together are worked on faster.
        R = np.ascontiguousarray(poses.rotations.reshape(-1, 9).T)
        t = np.ascontiguousarray(poses.translations.T)
        lPs, rates = self._moved(poses, views, pose, point)
        cPs = _rotated(R[:, pose], lPs) + t[:, pose]
        # 2. Where they are at the image's instant.
        ahead = np.maximum(cPs[2], _MIN_DEPTH_M)
        uvs = np.stack([camera.fx * cPs[0] / ahead + camera.cx, camera.fy * cPs[1] / ahead + camera.cy])
        inside = np.flatnonzero((cPs[2] > _MIN_DEPTH_M) & camera.in_image(uvs.T))
        pose, point = pose[inside], point[inside]
        turns = R[:, pose]
        ways = _rotated(turns, self.ways[:, point])
        rates = None if rates is None else _rotated(turns, rates[:, inside])
        return _Seen(pose, point, cPs[:, inside], ways, uvs[:, inside], rates)

    def _roughly_in_view(self, poses: Poses, views: Views, config: MatchConfig) -> NDArray[np.bool_]:
        """(m, n) whether a point that moves by less than :data:`_REACH_M` may fall into its image."""
        camera = self.camera
        margin = 0.0 if views.twists is None else _REACH_M
        side = max(camera.cx + 0.5, camera.width - camera.cx - 0.5) / camera.fx
        across, ahead = (
            poses.rotations[:, row] @ self.lPs + poses.translations[:, row, None] for row in (0, 2)
        )
        near = (ahead > _MIN_DEPTH_M - margin) & (np.abs(across) <= side * (ahead + margin) + margin)
        near &= views.images[:, self.scans] >= 0
        if not config.top_edges:
            near &= self.edges != Edge.TOP
        return np.asarray(near)

    def _moved(
        self, poses: Poses, views: Views, pose: IntArray, point: IntArray
    ) -> tuple[FloatArray, FloatArray | None]:
        """Points (3, k) at their images' instant, and their rates by the time offset, in the LiDAR frame.

        lP' = Exp(-tau w) lP to second order, w the LiDAR's mean twist over the interval.
        """
        lPs = self.lPs[:, point]
        if views.twists is None or views.accelerations is None:
            return lPs, None
        scan = self.scans[point]
        taus = poses.offsets[pose] + views.base_taus_s[pose, scan] - self.offsets_s[point]
        number = pose * views.images.shape[1] + scan
        now, change = (
            np.ascontiguousarray(each.reshape(-1, 6).T)[:, number]
            for each in (views.twists, views.accelerations)
        )
        change *= taus
        mean, last = now - 0.5 * change, now - change
        step = taus * (cross(mean[:3], lPs) + mean[3:])
        moved = lPs - step + 0.5 * taus * cross(mean[:3], step)
        return moved, -(cross(last[:3], moved) + last[3:])

    def _look_up(self, seen: _Seen, image: IntArray) -> tuple[FloatArray, FloatArray]:
        """Signed distances (k,) [px] and normals (2, k); infinite and 0 where there is no clear contour."""
        distance, normals = np.full(len(image), np.inf), np.zeros((2, len(image)))
        if len(image) == 0:
            return distance, normals
        key = image * len(self.classes) + self.kinds[seen.point]
        order = np.argsort(key, kind="stable")
        names, starts = np.unique(key[order], return_index=True)
        contours = [
            self.contours[number].get(self.classes[kind])
            for number, kind in (divmod(name, len(self.classes)) for name in names.tolist())
        ]
        ends = [*starts[1:].tolist(), len(order)]
        spans = list(zip(starts.tolist(), ends, strict=True))
        known = [
            (contour, a, b) for contour, (a, b) in zip(contours, spans, strict=True) if contour is not None
        ]
        some = np.concatenate([order[:0], *(order[a:b] for _, a, b in known)])
        if len(some):
            counts = [b - a for _, a, b in known]
            fields = [contour for contour, _, _ in known]
            distance[some], normals[:, some] = _feet(fields, counts, seen.uvs[:, some])
        return distance, normals

    def _rows(self, seen: _Seen, normals: FloatArray, kind: IntArray, classes: int) -> FloatArray:
        """(7 + classes, k) derivatives of the residuals."""
        X, Y, Z = seen.cPs
        rows = np.zeros((7 + classes, len(X)))
        a, b = normals[0] * self.camera.fx / Z, normals[1] * self.camera.fy / Z
        c = -(a * X + b * Y) / Z
        rows[0], rows[1], rows[2] = Y * c - Z * b, Z * a - X * c, X * b - Y * a
        rows[3], rows[4], rows[5] = a, b, c
        if seen.rates is not None:
            rows[6] = (rows[3:6] * seen.rates).sum(axis=0)
        rows[7 + kind, np.arange(len(X))] = 1.0
        return rows


def _rotated(R: FloatArray, x: FloatArray) -> FloatArray:
    """(3, k) vectors x turned by a matrix each, (9, k) row by row."""
    return np.stack([R[i] * x[0] + R[i + 1] * x[1] + R[i + 2] * x[2] for i in (0, 3, 6)])


def _directions(camera: PinholeCamera, seen: _Seen) -> tuple[FloatArray, FloatArray]:
    """(2, k) unit ways out of the objects in the image, and the lengths (k,) of the steps [px]."""
    X, Y, Z = seen.cPs
    dX, dY, dZ = seen.ways
    farther = np.maximum(Z + dZ, _MIN_DEPTH_M)
    step = np.stack([camera.fx * (dX - dZ * X / Z), camera.fy * (dY - dZ * Y / Z)]) / farther
    length = np.sqrt(step[0] ** 2 + step[1] ** 2)
    return step / np.maximum(length, 1e-9), length


def _feet(
    contours: Sequence[ContourMap], counts: Sequence[int], uvs: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Signed distances (k,) and normals (2, k) of contours at pixels (2, k) on their images; infinite at
    ridges.

    Args:
        counts: pixels of each contour, one contour's after the other's.
    """
    boxes = [(c.left, c.top, *c.box, c.width, c.height) for c in contours]
    left, top, columns, rows, width, height = np.repeat(boxes, counts, axis=0).T
    u, v = uvs
    column, row = u.astype(np.intp), v.astype(np.intp)
    x0, y0 = column - left, row - top
    valid = well_inside(u, v, width, height) & (x0 >= 0) & (y0 >= 0) & (x0 < columns - 1) & (y0 < rows - 1)
    at = np.where(valid, y0 * columns + x0, 0)
    corners = at + np.stack([np.zeros_like(columns), np.ones_like(columns), columns, columns + 1])
    values = np.empty(corners.shape, np.float32)
    spans = list(itertools.pairwise(np.cumsum([0, *counts]).tolist()))
    for contour, (start, end) in zip(contours, spans, strict=True):
        values[:, start:end] = contour.distance.reshape(-1)[corners[:, start:end]]
    a, b, c, d = values.astype(np.float64)
    x, y = u - column, v - row
    above, below = a + x * (b - a), c + x * (d - c)
    distance = above + y * (below - above)
    gradient = np.stack([(1.0 - y) * (b - a) + y * (d - c), below - above])
    length = np.sqrt(gradient[0] ** 2 + gradient[1] ** 2)
    valid &= length > MIN_GRADIENT
    normals = gradient / np.maximum(length, MIN_GRADIENT)
    valid &= ~are_unknown(contours, spans, uvs - distance * normals - [left, top])
    return np.where(valid, distance, np.inf), normals


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

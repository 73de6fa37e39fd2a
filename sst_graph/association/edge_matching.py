"""Matches between boundary points of scans and mask contours of images.

:func:`match_edges` matches the points of many scans under one pose, as the graph needs them: exact motion,
objects that move, deviations from assumptions. :mod:`~sst_graph.initialization.pose_batch` matches a few
points of the same scans under hundreds of poses. The two project differently, because in the search the
projection takes most of the time. Both use the functions at the end of this file, which define a match, its
sigma and its weight.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sst_graph.assumptions.model import Effect, Scene
from sst_graph.config import Settings, internal, setting
from sst_graph.factors.alignment import Alignment
from sst_graph.factors.camera import PinholeCamera
from sst_graph.factors.motion import CameraTwist, group_poses, moved_points, transformed
from sst_graph.factors.robust import RobustKernel
from sst_graph.features.lidar_edges import Boundaries, Edge, joined
from sst_graph.features.mask_contour import ContourFeet, ContourMap, nearest_contours, stretches
from sst_graph.features.picture_gradients import EdgePlace, PictureGradients, nearest_edges
from sst_graph.types import BoolArray, Calibration, FloatArray, IntArray, SemanticClass

_OUTWARD, _LEAST_STRETCH = 0.01, 0.1
"""A pixel that is farther from the principal point by the first fraction must be imaged farther out by at
least the second fraction of that step: else the distortion folds the picture over."""

SIDES = 4
"""An object has a left, a right, a top and a bottom side."""
SIDE_OF = np.array([[0, 1], [2, 2], [3, 3], [2, 2]])
"""Side by kind of edge and whether the outward direction points to the right."""
BOTTOM = int(SIDE_OF[Edge.BOTTOM, 0])
"""The side towards the ground."""
TOP = int(SIDE_OF[Edge.TOP, 0])
"""The upper side."""
LOWER_EDGE_SIGMA_PX = 1.2
"""Error that all matches on an object's lower edge share [px]: masks are least exact there."""


@dataclass(frozen=True)
class MatchConfig(Settings):
    """How boundary points are matched to contours.

    Attributes:
        edge_place: what points are matched to where no mask has the class
            (:func:`~sst_graph.features.picture_gradients.nearest_edges`): the centre of mass of the picture's
            edge under the kernel; its peak, so that one step goes as far as many, and the information is that
            of a match which follows the pose; or the strongest edge, to measure residuals.
    """

    mask_sigma_px: float = setting(
        1.0,
        at_least=0.01,
        at_most=100.0,
        doc="Deviation of a mask's contour from the object's. Raise it for coarse masks.",
    )
    side_sigma_px: float = setting(
        0.7,
        at_least=0.0,
        at_most=100.0,
        doc="Error that all matches on one side of an object in one image share. Raise it where "
        "outlines are drawn carelessly.",
    )
    edge_place: EdgePlace = internal("centre")


GATE = 3.0
"""Farthest match, in units of the kernel's scale: there the Geman-McClure weight is 1 %."""
_MIN_COSINE = 0.5
"""Least cosine between the contour's normal and the outward direction of the object: contours at more than 60
degrees are other edges."""
MIN_OBJECT_SHARE = 0.1
"""Least fraction of an object's boundary points in view that must have a match. An object that the image's
labels miss crosses contours of others in a few places only."""


class PointDeviation(Protocol):
    """Deviation of points and pixels from the assumptions (:mod:`sst_graph.assumptions`)."""

    @property
    def scene(self) -> Scene: ...

    def effect(self, lPs: FloatArray, offsets_s: FloatArray, uvs: FloatArray) -> Effect:
        """Effect on points (n, 3) [m] with times (n,) [s] and ideal pixels (n, 2) [px]."""
        ...

    def take(self, index: IntArray) -> PointDeviation:
        """The deviation of some of the points, by position."""
        ...


@dataclass(frozen=True)
class SilhouetteMatches:
    """Matches of one class in one pair.

    Attributes:
        alignment: the frozen matches.
        objects: (n,) object of each match, within its scan.
        sides: (n,) 0 left, 1 right, 2 top, 3 bottom: which side of the object the match lies on.
        index: (n,) which boundary point each match is.
        level_px: (n,) of :func:`level_sigmas`; 0 for objects without a class.
        offsets_s: (n,) time of each point relative to its scan's stamp, as it was measured [s].
        seen: how many boundary points fall into the image, matched or not.
    """

    alignment: Alignment
    objects: NDArray[np.intp]
    sides: NDArray[np.intp]
    index: NDArray[np.intp]
    level_px: FloatArray
    offsets_s: FloatArray
    seen: int

    def __len__(self) -> int:
        return len(self.alignment)


@dataclass(frozen=True)
class PairedEdges:
    """Boundary points of scans and the contours that they are matched to, all of one camera, by groups.

    A group is what one scan shows of one class, and the image that it is compared with.

    Attributes:
        camera: of all images.
        points: of all groups, one group after the other.
        owners: (n,) number of the object of each point, counted over all groups.
        bounds: (g + 1,) where each group begins, and the end.
        contours: of each group's class in its image; for objects without a class the picture's gradients.
        motion: the camera's, its rows (g, 6) of each group's image, or (6,) where all share one.
        base_taus_s: (n,) stamp of the image minus the time of the point [s].
        biases_px: (g,) mask bias of each group's class [px].
        velocities: (n, 3) velocity over ground of each point's object, in the LiDAR frame, or None where all
            are static [m/s].
    """

    camera: PinholeCamera
    points: Boundaries
    owners: IntArray
    bounds: IntArray
    contours: Sequence[ContourMap | PictureGradients]
    motion: CameraTwist
    base_taus_s: FloatArray
    biases_px: FloatArray
    velocities: FloatArray | None = None

    def take(self, index: IntArray) -> PairedEdges:
        """Some of the points, by position, rising; no group is lost."""
        return PairedEdges(
            self.camera,
            self.points.take(index),
            self.owners.take(index),
            np.searchsorted(index, self.bounds),
            self.contours,
            self.motion,
            self.base_taus_s.take(index),
            self.biases_px,
            None if self.velocities is None else self.velocities.take(index, axis=0),
        )

    def repeated(self, of_groups: ArrayLike) -> NDArray[Any]:
        """(n, ...) the value of each point's group, from those of the groups (g, ...)."""
        return np.asarray(of_groups).repeat(self.counts, axis=0)

    @cached_property
    def counts(self) -> IntArray:
        """(g,) points of each group."""
        return np.diff(self.bounds)

    def projected(self, lPs: FloatArray, at: Calibration, poses: FloatArray | None = None) -> FloatArray:
        """(n, 2) pixels of points (n, 3) of the groups, moved to their images' instant; NaN behind the
        camera. Arguments as in :meth:`moved`."""
        return self.camera.project(self.moved(lPs, at, poses))

    def moved(self, lPs: FloatArray, at: Calibration, poses: FloatArray | None = None) -> FloatArray:
        """(n, 3) points (n, 3) of the groups at their images' instant, in the camera [m].

        Args:
            poses: what :meth:`poses` gives, of these or of all points, where it is known.
        """
        columns, taus = np.ascontiguousarray(lPs.T), at.time_offset_s + self.base_taus_s
        if self.velocities is not None:
            columns = columns + taus * self.velocities.T
        if poses is None:
            poses = self.poses(at)
        if poses is None:
            rows = self.motion.c_twist, self.motion.c_acceleration
            each = self.motion if rows[0].ndim == 1 else CameraTwist(*(self.repeated(row).T for row in rows))
            return np.asarray(moved_points(at.cTl, columns, taus, each, "se3", None).cPs.T)
        return transformed(poses, columns, self.bounds).T

    def poses(self, at: Calibration) -> FloatArray | None:
        """(g, 4, 4) pose of the LiDAR in the camera with the motion, of groups that move as one rigid body;
        None where the points of a group have times of their own."""
        if len(self.base_taus_s) == 0:
            return None
        base_taus_s = self.base_taus_s[np.minimum(self.bounds[:-1], len(self.base_taus_s) - 1)]
        if not np.array_equal(self.base_taus_s, self.repeated(base_taus_s)):
            return None
        return group_poses(at.cTl, at.time_offset_s + base_taus_s, self.motion)

    def accelerations(self, counts: IntArray) -> FloatArray:
        """(6,) where all groups share it, else (m, 6): of the image of each of so many points a group (g,)
        [rad/s^2, m/s^2]."""
        shared = self.motion.c_acceleration
        return shared if shared.ndim == 1 else shared.repeat(counts, axis=0)

    @cached_property
    def by_masks(self) -> BoolArray:
        """(n,) whether each point is matched to a mask's contour, not to the picture's gradients."""
        found = [isinstance(contour, ContourMap) for contour in self.contours]
        return np.asarray(self.repeated(found), np.bool_)

    @cached_property
    def spans(self) -> list[tuple[int, int]]:
        """Where each group begins and ends."""
        return list(pairwise(self.bounds.tolist()))


@dataclass(frozen=True)
class EdgeMatches:
    """Matches of some :class:`PairedEdges`.

    Attributes:
        index: (m,) which of the points, rising.
        sides: (m,) 0 left, 1 right, 2 top, 3 bottom: which side of the object the match lies on.
        alignment: all of them, for :mod:`factors`.
        bounds: (g + 1,) where each group's begin, and the end.
        seen: (g,) how many of a group's points fall into the image, matched or not.
        shares: (m,) share of its full weight that each has: less than 1 of faint edges of pictures.
        level_px: (m,) of :func:`level_sigmas`; 0 for objects without a class, all of whose upper edges are
            taken to err together.
    """

    index: IntArray
    sides: IntArray
    alignment: Alignment
    bounds: IntArray
    seen: IntArray
    shares: FloatArray
    level_px: FloatArray


@dataclass(frozen=True)
class ScanWithImage:
    """One scan's boundary points and the image that they are compared with.

    Attributes:
        boundaries, contours: by class.
        camera: of the image.
        base_tau_s: stamp of the image minus that of the scan [s].
        motion: the camera's around the image.
        velocities: (n, 3) velocity over ground of each boundary point's object, in the LiDAR frame [m/s], of
            the classes in which some move.
    """

    boundaries: Mapping[SemanticClass, Boundaries]
    contours: Mapping[SemanticClass, ContourMap | PictureGradients]
    camera: PinholeCamera
    base_tau_s: float
    motion: CameraTwist
    velocities: Mapping[SemanticClass, FloatArray] | None = None


def match_silhouettes(
    pair: ScanWithImage,
    at: Calibration,
    biases_px: Mapping[SemanticClass, float],
    kernel: RobustKernel,
    config: MatchConfig,
) -> dict[SemanticClass, SilhouetteMatches]:
    """:func:`match_edges` of one scan and one image, by class.

    Args:
        biases_px: mask biases; 0 where one is missing.
    """
    classes = [c for c in pair.boundaries if c in pair.contours]
    if not classes:
        return {}
    parts = [pair.boundaries[c] for c in classes]
    points, counts = joined(parts), [len(part) for part in parts]
    bounds = np.cumsum([0, *counts])
    moving = None
    if pair.velocities:
        static, known = np.zeros((len(points), 3)), pair.velocities
        moving = np.concatenate(
            [known.get(c, static[a:b]) for c, (a, b) in zip(classes, pairwise(bounds), strict=True)]
        )
    paired = PairedEdges(
        pair.camera,
        points,
        numbered_through([part.objects for part in parts]),
        bounds,
        [pair.contours[c] for c in classes],
        pair.motion,
        pair.base_tau_s - points.offsets_s,
        np.array([biases_px.get(c, 0.0) for c in classes]),
        moving,
    )
    found = match_edges(paired, at, kernel, config)
    return {
        c: SilhouetteMatches(
            found.alignment if b - a == len(found.index) else found.alignment.take(np.arange(a, b)),
            points.objects[found.index[a:b]],
            found.sides[a:b],
            found.index[a:b] - start,
            found.level_px[a:b],
            points.offsets_s[found.index[a:b]],
            int(seen),
        )
        for c, (a, b), start, seen in zip(
            classes, pairwise(found.bounds.tolist()), bounds[:-1].tolist(), found.seen, strict=True
        )
        if b > a
    }


def numbered_through(objects: Sequence[IntArray]) -> IntArray:
    """(n,) consecutive numbers of the objects in several lists, each of which counts from 0."""
    firsts = np.cumsum([0, *(int(own.max(initial=-1)) + 1 for own in objects)])
    return np.concatenate(
        [np.zeros(0, np.intp), *(own + first for own, first in zip(objects, firsts[:-1], strict=True))]
    )


def match_edges(
    paired: PairedEdges,
    at: Calibration,
    kernel: RobustKernel,
    config: MatchConfig,
    deviation: PointDeviation | None = None,
) -> EdgeMatches:
    """Each boundary point's nearest contour at the current estimate, where both face the same direction.

    Args:
        kernel: its scale is in pixels here; matches farther than :data:`GATE` times it are left out.
        deviation: of points and pixels from the assumptions; the matched pixels are then those of the ideal
            camera.
    """
    # 1. Project the points into their images.
    poses = paired.poses(at)
    uvs, shift = paired.projected(paired.points.lPs, at, poses), None
    if deviation is not None:
        effect = _effect(deviation, paired, uvs)
        if effect.l_shift is not None or effect.time_s is not None:
            paired, poses = _deviated(paired, effect), None
            uvs = paired.projected(paired.points.lPs, at)
            effect = _effect(deviation, paired, uvs)
        ideal, shift = uvs, _pixel_shift(deviation, paired, uvs, effect)
        uvs = ideal + shift
    index = np.flatnonzero(paired.camera.in_image(uvs))
    some, uvs = paired.take(index), uvs.take(index, axis=0)
    outer = some.projected(some.points.outward, at, poses)
    objects_seen = np.bincount(some.owners)
    # 2. Find the nearest contours within the gate.
    if any(isinstance(contour, PictureGradients) for contour in paired.contours):
        steps = outer - (uvs if shift is None else ideal.take(index, axis=0))
        feet, shares = _contours_or_gradients(some, uvs, steps, kernel, config.edge_place)
    else:
        maps = [contour for contour in paired.contours if isinstance(contour, ContourMap)]
        feet, shares = nearest_contours(maps, some.spans, uvs), None
    enlarged = stretches(some.contours, some.spans, feet)
    distances = feet.distances if enlarged is None else feet.distances / enlarged
    residuals = distances + some.repeated(some.biases_px)
    near = np.flatnonzero(feet.valid & (np.abs(residuals) < GATE * kernel.scale))
    index, owners = index.take(near), some.owners.take(near)
    rows = uvs, outer, feet.normals, feet.feet
    uvs, outer, normals, pixels = (each.take(near, axis=0) for each in rows)
    # 3. Keep contours that face the outward direction of the object.
    if shift is not None and deviation is not None:
        own, moved = deviation.take(index), some.take(near)
        outer = outer + _pixel_shift(own, moved, outer, _effect(own, moved, outer))
        pixels = pixels - shift.take(index, axis=0)
    outward = outer - uvs
    length = np.sqrt(np.vecdot(outward, outward))
    outward = outward / np.maximum(length, 1e-9)[:, None]
    cosine = np.vecdot(outward, normals)
    # 4. Keep objects of which enough points have a match.
    on = np.flatnonzero(of_matched_objects(faces(cosine), owners, objects_seen, MIN_OBJECT_SHARE))
    index, owners, length = index.take(on), owners.take(on), length.take(on)
    if enlarged is not None:
        enlarged = enlarged[near][on]
        length = length / enlarged
    sigmas = match_sigmas(length, cosine.take(on), config)
    sides = sides_of(paired.points.edges.take(index), outward[on, 0])
    level_px = level_sigmas(sides, sigmas, config)
    if shares is not None:
        level_px = np.where(paired.by_masks[index], level_px, 0.0)
    weights = side_weights(owners, sides, sigmas, config, (level_px, paired.points.rings.take(index)))
    shares = np.ones(len(index)) if shares is None else shares[near][on]
    weights = weights * shares
    bounds = np.searchsorted(index, paired.bounds)
    velocities = None if paired.velocities is None else paired.velocities.take(index, axis=0)
    alignment = Alignment(
        camera=paired.camera,
        lPs=paired.points.lPs.take(index, axis=0),
        base_taus_s=paired.base_taus_s.take(index),
        pixels=pixels.take(on, axis=0),
        sigmas_px=sigmas,
        normals=normals.take(on, axis=0),
        kernel=kernel,
        c_acceleration=paired.accelerations(np.diff(bounds)),
        weights=weights,
        l_velocities=velocities if velocities is not None and velocities.any() else None,
        stretches=enlarged,
    )
    return EdgeMatches(index, sides, alignment, bounds, some.counts, shares, level_px)


def _contours_or_gradients(
    paired: PairedEdges, uvs: FloatArray, steps: FloatArray, kernel: RobustKernel, place: EdgePlace
) -> tuple[ContourFeet, FloatArray]:
    """Contours of masks for the groups that have one, edges of the picture for the others.

    Args:
        steps: (n, 2) outward across the edges, in the image [px].
        place: as :func:`~sst_graph.features.picture_gradients.nearest_edges` has it.

    Returns:
        The contours, and (n,) the share of its full weight that each has.
    """
    n, found = len(uvs), []
    if n == 0:
        return nearest_contours([], [], uvs), np.zeros(0)
    for masks in (True, False):
        index = np.flatnonzero(paired.by_masks == masks)
        if len(index) == 0:
            continue
        some, own, step = paired, uvs, steps
        if len(index) < n:
            some, own, step = paired.take(index), uvs.take(index, axis=0), steps.take(index, axis=0)
        groups = [
            (each, span) for each, span in zip(some.contours, some.spans, strict=True) if span[1] > span[0]
        ]
        spans = [span for _, span in groups]
        if masks:
            maps = [each for each, _ in groups if isinstance(each, ContourMap)]
            found.append((index, nearest_contours(maps, spans, own), np.ones(len(index))))
            continue
        pictures = [each for each, _ in groups if isinstance(each, PictureGradients)]
        right, down = step.T
        outward = step / np.maximum(np.sqrt(right**2 + down**2), 1e-9)[:, None]
        # The window is where the residual is 0.
        bias = some.repeated(some.biases_px)
        edges = nearest_edges(pictures, spans, own + bias[:, None] * outward, outward, kernel.scale, place)
        feet = ContourFeet(edges.distances - bias, edges.normals, edges.feet, edges.valid)
        found.append((index, feet, np.maximum(edges.shares, 1e-3)))
    if len(found) == 1:
        return found[0][1:]
    order = np.argsort(np.concatenate([index for index, _, _ in found]))
    parts = [(feet.distances, feet.normals, feet.feet, feet.valid, shares) for _, feet, shares in found]
    *whole, shares = (np.concatenate(each).take(order, axis=0) for each in zip(*parts, strict=True))
    return ContourFeet(*whole), shares


def _effect(deviation: PointDeviation, paired: PairedEdges, uvs: FloatArray) -> Effect:
    """Effect of the deviation on points at ideal pixels (n, 2) [px]."""
    return deviation.effect(paired.points.lPs, paired.points.offsets_s, uvs)


def _deviated(paired: PairedEdges, effect: Effect) -> PairedEdges:
    """The points moved, and their intervals changed."""
    points, base_taus_s = paired.points, paired.base_taus_s
    if effect.l_shift is not None:
        points = replace(points, lPs=points.lPs + effect.l_shift, outward=points.outward + effect.l_shift)
    if effect.time_s is not None:
        base_taus_s = base_taus_s + effect.time_s
    return replace(paired, points=points, base_taus_s=base_taus_s)


def _pixel_shift(
    deviation: PointDeviation, paired: PairedEdges, uvs: FloatArray, effect: Effect
) -> FloatArray:
    """(n, 2) distortion: pixels minus the ideal ones ``uvs`` [px], of the deviation's effect there.

    NaN where the picture would fold over: beyond the radius at which a polynomial lens turns back, points
    far outside the view come to lie inside the image.
    """
    shift = effect.pixel_shift
    if shift is None:
        return np.zeros_like(uvs)
    arms = uvs - deviation.scene.centre
    farther = _effect(deviation, paired, uvs + _OUTWARD * arms).pixel_shift
    assert farther is not None
    stretch = ((_OUTWARD * arms + farther - shift) * arms).sum(axis=1)
    folded = stretch < _LEAST_STRETCH * _OUTWARD * (arms**2).sum(axis=1)
    return np.where(folded[:, None], np.nan, shift)


def faces(cosines: FloatArray) -> BoolArray:
    """Whether contours face outward, from the cosines between their normals and the outward directions."""
    return cosines > _MIN_COSINE


def of_matched_objects(
    matched: BoolArray, owners: IntArray, objects_seen: IntArray, min_share: float
) -> BoolArray:
    """(n,) the matches of the objects of which at least a share meets a contour.

    Args:
        matched: (n,) whether a point meets one.
        owners: (n,) number of its object.
        objects_seen: by object, its points in the image.
    """
    meets = np.bincount(owners, matched, len(objects_seen))
    return np.asarray(matched & (meets >= min_share * objects_seen)[owners])


def match_sigmas(lengths_px: FloatArray, cosines: FloatArray, config: MatchConfig) -> FloatArray:
    """(n,) deviation of matches [px]: the mask's, and uniform over half the step to the beam beyond the edge,
    across the contour."""
    return np.asarray(np.hypot(config.mask_sigma_px, 0.5 * lengths_px * cosines / np.sqrt(3.0)))


def sampling_sigmas(sigmas_px: FloatArray, config: MatchConfig) -> FloatArray:
    """(n,) the part of :func:`match_sigmas` that is there because an edge lies anywhere between two beams
    [px]."""
    return np.asarray(np.sqrt(np.maximum(sigmas_px**2 - config.mask_sigma_px**2, 0.0)))


def sides_of(edges: NDArray[np.uint8], to_the_right: FloatArray) -> IntArray:
    """(n,) 0 left, 1 right, 2 top, 3 bottom, by kind of edge and horizontal part of the outward direction."""
    return np.asarray(SIDE_OF[edges, (to_the_right > 0.0).astype(np.intp)])


def level_sigmas(sides: IntArray, sigmas_px: FloatArray, config: MatchConfig) -> FloatArray:
    """(n,) :func:`sampling_sigmas` of upper and lower edges, whose matches share it [px]: a level edge lies
    between the same two rings all along. 0 at the sides."""
    level_px = np.zeros(len(sides))
    level = np.flatnonzero(sides >= TOP)
    level_px[level] = sampling_sigmas(sigmas_px.take(level), config)
    return level_px


def side_weights(
    owners: IntArray,
    sides: IntArray,
    sigmas_px: FloatArray,
    config: MatchConfig,
    level: tuple[FloatArray, IntArray] | None = None,
) -> FloatArray:
    """(n,) weights under which the mean of a side of an object counts with sigma^2 / n + shared^2 instead of
    sigma^2 / n, shared the mask's error at that side.

    Args:
        level: :func:`level_sigmas` and rings (n,): what a ring shows of a side shares that error, too.
    """
    shared_px = np.where(sides == BOTTOM, LOWER_EDGE_SIGMA_PX, config.side_sigma_px)
    numbers = owners * SIDES + sides
    shared = _information(numbers, sigmas_px) * shared_px**2
    if level is not None:
        level_px, rings = level
        on = np.flatnonzero(level_px)
        numbers = numbers.take(on) * (int(rings.max(initial=0)) + 1) + rings.take(on)
        _, groups = np.unique(numbers, return_inverse=True)
        shared[on] += _information(groups, sigmas_px.take(on)) * level_px.take(on) ** 2
    return np.asarray(1.0 / (1.0 + shared))


def _information(groups: IntArray, sigmas_px: FloatArray) -> FloatArray:
    """(n,) of the mean of all matches of each one's group [1/px^2]."""
    if len(groups) == 0:
        return np.zeros(0)
    return np.asarray(np.bincount(groups, sigmas_px**-2.0)[groups], np.float64)

"""Matches between a scan's boundary points and an image's mask contours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, Protocol

import gtsam
import numpy as np
from numpy.typing import ArrayLike, NDArray

from sst_graph.assumptions.model import Effect, Scene
from sst_graph.config import Settings, setting
from sst_graph.factors.alignment import Alignment
from sst_graph.factors.camera import PinholeCamera
from sst_graph.factors.motion import move_points, moved_pose
from sst_graph.factors.robust import RobustKernel
from sst_graph.features.lidar_edges import Boundaries, Edge, joined
from sst_graph.features.mask_contour import ContourMap, nearest_contours
from sst_graph.types import SemanticClass

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]

_OUTWARD, _LEAST_STRETCH = 0.01, 0.1
"""A pixel this share farther from the principal point must come to lie farther out by this part of it."""

SIDES = 4
"""An object has a left, a right, a top and a bottom side."""
SIDE_OF = np.array([[0, 1], [2, 2], [3, 3]])
"""Side by kind of edge and whether the way out of the object runs to the right."""
BOTTOM = int(SIDE_OF[Edge.BOTTOM, 0])
"""The side towards the ground."""


@dataclass(frozen=True)
class MatchConfig(Settings):
    """How boundary points are matched to contours.

    Attributes:
        mask_sigma_px: deviation of a mask's contour from the object's [px].
        side_sigma_px: error that all matches on one side of one object in one image share [px]; it
            bounds what a side may claim, however many points it has.
        lower_edge_sigma_px: the same of an object's edge towards the ground [px].
        gate: farthest match, in units of the kernel's scale.
        min_cosine: least agreement between the contour's normal and the way out of the object.
        min_object_share: an object of whose boundary in view less than this share finds a match is left out.
        top_edges: use boundaries towards the ring above.
    """

    mask_sigma_px: float = setting(1.0, at_least=0.01, at_most=100.0)
    side_sigma_px: float = setting(0.7, at_least=0.0, at_most=100.0)
    lower_edge_sigma_px: float = setting(1.2, at_least=0.0, at_most=100.0)
    gate: float = setting(3.0, at_least=0.1, at_most=100.0)
    min_cosine: float = setting(0.5, at_least=0.0, less_than=1.0)
    min_object_share: float = setting(0.1, at_least=0.0, at_most=1.0)
    top_edges: bool = True


@dataclass(frozen=True)
class Motion:
    """Camera motion around one image: twist at its instant and the twist's rate of change, (6,) each."""

    c_twist: FloatArray
    c_acceleration: FloatArray


class PointDeviation(Protocol):
    """What points and pixels differ by from what is assumed of them (:mod:`sst_graph.assumptions`)."""

    @property
    def scene(self) -> Scene: ...

    def effect(self, lPs: FloatArray, offsets_s: FloatArray, uvs: FloatArray) -> Effect:
        """On points (n, 3) [m] with times (n,) [s] and ideal pixels (n, 2) [px]."""
        ...

    def take(self, index: IntArray) -> PointDeviation:
        """Of some of the points, by position."""
        ...


@dataclass(frozen=True)
class SilhouetteMatches:
    """Matches of one class in one pair.

    Attributes:
        alignment: the frozen matches.
        objects: (n,) object of each match, within its scan.
        sides: (n,) 0 left, 1 right, 2 top, 3 bottom: which side of the object the match lies on.
        index: (n,) which boundary point each match is.
        seen: how many boundary points fall into the image, matched or not.
    """

    alignment: Alignment
    objects: NDArray[np.intp]
    sides: NDArray[np.intp]
    index: NDArray[np.intp]
    seen: int

    def __len__(self) -> int:
        return len(self.alignment)


@dataclass(frozen=True)
class Facing:
    """Boundary points of one camera's scans and the contours that they are matched to, group by group.

    A group is what one scan shows of one class, and the image that it is compared with.

    Attributes:
        camera: of all images.
        points: of all groups, one group after the other.
        owners: (n,) number of the object of each point, through all groups.
        bounds: (g + 1,) where each group begins, and the end.
        contours: of each group's class in its image.
        motions: the camera's around each group's image.
        base_taus_s: (n,) stamp of the image minus the time of the point [s].
        biases_px: (g,) mask bias of each group's class [px].
        velocities: (n, 3) velocity over ground of each point's object, in the LiDAR frame, or None where all
            stand [m/s].
    """

    camera: PinholeCamera
    points: Boundaries
    owners: IntArray
    bounds: IntArray
    contours: Sequence[ContourMap]
    motions: Sequence[Motion]
    base_taus_s: FloatArray
    biases_px: FloatArray
    velocities: FloatArray | None = None

    def take(self, index: IntArray) -> Facing:
        """Some of the points, by position, rising; no group is lost."""
        return Facing(
            self.camera,
            self.points.take(index),
            self.owners[index],
            np.searchsorted(index, self.bounds),
            self.contours,
            self.motions,
            self.base_taus_s[index],
            self.biases_px,
            None if self.velocities is None else self.velocities[index],
        )

    def repeated(self, of_groups: ArrayLike) -> NDArray[Any]:
        """(n, ...) the value of each point's group, from those of the groups (g, ...)."""
        return np.repeat(np.asarray(of_groups), np.diff(self.bounds), axis=0)

    def projected(self, lPs: FloatArray, cTl: gtsam.Pose3, offset_s: float) -> FloatArray:
        """(n, 2) pixels of points (n, 3) of the groups, moved to their images' instant; NaN behind the
        camera."""
        columns, taus = np.ascontiguousarray(lPs.T), offset_s + self.base_taus_s
        if self.velocities is not None:
            columns = columns + taus * self.velocities.T
        groups = [(a, b, motion) for (a, b), motion in zip(self.spans, self.motions, strict=True) if b > a]
        starts = [a for a, _, _ in groups]
        if not all((taus[a:b] == taus[a]).all() for a, b, _ in groups):
            twists, accelerations = (self.repeated(each).T for each in self._motion_rows())
            return self.camera.project(move_points(cTl, columns, taus, twists, accelerations).cPs.T)
        # Every group moves as one rigid body.
        cPs = np.empty_like(columns)
        for (a, b, motion), tau_s in zip(groups, taus[starts].tolist(), strict=True):
            moved = moved_pose(cTl, tau_s, motion.c_twist, motion.c_acceleration)
            np.matmul(moved.rotation().matrix(), columns[:, a:b], out=cPs[:, a:b])
            cPs[:, a:b] += np.asarray(moved.translation()).reshape(3, 1)
        return self.camera.project(cPs.T)

    def accelerations(self) -> FloatArray:
        """(6,) where all groups share it, else (n, 6): of each point's image [rad/s^2, m/s^2]."""
        first = self.motions[0]
        if all(motion is first for motion in self.motions):
            return first.c_acceleration
        return self.repeated(self._motion_rows()[1])

    @cached_property
    def spans(self) -> list[tuple[int, int]]:
        """Where each group begins and ends."""
        return list(pairwise(self.bounds.tolist()))

    def _motion_rows(self) -> tuple[FloatArray, FloatArray]:
        """(g, 6) twists and accelerations."""
        return (
            np.stack([motion.c_twist for motion in self.motions]),
            np.stack([motion.c_acceleration for motion in self.motions]),
        )


@dataclass(frozen=True)
class FacingMatches:
    """What :func:`match_facing` found.

    Attributes:
        index: (m,) which of the points, rising.
        sides: (m,) 0 left, 1 right, 2 top, 3 bottom: which side of the object the match lies on.
        alignment: all of them, for :mod:`factors`.
        bounds: (g + 1,) where each group's begin, and the end.
        seen: (g,) how many of a group's points fall into the image, matched or not.
    """

    index: IntArray
    sides: IntArray
    alignment: Alignment
    bounds: IntArray
    seen: IntArray


def match_silhouettes(
    boundaries: Mapping[SemanticClass, Boundaries],
    contours: Mapping[SemanticClass, ContourMap],
    camera: PinholeCamera,
    cTl: gtsam.Pose3,
    offset_s: float,
    base_tau_s: float,
    motion: Motion,
    biases_px: Mapping[SemanticClass, float],
    kernel: RobustKernel,
    config: MatchConfig,
    velocities: Mapping[SemanticClass, FloatArray] | None = None,
    deviation: PointDeviation | None = None,
) -> dict[SemanticClass, SilhouetteMatches]:
    """:func:`match_facing` of one scan and one image, by class.

    Args:
        velocities: (n, 3) velocity over ground of each boundary point's object, in the LiDAR frame [m/s], of
            the classes in which some move.
        deviation: of the points and pixels from what is assumed of them; the matched pixels are then those
            of the ideal camera.
    """
    classes = [c for c in boundaries if c in contours]
    if not classes:
        return {}
    parts = [boundaries[c] for c in classes]
    points, counts = joined(parts), [len(part) for part in parts]
    bounds = np.cumsum([0, *counts])
    moving = None
    if velocities:
        still = np.zeros((len(points), 3))
        moving = np.concatenate(
            [velocities.get(c, still[a:b]) for c, (a, b) in zip(classes, pairwise(bounds), strict=True)]
        )
    facing = Facing(
        camera,
        points,
        numbered_through([part.objects for part in parts]),
        bounds,
        [contours[c] for c in classes],
        [motion] * len(classes),
        base_tau_s - points.offsets_s,
        np.array([biases_px.get(c, 0.0) for c in classes]),
        moving,
    )
    found = match_facing(facing, cTl, offset_s, kernel, config, deviation)
    return {
        c: SilhouetteMatches(
            found.alignment if b - a == len(found.index) else found.alignment.take(np.arange(a, b)),
            points.objects[found.index[a:b]],
            found.sides[a:b],
            found.index[a:b] - start,
            int(seen),
        )
        for c, (a, b), start, seen in zip(
            classes, pairwise(found.bounds.tolist()), bounds[:-1].tolist(), found.seen, strict=True
        )
        if b > a
    }


def numbered_through(objects: Sequence[IntArray]) -> IntArray:
    """(n,) numbers of objects through several lists, each of which numbers its own from 0."""
    firsts = np.cumsum([0, *(int(own.max(initial=-1)) + 1 for own in objects)])
    return np.concatenate(
        [np.zeros(0, np.intp), *(own + first for own, first in zip(objects, firsts[:-1], strict=True))]
    )


def match_facing(
    facing: Facing,
    cTl: gtsam.Pose3,
    offset_s: float,
    kernel: RobustKernel,
    config: MatchConfig,
    deviation: PointDeviation | None = None,
) -> FacingMatches:
    """Each boundary point's nearest contour at the current estimate, where the two face the same way.

    The kernel's scale is in pixels here; matches farther than ``gate`` times it are left out.
    """
    # 1. The points in their images.
    uvs, shift = facing.projected(facing.points.lPs, cTl, offset_s), None
    if deviation is not None:
        facing = _deviated(facing, deviation, uvs)
        ideal = facing.projected(facing.points.lPs, cTl, offset_s)
        shift = _pixel_shift(deviation, facing, ideal)
        uvs = ideal + shift
    used = facing.camera.in_image(uvs) & (config.top_edges | (facing.points.edges != Edge.TOP))
    index = np.flatnonzero(used)
    facing, uvs = facing.take(index), uvs[index]
    seen = np.diff(facing.bounds)
    # 2. The nearest contours that are near.
    feet = nearest_contours(facing.contours, facing.spans, uvs)
    residuals = feet.distances + facing.repeated(facing.biases_px)
    near = np.flatnonzero(feet.valid & (np.abs(residuals) < config.gate * kernel.scale))
    owners_seen = np.bincount(facing.owners)
    facing, uvs, index = facing.take(near), uvs[near], index[near]
    normals, pixels = feet.normals[near], feet.feet[near]
    # 3. Those that face the way out of the object.
    beyond = facing.projected(facing.points.outward, cTl, offset_s)
    if shift is not None and deviation is not None:
        shift = shift[index]
        beyond = beyond + _pixel_shift(deviation.take(index), facing, beyond)
        pixels = pixels - shift
    way = beyond - uvs
    length = np.linalg.norm(way, axis=1)
    way = way / np.maximum(length, 1e-9)[:, None]
    cosine = (way * normals).sum(axis=1)
    ok = cosine > config.min_cosine
    # 4. Enough of the boundary of the object meets a contour: one that the image's labels miss crosses the
    # contours of others here and there.
    meets = np.bincount(facing.owners, ok, len(owners_seen))
    on = np.flatnonzero(ok & (meets >= config.min_object_share * owners_seen)[facing.owners])
    facing, index = facing.take(on), index[on]
    sigmas = np.hypot(config.mask_sigma_px, 0.5 * length[on] * cosine[on] / np.sqrt(3.0))
    sides = SIDE_OF[facing.points.edges, (way[on, 0] > 0).astype(np.intp)]
    alignment = Alignment(
        camera=facing.camera,
        lPs=facing.points.lPs,
        base_taus_s=facing.base_taus_s,
        pixels=pixels[on],
        sigmas_px=sigmas,
        normals=normals[on],
        kernel=kernel,
        c_acceleration=facing.accelerations(),
        weights=_shared_weights(facing.owners, sides, sigmas, config),
        l_velocities=facing.velocities,
    )
    return FacingMatches(index, sides, alignment, facing.bounds, seen)


def _deviated(facing: Facing, deviation: PointDeviation, uvs: FloatArray) -> Facing:
    """The points where they are, and their intervals."""
    points, base_taus_s = facing.points, facing.base_taus_s
    effect = deviation.effect(points.lPs, points.offsets_s, uvs)
    if effect.l_shift is not None:
        points = replace(points, lPs=points.lPs + effect.l_shift, outward=points.outward + effect.l_shift)
    if effect.time_s is not None:
        base_taus_s = base_taus_s + effect.time_s
    return replace(facing, points=points, base_taus_s=base_taus_s)


def _pixel_shift(deviation: PointDeviation, facing: Facing, uvs: FloatArray) -> FloatArray:
    """(n, 2) by how much the pixels of points lie beside the ideal ones ``uvs`` [px].

    NaN where the picture would fold over: beyond the radius at which a polynomial lens turns back, points
    far outside the view come to lie inside the image.
    """
    points = facing.points
    shift = deviation.effect(points.lPs, points.offsets_s, uvs).pixel_shift
    if shift is None:
        return np.zeros_like(uvs)
    arms = uvs - deviation.scene.centre
    farther = deviation.effect(points.lPs, points.offsets_s, uvs + _OUTWARD * arms).pixel_shift
    assert farther is not None
    stretch = ((_OUTWARD * arms + farther - shift) * arms).sum(axis=1)
    folded = stretch < _LEAST_STRETCH * _OUTWARD * (arms**2).sum(axis=1)
    return np.where(folded[:, None], np.nan, shift)


def _shared_weights(
    owners: IntArray, sides: IntArray, sigmas_px: FloatArray, config: MatchConfig
) -> FloatArray:
    """(n,) weights under which the mean of a side of an object counts with sigma^2 / n + shared^2 instead of
    sigma^2 / n."""
    shared_px = np.where(sides == BOTTOM, config.lower_edge_sigma_px, config.side_sigma_px)
    numbers = owners * SIDES + sides
    information = np.bincount(numbers, sigmas_px**-2.0)[numbers] if len(numbers) else np.zeros(0)
    return np.asarray(1.0 / (1.0 + information * shared_px**2))

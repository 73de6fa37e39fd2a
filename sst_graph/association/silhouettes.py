"""Matches between a scan's boundary points and an image's mask contours."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Protocol

import gtsam
import numpy as np
from numpy.typing import NDArray

from factors.alignment import Alignment
from factors.camera import PinholeCamera
from factors.motion import move_points
from factors.robust import RobustKernel
from sst_graph.association.boundary import Boundaries, Edge
from sst_graph.association.contour import ContourMap
from sst_graph.assumptions.model import Effect, Scene
from sst_graph.config import Settings, setting
from sst_graph.types import SemanticClass

FloatArray = NDArray[np.float64]

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
        underside_sigma_px: the same of an object's edge towards the ground [px].
        gate: farthest match, in units of the kernel's scale.
        min_cosine: least agreement between the contour's normal and the way out of the object.
        min_object_share: an object of whose boundary in view less than this share finds a match is left out.
        top_edges: use boundaries towards the ring above.
    """

    mask_sigma_px: float = setting(1.0, at_least=0.01, at_most=100.0)
    side_sigma_px: float = setting(0.7, at_least=0.0, at_most=100.0)
    underside_sigma_px: float = setting(1.2, at_least=0.0, at_most=100.0)
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
    """Each boundary point's nearest contour at the current estimate, where the two face the same way.

    The kernel's scale is in pixels here; matches farther than ``gate`` times it are left out.

    Args:
        velocities: (n, 3) velocity over ground of each boundary point's object, in the LiDAR frame [m/s], of
            the classes in which some move.
        deviation: of the points and pixels from what is assumed of them; the matched pixels are then those
            of the ideal camera.
    """
    found = {}
    for c, points in boundaries.items():
        if c not in contours:
            continue
        base_taus = base_tau_s - points.offsets_s
        moving = (velocities or {}).get(c)
        uvs, outs = _project(points, camera, cTl, offset_s + base_taus, motion, moving)
        shift = np.zeros((len(points), 2))
        if deviation is not None:
            points, base_taus = _deviated(points, base_taus, deviation, uvs)
            ideal, beyond = _project(points, camera, cTl, offset_s + base_taus, motion, moving)
            shift, out_shift = (_pixel_shift(deviation, points, each) for each in (ideal, beyond))
            uvs, outs = ideal + shift, beyond + out_shift
        feet = contours[c].look_up(uvs)
        way = outs - uvs
        length = np.linalg.norm(way, axis=1)
        way = way / np.maximum(length, 1e-9)[:, None]
        cosine = (way * feet.normals).sum(axis=1)
        residuals = feet.distances + biases_px.get(c, 0.0)
        ok = feet.valid & (cosine > config.min_cosine) & (np.abs(residuals) < config.gate * kernel.scale)
        used = camera.in_image(uvs) & (config.top_edges | (points.edges != Edge.TOP))
        index = np.flatnonzero(ok & used & _has_a_mask(points.objects, ok & used, used, config))
        if len(index) == 0:
            continue
        sigmas = np.hypot(config.mask_sigma_px, 0.5 * length[index] * cosine[index] / np.sqrt(3.0))
        sides = SIDE_OF[points.edges[index], (way[index, 0] > 0).astype(np.intp)]
        alignment = Alignment(
            camera=camera,
            lPs=points.lPs[index],
            base_taus_s=base_taus[index],
            pixels=feet.feet[index] - shift[index],
            sigmas_px=sigmas,
            normals=feet.normals[index],
            kernel=kernel,
            c_acceleration=motion.c_acceleration,
            weights=_shared_weights(points.objects[index], sides, sigmas, config),
            l_velocities=None if moving is None else moving[index],
        )
        found[c] = SilhouetteMatches(
            alignment, points.objects[index], sides, index, int(np.count_nonzero(used))
        )
    return found


def _deviated(
    points: Boundaries, base_taus_s: FloatArray, deviation: PointDeviation, uvs: FloatArray
) -> tuple[Boundaries, FloatArray]:
    """The points where they are, and their intervals."""
    effect = deviation.effect(points.lPs, points.offsets_s, uvs)
    if effect.l_shift is not None:
        points = replace(points, lPs=points.lPs + effect.l_shift, outward=points.outward + effect.l_shift)
    return points, base_taus_s if effect.time_s is None else base_taus_s + effect.time_s


def _pixel_shift(deviation: PointDeviation, points: Boundaries, uvs: FloatArray) -> FloatArray:
    """(n, 2) by how much the pixels of points lie beside the ideal ones ``uvs`` [px].

    NaN where the picture would fold over: beyond the radius at which a polynomial lens turns back, points
    far outside the view come to lie inside the image.
    """
    shift = deviation.effect(points.lPs, points.offsets_s, uvs).pixel_shift
    if shift is None:
        return np.zeros_like(uvs)
    arms = uvs - deviation.scene.centre
    farther = deviation.effect(points.lPs, points.offsets_s, uvs + _OUTWARD * arms).pixel_shift
    assert farther is not None
    stretch = ((_OUTWARD * arms + farther - shift) * arms).sum(axis=1)
    folded = stretch < _LEAST_STRETCH * _OUTWARD * (arms**2).sum(axis=1)
    return np.where(folded[:, None], np.nan, shift)


def _has_a_mask(
    objects: NDArray[np.intp], matched: NDArray[np.bool_], seen: NDArray[np.bool_], config: MatchConfig
) -> NDArray[np.bool_]:
    """(n,) whether enough of the boundary of each point's object meets a contour.

    An object that the image's labels miss crosses the contours of others here and there.
    """
    if len(objects) == 0:
        return np.zeros(0, dtype=bool)
    meets = np.bincount(objects, matched)
    return np.asarray((meets >= config.min_object_share * np.bincount(objects, seen))[objects])


def _shared_weights(
    objects: NDArray[np.intp], sides: NDArray[np.intp], sigmas_px: FloatArray, config: MatchConfig
) -> FloatArray:
    """(n,) weights under which the mean of a side of an object counts with sigma^2 / n + shared^2 instead of
    sigma^2 / n."""
    shared_px = np.where(sides == BOTTOM, config.underside_sigma_px, config.side_sigma_px)
    numbers = np.unique(objects * SIDES + sides, return_inverse=True)[1].reshape(-1)
    information = np.bincount(numbers, sigmas_px**-2.0)[numbers]
    return np.asarray(1.0 / (1.0 + information * shared_px**2))


def _project(
    points: Boundaries,
    camera: PinholeCamera,
    cTl: gtsam.Pose3,
    taus_s: FloatArray,
    motion: Motion,
    velocities: FloatArray | None,
) -> tuple[FloatArray, FloatArray]:
    """(n, 2) pixels of boundary points, and of those across the boundary, moved to their image's instant; NaN
    behind the camera."""
    # Both at once: with few points a call costs more than what it does.
    lPs = np.concatenate([points.lPs, points.outward]).T
    common = bool((taus_s == taus_s[0]).all()) if len(taus_s) else True
    taus = float(taus_s[0]) if common and len(taus_s) else np.tile(taus_s, 2)
    both = None if velocities is None else np.tile(velocities.T, 2)
    columns, twist, acceleration = np.ascontiguousarray(lPs), motion.c_twist, motion.c_acceleration
    moved = move_points(cTl, columns, taus, twist, acceleration, l_velocities=both)
    uvs = camera.project(moved.cPs.T)
    return uvs[: len(taus_s)], uvs[len(taus_s) :]

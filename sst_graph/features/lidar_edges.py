"""Boundary points of a scan: where a scan line leaves an object for what is behind it.

The edge lies between the last return on the object and the next beam, so the direction half way is
unbiased, uniform over half a beam step to either side. Where the neighbour is *nearer* the edge belongs
to the neighbour and is skipped. The range is extrapolated over the half step with the slope of the last
two returns. A roof that is seen from above is curved, and ends where a ray touches it, well behind the last
return: a camera below the LiDAR sees the difference.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from enum import IntEnum
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sst_graph.features.lidar_beams import Beams, arrange_beams
from sst_graph.features.up import up_direction
from sst_graph.files.array_store import ArrayStore, shape_of, storable
from sst_graph.types import FloatArray, IntArray, Scan, SemanticClass

_BEHIND_M = 0.5
"""The neighbour has to be farther by this much: less is the object's own relief [m]."""
_JUMP_M = 0.25
"""In place of :data:`_BEHIND_M` on objects without a class: every near side of a jump counts, on the object's
own parts too [m]."""
_OUTLINE_M = 1.0
"""Upper edges of objects without a class are shallow where the ring above returns from less than this behind:
a bonnet, a rear window or a hedge may go on there [m]."""
_MAX_STEPS = 1.6
"""Largest azimuth gap between neighbours, in beam steps: one missing return ends the line."""
_MAX_ELEVATION_GAP = np.radians(0.9)
"""Largest gap between neighbouring rings: twice the 0.4 deg of an HDL-64E [rad]."""
_GROUND_MARGIN_M = 0.3
"""What is lower than an object's lowest points plus this is the ground below it [m]."""
_MAX_SLOPE_M = 1.0
"""Most that the range is extrapolated by the slope of the last two returns [m]."""
_ROOF_RADIUS_M = 3.0
"""Radius of curvature of roofs seen from above [m]: a car's is 4 cm lower half a metre from its middle. What
another radius and flat roofs cost: docs/measured/simulators.md."""
_HALF_TURN = np.array([1.0, -1.0, -1.0])
"""By this the coordinates are multiplied where the LiDAR is upside down: half a turn about its x axis."""
_ROOF_BEAMS = 2
"""Beams to either side of a point on a roof that hit the object, too."""
_CELL_M = 0.3
"""Grid cell for splitting a class into objects where instances are missing [m]."""
MAX_RANGE_M = 60.0
"""Range beyond which objects are not used [m]: their labels are poor, and few returns outline them."""
_OFF_AXIS_M = 1e-3
"""Points nearer to the z axis have no azimuth [m]; no laser of a scanner that turns measures along it."""
_MIN_POINTS = 15
"""Objects with fewer returns are not used: their edges are those of a few beams."""


class Edge(IntEnum):
    """On which side of the object the scan leaves it."""

    SIDE = 0
    TOP = 1
    BOTTOM = 2
    SHALLOW_TOP = 3
    """At the top of an object without a class, where what is behind is so near that the surface may go on:
    the outline may lie higher."""


@storable("lPs", "outward", "rings", "offsets_s", "edges", "objects")
@dataclass(frozen=True)
class Boundaries:
    """Boundary points of one class in one scan.

    Attributes:
        lPs: (m, 3) points in the LiDAR frame [m].
        outward: (m, 3) a point farther out across the edge at the same range [m]: its direction in the
            image tells on which side the background lies.
        rings: (m,) number of the ring that each point's return is from, within the scan.
        offsets_s: (m,) time of each point relative to the scan's stamp [s].
        edges: (m,) of :class:`Edge`.
        objects: (m,) number of the object within the scan.
    """

    lPs: FloatArray
    outward: FloatArray
    rings: IntArray
    offsets_s: FloatArray
    edges: NDArray[np.uint8]
    objects: IntArray

    def __len__(self) -> int:
        return shape_of(self, "lPs")[0]

    def stored_in(self, store: ArrayStore) -> Boundaries:
        """The boundaries with their points in an array store."""
        return Boundaries(*map(store.put, self._rows()))

    def joined(self, other: Boundaries) -> Boundaries:
        """These points and others of the same scan."""
        return joined([self, other])

    def take(self, index: IntArray) -> Boundaries:
        """Some of the points, by position."""
        # Much faster than by an index.
        return Boundaries(*(rows.take(index, axis=0) for rows in self._rows()))

    def _rows(self) -> tuple[NDArray[Any], ...]:
        """All attributes, in their order."""
        return self.lPs, self.outward, self.rings, self.offsets_s, self.edges, self.objects


def with_points(found: Mapping[SemanticClass, Boundaries]) -> dict[SemanticClass, Boundaries]:
    """Without the classes that have no points."""
    return {c: points for c, points in found.items() if len(points)}


def joined(parts: Sequence[Boundaries]) -> Boundaries:
    """The points of one or more, one after the other; objects keep their numbers."""
    if len(parts) == 1:
        return parts[0]
    names = [field.name for field in fields(Boundaries)]
    return Boundaries(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def find_boundaries(
    scan: Scan,
    classes: Sequence[SemanticClass],
    max_range_m: float = MAX_RANGE_M,
    with_lower_edges: bool = True,
) -> dict[SemanticClass, Boundaries]:
    """Boundary points of each class in a scan; a class without any has no entry.

    Args:
        with_lower_edges: find edges towards the ground, too.
    """
    points = scan.points.astype(np.float64)
    apart = np.einsum("ij,ij->i", points, points) > 0.25
    # On the axis of rotation there is no azimuth.
    apart &= (np.abs(points[:, 0]) > _OFF_AXIS_M) | (np.abs(points[:, 1]) > _OFF_AXIS_M)
    usable = slice(None) if apart.all() else apart
    points, labels = points[usable], scan.classes[usable]
    # Compared with plain ints: compared with an enum, all labels are converted to int64.
    members = {c: labels == int(c) for c in classes}
    present = [c for c in classes if np.count_nonzero(members[c]) >= _MIN_POINTS]
    if not present:
        return {}
    # Upside down, what the scan lines leave at the top is the ground: they are turned by half a turn.
    up = up_direction(points)
    upside_down = bool(up[2] < 0.0)
    if upside_down:
        points, up = points * _HALF_TURN, up * _HALF_TURN
    beams = arrange_beams(points, None if scan.rings is None else scan.rings[usable])
    offsets = np.zeros(len(points)) if scan.offsets_s is None else scan.offsets_s[usable].astype(float)
    instances = None if scan.instances is None else scan.instances[usable]
    found = {}
    for c in present:
        mask = members[c]
        objects = split_objects(points, mask, instances, _MIN_POINTS)
        seen = _Seen(mask, mask)
        if c == SemanticClass.OBJECT:
            seen = _Seen(mask, np.zeros_like(mask), _JUMP_M, _OUTLINE_M)
        parts = [
            _side_edges(points, seen, beams, +1),
            _side_edges(points, seen, beams, -1),
            _ring_edges(points, seen, beams, roofs=c == SemanticClass.VEHICLE),
        ]
        if with_lower_edges and c != SemanticClass.OBJECT:
            parts.append(_ring_edges(points, seen, beams, _ground_below(points @ up, objects)))
        edges = _collect(parts, beams.ring, offsets, objects, max_range_m)
        if upside_down:
            edges = replace(edges, lPs=edges.lPs * _HALF_TURN, outward=edges.outward * _HALF_TURN)
        found[c] = edges
    return {c: b for c, b in found.items() if len(b)}


@dataclass(frozen=True)
class _Seen:
    """Where edges may lie.

    Attributes:
        mask: (n,) points that may be the last before an edge.
        inner: (n,) points that are never behind one.
        behind_m: least step in range across an edge [m].
        outline_m: least step upwards across an edge that is surely the outline [m].
    """

    mask: NDArray[np.bool_]
    inner: NDArray[np.bool_]
    behind_m: float = _BEHIND_M
    outline_m: float = 0.0


@dataclass(frozen=True)
class _Ground:
    """Heights above the LiDAR (n,) of all points, and of the ground below each point's object [m]."""

    levels: FloatArray
    lowest: FloatArray


@dataclass(frozen=True)
class _Edges:
    """Edges of one side: index of the object's point, the boundary point, the point across it, and its kind,
    of :class:`Edge`."""

    index: IntArray
    lPs: FloatArray
    outward: FloatArray
    kinds: NDArray[np.uint8]


def _side_edges(points: FloatArray, seen: _Seen, beams: Beams, side: int) -> _Edges:
    """Edges towards rising (side = 1) or falling azimuth, half a beam step from the last return.

    The half step, not the middle of the two azimuths: a laser mounted off the axis shows a near and a
    far return of neighbouring firings under azimuths that differ by more, or less, than the step.
    """
    mask = seen.mask
    member = mask[beams.order]
    inner = member if seen.inner is mask else seen.inner[beams.order]
    here, there = (member[:-1], inner[1:]) if side > 0 else (member[1:], inner[:-1])
    # Few points are the last of a class: all that follows is computed for these alone.
    place = np.flatnonzero(here & ~there) + (side < 0)
    last, following = beams.order[place], beams.order[place + side]
    before = beams.order[np.clip(place - side, 0, len(beams.order) - 1)]
    gap = side * (beams.azimuth[following] - beams.azimuth[last])
    parallax = 0.04 * np.abs(1.0 / beams.rho[last] - 1.0 / beams.rho[following])
    ok = (beams.ring[last] == beams.ring[following]) & (gap < _MAX_STEPS * beams.step + parallax)
    ok &= _is_behind(beams.rho, last, following, seen.behind_m)
    last, before = last[ok], before[ok]
    steps = side * (beams.azimuth[last] - beams.azimuth[before])
    known = mask[before] & (beams.ring[before] == beams.ring[last]) & (steps > 0.0)
    known &= steps < _MAX_STEPS * beams.step
    edge = _along_rays(points, beams, last, _extrapolated(beams, last, before, known))
    half = 0.5 * side * beams.step
    kinds = np.full(len(last), Edge.SIDE, np.uint8)
    return _Edges(last, _turn(edge, half), _turn(edge, 3.0 * half), kinds)


def _extrapolated(beams: Beams, last: IntArray, before: IntArray, known: NDArray[np.bool_]) -> FloatArray:
    """(n,) half the range step to last returns from those before, where these are known [m]."""
    step = beams.rho[last] - beams.rho[before]
    push = np.clip(0.5 * step, -_MAX_SLOPE_M, _MAX_SLOPE_M)
    return np.where(known & (np.abs(step) < 2.0 * _MAX_SLOPE_M), push, 0.0)


def _along_rays(points: FloatArray, beams: Beams, index: IntArray, push: FloatArray) -> FloatArray:
    """Some points pushed along their rays, which leave the tip of their ring's cone [m]."""
    farther = 1.0 + push / beams.rho[index]
    tips = beams.height[beams.ring[index]]
    moved = points[index] * farther[:, None]
    moved[:, 2] = tips + (points[index, 2] - tips) * farther
    return np.asarray(moved)


def _turn(points: FloatArray, angle: float) -> FloatArray:
    """Points turned about the z axis by an angle [rad]."""
    c, s = np.cos(angle), np.sin(angle)
    x, y = points[:, 0], points[:, 1]
    return np.stack([c * x - s * y, s * x + c * y, points[:, 2]], axis=1)


def _ring_edges(
    points: FloatArray,
    seen: _Seen,
    beams: Beams,
    ground: _Ground | None = None,
    roofs: bool = False,
) -> _Edges:
    """Edges towards the ring above: half way, at the object's range, to that ring's cone.

    The one return of that ring that is nearest in azimuth decides. To require that two of them miss the
    object would prefer edges far from that ring, and so shift the mean by a tenth of the gap.

    With the ground that each point's object stands on, edges towards the ring below: the object ends where
    that ring meets the ground, no matter how far before or behind.

    Args:
        roofs: whether objects of the class have one: seen from above, they end where a ray touches it.
    """
    mask = seen.mask
    up = 1 if ground is None else -1
    ring = beams.ring + up
    i = np.flatnonzero(mask & (ring >= 0) & (ring < len(beams.height)))
    following, near = _nearest_in_ring(beams, i, ring[i])
    ok = near & ~seen.inner[following]
    if ground is None:
        ok &= _is_behind(beams.rho, i, following, seen.behind_m)
    else:
        ok &= ground.levels[following] < ground.lowest[i] + _GROUND_MARGIN_M
    i, following = i[ok], following[ok]
    # The two rays: height over range, from their cones' tips.
    rho, tip, tip_there = beams.rho[i], beams.height[beams.ring[i]], beams.height[ring[i]]
    slope = (points[i, 2] - tip) / rho
    slope_there = (points[following, 2] - tip_there) / beams.rho[following]
    gap = tip_there + slope_there * rho - points[i, 2]
    ok = (up * gap > 0.0) & (up * gap < _MAX_ELEVATION_GAP * rho)
    i, following, rho, gap = (a[ok] for a in (i, following, rho, gap))
    slope, slope_there = slope[ok], slope_there[ok]
    before, known = _nearest_in_ring(beams, i, beams.ring[i] - up)
    push = _extrapolated(beams, i, before, known & mask[before])
    if roofs:
        roof = (slope < 0.0) & _within_object(mask, beams, i)
        push = np.where(roof, _to_tangent(gap), push)
    edge = _along_rays(points, beams, i, push)
    half = 0.5 * (gap + push * (slope_there - slope))
    lPs, outward = edge.copy(), edge.copy()
    lPs[:, 2] += half
    outward[:, 2] += 3.0 * half
    kinds = np.full(len(i), Edge.TOP if up > 0 else Edge.BOTTOM, np.uint8)
    if up > 0:
        kinds[~_is_behind(beams.rho, i, following, seen.outline_m)] = Edge.SHALLOW_TOP
    return _Edges(i, lPs, outward, kinds)


def _to_tangent(gap: FloatArray) -> FloatArray:
    """(n,) mean distance along a ray from its return on a roof to where rays just touch the roof [m].

    A return that lies h below the tangent to a surface of radius R is sqrt(2 R h) nearer than the point of
    contact; h is uniform between nothing and the gap between two rings, and the mean 2/3 of the largest.

    Args:
        gap: (n,) distance of the two rings there, above 0 [m].
    """
    return np.asarray(2.0 / 3.0 * np.sqrt(2.0 * _ROOF_RADIUS_M * gap))


def _within_object(mask: NDArray[np.bool_], beams: Beams, index: IntArray) -> NDArray[np.bool_]:
    """(n,) whether the class goes on in the ring to both sides of a point: where it does not, the edge above
    may well be that of a slanting pillar, not of a roof."""
    place = np.searchsorted(beams.keys, Beams.key(beams.ring[index], beams.azimuth[index]))
    within = np.ones(len(index), np.bool_)
    for steps in (-_ROOF_BEAMS, _ROOF_BEAMS):
        beside = beams.order[np.clip(place + steps, 0, len(beams.order) - 1)]
        gap = np.abs(beams.azimuth[beside] - beams.azimuth[index])
        within &= (
            mask[beside] & (beams.ring[beside] == beams.ring[index]) & (gap < (_ROOF_BEAMS + 1) * beams.step)
        )
    return within


def _ground_below(levels: FloatArray, objects: IntArray) -> _Ground:
    """The ground by the lowest points of each object, few stray ones aside; -inf where there is no object."""
    heights = np.full(len(levels), -np.inf)
    some = np.flatnonzero(objects >= 0)
    if len(some) == 0:
        return _Ground(levels, heights)
    z = levels[some]
    # By object, then by height: one key is sorted much faster than two.
    order = some[np.argsort(objects[some] * (np.ptp(z) + 1.0) + z)]
    first = np.flatnonzero(np.diff(objects[order], prepend=-1))
    counts = np.diff(first, append=len(order))
    lowest = levels[order[first + (0.03 * counts).astype(np.intp)]]
    heights[order] = np.repeat(lowest, counts)
    return _Ground(levels, heights)


def _nearest_in_ring(beams: Beams, index: IntArray, ring: IntArray) -> tuple[IntArray, NDArray[np.bool_]]:
    """The point of a ring nearest in azimuth to each of ``index``, and whether it is within a step or so."""
    keys, wanted = beams.keys, Beams.key(ring, beams.azimuth[index])
    place = np.clip(np.searchsorted(keys, wanted), 1, len(keys) - 1)
    place = np.where(keys[place] - wanted < wanted - keys[place - 1], place, place - 1)
    found = beams.order[place]
    return found, (beams.ring[found] == ring) & (np.abs(keys[place] - wanted) < beams.step)


def _is_behind(rho: FloatArray, last: IntArray, following: IntArray, behind_m: float) -> NDArray[np.bool_]:
    return np.asarray(rho[following] > rho[last] + behind_m)


def _collect(
    parts: Sequence[_Edges], rings: IntArray, offsets: FloatArray, objects: IntArray, max_range_m: float
) -> Boundaries:
    index = np.concatenate([part.index for part in parts])
    lPs = np.concatenate([part.lPs for part in parts])
    outward = np.concatenate([part.outward for part in parts])
    edges = np.concatenate([part.kinds for part in parts])
    keep = (objects[index] >= 0) & (np.linalg.norm(lPs, axis=1) < max_range_m)
    index = index[keep]
    return Boundaries(lPs[keep], outward[keep], rings[index], offsets[index], edges[keep], objects[index])


def split_objects(
    points: FloatArray,
    mask: NDArray[np.bool_],
    instances: NDArray[np.uint16] | None,
    min_points: int,
) -> IntArray:
    """(n,) number of the object that each point of a class belongs to; -1 for none, or one of too few points.

    The data's instances where all points carry one, else connected cells of a grid seen from above.
    """
    objects, members = np.full(len(points), -1, dtype=np.intp), np.flatnonzero(mask)
    if instances is not None and bool((instances[members] > 0).all()):
        numbers = instances[members].astype(np.intp)
    else:
        plan = np.ascontiguousarray(points.take(members, axis=0)[:, :2].T)
        cells = np.floor(plan / _CELL_M).astype(np.intp)
        cells -= cells.min(axis=1, keepdims=True) - 1
        size = np.minimum(cells.max(axis=1) + 2, 4000)
        u, v = np.minimum(cells, size[:, None] - 1)
        grid = np.zeros(size, dtype=np.uint8)
        grid[u, v] = 1
        grown = cv2.dilate(grid, np.ones((3, 3), np.uint8))
        _, regions = cv2.connectedComponents(grown, connectivity=4)
        numbers = regions[u, v].astype(np.intp)
    counts = np.bincount(numbers)
    objects[members] = np.where(counts[numbers] >= min_points, numbers, -1)
    return objects

"""Occupancy test: the place of a static object is occupied in a scan shortly before or after, too.

A dynamic object has left its place by then. That needs no track of the object, so it also finds oncoming
vehicles, whose tracks break and join others'. An object that has just come into view is at its place later,
and one that is about to leave was there before: the better of the two counts. Labels come and go, too: where
a place is occupied by anything but ground, the object has not left it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sst_graph.drive.preparation import ScanFeatures
from sst_graph.odometry.lidar import GROUND_CLASSES, TESTED_CLASSES
from sst_graph.points import transformed_points
from sst_graph.sampling import step_for
from sst_graph.types import FloatArray, SemanticClass

ObjectName = tuple[SemanticClass, int]
"""Class of an object and its number within its scan."""


_HORIZONS_S = (0.1, 0.3)
"""Time between the scans that are compared: the shorter finds fast objects before the next one takes their
place, the longer slow ones [s]."""
_OLDEST_S = 1.1
"""Oldest scan that stands for the longer time where scans are farther apart than that, as key frames at 2 Hz
are [s]."""
_REACH_M, _REACH_RATIO = 0.2, 0.008
"""Farthest from its place that a point counts as found again [m], or this fraction of its range where that is
more, for beams diverge."""
_DYNAMIC_SHARE, _STATIC_SHARE = 0.35, 0.55
"""Shares of an object's points that are found again, at or below which it is dynamic with any speed, and at
or above which it is static."""
_MAX_POINTS = 48
"""Points of an object that are looked up."""
_MAX_INSIDE = 1000
"""Points of a class, beside its outlines, among which they are looked up (about)."""
_SPEED_MPS = 0.6
"""Assumed speed of an object half way between the two shares [m/s]."""
_MAX_SPEED_MPS = 30.0
"""Assumed speed of an object below the smaller share [m/s]."""
_RAISED = ~np.isin(np.arange(256), GROUND_CLASSES)
"""Whether a label is anything but ground."""


class OccupancyTest:
    """Which objects of the latest scans are static by their place; scans are known by their number.

    Attributes:
        shares: of each object of each scan, the share of its points found again, for each horizon (nan where
            no scan is that far away).
    """

    def __init__(self) -> None:
        self.shares: dict[int, dict[ObjectName, FloatArray]] = {}
        self._places: dict[int, _Places] = {}

    def add(self, number: int, scan: ScanFeatures, wTl: gtsam.Pose3) -> set[int]:
        """The next scan, posed at ``wTl``; numbers of the earlier ones in which a speed changes by it.

        A scan without labels shows no object, and takes none from its place: it is passed over.
        """
        if not scan.boundaries and not len(scan.classes):
            return set()
        here = self._insert(number, scan, wTl)
        self.shares[number] = {name: np.full(len(_HORIZONS_S), np.nan) for name in here.names}
        others = [self._nearest(number, scan.stamp_ns, seconds) for seconds in _HORIZONS_S]
        before = {other: self.speeds(other) for other in others if other is not None}
        for horizon, other in enumerate(others):
            if other is not None:
                self._set(number, horizon, here.found_in(self._places[other]))
                self._set(other, horizon, self._places[other].found_in(here))
        return {other for other, speeds in before.items() if self.speeds(other) != speeds}

    def _insert(self, number: int, scan: ScanFeatures, wTl: gtsam.Pose3) -> _Places:
        """Keep the places of a scan's objects for the scans that follow."""
        self._places[number] = places = _Places.of(scan, wTl)
        # No later scan is compared with one that is older, but for the last one where scans are far apart.
        since = scan.stamp_ns - round(1.5e9 * max(_HORIZONS_S))
        last = [*self._places][-2:]
        self._places = {k: kept for k, kept in self._places.items() if kept.stamp_ns >= since or k in last}
        return places

    def forget(self, before: int) -> None:
        """Drop all scans before one."""
        for by_scan in (self.shares, self._places):
            for number in [k for k in by_scan if k < before]:
                del by_scan[number]

    def speeds(self, number: int) -> dict[ObjectName, float]:
        """Assumed speed [m/s] of the objects of a scan that are not static.

        None before the longest horizon is known: within a few scans a dynamic object is still near its place.
        """
        least = {}
        for name, shares in self.shares.get(number, {}).items():
            known = [share for share in shares.tolist() if share == share]
            if known and shares[-1] == shares[-1]:  # not nan
                least[name] = min(known)
        return {name: _speed(share) for name, share in least.items() if share < _STATIC_SHARE}

    def _nearest(self, number: int, stamp_ns: int, seconds: float) -> int | None:
        """The earlier scan whose age is nearest to some seconds, from 0.7 to 1.5 times as much; for the
        longest time an older one where there is none."""
        ages = {k: 1e-9 * (stamp_ns - kept.stamp_ns) for k, kept in self._places.items() if k != number}
        near = {k: abs(age - seconds) for k, age in ages.items() if 0.7 * seconds <= age <= 1.5 * seconds}
        if not near and seconds == max(_HORIZONS_S):
            near = {k: age for k, age in ages.items() if seconds < age <= _OLDEST_S}
        return min(near, key=near.__getitem__) if near else None

    def _set(self, number: int, horizon: int, found: dict[ObjectName, float]) -> None:
        for name, share in found.items():
            shares = self.shares.get(number, {}).get(name)
            if shares is not None:
                better = shares.copy()
                better[horizon] = np.fmax(shares[horizon], share)
                self.shares[number][name] = better


def _speed(share: float) -> float:
    """Assumed speed [m/s] by the share of points found again: rises as less is found."""
    above = max(share - _DYNAMIC_SHARE, 1e-9)
    return float(min(_SPEED_MPS * np.sqrt((_STATIC_SHARE - share) / above), _MAX_SPEED_MPS))


@dataclass(frozen=True)
class _Places:
    """The movable objects of a scan.

    Attributes:
        stamp_ns: of the scan.
        names: of the objects.
        outlines: by class.
        trees: all points of a class in the world.
        scan, wTl: itself, and its pose.
    """

    stamp_ns: int
    names: tuple[ObjectName, ...]
    outlines: dict[SemanticClass, _Outlines]
    trees: dict[SemanticClass, cKDTree]
    scan: ScanFeatures
    wTl: gtsam.Pose3

    @classmethod
    def of(cls, scan: ScanFeatures, wTl: gtsam.Pose3) -> _Places:
        names: list[ObjectName] = []
        outlines, trees = {}, {}
        for c in [c for c in TESTED_CLASSES if c in scan.boundaries]:
            edges = [scan.boundaries[c], *([scan.lower_edges[c]] if c in scan.lower_edges else [])]
            lPs = np.concatenate([part.lPs for part in edges])
            objects = np.concatenate([part.objects for part in edges])
            names += [(c, int(n)) for n in np.unique(objects)]
            chosen = _some_of_each(objects, _MAX_POINTS)
            reaches = np.maximum(_REACH_M, _REACH_RATIO * np.linalg.norm(lPs[chosen], axis=1))
            outlines[c] = _Outlines(transformed_points(wTl, lPs[chosen]), reaches, objects[chosen])
            inside = scan.lPs[scan.classes == c]
            thin = inside[:: max(1, len(inside) // _MAX_INSIDE)]
            trees[c] = _tree(transformed_points(wTl, np.concatenate([lPs, thin])))
        return cls(scan.stamp_ns, tuple(names), outlines, trees, scan, wTl)

    @cached_property
    def _raised(self) -> FloatArray:
        """(n, 3) all points but the ground's in the world; made when needed [m]."""
        return transformed_points(self.wTl, self.scan.lPs[_RAISED[self.scan.classes]])

    def found_in(self, other: _Places) -> dict[ObjectName, float]:
        """Share of each object's points whose place is occupied in another scan, by its class or anything."""
        shares = {}
        for c, outlines in self.outlines.items():
            near = outlines.near(other.trees[c]) if c in other.trees else np.zeros(len(outlines.wPs), bool)
            numbers, which = np.unique(outlines.owners, return_inverse=True)
            count = np.bincount(which)
            free = (np.bincount(which, near) < _STATIC_SHARE * count)[which]
            if free.any():
                near[free] |= outlines.take(free).near_some(other._raised)
            found = np.bincount(which, near) / count
            shares.update({(c, int(n)): float(share) for n, share in zip(numbers, found, strict=True)})
        return shares


@dataclass(frozen=True)
class _Outlines:
    """Some points (n, 3) of objects' outlines in the world [m], how far from there they may be found (n,)
    [m], and whose they are (n,)."""

    wPs: FloatArray
    reaches_m: FloatArray
    owners: NDArray[np.intp]

    def take(self, chosen: NDArray[np.bool_]) -> _Outlines:
        return _Outlines(self.wPs[chosen], self.reaches_m[chosen], self.owners[chosen])

    def near(self, tree: cKDTree) -> NDArray[np.bool_]:
        """(n,) whether a point of a tree lies within reach."""
        distances, _ = tree.query(self.wPs, distance_upper_bound=float(self.reaches_m.max()))
        return np.asarray(distances <= self.reaches_m)

    def near_some(self, wPs: FloatArray) -> NDArray[np.bool_]:
        """(n,) the same of points (m, 3) among which few are near: a tree of all would take longer."""
        x, y = wPs[:, 0], wPs[:, 1]
        reach = float(self.reaches_m.max())
        (left, low, _), (right, high, _) = self.wPs.min(axis=0) - reach, self.wPs.max(axis=0) + reach
        around = np.flatnonzero((x >= left) & (x <= right) & (y >= low) & (y <= high))
        return self.near(_tree(wPs.take(around, axis=0)))


def _tree(wPs: FloatArray) -> cKDTree:
    """A tree of points (n, 3); for few queries it is not balanced, which takes longer than they do."""
    return cKDTree(wPs, balanced_tree=False, compact_nodes=False)


def _some_of_each(objects: NDArray[np.intp], most: int) -> NDArray[np.intp]:
    """Positions of at most ``most`` evenly spread entries of each number."""
    order = np.argsort(objects, kind="stable")
    parts = np.split(order, np.flatnonzero(np.diff(objects[order])) + 1)
    return np.concatenate([part[:: step_for(len(part), most)] for part in parts if len(part)])

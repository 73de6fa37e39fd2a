"""Objects that stay: what a scan shows of them is at the same place a little before or after, too.

An object that moves by itself has left its place by then. That needs no track of the object and no scan in
which it is alone, so it tells oncoming vehicles, too, whose tracks break and join others'. What has only
just come into view is at its place a little later, and what is about to leave was there a little before: the
better of the two counts. Labels come and go, too: where a place is taken by anything but ground, it has not
been left.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sst_graph.config import Settings, setting
from sst_graph.drive.preparation import ScanFeatures
from sst_graph.odometry.lidar import MOVABLE_CLASSES
from sst_graph.types import SemanticClass

FloatArray = NDArray[np.float64]
ObjectName = tuple[SemanticClass, int]
"""Class of an object and its number within its scan."""


@dataclass(frozen=True)
class PersistenceConfig(Settings):
    """When an object stays where it is.

    Attributes:
        horizons_s: how long before and after a scan is looked; the shorter tells fast objects before they
            overlap with the next, the longer slow ones [s].
        reach_m: farthest from its place that a point counts as found again [m] ...
        reach_ratio: ... or this fraction of its range, where that is more.
        lost, kept: shares of an object's points that are found again, at or below which it moves, and at or
            above which it stays.
        most_points: points of an object that are looked for.
        most_inside: points of a class, beside its outlines, among which they are (about).
    """

    horizons_s: tuple[float, ...] = setting(
        (0.1, 0.3), at_least=0.01, at_most=10.0, length=(1, 5), order="increasing"
    )
    reach_m: float = setting(0.2, at_least=0.001, at_most=10.0)
    reach_ratio: float = setting(0.008, at_least=0.0, at_most=1.0)
    lost: float = setting(0.35, at_least=0.0, at_most=1.0)
    kept: float = setting(0.55, at_least=0.0, at_most=1.0)
    most_points: int = setting(48, at_least=1, at_most=10_000)
    most_inside: int = setting(1000, at_least=1, at_most=1_000_000)

    def __post_init__(self) -> None:
        self.expect_at_most("lost", self.kept, "kept")


_SPEED = 0.6
"""Speed that an object half way between lost and kept passes for [m/s]."""
_FASTEST = 30.0
"""Speed that a lost object passes for [m/s]."""
_RAISED = ~np.isin(np.arange(256), (SemanticClass.GROUND, SemanticClass.TERRAIN))
"""Whether a label is anything but ground."""


class Persistence:
    """Which objects of the latest scans stay, scan by scan; scans are told apart by their number.

    Attributes:
        shares: of each object of each scan, the share of its points found again, for each horizon (nan where
            no scan is that far away).
    """

    def __init__(self, config: PersistenceConfig | None = None) -> None:
        self.config = config or PersistenceConfig()
        self.shares: dict[int, dict[ObjectName, FloatArray]] = {}
        self._places: dict[int, _Places] = {}

    def add(self, number: int, scan: ScanFeatures, wTl: gtsam.Pose3) -> set[int]:
        """The next scan, posed at ``wTl``; numbers of the earlier ones that it tells something new about."""
        here = self._remember(number, scan, wTl)
        horizons = self.config.horizons_s
        self.shares[number] = {name: np.full(len(horizons), np.nan) for name in here.names}
        others = [self._nearest(number, scan.stamp_ns, seconds) for seconds in horizons]
        before = {other: self.speeds(other) for other in others if other is not None}
        for horizon, other in enumerate(others):
            if other is not None:
                self._note(number, horizon, here.found_in(self._places[other]))
                self._note(other, horizon, self._places[other].found_in(here))
        return {other for other, speeds in before.items() if self.speeds(other) != speeds}

    def _remember(self, number: int, scan: ScanFeatures, wTl: gtsam.Pose3) -> _Places:
        """Keep the places of a scan's objects for the scans that follow."""
        self._places[number] = places = _Places.of(scan, wTl, self.config)
        # No scan to come is compared with one that is older.
        since = scan.stamp_ns - round(1.5e9 * max(self.config.horizons_s))
        self._places = {k: kept for k, kept in self._places.items() if kept.stamp_ns >= since}
        return places

    def forget(self, before: int) -> None:
        """Drop all scans before one."""
        for by_scan in (self.shares, self._places):
            for number in [k for k in by_scan if k < before]:
                del by_scan[number]

    def speeds(self, number: int) -> dict[ObjectName, float]:
        """Speed [m/s] that the objects of a scan pass for, of those that do not stay.

        Nothing is said before the longest horizon is known: a short burst of scans has little else to go by,
        and in it what moves is still near its place.
        """
        least = {}
        for name, shares in self.shares.get(number, {}).items():
            known = [share for share in shares.tolist() if share == share]
            if known and shares[-1] == shares[-1]:  # not nan
                least[name] = min(known)
        return {name: self._speed(share) for name, share in least.items() if share < self.config.kept}

    def _speed(self, share: float) -> float:
        above = max(share - self.config.lost, 1e-9)
        return float(min(_SPEED * np.sqrt((self.config.kept - share) / above), _FASTEST))

    def _nearest(self, number: int, stamp_ns: int, seconds: float) -> int | None:
        """The earlier scan whose age is nearest to some seconds, from 0.7 to 1.5 times as much."""
        ages = {k: 1e-9 * (stamp_ns - kept.stamp_ns) for k, kept in self._places.items() if k != number}
        near = {k: abs(age - seconds) for k, age in ages.items() if 0.7 * seconds <= age <= 1.5 * seconds}
        return min(near, key=near.__getitem__) if near else None

    def _note(self, number: int, horizon: int, found: dict[ObjectName, float]) -> None:
        for name, share in found.items():
            shares = self.shares.get(number, {}).get(name)
            if shares is not None:
                better = shares.copy()
                better[horizon] = np.fmax(shares[horizon], share)
                self.shares[number][name] = better


@dataclass(frozen=True)
class _Places:
    """The movable objects of a scan.

    Attributes:
        stamp_ns: of the scan.
        names: of the objects.
        outlines: by class.
        trees: all points of a class in the world.
        scan, wTl: itself, and its pose.
        kept: share of an object's points from which on it stays.
    """

    stamp_ns: int
    names: tuple[ObjectName, ...]
    outlines: dict[SemanticClass, _Outlines]
    trees: dict[SemanticClass, cKDTree]
    scan: ScanFeatures
    wTl: gtsam.Pose3
    kept: float

    @classmethod
    def of(cls, scan: ScanFeatures, wTl: gtsam.Pose3, config: PersistenceConfig) -> _Places:
        names: list[ObjectName] = []
        outlines, trees = {}, {}
        for c in [c for c in MOVABLE_CLASSES if c in scan.boundaries]:
            edges = [scan.boundaries[c], *([scan.lower_edges[c]] if c in scan.lower_edges else [])]
            lPs = np.concatenate([part.lPs for part in edges])
            objects = np.concatenate([part.objects for part in edges])
            names += [(c, int(n)) for n in np.unique(objects)]
            chosen = _some_of_each(objects, config.most_points)
            reaches = np.maximum(config.reach_m, config.reach_ratio * np.linalg.norm(lPs[chosen], axis=1))
            outlines[c] = _Outlines(_moved(wTl, lPs[chosen]), reaches, objects[chosen])
            inside = scan.lPs[scan.classes == c]
            thin = inside[:: max(1, len(inside) // config.most_inside)]
            trees[c] = _tree(_moved(wTl, np.concatenate([lPs, thin])))
        return cls(scan.stamp_ns, tuple(names), outlines, trees, scan, wTl, config.kept)

    @cached_property
    def _anything(self) -> cKDTree | None:
        """All points but the ground's in the world; made where it is asked for."""
        raised = self.scan.lPs[_RAISED[self.scan.classes]]
        return _tree(_moved(self.wTl, raised)) if len(raised) else None

    def found_in(self, other: _Places) -> dict[ObjectName, float]:
        """Share of each object's points whose place is taken in another scan, by its class or anything."""
        shares = {}
        for c, outlines in self.outlines.items():
            near = outlines.near(other.trees[c]) if c in other.trees else np.zeros(len(outlines.wPs), bool)
            numbers, which = np.unique(outlines.owners, return_inverse=True)
            count = np.bincount(which)
            lost = (np.bincount(which, near) < self.kept * count)[which]
            if lost.any() and other._anything is not None:
                near[lost] |= outlines.take(lost).near(other._anything)
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


def _tree(wPs: FloatArray) -> cKDTree:
    """Points (n, 3) to look among: for few queries, so it is built without care for its shape."""
    return cKDTree(wPs, balanced_tree=False, compact_nodes=False)


def _moved(wTl: gtsam.Pose3, lPs: FloatArray) -> FloatArray:
    """Points (n, 3) in the world [m]."""
    return np.asarray(lPs @ wTl.rotation().matrix().T + wTl.translation())


def _some_of_each(objects: NDArray[np.intp], most: int) -> NDArray[np.intp]:
    """Positions of at most ``most`` evenly spread entries of each number."""
    order = np.argsort(objects, kind="stable")
    parts = np.split(order, np.flatnonzero(np.diff(objects[order])) + 1)
    return np.concatenate([part[:: -(-len(part) // most)] for part in parts if len(part)])

"""Scans of one stretch of a drive, registered to one another with the times of their points unknown.

Point to plane, r = n . (X_b p_b(t_b) - X_a p_a(t_a)), between scans near and far in time, over all poses X at
once. A point's time after its stamp is t = T u(azimuth); the columns of u are those of
:class:`SweepProfile`. With the poses eliminated, the normal equations over these columns say how well any
share f of the sweep, either sense of rotation and any start of the turn explain the static scene.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np
import small_gicp
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sst_graph.config import Settings, setting
from sst_graph.odometry.cloud import compensate_sweep, usable_points
from sst_graph.odometry.lidar import MOVABLE_CLASSES, LidarOdometry, LidarOdometryConfig
from sst_graph.odometry.stationary_objects import MoverConfig, standing
from sst_graph.sweep_timing import turned
from sst_graph.types import Scan

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.intp]

SECTORS = 72
"""Sectors of azimuth at whose borders a turn may begin."""


@dataclass(frozen=True)
class SweepWindowConfig(Settings):
    """How the scans of a stretch are thinned and matched.

    Attributes:
        near_m, far_m: ranges between which points are used [m].
        max_points: most points of a scan that are looked at.
        voxel_m: edge of the voxels of which one point is kept [m].
        neighbours: points from which a surface's normal is estimated.
        flatness: a patch counts as a surface where its thickness is below this share of its width ...
        breadth: ... and its width above this share of its length.
        points_a_way: most points of a scan that are matched, of each direction of their surfaces' normals.
        gaps: scans are matched with those so many places later.
        gates_m: farthest match, pass by pass; the last one stays [m].
        scales_m: scale of the robust kernel, pass by pass; the last one stays [m].
        cell_m: edge of the cells of the ground plan; level surfaces of one cell share an error, and so do all
            its others; errors are independent from cell to cell [m].
        movers: which objects of movable classes stand.
        passes: most times that matches are made anew.
    """

    near_m: float = setting(2.5, at_least=0.0, at_most=100.0)
    far_m: float = setting(45.0, at_least=1.0, at_most=500.0)
    max_points: int = setting(40_000, at_least=100, at_most=10_000_000)
    voxel_m: float = setting(0.12, at_least=0.01, at_most=10.0)
    neighbours: int = setting(9, at_least=3, at_most=100)
    flatness: float = setting(0.3, at_least=0.001, at_most=1.0)
    breadth: float = setting(0.25, at_least=0.0, at_most=1.0)
    points_a_way: int = setting(200, at_least=10, at_most=100_000)
    gaps: tuple[int, ...] = setting((1, 4, 8), at_least=1, at_most=1000, length=(1, 20))
    gates_m: tuple[float, ...] = setting(
        (1.0, 0.8, 0.6, 0.5, 0.4), at_least=0.01, at_most=100.0, length=(1, 50)
    )
    scales_m: tuple[float, ...] = setting(
        (0.4, 0.3, 0.2, 0.12, 0.08), at_least=0.001, at_most=100.0, length=(1, 50)
    )
    cell_m: float = setting(3.0, at_least=0.1, at_most=1000.0)
    movers: MoverConfig = field(default_factory=lambda: MoverConfig(slack_m=0.3))
    passes: int = setting(12, at_least=1, at_most=100)


@dataclass(frozen=True)
class _Surfaces:
    """Surface points of one scan: places and normals (n, 3), azimuths (n,) [rad], sectors (n,), and which
    of them are matched to other scans."""

    points: FloatArray
    normals: FloatArray
    azimuths: FloatArray
    sectors: IndexArray
    asked: IndexArray


@dataclass(frozen=True)
class Normal:
    """Normal equations H u = g over the columns of the times, poses eliminated, in units of 1/m^2 residuals.

    Attributes:
        H, g: (1 + SECTORS, 1 + SECTORS) and (1 + SECTORS,).
        back: (6 n, 1 + SECTORS) and (6 n,): the poses' step is back[0] @ u + back[1]; a window's own.
        rows: number of matches.
    """

    H: FloatArray
    g: FloatArray
    back: tuple[FloatArray, FloatArray] = field(repr=False)
    rows: int = 0


@dataclass(frozen=True)
class _Rows:
    """Matches of two scans: residuals (m,), weights (m,), Jacobians, and for each the cell of the ground plan
    (m,) and the direction from the LiDAR (m,) in which it lies."""

    scans: tuple[int, int]
    residuals: FloatArray
    weights: FloatArray
    of_poses: FloatArray
    of_times: FloatArray
    cells: IndexArray
    directions: IndexArray


@dataclass(frozen=True)
class SurfaceSums:
    """Sums over the matches of each group (groups, k), for k directions of the times.

    Attributes:
        score: derivative of half the squared residuals at the best fit, the poses following [m^2].
        origin: the same for points that share one instant [m^2].
        lever: what an error of 1 m that all of a group's matches share adds to it [m].
        information: second derivative [m^2].
    """

    score: FloatArray
    origin: FloatArray
    lever: FloatArray
    information: FloatArray


@dataclass(frozen=True)
class Errors:
    """Variances of residuals at the last matches [m^2], from the residuals themselves.

    Attributes:
        own: of one match around what its cell's matches share.
        shared: of that: what vegetation, edges, sparse rings and the LiDAR's own calibration leave, however
            many points there are.
        weight: of the matches.
    """

    own: float
    shared: float
    weight: float


class Window:
    """Scans of a stretch, and their poses."""

    def __init__(self, scans: Sequence[Scan], period_s: float, config: SweepWindowConfig) -> None:
        """scans: in the order of their stamps; period_s: duration of a turn [s]."""
        self.config, self.period_s = config, period_s
        self._stamps_s = np.array([(scan.stamp_ns - scans[0].stamp_ns) * 1e-9 for scan in scans])
        self.ok, self._poses = _odometry(scans)
        self._surfaces = [_surfaces(points, config) for points in self._still(scans)]
        self._rows: list[_Rows] = []

    def thinned(self, scans: int, points_a_way: int) -> Window:
        """The first scans of the window, matched to the next ones only, with fewer points."""
        few = self.copy()
        few.config = replace(self.config, gaps=(1, 2))
        few._stamps_s, few._poses = self._stamps_s[:scans], self._poses[:scans]
        few._surfaces = [
            replace(surfaces, asked=_varied(surfaces.normals, points_a_way))
            for surfaces in self._surfaces[:scans]
        ]
        return few

    def copy(self) -> Window:
        """The same scans; poses that move apart from this window's."""
        other = copy(self)
        other._poses, other._rows = list(self._poses), []
        return other

    def _still(self, scans: Sequence[Scan]) -> list[FloatArray]:
        """Points of each scan on what does not move by itself (in its LiDAR frame) [m]."""
        config, found = self.config, []
        parts = [usable_points(scan, config.near_m, config.far_m, config.max_points)[:2] for scan in scans]
        world = [
            points @ pose[:3, :3].T + pose[:3, 3]
            for (points, _), pose in zip(parts, self._poses, strict=True)
        ]
        movable = [np.isin(classes, MOVABLE_CLASSES) for _, classes in parts]
        for k, (points, _) in enumerate(parts):
            # An object stands if it is where it is in the scan farthest away in time within half the window.
            other = k + len(scans) // 2 if k < len(scans) // 2 else k - len(scans) // 2
            kept = ~movable[k]
            stands = standing(world[k][movable[k]], world[other][movable[other]], config.movers)
            kept[np.flatnonzero(movable[k])[stands]] = True
            found.append(points[kept])
        return found

    @property
    def travel(self) -> tuple[float, float]:
        """Distance and turn from first scan to last [m, rad]; 0 where some could not be registered."""
        if not self.ok:
            return 0.0, 0.0
        step = gtsam.Pose3(self._poses[0]).between(gtsam.Pose3(self._poses[-1]))
        turn = np.linalg.norm(gtsam.Rot3.Logmap(step.rotation()))
        return float(np.linalg.norm(step.translation())), float(turn)

    @property
    def twists(self) -> FloatArray:
        """(n, 6) twist of the LiDAR at each scan [rad/s, m/s], from the poses around it."""
        poses = [gtsam.Pose3(pose) for pose in self._poses]
        steps = (
            np.stack([gtsam.Pose3.Logmap(a.between(b)) for a, b in itertools.pairwise(poses)])
            / np.diff(self._stamps_s)[:, None]
        )
        middle = 0.5 * (steps[1:] + steps[:-1])
        first, last = steps[0], steps[-1]
        if len(steps) > 1:
            first, last = 1.5 * steps[0] - 0.5 * steps[1], 1.5 * steps[-1] - 0.5 * steps[-2]
        return np.vstack([first, middle, last])

    def linearized(self, fraction: float, start_rad: float, number: int) -> Normal:
        """Matches at the present poses under a timing, and their normal equations about it."""
        config = self.config
        gate = config.gates_m[min(number, len(config.gates_m) - 1)]
        scale = config.scales_m[min(number, len(config.scales_m) - 1)]
        twists = self.twists
        moved, trees = [], []
        for surfaces, twist, pose in zip(self._surfaces, twists, self._poses, strict=True):
            share = turned(surfaces.azimuths, start_rad) - 0.5
            points = compensate_sweep(surfaces.points, fraction * self.period_s * share, twist)
            moved.append(points)
            trees.append(cKDTree(points @ pose[:3, :3].T + pose[:3, 3]))
        count = len(self._poses)
        self._rows = [
            self._matched(a, a + gap, moved, trees, twists, gate, scale)
            for gap in config.gaps
            for a in range(count - gap)
        ]
        return self._eliminated()

    def move(self, normal: Normal, u: FloatArray) -> None:
        """Take the step of the poses that goes with a step (1 + SECTORS,) of the times."""
        steps = (normal.back[0] @ u + normal.back[1]).reshape(-1, 6)
        self._poses = [
            np.asarray((gtsam.Pose3(_orthonormal(pose)) * gtsam.Pose3.Expmap(step)).matrix())
            for pose, step in zip(self._poses, steps, strict=True)
        ]

    def surface_sums(
        self, columns: FloatArray, normal: Normal, present: FloatArray
    ) -> tuple[SurfaceSums, SurfaceSums]:
        """By cell of the ground plan and by direction from the LiDAR, for directions (1 + SECTORS, k) of the
        times: a surface stays in its cell, and what moves along with the vehicle in its direction.

        present: (1 + SECTORS,) times at which the matches were made.
        """
        steps = normal.back[0] @ np.column_stack([columns, present])
        levers, squares, scores, origins = [], [], [], []
        for rows in self._rows:
            a, b = rows.scans
            at = np.concatenate([np.arange(6 * a, 6 * a + 6), np.arange(6 * b, 6 * b + 6)])
            own = rows.of_times @ columns + rows.of_poses @ steps[at, :-1]
            residuals = rows.residuals + rows.of_poses @ normal.back[1][at]
            origin = residuals - rows.of_times @ present - rows.of_poses @ steps[at, -1]
            lever = rows.weights[:, None] * own
            levers.append(lever)
            squares.append(lever * own)
            scores.append(lever * residuals[:, None])
            origins.append(lever * origin[:, None])
        stacked = [np.concatenate(parts) for parts in (scores, origins, levers, squares)]

        def grouped(groups: IndexArray) -> SurfaceSums:
            order, first = _groups(groups)
            return SurfaceSums(*(np.add.reduceat(values[order], first, axis=0) for values in stacked))

        directions = np.concatenate([rows.directions for rows in self._rows])
        return grouped(self._stacked()[0]), grouped(directions)

    @property
    def errors(self) -> Errors:
        """How large residuals are, and what those of one cell share: a median, for some cells are wrong."""
        cells, weights, residuals = self._stacked()
        order, first = _groups(cells)
        weights, residuals = weights[order], residuals[order]
        amount = np.maximum(np.add.reduceat(weights, first), 1e-9)
        shared = np.add.reduceat(weights * residuals, first) / amount
        around = float((weights * residuals**2).sum() - (amount * shared**2).sum())
        many = amount > _MANY
        spread = 1.4826 * float(np.median(np.abs(shared[many]))) if many.any() else 0.0
        total = float(amount.sum())
        return Errors(max(around / total, 1e-12), spread**2, total)

    def _stacked(self) -> tuple[IndexArray, FloatArray, FloatArray]:
        """Cells, weights and residuals of all matches."""
        return (
            np.concatenate([rows.cells for rows in self._rows]),
            np.concatenate([rows.weights for rows in self._rows]),
            np.concatenate([rows.residuals for rows in self._rows]),
        )

    def misfit(self, scale: float) -> float:
        """Mean robust misfit of the points asked about, 0 (all on a surface) to 1 (none near one)."""
        good = sum(float((1.0 / (1.0 + (rows.residuals / scale) ** 2)).sum()) for rows in self._rows)
        asked = sum(len(self._surfaces[rows.scans[1]].asked) for rows in self._rows)
        return 1.0 - good / max(asked, 1)

    def _matched(
        self,
        a: int,
        b: int,
        moved: list[FloatArray],
        trees: list[cKDTree],
        twists: FloatArray,
        gate: float,
        scale: float,
    ) -> _Rows:
        """Points of scan b matched to surfaces of scan a."""
        Ra, Rb = self._poses[a][:3, :3], self._poses[b][:3, :3]
        asked = self._surfaces[b].asked
        wBs = trees[b].data
        distance, nearest = trees[a].query(wBs[asked], distance_upper_bound=gate)
        found = np.isfinite(distance)
        kept, nearest = asked[found], nearest[found]
        normals = self._surfaces[a].normals[nearest] @ Ra.T
        alike = np.abs(np.einsum("ij,ij->i", normals, self._surfaces[b].normals[kept] @ Rb.T)) > 0.8
        kept, nearest, normals = kept[alike], nearest[alike], normals[alike]
        wAs = trees[a].data[nearest]
        residuals = np.einsum("ij,ij->i", normals, wBs[kept] - wAs)
        weights = 1.0 / (1.0 + (residuals / scale) ** 2) ** 2
        of_poses, of_times = np.zeros((len(kept), 12)), np.zeros((len(kept), 1 + SECTORS))
        row = np.arange(len(kept))
        for scan, index, R, sign, at in ((a, nearest, Ra, -1.0, 0), (b, kept, Rb, 1.0, 6)):
            points, own = moved[scan][index], sign * (normals @ R)
            of_poses[:, at : at + 3] = np.cross(points, own)
            of_poses[:, at + 3 : at + 6] = own
            rate = np.cross(twists[scan, :3], points) + twists[scan, 3:]
            per_turn = self.period_s * np.einsum("ij,ij->i", own, rate)
            surfaces = self._surfaces[scan]
            of_times[:, 0] += per_turn * (turned(surfaces.azimuths[index], -np.pi) - 0.5)
            of_times[row, 1 + surfaces.sectors[index]] += per_turn
        level = np.abs(normals[:, 2]) > _LEVEL
        cells = np.floor(wAs[:, :2] / self.config.cell_m).astype(np.int64) + 2**20
        number = 2 * (cells[:, 0] * 2**22 + cells[:, 1]) + level
        directions = self._surfaces[b].sectors[kept] // _DIRECTION
        return _Rows((a, b), residuals, weights, of_poses, of_times, number, directions)

    def _eliminated(self) -> Normal:
        """Normal equations of all rows with the poses, of which the first stays, eliminated."""
        size, columns = 6 * len(self._poses), 1 + SECTORS
        Hpp, Hpu, gp = np.zeros((size, size)), np.zeros((size, columns)), np.zeros(size)
        Huu, gu, count = np.zeros((columns, columns)), np.zeros(columns), 0
        for rows in self._rows:
            a, b = rows.scans
            at = np.concatenate([np.arange(6 * a, 6 * a + 6), np.arange(6 * b, 6 * b + 6)])
            weighted = rows.weights[:, None] * rows.of_poses
            Hpp[np.ix_(at, at)] += weighted.T @ rows.of_poses
            Hpu[at] += weighted.T @ rows.of_times
            gp[at] -= weighted.T @ rows.residuals
            weighted = rows.weights[:, None] * rows.of_times
            Huu += weighted.T @ rows.of_times
            gu -= weighted.T @ rows.residuals
            count += len(rows.residuals)
        Hpp[:6, :6] += 1e9 * np.eye(6)
        Hpp[np.diag_indices(size)] += _DAMPING
        toward = np.linalg.solve(Hpp, np.column_stack([Hpu, gp]))
        toward = np.asarray(toward, np.float64)
        back = (np.asarray(-toward[:, :-1], np.float64), np.asarray(toward[:, -1], np.float64))
        return Normal(Huu - Hpu.T @ toward[:, :-1], gu - Hpu.T @ toward[:, -1], back, count)


_DIRECTION = 3
"""Sectors of a direction: what a vehicle in front fills."""
_MANY = 10.0
"""Matches from which on a cell's mean residual tells its error rather than theirs."""
_DAMPING = 1e-3
"""Keeps poses where nothing is matched; a match counts about 1."""


def _surfaces(points: FloatArray, config: SweepWindowConfig) -> _Surfaces:
    """Flat patches among points (n, 3), and of them evenly spread ones of every direction to ask about."""
    if len(points) > config.neighbours:
        thinned = small_gicp.voxelgrid_sampling(small_gicp.PointCloud(points), config.voxel_m)
        points = np.asarray(thinned.points())[:, :3].copy()
    if len(points) <= config.neighbours:
        return _Surfaces(*(np.zeros((0, 3)),) * 2, np.zeros(0), *(np.zeros(0, np.intp),) * 2)
    _, near = cKDTree(points).query(points, k=config.neighbours)
    around = points[near] - points[near].mean(axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))
    width = np.sqrt(np.maximum(values, 1e-12))
    flat = (width[:, 0] < config.flatness * width[:, 1]) & (width[:, 1] > config.breadth * width[:, 2])
    points, normals = points[flat], vectors[flat][:, :, 0]
    # All towards the sensor: what matches of one surface share is to have one sign.
    normals = normals * -np.sign(np.einsum("ij,ij->i", normals, points))[:, None]
    azimuths = np.arctan2(points[:, 1], points[:, 0])
    sectors = np.minimum((turned(azimuths, -np.pi) * SECTORS).astype(np.intp), SECTORS - 1)
    return _Surfaces(points, normals, azimuths, sectors, _varied(normals, config.points_a_way))


def _varied(normals: FloatArray, most: int) -> IndexArray:
    """Of patches with normals (n, 3): at most so many of each direction, level ones being one more."""
    way = np.mod(np.arctan2(normals[:, 1], normals[:, 0]), np.pi) / np.pi * _WAYS
    way = np.where(np.abs(normals[:, 2]) > _LEVEL, _WAYS, np.minimum(way.astype(np.intp), _WAYS - 1))
    return np.concatenate([_spread(way == k, most) for k in range(_WAYS + 1)])


_LEVEL = 0.8
"""A surface whose normal's height is more than this is level."""
_WAYS = 12
"""Directions of normals in the horizontal plane that are told apart."""


def _spread(chosen: NDArray[np.bool_], most: int) -> IndexArray:
    """At most so many of the places where an array is True, evenly spread."""
    found = np.flatnonzero(chosen)
    return found if len(found) <= most else found[np.linspace(0, len(found) - 1, most).astype(np.intp)]


def _groups(cells: IndexArray) -> tuple[IndexArray, IndexArray]:
    """The order that puts equal cells together, and where in it each cell begins."""
    order = np.argsort(cells, kind="stable")
    ordered = cells[order]
    return order, np.flatnonzero(np.concatenate([[True], ordered[1:] != ordered[:-1]]))


def _odometry(scans: Sequence[Scan]) -> tuple[bool, list[FloatArray]]:
    """Whether every scan could be registered, and the poses (4, 4) as if all points shared one instant."""
    odometry = LidarOdometry(LidarOdometryConfig())
    poses, ok = [np.eye(4)], True
    odometry.add(scans[0])
    for scan in scans[1:]:
        motion = odometry.add(scan)
        ok &= motion is not None and motion.ok
        poses.append(np.asarray(odometry.pose.matrix()))
    return ok, poses


def _orthonormal(matrix: FloatArray) -> FloatArray:
    return np.asarray(gtsam.Pose3(gtsam.Rot3.ClosestTo(matrix[:3, :3]), matrix[:3, 3]).matrix())

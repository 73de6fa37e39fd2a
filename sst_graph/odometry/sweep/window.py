"""Scans of one part of a drive, registered to one another with the times of their points unknown.

Point to plane, r = n . (X_b p_b(t_b) - X_a p_a(t_a)), between scans near and far in time, over all poses X at
once. A point's time after its stamp is t = T u(azimuth); u has one column for a turn that begins behind and
one for each sector. With the poses eliminated, the normal equations over these columns give the cost of any
share f of the sweep, either sense of rotation and any start of the turn.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property

import gtsam
import numpy as np
import small_gicp
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from sst_graph.factors.motion import cross, cross_rows
from sst_graph.odometry.cloud import compensate_sweep, scatter, usable_points
from sst_graph.odometry.lidar import GROUND_CLASSES, TESTED_CLASSES, LidarOdometry, orthonormal
from sst_graph.odometry.static_points import on_static_objects
from sst_graph.points import transformed_by
from sst_graph.sampling import spread_places
from sst_graph.spread import robust_sigma
from sst_graph.sweep_timing import turned
from sst_graph.types import FloatArray, Scan

IndexArray = NDArray[np.intp]

SECTORS = 72
"""Sectors of azimuth at whose borders a turn may begin."""


_NEAR_M, _FAR_M = 2.5, 45.0
"""Ranges between which points are used [m]."""
_MAX_POINTS = 40_000
"""Most points of a scan that are read."""
_VOXEL_M = 0.12
"""Edge of the voxels of which one point is kept [m]."""
_NEIGHBOURS = 9
"""Points from which a surface's normal is estimated."""
_MAX_THICKNESS_RATIO, _MIN_WIDTH_RATIO = 0.3, 0.25
"""Planarity: a patch is a surface where its thickness is below this share of its width, and its width above
this share of its length (square roots of the scatter matrix's eigenvalues)."""
_POINTS_PER_DIRECTION = 200
"""Most points of a scan that are matched, of each direction of their normals."""
_INTERVALS = (1, 4, 8)
"""Scans are matched with those so many later."""
_GATES_M = (1.0, 0.8, 0.6, 0.5, 0.4)
"""Farthest match, iteration by iteration; the last one stays [m]."""
_SCALES_M = (0.4, 0.3, 0.2, 0.12, 0.08)
"""Scale of the robust kernel, iteration by iteration; the last one stays [m]."""
ANNEALING = len(_GATES_M)
"""Iterations until the gate and the scale stay."""
_CELL_M = 3.0
"""Edge of the cells of the ground plan: level surfaces of one cell share an error, and so do all its others;
errors are independent from cell to cell [m]."""
_STATIC_M = 0.3
"""Farthest that points of a static object lie from those of another scan: twice odometry's, for points are
not compensated yet [m]."""
_MISSING_M = 1.1
"""Longest part of a static object that is not found in another scan, a quarter of a car [m]."""
_MIN_NORMAL_COSINE = 0.8
"""Surfaces are matched where the cosine between their normals is larger."""


@dataclass(frozen=True)
class _Surfaces:
    """Surface points of one scan: positions and normals (n, 3), azimuths (n,) [rad], sectors (n,), and the
    indices of those that are matched to other scans."""

    points: FloatArray
    normals: FloatArray
    azimuths: FloatArray
    sectors: IndexArray
    chosen: IndexArray

    @cached_property
    def behind(self) -> FloatArray:
        """(n,) share of a turn that begins behind, from its middle to the azimuths, -0.5 to 0.5."""
        return turned(self.azimuths, -np.pi) - 0.5


@dataclass(frozen=True)
class _PosedScan:
    """Surface points of one scan under a timing: (n, 3) in the LiDAR frame at the stamp [m], a tree of them
    in the window's frame, and the LiDAR's twist (6,) [rad/s, m/s]."""

    points: FloatArray
    tree: cKDTree
    twist: FloatArray


@dataclass(frozen=True)
class Normal:
    """Normal equations H u = g over the columns of the times, poses eliminated, in units of 1/m^2 residuals.

    Attributes:
        H, g: (1 + SECTORS, 1 + SECTORS) and (1 + SECTORS,).
        back: (6 n, 1 + SECTORS) and (6 n,): the poses' step is back[0] @ u + back[1]; a window's own.
    """

    H: FloatArray
    g: FloatArray
    back: tuple[FloatArray, FloatArray] = field(repr=False)


@dataclass(frozen=True)
class _Matches:
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
    """

    own: float
    shared: float


class SweepWindow:
    """Scans of a part of the drive, and their poses."""

    def __init__(self, scans: Sequence[Scan], period_s: float) -> None:
        """scans: in the order of their stamps; period_s: duration of a turn [s]."""
        self.period_s = period_s
        self._intervals: tuple[int, ...] = _INTERVALS
        self._stamps_s = np.array([(scan.stamp_ns - scans[0].stamp_ns) * 1e-9 for scan in scans])
        self.ok, self._poses = _odometry(scans)
        self._surfaces = [_surfaces(points) for points in self._static_points(scans)]
        self._matches: list[_Matches] = []

    def thinned(self, scans: int, points_per_direction: int) -> SweepWindow:
        """The first scans of the window, matched to the next two only, with fewer points."""
        few = self.copy()
        few._intervals = (1, 2)
        few._stamps_s, few._poses = self._stamps_s[:scans], self._poses[:scans]
        few._surfaces = [
            replace(surfaces, chosen=_of_every_direction(surfaces.normals, points_per_direction))
            for surfaces in self._surfaces[:scans]
        ]
        return few

    def copy(self) -> SweepWindow:
        """A window of these scans, whose poses move apart from this one's."""
        other = copy(self)
        other._poses, other._matches = list(self._poses), []
        return other

    def _static_points(self, scans: Sequence[Scan]) -> list[FloatArray]:
        """Points of each scan on the ground and static objects (in its LiDAR frame) [m]."""
        found = []
        parts = [usable_points(scan, _NEAR_M, _FAR_M, _MAX_POINTS)[:2] for scan in scans]
        world = [transformed_by(pose, points) for (points, _), pose in zip(parts, self._poses, strict=True)]
        raised = [np.isin(classes, GROUND_CLASSES, invert=True) for _, classes in parts]
        for k, (points, classes) in enumerate(parts):
            # An object is static if it is where it is in a scan a third of the window earlier or later.
            kept = np.isin(classes, TESTED_CLASSES, invert=True)
            tested = np.flatnonzero(~kept)
            for other in (k - len(scans) // 3, k + len(scans) // 3):
                if 0 <= other < len(scans):
                    there = world[other][raised[other]]
                    kept[tested] |= on_static_objects(world[k][tested], there, _STATIC_M, _MISSING_M)
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
        gate = _GATES_M[min(number, len(_GATES_M) - 1)]
        scale = _SCALES_M[min(number, len(_SCALES_M) - 1)]
        posed = []
        for surfaces, twist, pose in zip(self._surfaces, self.twists, self._poses, strict=True):
            share = turned(surfaces.azimuths, start_rad) - 0.5
            points = compensate_sweep(surfaces.points, fraction * self.period_s * share, twist)
            world = transformed_by(pose, points)
            # For few queries: balancing it takes longer than they do.
            posed.append(_PosedScan(points, cKDTree(world, balanced_tree=False, compact_nodes=False), twist))
        count = len(self._poses)
        self._matches = [
            self._matched(a, a + interval, posed, gate, scale)
            for interval in self._intervals
            for a in range(count - interval)
        ]
        return self._eliminated()

    def move(self, normal: Normal, u: FloatArray) -> None:
        """Move the poses by the step that goes with a step (1 + SECTORS,) of the times."""
        steps = (normal.back[0] @ u + normal.back[1]).reshape(-1, 6)
        self._poses = [
            np.asarray((gtsam.Pose3(orthonormal(pose)) * gtsam.Pose3.Expmap(step)).matrix())
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
        for rows in self._matches:
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
            shape = len(first), len(order)
            members = csr_array((np.ones(len(order)), order, np.append(first, len(order))), shape=shape)
            return SurfaceSums(*(members @ values for values in stacked))

        directions = np.concatenate([rows.directions for rows in self._matches])
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
        many = amount > _MIN_WEIGHT
        spread = robust_sigma(shared[many])
        total = max(float(amount.sum()), 1e-9)
        return Errors(max(around / total, 1e-12), spread**2)

    @property
    def has_matches(self) -> bool:
        """Whether any point met a surface."""
        return any(len(rows.residuals) for rows in self._matches)

    def _stacked(self) -> tuple[IndexArray, FloatArray, FloatArray]:
        """Cells, weights and residuals of all matches."""
        return (
            np.concatenate([rows.cells for rows in self._matches]),
            np.concatenate([rows.weights for rows in self._matches]),
            np.concatenate([rows.residuals for rows in self._matches]),
        )

    def missed(self) -> FloatArray:
        """(pairs of scans,) chosen points of each pair that lie on no surface, by the robust kernel."""
        scale = _SCALES_M[-1]
        near = [float((1.0 / (1.0 + (rows.residuals / scale) ** 2)).sum()) for rows in self._matches]
        chosen = [len(self._surfaces[rows.scans[1]].chosen) for rows in self._matches]
        return np.array(chosen, np.float64) - near

    def _matched(self, a: int, b: int, posed: Sequence[_PosedScan], gate: float, scale: float) -> _Matches:
        """Points of scan b matched to surfaces of scan a."""
        Ra, Rb = self._poses[a][:3, :3], self._poses[b][:3, :3]
        chosen = self._surfaces[b].chosen
        wBs = posed[b].tree.data
        distance, nearest = posed[a].tree.query(wBs[chosen], distance_upper_bound=gate)
        found = np.isfinite(distance)
        kept, nearest = chosen[found], nearest[found]
        normals = self._surfaces[a].normals[nearest] @ Ra.T
        others = self._surfaces[b].normals[kept] @ Rb.T
        cosine = np.einsum("ij,ij->i", normals, others)
        alike = np.abs(cosine) > _MIN_NORMAL_COSINE
        kept, nearest, cosine = kept[alike], nearest[alike], cosine[alike]
        # The mean of both: where patches end, errors of one normal are in residual and Jacobian alike, and
        # pull every point towards the middle of its patch.
        normals = normals[alike] + np.sign(cosine)[:, None] * others[alike]
        normals /= np.sqrt(2.0 + 2.0 * np.abs(cosine))[:, None]
        wAs = posed[a].tree.data[nearest]
        residuals = np.einsum("ij,ij->i", normals, wBs[kept] - wAs)
        weights = 1.0 / (1.0 + (residuals / scale) ** 2) ** 2
        of_poses, of_times = np.zeros((len(kept), 12)), np.zeros((len(kept), 1 + SECTORS))
        row = np.arange(len(kept))
        for scan, index, R, sign, at in ((a, nearest, Ra, -1.0, 0), (b, kept, Rb, 1.0, 6)):
            points, own = posed[scan].points.take(index, axis=0), sign * (normals @ R)
            of_poses[:, at : at + 3] = cross(points.T, own.T).T
            of_poses[:, at + 3 : at + 6] = own
            rate = cross_rows(posed[scan].twist[:3], points) + posed[scan].twist[3:]
            per_turn = self.period_s * np.einsum("ij,ij->i", own, rate)
            surfaces = self._surfaces[scan]
            of_times[:, 0] += per_turn * surfaces.behind[index]
            of_times[row, 1 + surfaces.sectors[index]] += per_turn
        level = np.abs(normals[:, 2]) > _LEVEL
        cells = np.floor(wAs[:, :2] / _CELL_M).astype(np.int64) + 2**20
        number = 2 * (cells[:, 0] * 2**22 + cells[:, 1]) + level
        directions = self._surfaces[b].sectors[kept] // _SECTORS_PER_VIEW
        return _Matches((a, b), residuals, weights, of_poses, of_times, number, directions)

    def _eliminated(self) -> Normal:
        """Normal equations of all rows with the poses, of which the first stays, eliminated."""
        size, columns = 6 * len(self._poses), 1 + SECTORS
        Hpp, Hpu, gp = np.zeros((size, size)), np.zeros((size, columns)), np.zeros(size)
        Huu, gu = np.zeros((columns, columns)), np.zeros(columns)
        for rows in self._matches:
            a, b = rows.scans
            at = np.concatenate([np.arange(6 * a, 6 * a + 6), np.arange(6 * b, 6 * b + 6)])
            weighted = rows.weights[:, None] * rows.of_poses
            Hpp[np.ix_(at, at)] += weighted.T @ rows.of_poses
            Hpu[at] += weighted.T @ rows.of_times
            gp[at] -= weighted.T @ rows.residuals
            weighted = rows.weights[:, None] * rows.of_times
            Huu += weighted.T @ rows.of_times
            gu -= weighted.T @ rows.residuals
        Hpp[:6, :6] += 1e9 * np.eye(6)
        Hpp[np.diag_indices(size)] += _DAMPING
        toward = np.linalg.solve(Hpp, np.column_stack([Hpu, gp]))
        toward = np.asarray(toward, np.float64)
        back = (np.asarray(-toward[:, :-1], np.float64), np.asarray(toward[:, -1], np.float64))
        return Normal(Huu - Hpu.T @ toward[:, :-1], gu - Hpu.T @ toward[:, -1], back)


_SECTORS_PER_VIEW = 3
"""Sectors of a direction from the LiDAR: 15 degrees, what a vehicle in front fills."""
_MIN_WEIGHT = 10.0
"""Sum of weights from which on a cell's mean residual is the error that its matches share, not their
noise."""
_DAMPING = 1e-3
"""Added to the diagonal of the poses' information, for scans without matches; a match counts about 1."""


def _surfaces(points: FloatArray) -> _Surfaces:
    """Planar patches among points (n, 3), and evenly spread ones of every direction among them."""
    if len(points) > _NEIGHBOURS:
        thinned = small_gicp.voxelgrid_sampling(small_gicp.PointCloud(points), _VOXEL_M)
        points = np.asarray(thinned.points())[:, :3].copy()
    if len(points) <= _NEIGHBOURS:
        return _Surfaces(*(np.zeros((0, 3)),) * 2, np.zeros(0), *(np.zeros(0, np.intp),) * 2)
    near = np.asarray(small_gicp.KdTree(points).batch_knn_search(points, _NEIGHBOURS)[0], np.intp)
    values, vectors = np.linalg.eigh(scatter(points, near))
    width = np.sqrt(np.maximum(values, 1e-12))
    flat = (width[:, 0] < _MAX_THICKNESS_RATIO * width[:, 1]) & (width[:, 1] > _MIN_WIDTH_RATIO * width[:, 2])
    points, normals = points[flat], vectors[flat][:, :, 0]
    # All towards the sensor: what matches of one surface share is to have one sign.
    normals = normals * -np.sign(np.einsum("ij,ij->i", normals, points))[:, None]
    azimuths = np.arctan2(points[:, 1], points[:, 0])
    chosen = _of_every_direction(normals, _POINTS_PER_DIRECTION)
    return _Surfaces(points, normals, azimuths, sectors_of(azimuths), chosen)


def sectors_of(azimuths_rad: FloatArray) -> IndexArray:
    """Sectors (n,) of azimuth, the first one behind."""
    return np.minimum((turned(azimuths_rad, -np.pi) * SECTORS).astype(np.intp), SECTORS - 1)


def _of_every_direction(normals: FloatArray, most: int) -> IndexArray:
    """Some of the patches with normals (n, 3): at most so many of each direction, level being one more."""
    number = np.mod(np.arctan2(normals[:, 1], normals[:, 0]), np.pi) / np.pi * _DIRECTIONS
    upright = np.minimum(number.astype(np.intp), _DIRECTIONS - 1)
    direction = np.where(np.abs(normals[:, 2]) > _LEVEL, _DIRECTIONS, upright)
    along = [np.flatnonzero(direction == k) for k in range(_DIRECTIONS + 1)]
    return np.concatenate([spread_places(places, most) for places in along])


_LEVEL = 0.8
"""A surface whose normal's height is more than this is level."""
_DIRECTIONS = 12
"""Directions of normals in the horizontal plane that are distinguished."""


def _groups(cells: IndexArray) -> tuple[IndexArray, IndexArray]:
    """The order that puts equal cells together, and where in it each cell begins."""
    order = np.argsort(cells, kind="stable")
    ordered = cells[order]
    starts = np.append(True, ordered[1:] != ordered[:-1])[: len(cells)]
    return order, np.flatnonzero(starts)


def _odometry(scans: Sequence[Scan]) -> tuple[bool, list[FloatArray]]:
    """Whether every scan could be registered, and the poses (4, 4) as if all points shared one instant."""
    odometry = LidarOdometry()
    poses, ok = [np.eye(4)], True
    odometry.add(scans[0])
    for scan in scans[1:]:
        motion = odometry.add(scan)
        ok &= motion is not None and motion.ok
        poses.append(np.asarray(odometry.pose.matrix()))
    return ok, poses

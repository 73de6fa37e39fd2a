"""LiDAR odometry: each scan registered to a local map of Gaussian voxels by small_gicp."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
import small_gicp
from numpy.typing import NDArray

from sst_graph.config import Settings, setting
from sst_graph.errors import DataError
from sst_graph.factors.motion import cross_rows
from sst_graph.odometry.cloud import (
    FEWEST_POINTS,
    compensate_sweep,
    registration_cloud,
    surfaces,
    usable_points,
)
from sst_graph.odometry.local_map import LocalMap, MappedCloud
from sst_graph.odometry.static_points import StaticPoints
from sst_graph.points import transformed_by
from sst_graph.types import FloatArray, RelativeMotion, Scan, SemanticClass

MOVABLE_CLASSES = (SemanticClass.VEHICLE, SemanticClass.PERSON, SemanticClass.TWO_WHEELER)
"""Classes whose members may move by themselves."""
TESTED_CLASSES = (*MOVABLE_CLASSES, SemanticClass.OBJECT)
"""Classes of objects that may move. Odometry registers OBJECT, which is most of what stands still, too."""
GROUND_CLASSES = (SemanticClass.GROUND, SemanticClass.TERRAIN)
"""Classes of points on the ground."""
_MOVABLE = np.isin(np.arange(256), MOVABLE_CLASSES)
"""Whether a label is one of them."""
_MIN_VOXEL_M, _MAX_VOXEL_M = 0.1, 1.0
"""Limits between which the voxels' edge is adapted from scan to scan [m]."""
_TARGET_POINTS = 3000
"""Number of registered points that the adaptation aims at; the time of a registration grows with it."""
_MAP_VOXEL_M = 0.4
"""Edge of the Gaussian voxels of the local map [m]."""
_MAP_AGE = 20
"""Scans after which a voxel that was not seen again leaves the map."""
_MAX_POINTS = 40_000
"""Most points of a scan that are read."""
_MIN_POINTS = 200
"""Fewest points that are registered; else movable classes are kept, or the scan fails."""
_NEIGHBOURS = 6
"""Points from which the covariance of a surface patch is estimated."""
PLANE_RATIO = 0.5
"""Most points of the main surface (ground), per point of another direction."""
_MAX_DISTANCE_M = 1.0
"""Farthest pair of a point and a voxel [m]."""
_MAX_ITERATIONS = 30
"""Most Gauss-Newton steps of a registration; it stops where a step is below 1e-4 rad and 5e-4 m."""
_SEARCH_M = 3.0
"""Where the speed is unknown (first pair, or after a failure), starts shifted this far in the LiDAR's
horizontal plane, in eight directions, are tried, too [m]: 30 m/s at 10 Hz."""
_SEARCH_DISTANCE_M, _SEARCH_ITERATIONS = 2.0, 10
"""Farthest pair of two points in this search [m], and Gauss-Newton steps from each start."""
_SEARCH_VOXELS = 4.0
"""Edge of the voxels of which one point is registered in this search, in edges of the usual ones."""
_MISSED_COST = 1.0
"""What a point without a voxel to pair with costs in the choice among starts; a pair costs its squared,
whitened residual."""
_MIN_INLIER_RATIO = 0.3
"""A registration with fewer points paired than this fraction has failed."""
_FASTEST_RADPS, _FASTEST_MPS = 10.0, 100.0
"""No vehicle turns or drives faster. A scan that shows next to nothing (a single line) can be registered in
any pose, and a prediction from that one misses all that follows, at ten seconds a scan."""
_STAMPS_JITTER_S = 0.1
"""Scans stamped on arrival may be so much farther apart than their stamps say."""
_COMPENSATIONS = 3
"""Most registrations of one scan while its sweep compensation converges."""
_CONVERGED_M = 5e-3
"""Sweep compensation has converged where another pass would move no point farther than this [m]."""
_INFLATION = 2.0
"""Factor on the sigmas of the registration's own covariance, for pairs are correlated."""
FLOOR_RAD, FLOOR_M = 1e-4, 2e-3
"""Sigmas added to every motion for what the registration cannot know [rad, m]."""
FAILED_RAD, FAILED_M = 0.1, 2.0
"""Sigmas of a motion that was only predicted [rad, m]."""


@dataclass(frozen=True)
class LidarOdometryConfig(Settings):
    """Which points are registered."""

    voxel_m: float = setting(
        0.2,
        at_least=0.02,
        at_most=10.0,
        doc="Voxel size of the first scan in LiDAR odometry; later ones adapt. Larger for open "
        "country, smaller indoors.",
    )
    near_m: float = setting(
        1.0,
        at_least=0.0,
        at_most=100.0,
        doc="Nearest range of the points that LiDAR odometry uses. Raise it above the size of the own"
        " vehicle.",
    )
    far_m: float = setting(
        100.0,
        at_least=1.0,
        at_most=300.0,
        doc="Farthest range of the points that LiDAR odometry uses. Lower it for short-range LiDARs "
        "with noisy far returns.",
    )

    def __post_init__(self) -> None:
        self.expect_at_most("near_m", self.far_m, "far_m")


class LidarOdometry:
    """Motion of the LiDAR, scan by scan."""

    def __init__(self, config: LidarOdometryConfig | None = None) -> None:
        self.config = config or LidarOdometryConfig()
        self._map: LocalMap | None = None
        self._mapped: deque[MappedCloud] = deque(maxlen=_MAP_AGE)
        self._clouds = 0
        self._static = StaticPoints()
        self._last: Scan | None = None
        self._wTl = np.eye(4)
        self._twist: FloatArray | None = None
        self._covariance = np.zeros((6, 6))
        self._voxel_m = self.config.voxel_m
        self._lost = True
        self._split: tuple[Scan, _Sweep, _Sweep] | None = None

    @property
    def pose(self) -> gtsam.Pose3:
        """Pose of the last scan in the first scan's frame."""
        return gtsam.Pose3(self._wTl)

    def add(self, scan: Scan) -> RelativeMotion | None:
        """Motion from the scan before to this one; None for the first.

        Raises:
            DataError: the scan is not later than the one before.
        """
        last, self._last = self._last, scan
        if last is None:
            self._restart_map(scan)
            return None
        seconds = (scan.stamp_ns - last.stamp_ns) * 1e-9
        if seconds <= 0.0:
            self._last = last
            raise DataError("LiDAR odometry", f"a scan {seconds:.6f} s after the one before", "rising stamps")
        # 1. Constant velocity predicts; registration to the map corrects.
        registration = self._register(scan, seconds)
        if self._twist is None and last.offsets_s is not None:
            # 2. Only now is the first scan's own sweep known: rebuild the map and register again.
            for _ in range(_COMPENSATIONS):
                if registration is None:
                    break
                self._twist, self._lost = registration.twist, False
                self._restart_map(last)
                registration = self._register(scan, seconds)
        # 3. The map grows, or starts again where the registration failed.
        return self._advance(last, scan, registration)

    def _register(self, scan: Scan, seconds: float) -> _Registration | None:
        """Pose of the scan in the map, its sweep compensated by its own motion; None where it fails."""
        wTl = self._wTl @ _exp(self._twist, seconds)
        if self._lost:
            wTl = self._best_start(self._parts(scan)[0].at_stamp(self._twist), wTl)
        twist: FloatArray | None = self._twist
        static, movable = self._parts(scan)
        for _ in range(_COMPENSATIONS):
            points, others = static.at_stamp(twist), movable.at_stamp(twist)
            # Static objects of movable classes (parked cars) help where there is little else.
            parked = self._static.find(transformed_by(wTl, others), scan.stamp_ns)
            found = self._align(np.concatenate([points, others[parked]]), wTl, seconds)
            if found is None or scan.offsets_s is None or not scan.offsets_s.any():
                return found
            if twist is not None and _farthest_move(static, found.twist - twist) < _CONVERGED_M:
                return found
            wTl, twist = found.wTl, found.twist
        return found

    def _best_start(self, points: FloatArray, wTl: FloatArray) -> FloatArray:
        """The pose from which registration goes best, among shifts of the predicted one all around it.

        With nothing known of the speed, registration to the map ends in the nearest of many local minima, and
        where rings are far apart in that of no motion: what lies between the map's rings has no voxel. So the
        cloud is registered to the points of the last one.
        """
        if not self._mapped or len(points) < _MIN_POINTS:
            return wTl
        cloud = registration_cloud(points, _SEARCH_VOXELS * self._voxel_m, _NEIGHBOURS, PLANE_RATIO)
        _, last, wTlast = self._mapped[-1]
        if min(last.size(), cloud.size()) < FEWEST_POINTS:
            return wTl
        tree = small_gicp.KdTree(last)
        predicted = np.linalg.inv(wTlast) @ wTl
        best, least = wTl, np.inf
        for shift in _shifts():
            start = predicted.copy()
            start[:3, 3] += predicted[:3, :3] @ shift
            result = small_gicp.align(
                last,
                cloud,
                tree,
                start,
                max_correspondence_distance=_SEARCH_DISTANCE_M,
                num_threads=1,
                max_iterations=_SEARCH_ITERATIONS,
            )
            found = np.asarray(result.T_target_source)
            missed = cloud.size() - result.num_inliers
            misfit = (2.0 * result.error + _MISSED_COST * missed) / cloud.size()
            if np.isfinite(found).all() and misfit < least:
                best, least = wTlast @ orthonormal(found), misfit
        return best

    def _registered(
        self, cloud: small_gicp.PointCloud, wTl: FloatArray
    ) -> small_gicp.RegistrationResult | None:
        """A cloud registered to the map from a start; None where either has too few points."""
        assert self._map is not None
        target = self._map.with_all(self._mapped)
        if min(target.size(), cloud.size()) < FEWEST_POINTS:
            return None
        return small_gicp.align(
            target,
            cloud,
            wTl,
            max_correspondence_distance=_MAX_DISTANCE_M,
            num_threads=1,
            max_iterations=_MAX_ITERATIONS,
            rotation_epsilon=1e-4,
            translation_epsilon=5e-4,
        )

    def _align(self, points: FloatArray, wTl: FloatArray, seconds: float) -> _Registration | None:
        """Points (n, 3) registered to the map from a start; None where that fails."""
        if self._map is None or len(points) < _MIN_POINTS:
            return None
        cloud = registration_cloud(points, self._voxel_m, _NEIGHBOURS, PLANE_RATIO)
        result = self._registered(cloud, wTl)
        if result is None:
            return None
        found = np.asarray(result.T_target_source)
        if not np.isfinite(found).all() or result.num_inliers < _MIN_INLIER_RATIO * cloud.size():
            return None
        found = orthonormal(found)
        step = _log(np.linalg.inv(self._wTl) @ found)
        turned, moved = np.linalg.norm(step.reshape(2, 3), axis=1) / max(seconds, _STAMPS_JITTER_S)
        if turned > _FASTEST_RADPS or moved > _FASTEST_MPS:
            return None
        return _Registration(found, cloud, step / seconds, registration_covariance(result))

    def _advance(self, last: Scan, scan: Scan, registration: _Registration | None) -> RelativeMotion:
        """Go on to the registered pose, or the predicted one; the motion since the last scan."""
        if registration is None or self._map is None:
            step = _exp(self._twist, (scan.stamp_ns - last.stamp_ns) * 1e-9)
            self._wTl = self._wTl @ step
            self._covariance = np.zeros((6, 6))
            self._restart_map(scan)
            covariance = np.diag(np.repeat([FAILED_RAD, FAILED_M], 3) ** 2)
        else:
            step = np.linalg.inv(self._wTl) @ registration.wTl
            self._wTl, self._twist = registration.wTl, registration.twist
            self._insert(registration.cloud)
            self._after_registration(scan, registration.cloud.size())
            bHa = gtsam.Pose3(step).inverse().AdjointMap()
            floor = np.repeat([FLOOR_RAD, FLOOR_M], 3) ** 2
            covariance = registration.covariance + bHa @ self._covariance @ bHa.T + np.diag(floor)
            self._covariance = registration.covariance
        ok = registration is not None
        self._lost = not ok
        return RelativeMotion(last.stamp_ns, scan.stamp_ns, gtsam.Pose3(step), covariance, ok)

    def _after_registration(self, scan: Scan, registered: int) -> None:
        """Keep the movable objects for later comparison, and adapt the voxels to the number registered."""
        movable = self._parts(scan)[1].at_stamp(self._twist)
        self._static.insert(transformed_by(self._wTl, movable), scan.stamp_ns)
        edge = self._voxel_m * np.sqrt(registered / _TARGET_POINTS)
        self._voxel_m = float(np.clip(edge, _MIN_VOXEL_M, _MAX_VOXEL_M))

    def _restart_map(self, scan: Scan) -> None:
        """Drop the map and start a new one with a scan at the current pose."""
        points = self._parts(scan)[0].at_stamp(self._twist)
        self._map = None
        self._mapped.clear()
        if len(points) >= _MIN_POINTS:
            self._map = LocalMap(_MAP_VOXEL_M, _MAP_AGE)
            self._insert(registration_cloud(points, self._voxel_m, _NEIGHBOURS, PLANE_RATIO))

    def _insert(self, cloud: small_gicp.PointCloud) -> None:
        """Put a cloud into the map at the current pose."""
        self._mapped.append((self._clouds, cloud, self._wTl.copy()))
        self._clouds += 1

    def rebuild_map(self) -> None:
        """Build the map of the latest scans alone, as it is built after a restore."""
        self._map = LocalMap(_MAP_VOXEL_M, _MAP_AGE) if self._mapped else None

    def __getstate__(self) -> dict[str, Any]:
        """All but the map and the last scan's parts; of the scans in the map, points and poses."""
        points = [(n, np.asarray(cloud.points())[:, :3], wTl) for n, cloud, wTl in self._mapped]
        return {**vars(self), "_map": None, "_split": None, "_mapped": points}

    def __setstate__(self, state: Mapping[str, Any]) -> None:
        vars(self).update(state)
        clouds = [(n, surfaces(points, _NEIGHBOURS), wTl) for n, points, wTl in state["_mapped"]]
        self._mapped = deque(clouds, maxlen=_MAP_AGE)
        self.rebuild_map()

    def _parts(self, scan: Scan) -> tuple[_Sweep, _Sweep]:
        """Static classes and movable ones; the latter count as static where too little else is left."""
        config = self.config
        if self._split is not None and self._split[0] is scan:
            return self._split[1:]
        points, classes, offsets = usable_points(scan, config.near_m, config.far_m, _MAX_POINTS)
        sweep, movable = _Sweep(points, offsets), _MOVABLE[classes]
        if np.count_nonzero(~movable) < _MIN_POINTS:
            movable[:] = False
        parts = sweep.take(np.flatnonzero(~movable)), sweep.take(np.flatnonzero(movable))
        self._split = (scan, *parts)
        return parts


def lidar_odometry(scans: Iterable[Scan], config: LidarOdometryConfig | None = None) -> list[RelativeMotion]:
    """Motions between consecutive scans: one fewer than scans.

    Raises:
        DataError: stamps do not rise.
    """
    odometry = LidarOdometry(config)
    return [motion for scan in scans if (motion := odometry.add(scan)) is not None]


@dataclass(frozen=True)
class _Sweep:
    """Points (n, 3) in the LiDAR frame at their own times [m]: (n,) after the stamp [s], or None, at it."""

    points: FloatArray
    offsets_s: FloatArray | None

    def take(self, index: NDArray[np.intp]) -> _Sweep:
        """Some of the points, by position."""
        # Rows are taken much faster by ``take`` than by an index.
        return _Sweep(
            self.points.take(index, axis=0), None if self.offsets_s is None else self.offsets_s[index]
        )

    def at_stamp(self, twist: FloatArray | None) -> FloatArray:
        """(n, 3) points in the LiDAR frame at the stamp [m]; as measured where no twist is known."""
        if twist is None or self.offsets_s is None:
            return self.points
        return compensate_sweep(self.points, self.offsets_s, twist)


@dataclass(frozen=True)
class _Registration:
    """One scan placed in the map.

    Attributes:
        wTl: (4, 4) pose of the scan in the map's frame.
        cloud: what was registered.
        twist: (6,) mean twist since the scan before [rad/s, m/s].
        covariance: (6, 6) of wTl, right perturbation.
    """

    wTl: FloatArray
    cloud: small_gicp.PointCloud
    twist: FloatArray
    covariance: FloatArray


def _farthest_move(sweep: _Sweep, twist: FloatArray) -> float:
    """Farthest that another twist, which differs by this one (6,), moves a point of a sweep [m]."""
    if sweep.offsets_s is None:
        return 0.0
    rates = cross_rows(twist[:3], sweep.points) + twist[3:]
    moves = sweep.offsets_s**2 * np.einsum("ij,ij->i", rates, rates)
    return float(np.sqrt(moves.max(initial=0.0)))


def registration_covariance(result: small_gicp.RegistrationResult) -> FloatArray:
    """(6, 6) inverse Hessian scaled by the residual; small_gicp perturbs [rot, trans] on the right."""
    variance = 2.0 * result.error / max(result.num_inliers - 6, 1)
    hessian = np.asarray(result.H) + 1e-6 * np.eye(6)
    return np.asarray(_INFLATION**2 * variance * np.linalg.inv(hessian))


def _shifts() -> list[FloatArray]:
    """Horizontal translations (3,) [m]: none first, then all around."""
    angles = np.arange(8) * (2.0 * np.pi / 8)
    around = _SEARCH_M * np.stack([np.cos(angles), np.sin(angles), np.zeros(8)], axis=1)
    return [np.zeros(3), *around]


def _exp(twist: FloatArray | None, seconds: float) -> FloatArray:
    """(4, 4) motion of a constant twist (none: standstill) over some seconds."""
    return np.eye(4) if twist is None else np.asarray(gtsam.Pose3.Expmap(twist * seconds).matrix())


def _log(matrix: FloatArray) -> FloatArray:
    """(6,) logarithm [rot, trans] of a (4, 4) motion."""
    return np.asarray(gtsam.Pose3.Logmap(gtsam.Pose3(matrix)))


def orthonormal(matrix: FloatArray) -> FloatArray:
    """The (4, 4) pose with its rotation made exact, so that products do not drift."""
    pose = gtsam.Pose3(gtsam.Rot3.ClosestTo(matrix[:3, :3]), matrix[:3, 3])
    return np.asarray(pose.matrix())

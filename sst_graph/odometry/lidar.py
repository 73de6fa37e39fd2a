"""LiDAR odometry: each scan registered to a local map of Gaussian voxels by small_gicp."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import gtsam
import numpy as np
import small_gicp
from numpy.typing import NDArray

from sst_graph.errors import DataError
from sst_graph.odometry.cloud import compensate_sweep, registration_cloud, usable_points
from sst_graph.types import RelativeMotion, Scan, SemanticClass

FloatArray = NDArray[np.float64]

MOVABLE_CLASSES = (SemanticClass.VEHICLE, SemanticClass.PERSON, SemanticClass.TWO_WHEELER)
"""Classes whose members may move by themselves."""


@dataclass(frozen=True)
class LidarOdometryConfig:
    """How scans are thinned, registered and trusted.

    Attributes:
        voxel_m: edge of the voxels of which one point is registered [m].
        map_voxel_m: edge of the Gaussian voxels of the local map [m].
        map_age: scans after which a voxel that was not seen again is forgotten.
        near_m, far_m: ranges between which points are used [m].
        max_points: most points of a scan that are looked at.
        min_points: fewest points that are registered; else movable classes are kept, or the scan fails.
        neighbours: points from which the covariance of a surface patch is estimated.
        plane_ratio: most points of the main surface (ground), per point of another direction.
        max_distance_m: farthest pair of a point and a voxel [m].
        max_iterations: Gauss-Newton steps of one registration.
        min_inlier_ratio: a registration with fewer points paired than this fraction has failed.
        compensations: most registrations of one scan while its sweep compensation settles.
        inflation: factor on the sigmas of the registration's own covariance, for pairs are correlated.
        floor_rad, floor_m: sigmas added to every motion for what the registration cannot know [rad, m].
        failed_rad, failed_m: sigmas of a motion that was only predicted [rad, m].
    """

    voxel_m: float = 0.2
    map_voxel_m: float = 0.4
    map_age: int = 20
    near_m: float = 1.0
    far_m: float = 100.0
    max_points: int = 60_000
    min_points: int = 200
    neighbours: int = 10
    plane_ratio: float = 1.0
    max_distance_m: float = 1.0
    max_iterations: int = 30
    min_inlier_ratio: float = 0.3
    compensations: int = 3
    inflation: float = 2.0
    floor_rad: float = 1e-4
    floor_m: float = 2e-3
    failed_rad: float = 0.1
    failed_m: float = 2.0


class LidarOdometry:
    """Motion of the LiDAR, scan by scan."""

    def __init__(self, config: LidarOdometryConfig | None = None) -> None:
        self.config = config or LidarOdometryConfig()
        self._map: small_gicp.GaussianVoxelMap | None = None
        self._last: Scan | None = None
        self._wTl = np.eye(4)
        self._twist: FloatArray | None = None
        self._covariance = np.zeros((6, 6))

    @property
    def pose(self) -> gtsam.Pose3:
        """Pose of the last scan in the first scan's frame."""
        return gtsam.Pose3(self._wTl)

    def add(self, scan: Scan) -> RelativeMotion | None:
        """Motion from the scan before to this one; None for the first.

        Raises:
            DataError: the scan is not later than the one before.
        """
        if self._last is None:
            self._last = scan
            self._restart_map(scan)
            return None
        seconds = (scan.stamp_ns - self._last.stamp_ns) * 1e-9
        if seconds <= 0.0:
            raise DataError("LiDAR odometry", f"a scan {seconds:.6f} s after the one before", "rising stamps")
        # 1. Constant velocity predicts; registration to the map corrects.
        registration = self._register(scan, seconds)
        if registration is not None and self._twist is None and self._last.offsets_s is not None:
            # 2. Only now is the first scan's own sweep known: build the map anew and register again.
            self._twist = registration.twist
            self._restart_map(self._last)
            registration = self._register(scan, seconds) or registration
        # 3. The map grows, or starts again where the registration failed.
        motion = self._advance(self._last, scan, registration)
        self._last = scan
        return motion

    def _register(self, scan: Scan, seconds: float) -> _Registration | None:
        """Pose of the scan in the map, its sweep compensated by its own motion; None where it fails."""
        config = self.config
        start = self._wTl @ _exp(self._twist, seconds)
        twist: FloatArray | None = self._twist
        for _ in range(config.compensations):
            cloud = self._cloud(scan, twist)
            if cloud is None or self._map is None:
                return None
            result = small_gicp.align(
                self._map,
                cloud,
                start,
                max_correspondence_distance=config.max_distance_m,
                num_threads=1,
                max_iterations=config.max_iterations,
                rotation_epsilon=1e-4,
                translation_epsilon=5e-4,
            )
            if not np.isfinite(result.T_target_source).all() or (
                result.num_inliers < config.min_inlier_ratio * cloud.size()
            ):
                return None
            start = _orthonormal(np.asarray(result.T_target_source))
            step = np.linalg.inv(self._wTl) @ start
            assumed, twist = twist, _log(step) / seconds
            if scan.offsets_s is None or (
                assumed is not None
                and np.abs(twist - assumed)[3:].max() * np.abs(scan.offsets_s).max(initial=0.0) < 2e-3
            ):
                break
        return _Registration(start, cloud, _log(step) / seconds, _registration_covariance(result, config))

    def _advance(self, last: Scan, scan: Scan, registration: _Registration | None) -> RelativeMotion:
        """Take the registered pose, or the predicted one, and answer the motion since the last scan."""
        config = self.config
        if registration is None or self._map is None:
            step = _exp(self._twist, (scan.stamp_ns - last.stamp_ns) * 1e-9)
            self._wTl = self._wTl @ step
            sigmas = np.repeat([config.failed_rad, config.failed_m], 3)
            self._covariance = np.zeros((6, 6))
            self._restart_map(scan)
            covariance = np.diag(sigmas**2)
        else:
            step = np.linalg.inv(self._wTl) @ registration.wTl
            self._wTl, self._twist = registration.wTl, registration.twist
            self._map.insert(registration.cloud, self._wTl)
            bHa = gtsam.Pose3(step).inverse().AdjointMap()
            floor = np.repeat([config.floor_rad, config.floor_m], 3) ** 2
            covariance = registration.covariance + bHa @ self._covariance @ bHa.T + np.diag(floor)
            self._covariance = registration.covariance
        ok = registration is not None
        return RelativeMotion(last.stamp_ns, scan.stamp_ns, gtsam.Pose3(step), covariance, ok)

    def _restart_map(self, scan: Scan) -> None:
        """Forget the map and begin it anew with a scan at the current pose."""
        config = self.config
        cloud = self._cloud(scan, self._twist)
        self._map = None
        if cloud is not None:
            self._map = small_gicp.GaussianVoxelMap(config.map_voxel_m)
            self._map.set_lru(config.map_age, max(1, config.map_age // 2))
            self._map.insert(cloud, self._wTl)

    def _cloud(self, scan: Scan, twist: FloatArray | None) -> small_gicp.PointCloud | None:
        """The scan's static points at its stamp, ready for registration; None where too few are left."""
        config = self.config
        points, classes, offsets = usable_points(scan, config.near_m, config.far_m, config.max_points)
        if offsets is not None and twist is not None:
            points = compensate_sweep(points, offsets, twist)
        still = ~np.isin(classes, MOVABLE_CLASSES)
        if np.count_nonzero(still) >= config.min_points:
            points = points[still]
        if len(points) < config.min_points:
            return None
        return registration_cloud(points, config.voxel_m, config.neighbours, config.plane_ratio)


def lidar_odometry(scans: Iterable[Scan], config: LidarOdometryConfig | None = None) -> list[RelativeMotion]:
    """Motions between consecutive scans: one fewer than scans.

    Raises:
        DataError: stamps do not rise.
    """
    odometry = LidarOdometry(config)
    return [motion for scan in scans if (motion := odometry.add(scan)) is not None]


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


def _registration_covariance(
    result: small_gicp.RegistrationResult, config: LidarOdometryConfig
) -> FloatArray:
    """(6, 6) inverse Hessian scaled by the residual; small_gicp perturbs [rot, trans] on the right."""
    variance = 2.0 * result.error / max(result.num_inliers - 6, 1)
    hessian = np.asarray(result.H) + 1e-6 * np.eye(6)
    return np.asarray(config.inflation**2 * variance * np.linalg.inv(hessian))


def _exp(twist: FloatArray | None, seconds: float) -> FloatArray:
    """(4, 4) motion of a constant twist (none: standstill) over some seconds."""
    return np.eye(4) if twist is None else np.asarray(gtsam.Pose3.Expmap(twist * seconds).matrix())


def _log(matrix: FloatArray) -> FloatArray:
    """(6,) logarithm [rot, trans] of a (4, 4) motion."""
    return np.asarray(gtsam.Pose3.Logmap(gtsam.Pose3(matrix)))


def _orthonormal(matrix: FloatArray) -> FloatArray:
    """The (4, 4) pose with its rotation made exact, so that products do not drift."""
    pose = gtsam.Pose3(gtsam.Rot3.ClosestTo(matrix[:3, :3]), matrix[:3, 3])
    return np.asarray(pose.matrix())

"""Registration of one scan to another: odometry from scan to scan, and loop closures.

Between consecutive scans the errors of such motions are independent, as a pose graph takes them to be;
those of :class:`sst_graph.odometry.LidarOdometry`, which registers to a map, are smaller and are not.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
import small_gicp
from numpy.typing import NDArray

from sst_graph.config import Settings, setting
from sst_graph.errors import DataError
from sst_graph.odometry.cloud import registration_cloud, usable_points
from sst_graph.odometry.lidar import MOVABLE_CLASSES
from sst_graph.types import RelativeMotion, Scan

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class RegistrationConfig(Settings):
    """How two scans are registered and trusted.

    Attributes:
        voxel_m: edge of the voxels of which one point is registered [m].
        near_m, far_m: ranges between which points are used [m].
        max_points: most points of a scan that are looked at.
        min_points: fewest points outside the movable classes; with fewer, those classes are kept.
        neighbours: points from which the covariance of a surface patch is estimated.
        plane_ratio: most points of the main surface (ground), per point of another direction.
        max_distance_m: farthest pair of two points [m].
        max_iterations: Gauss-Newton steps.
        min_inlier_ratio: a registration with fewer points paired than this fraction has failed.
        inflation: factor on the sigmas of the registration's own covariance, for pairs are correlated.
        floor_rad, floor_m: sigmas added for what the registration cannot know [rad, m].
        failed_rad, failed_m: sigmas of a motion that was only guessed [rad, m].
    """

    voxel_m: float = setting(0.3, at_least=0.02, at_most=10.0)
    near_m: float = setting(1.0, at_least=0.0, at_most=100.0)
    far_m: float = setting(100.0, at_least=1.0, at_most=300.0)
    max_points: int = setting(60_000, at_least=10, at_most=10_000_000)
    min_points: int = setting(200, at_least=10, at_most=1_000_000)
    neighbours: int = setting(10, at_least=5, at_most=100)
    plane_ratio: float = setting(0.5, at_least=0.0, at_most=1000.0)
    max_distance_m: float = setting(1.0, at_least=0.01, at_most=100.0)
    max_iterations: int = setting(40, at_least=1, at_most=1000)
    min_inlier_ratio: float = setting(0.3, at_least=0.0, at_most=1.0)
    inflation: float = setting(2.0, at_least=0.01, at_most=1000.0)
    floor_rad: float = setting(1e-4, at_least=0.0, at_most=10.0)
    floor_m: float = setting(2e-3, at_least=0.0, at_most=100.0)
    failed_rad: float = setting(0.1, at_least=0.0001, at_most=100.0)
    failed_m: float = setting(2.0, at_least=0.0001, at_most=1000.0)

    def __post_init__(self) -> None:
        self.expect_at_most("near_m", self.far_m, "far_m")


@dataclass(frozen=True)
class LoopConfig(Settings):
    """Which scans are tried as loop closures.

    Attributes:
        every: one scan out of so many is tried.
        min_seconds: least time between the two scans [s].
        max_distance_m: farthest between their poses as known before [m].
        min_inlier_ratio: a closure needs this fraction of its points paired.
    """

    every: int = setting(4, at_least=1, at_most=100_000)
    min_seconds: float = setting(2.0, at_least=0.001, at_most=1e6)
    max_distance_m: float = setting(4.0, at_least=0.0, at_most=1000.0)
    min_inlier_ratio: float = setting(0.5, at_least=0.0, at_most=1.0)


@dataclass(frozen=True)
class LoopClosure:
    """Two scans of one place: their positions in the drive, and the motion from the first to the second."""

    first: int
    second: int
    motion: RelativeMotion


class RegisteredScan:
    """A scan made ready for registration, as often as needed."""

    def __init__(self, scan: Scan, config: RegistrationConfig | None = None) -> None:
        """scan: deskewed to its stamp.

        Raises:
            DataError: too few points.
        """
        self.stamp_ns = scan.stamp_ns
        self.config = config or RegistrationConfig()
        self.cloud = _cloud(scan, self.config)
        self.tree = small_gicp.KdTree(self.cloud)

    def motion_to(
        self, other: RegisteredScan, guess: gtsam.Pose3, min_inlier_ratio: float | None = None
    ) -> RelativeMotion:
        """Pose of the other scan in this one, by generalized ICP; the guess, not ``ok``, where that fails.

        Args:
            other: the later scan.
            guess: of the pose.
            min_inlier_ratio: another one than the configuration's.

        Raises:
            DataError: the other scan is not the later one.
        """
        config = self.config
        least = config.min_inlier_ratio if min_inlier_ratio is None else min_inlier_ratio
        if other.stamp_ns <= self.stamp_ns:
            raise DataError("registration of scans", "a second scan not after the first", "rising stamps")
        result = small_gicp.align(
            self.cloud,
            other.cloud,
            self.tree,
            guess.matrix(),
            max_correspondence_distance=config.max_distance_m,
            num_threads=1,
            max_iterations=config.max_iterations,
        )
        found = np.asarray(result.T_target_source)
        if not np.isfinite(found).all() or result.num_inliers < least * other.cloud.size():
            covariance = np.diag(np.repeat([config.failed_rad, config.failed_m], 3) ** 2)
            return RelativeMotion(self.stamp_ns, other.stamp_ns, guess, covariance, ok=False)
        pose = gtsam.Pose3(gtsam.Rot3.ClosestTo(found[:3, :3]), found[:3, 3])
        return RelativeMotion(self.stamp_ns, other.stamp_ns, pose, _covariance(result, config))


def scan_to_scan(scans: Sequence[RegisteredScan]) -> list[RelativeMotion]:
    """Motions between consecutive scans, each guessed from the one before; the first from standstill."""
    motions: list[RelativeMotion] = []
    for a, b in itertools.pairwise(scans):
        seconds = (b.stamp_ns - a.stamp_ns) * 1e-9
        twist = motions[-1].mean_twist if motions else np.zeros(6)
        motions.append(a.motion_to(b, gtsam.Pose3.Expmap(twist * seconds)))
    return motions


def loop_closures(
    scans: Sequence[RegisteredScan], poses: Sequence[gtsam.Pose3], config: LoopConfig | None = None
) -> list[LoopClosure]:
    """Scans of one place, far apart in time, registered to one another.

    Args:
        scans: of a drive.
        poses: wTl of each scan as known before.
        config: which pairs are tried; a false closure is possible, so use a robust noise model.
    """
    config = config or LoopConfig()
    closures = []
    tried = range(0, len(scans), config.every)
    for second in tried:
        for first in tried:
            a, b = scans[first], scans[second]
            guess = poses[first].between(poses[second])
            far = float(np.linalg.norm(guess.translation())) > config.max_distance_m
            if far or (b.stamp_ns - a.stamp_ns) * 1e-9 < config.min_seconds:
                continue
            motion = a.motion_to(b, guess, config.min_inlier_ratio)
            if motion.ok:
                closures.append(LoopClosure(first, second, motion))
    return closures


def _cloud(scan: Scan, config: RegistrationConfig) -> small_gicp.PointCloud:
    points, classes, _ = usable_points(scan, config.near_m, config.far_m, config.max_points)
    still = ~np.isin(classes, MOVABLE_CLASSES)
    if np.count_nonzero(still) >= config.min_points:
        points = points[still]
    if len(points) < config.neighbours:
        raise DataError("scan to register", f"{len(points)} points in range", f"{config.neighbours} or more")
    return registration_cloud(points, config.voxel_m, config.neighbours, config.plane_ratio)


def _covariance(result: small_gicp.RegistrationResult, config: RegistrationConfig) -> FloatArray:
    """(6, 6) inverse Hessian scaled by the residual, and the floor; [rot, trans], right perturbation."""
    variance = 2.0 * result.error / max(result.num_inliers - 6, 1)
    hessian = np.asarray(result.H) + 1e-6 * np.eye(6)
    floor = np.diag(np.repeat([config.floor_rad, config.floor_m], 3) ** 2)
    return np.asarray(config.inflation**2 * variance * np.linalg.inv(hessian)) + floor

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

from sst_graph.errors import DataError, count_of
from sst_graph.odometry.cloud import FEWEST_POINTS, registration_cloud, usable_points
from sst_graph.odometry.lidar import (
    FAILED_M,
    FAILED_RAD,
    FLOOR_M,
    FLOOR_RAD,
    MOVABLE_CLASSES,
    PLANE_RATIO,
    registration_covariance,
)
from sst_graph.types import RelativeMotion, Scan

_VOXEL_M = 0.3
"""Edge of the voxels of which one point is registered [m]."""
_NEAR_M, _FAR_M = 1.0, 100.0
"""Ranges between which points are used [m]."""
_MAX_POINTS = 60_000
"""Most points of a scan that are read."""
_MIN_POINTS = 200
"""Fewest points outside the movable classes; with fewer, those classes are kept."""
_NEIGHBOURS = 10
"""Points from which the covariance of a surface patch is estimated."""
_MAX_DISTANCE_M = 1.0
"""Farthest pair of two points [m]."""
_MAX_ITERATIONS = 40
"""Most Gauss-Newton steps."""
_MIN_INLIER_RATIO = 0.3
"""A registration with fewer points paired than this fraction has failed."""
_LOOP_INLIER_RATIO = 0.5
"""A loop closure needs this fraction: more than odometry, whose guess is closer."""
_FLOOR = np.diag(np.repeat([FLOOR_RAD, FLOOR_M], 3) ** 2)
"""(6, 6) covariance added for what the registration cannot know."""


@dataclass(frozen=True)
class LoopClosure:
    """Two scans of one place: their positions in the drive, and the motion from the first to the second."""

    first: int
    second: int
    motion: RelativeMotion


class RegisteredScan:
    """A scan made ready for registration, as often as needed."""

    def __init__(self, scan: Scan) -> None:
        """scan: deskewed to its stamp.

        Raises:
            DataError: too few points.
        """
        self.stamp_ns = scan.stamp_ns
        self.cloud = _cloud(scan)
        self.tree = small_gicp.KdTree(self.cloud)

    def motion_to(
        self, other: RegisteredScan, guess: gtsam.Pose3, min_inlier_ratio: float = _MIN_INLIER_RATIO
    ) -> RelativeMotion:
        """Pose of the other scan in this one, by generalized ICP; the guess, not ``ok``, where that fails.

        Args:
            other: the later scan.
            guess: of the pose.
            min_inlier_ratio: with fewer points paired than this fraction it has failed.

        Raises:
            DataError: the other scan is not the later one.
        """
        if other.stamp_ns <= self.stamp_ns:
            raise DataError("registration of scans", "a second scan not after the first", "rising stamps")
        covariance = np.diag(np.repeat([FAILED_RAD, FAILED_M], 3) ** 2)
        failed = RelativeMotion(self.stamp_ns, other.stamp_ns, guess, covariance, ok=False)
        if min(self.cloud.size(), other.cloud.size()) < FEWEST_POINTS:
            return failed
        result = small_gicp.align(
            self.cloud,
            other.cloud,
            self.tree,
            guess.matrix(),
            max_correspondence_distance=_MAX_DISTANCE_M,
            num_threads=1,
            max_iterations=_MAX_ITERATIONS,
        )
        found = np.asarray(result.T_target_source)
        if not np.isfinite(found).all() or result.num_inliers < min_inlier_ratio * other.cloud.size():
            return failed
        pose = gtsam.Pose3(gtsam.Rot3.ClosestTo(found[:3, :3]), found[:3, 3])
        return RelativeMotion(self.stamp_ns, other.stamp_ns, pose, registration_covariance(result) + _FLOOR)


def scan_to_scan(scans: Sequence[RegisteredScan]) -> list[RelativeMotion]:
    """Motions between consecutive scans, each guessed from the one before; the first from standstill."""
    motions: list[RelativeMotion] = []
    for a, b in itertools.pairwise(scans):
        seconds = (b.stamp_ns - a.stamp_ns) * 1e-9
        twist = motions[-1].mean_twist if motions else np.zeros(6)
        motions.append(a.motion_to(b, gtsam.Pose3.Expmap(twist * seconds)))
    return motions


def loop_closures(
    scans: Sequence[RegisteredScan],
    poses: Sequence[gtsam.Pose3],
    every: int = 4,
    min_seconds: float = 2.0,
    max_distance_m: float = 4.0,
) -> list[LoopClosure]:
    """Scans of one place, far apart in time, registered to one another.

    A false closure is possible, so use a robust noise model.

    Args:
        scans: of a drive.
        poses: wTl of each scan as known before.
        every: one scan out of so many is tried.
        min_seconds: least time between the two scans [s].
        max_distance_m: farthest between their poses as known before [m].
    """
    closures = []
    tried = range(0, len(scans), every)
    for second in tried:
        for first in tried:
            a, b = scans[first], scans[second]
            guess = poses[first].between(poses[second])
            far = float(np.linalg.norm(guess.translation())) > max_distance_m
            if far or (b.stamp_ns - a.stamp_ns) * 1e-9 < min_seconds:
                continue
            motion = a.motion_to(b, guess, _LOOP_INLIER_RATIO)
            if motion.ok:
                closures.append(LoopClosure(first, second, motion))
    return closures


def _cloud(scan: Scan) -> small_gicp.PointCloud:
    points, classes, _ = usable_points(scan, _NEAR_M, _FAR_M, _MAX_POINTS)
    static = ~np.isin(classes, MOVABLE_CLASSES)
    if np.count_nonzero(static) >= _MIN_POINTS:
        points = points[static]
    if len(points) < _NEIGHBOURS:
        raise DataError(
            "scan to register", f"{count_of(len(points), 'point')} in range", f"{_NEIGHBOURS} or more"
        )
    return registration_cloud(points, _VOXEL_M, _NEIGHBOURS, PLANE_RATIO)

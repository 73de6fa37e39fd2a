"""Scans made ready for registration: sweep compensation, static points, balanced surfaces."""

from __future__ import annotations

import numpy as np
import small_gicp
from numpy.typing import NDArray

from sst_graph.errors import DataError
from sst_graph.factors.motion import cross_rows
from sst_graph.sampling import spread_places
from sst_graph.types import FloatArray, Scan

PARALLEL_COSINE = 0.9
"""Normals whose angle to the main normal has a larger cosine count as the same surface direction."""


def compensate_sweep(points: FloatArray, offsets_s: FloatArray, twist: FloatArray) -> FloatArray:
    """lP(stamp) = Exp(twist * offset) . lP(offset), to second order in the offset.

    Args:
        points: (n, 3) in the LiDAR frame at each point's own time [m].
        offsets_s: (n,) time of each point after the stamp [s].
        twist: (6,) [omega, v] of the LiDAR in its own frame [rad/s, m/s].

    Returns:
        (n, 3) in the LiDAR frame at the stamp [m]; at 1 rad/s and 50 ms the error of the
        truncation is 2e-5 of the range.
    """
    omega, v = twist[:3], twist[3:]
    rate = cross_rows(omega, points) + v
    t = offsets_s[:, None]
    return np.asarray(points + t * (rate + 0.5 * t * cross_rows(omega, rate)))


FEWEST_POINTS = 11
"""Fewest points of a cloud: with fewer, small_gicp prints a warning of its own on stderr."""


def usable_points(
    scan: Scan, near_m: float, far_m: float, most: int
) -> tuple[FloatArray, NDArray[np.uint8], FloatArray | None]:
    """Finite points of a scan between two ranges, thinned evenly to at most ``most``.

    Returns:
        points (n, 3) [m], classes (n,), offsets_s (n,) [s] or None.
    """
    square = np.einsum("ij,ij->i", scan.points, scan.points)
    kept = np.flatnonzero((square > near_m**2) & (square < far_m**2))  # NaN and inf compare as False
    kept = spread_places(kept, most)
    offsets = None if scan.offsets_s is None else scan.offsets_s[kept].astype(np.float64)
    return scan.points.take(kept, axis=0).astype(np.float64), scan.classes[kept], offsets


def registration_cloud(
    points: FloatArray, voxel_m: float, neighbours: int, plane_ratio: float
) -> small_gicp.PointCloud:
    """Downsampled cloud with covariances, in which no single surface direction dominates.

    A scan is mostly ground. Its points do not constrain motion along it, yet the rings they form
    bias the registration towards no motion. Where one normal direction dominates, its points are
    thinned evenly to ``plane_ratio`` times the number of all the others.

    Args:
        points: (n, 3) [m].
        voxel_m: edge of the voxels of which one mean point is kept [m].
        neighbours: fewest points from which a covariance is estimated.
        plane_ratio: most points of the main direction, per point of another direction.
    """
    # From a cloud: from an array small_gicp takes half as long again.
    cloud = small_gicp.voxelgrid_sampling(small_gicp.PointCloud(points), voxel_m)
    lPs = np.asarray(cloud.points())
    parallel = _along_main_direction(cloud, lPs, voxel_m, neighbours)
    members = np.flatnonzero(parallel)
    allowed = max(int(plane_ratio * (len(lPs) - len(members))), 10 * neighbours)
    if len(members) > allowed:
        kept = ~parallel
        kept[spread_places(members, allowed)] = True
        lPs = lPs[kept]
    return surfaces(lPs, neighbours)


def _along_main_direction(
    cloud: small_gicp.PointCloud, points: FloatArray, voxel_m: float, neighbours: int
) -> NDArray[np.bool_]:
    """(n,) whether a cloud's points (n, 4) lie on surfaces of its main direction.

    By the normal of the nearest point of a coarser cloud: the covariances of the finer one are estimated only
    once.
    """
    coarse, tree = small_gicp.preprocess_points(cloud, _COARSER * voxel_m, neighbours, 1)
    normals = np.asarray(coarse.normals())[:, :3]
    main = np.linalg.eigh(normals.T @ normals)[1][:, 2]
    nearest = np.asarray(tree.batch_nearest_neighbor_search(points, num_threads=1)[0], np.intp)
    return np.asarray((np.abs(normals @ main) > PARALLEL_COSINE)[nearest])


_COARSER = 2.0
"""Edge of the voxels in which surface directions are estimated, in edges of those that are registered."""


def surfaces(points: FloatArray, neighbours: int) -> small_gicp.PointCloud:
    """Points (n, 3) or homogeneous (n, 4) [m] with the covariance of the surface around each.

    Args:
        neighbours: fewest from which it is estimated.

    Raises:
        DataError: another shape, or NaN or inf, on which small_gicp ends the process.
    """
    if points.ndim != 2 or points.shape[1] not in (3, 4) or not np.isfinite(points).all():
        raise DataError("points to register", f"an array {points.shape} or NaN", "(n, 3) or (n, 4), finite")
    cloud = small_gicp.PointCloud(points)
    tree = small_gicp.KdTree(cloud)
    number = _neighbours(np.asarray(cloud.points())[:, :3], tree, neighbours)
    small_gicp.estimate_normals_covariances(cloud, tree, num_neighbors=number, num_threads=1)
    return cloud


def _neighbours(points: FloatArray, tree: small_gicp.KdTree, fewest: int) -> int:
    """How many neighbours of points (n, 3) span a surface.

    Where scan lines are far apart, the nearest points all lie on one of them and tell no normal: registration
    then holds rings to rings, and comes out short of the motion.
    """
    if len(points) < _MORE_NEIGHBOURS:
        return fewest
    sample = points[:: max(1, len(points) // _SAMPLE)]
    near = np.asarray(tree.batch_knn_search(sample, fewest)[0], np.intp)
    variances = np.linalg.eigvalsh(scatter(points, near))
    lines = np.mean(variances[:, 1] < _LINE_RATIO * variances[:, 2])
    return max(fewest, _MORE_NEIGHBOURS) if lines > _MOST_LINES else fewest


_SAMPLE = 200
"""Points whose neighbours are looked at."""
_MORE_NEIGHBOURS = 20
"""Where the fewest lie on lines: 32 rings 1.3 deg apart came out 0.7 m short in a motion of 0.76 m."""
_LINE_RATIO, _MOST_LINES = 0.05, 0.25
"""Neighbours lie on a line where their second variance is less than this ratio of their first; at most this
share of the neighbourhoods may. Of six neighbours each, 4 to 11 % do with 64 and 128 rings, 27 to 32 % with
32 rings 1.3 deg apart. More neighbours for all would make the motions of 64 rings 1.5 times worse."""


def scatter(points: FloatArray, near: NDArray[np.intp]) -> FloatArray:
    """(m, 3, 3) sums of the squared deviations of k points each from their mean, near (m, k) among points
    (n, 3): axis by axis, which is many times faster."""
    rows = np.ascontiguousarray(near.T)
    each = [column.take(rows) for column in np.ascontiguousarray(points.T)]
    around = [column - column.mean(axis=0) for column in each]
    sums = [(a * b).sum(axis=0) for a in around for b in around]
    return np.stack(sums, axis=1).reshape(-1, 3, 3)

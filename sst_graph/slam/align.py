"""Matches of one image and one scan for an alignment factor in a graph of your own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import ArrayLike, NDArray

from sst_graph.association.edge_matching import (
    MatchConfig,
    Motion,
    ScanWithImage,
    SilhouetteMatches,
    match_silhouettes,
)
from sst_graph.drive.preparation import (
    ImageFeatures,
    PrepareConfig,
    ScanFeatures,
    image_features,
    scan_features,
)
from sst_graph.errors import DataError
from sst_graph.factors.alignment import Alignment
from sst_graph.factors.camera import PinholeCamera
from sst_graph.factors.robust import RobustKernel
from sst_graph.objects.occupancy import ObjectName
from sst_graph.objects.velocity import velocities_of_points
from sst_graph.types import CameraImage, Scan, SemanticClass

FloatArray = NDArray[np.float64]

VEHICLES = (SemanticClass.VEHICLE,)
SLAM_MATCHES = MatchConfig(side_sigma_px=1.5)
"""In a graph of your own the information is not corrected afterwards: each side of an object counts as one
measurement."""
SLAM_KERNEL = RobustKernel("geman_mcclure", 5.0)


@dataclass(frozen=True)
class FrameAlignments:
    """Matches of one scan and one image, an alignment for each class that both show.

    Attributes:
        classes: semantic class of each alignment, for the keys of their mask biases.
        alignments: for :func:`sst_graph.factors.frame_factor` or
            :func:`sst_graph.factors.pose_alignment_factor`.
        objects: of each alignment, (n,) number of the object within its scan that each match lies on, for
            mask biases by object (:class:`sst_graph.factors.GroupedBias`).
        sides: of each alignment, (n,) side of the object: 0 left, 1 right, 2 top, 3 bottom.
    """

    classes: tuple[SemanticClass, ...]
    alignments: tuple[Alignment, ...]
    objects: tuple[NDArray[np.intp], ...]
    sides: tuple[NDArray[np.intp], ...] = ()

    def __len__(self) -> int:
        """Number of matches."""
        return sum(len(alignment) for alignment in self.alignments)


def align_frame(
    scan: Scan | ScanFeatures,
    image: CameraImage | ImageFeatures,
    camera: PinholeCamera,
    cTl: gtsam.Pose3,
    time_offset_s: float,
    l_twist: ArrayLike,
    *,
    l_acceleration: ArrayLike | None = None,
    lTs: gtsam.Pose3 | None = None,
    from_ns: int | None = None,
    classes: Sequence[SemanticClass] = VEHICLES,
    biases_px: Mapping[SemanticClass, float] | None = None,
    l_velocities: Mapping[ObjectName, ArrayLike] | None = None,
    kernel: RobustKernel = SLAM_KERNEL,
    config: MatchConfig = SLAM_MATCHES,
) -> FrameAlignments:
    """Boundary points of a scan matched to the contours of an image, at the current estimate.

    Args:
        scan, image: as the data have them, or their ``scan_features``, ``image_features``, which spare work.
        camera: of the image.
        cTl, time_offset_s: current extrinsic, and time offset [s].
        l_twist: (6,) of the LiDAR, ``Pose3.Logmap(wTl_a.between(wTl_b)) / seconds`` [rad/s, m/s].
        l_acceleration: (6,) its rate of change [rad/s^2, m/s^2], zero by default.
        lTs: where the scan was taken at another time: pose of the scan's LiDAR frame in the LiDAR's frame
            at ``from_ns``, ``wTl_a.between(wTl_s)``; the scan deskewed to its stamp, no moving vehicles.
        from_ns: with ``lTs``, the LiDAR-clock stamp of the pose before the image [ns].
        classes: to match.
        biases_px: current mask biases by class [px].
        l_velocities: (3,) over ground of objects that move, in the scan's LiDAR frame, by class and number
            within the scan (the data's instance, where all points of the class carry one) [m/s]; all others
            stand. Not with ``lTs``.
        kernel: robust kernel of the matches; its scale, times ``GATE``, is also the farthest match [px].
        config: how boundary points meet contours.

    Returns:
        The matches, possibly none: a frame without any gives no factor.

    Raises:
        DataError: one of ``lTs`` and ``from_ns``, or both with velocities; arrays of a wrong shape.
    """
    _check_time(lTs, from_ns, l_velocities)
    points, contours = features_of(scan, image, classes)
    boundaries = {c: some for c, some in points.boundaries.items() if c in classes}
    pair = ScanWithImage(
        boundaries,
        contours.contours,
        camera,
        (contours.stamp_ns - (points.stamp_ns if from_ns is None else from_ns)) * 1e-9,
        _camera_motion(cTl, l_twist, l_acceleration),
        velocities_of_points(_velocities(l_velocities or {}), boundaries),
    )
    place = cTl if lTs is None else cTl * lTs
    found = match_silhouettes(pair, place, time_offset_s, biases_px or {}, kernel, config)
    return _frame_alignments(found)


def features_of(
    scan: Scan | ScanFeatures, image: CameraImage | ImageFeatures, classes: Sequence[SemanticClass]
) -> tuple[ScanFeatures, ImageFeatures]:
    """What :func:`align_frame` needs of a scan and an image."""
    points = scan
    if isinstance(points, Scan):
        points = scan_features(0, points, classes, PrepareConfig(), with_lower_edges=False)
    contours = image_features(0, image, classes) if isinstance(image, CameraImage) else image
    return points, contours


def _check_time(
    lTs: gtsam.Pose3 | None, from_ns: int | None, l_velocities: Mapping[ObjectName, ArrayLike] | None
) -> None:
    if (lTs is None) != (from_ns is None):
        raise DataError("align_frame", "one of lTs and from_ns", "both, or none")
    if lTs is not None and l_velocities:
        raise DataError(
            "align_frame", "l_velocities with lTs", "objects that stand in a scan of another time"
        )


def _frame_alignments(found: Mapping[SemanticClass, SilhouetteMatches]) -> FrameAlignments:
    return FrameAlignments(
        tuple(found),
        tuple(matches.alignment for matches in found.values()),
        tuple(matches.objects for matches in found.values()),
        tuple(matches.sides for matches in found.values()),
    )


def _camera_motion(cTl: gtsam.Pose3, l_twist: ArrayLike, l_acceleration: ArrayLike | None) -> Motion:
    Ad = np.asarray(cTl.AdjointMap())
    acceleration = np.zeros(6) if l_acceleration is None else _finite("l_acceleration", l_acceleration, 6)
    return Motion(Ad @ _finite("l_twist", l_twist, 6), Ad @ acceleration)


def _velocities(given: Mapping[ObjectName, ArrayLike]) -> dict[ObjectName, FloatArray]:
    return {
        (c, n): _finite(f"l_velocities[{c.name}, {n}]", velocity, 3) for (c, n), velocity in given.items()
    }


def _finite(name: str, value: ArrayLike, count: int) -> FloatArray:
    array = np.asarray(value, dtype=np.float64)
    if array.shape != (count,) or not np.isfinite(array).all():
        raise DataError(f"align_frame: {name}", f"shape {array.shape}", f"{count} finite numbers")
    return array

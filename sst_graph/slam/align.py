"""Matches of one image and one scan for an alignment factor in a graph of your own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sst_graph.association.edge_matching import (
    MatchConfig,
    ScanWithImage,
    SilhouetteMatches,
    match_silhouettes,
)
from sst_graph.config import expect_settings
from sst_graph.drive.preparation import (
    ImageFeatures,
    PrepareConfig,
    ScanFeatures,
    image_features,
    scan_features,
)
from sst_graph.errors import DataError
from sst_graph.factors import FactorError
from sst_graph.factors.alignment import Alignment
from sst_graph.factors.arguments import (
    checked_array,
    checked_gtsam,
    checked_number,
    checked_type,
    described,
)
from sst_graph.factors.camera import PinholeCamera
from sst_graph.factors.motion import CameraTwist
from sst_graph.factors.robust import RobustKernel
from sst_graph.features.lidar_edges import Boundaries, with_points
from sst_graph.objects.occupancy import ObjectName
from sst_graph.objects.velocity import velocities_of_points
from sst_graph.types import Calibration, CameraImage, FloatArray, Scan, SemanticClass
from sst_graph.validation import checked_image, checked_scan, checked_stamp

VEHICLES = (SemanticClass.VEHICLE,)
SLAM_MATCHES = MatchConfig(side_sigma_px=1.5)
"""In a graph of your own the information is not corrected afterwards: each side of an object counts as one
measurement."""
SLAM_KERNEL = RobustKernel("geman_mcclure", 5.0)
EDGE_KERNEL_SHARE, EDGE_KERNEL_PX = 0.3, 8.0
"""Scale of the kernel where there is no mask, over that of the contours, and at most [px]: pictures have
edges beside the objects', and a few pixels away they are others'."""
_LABELLED_M = 0.3
"""Boundary points of objects without a class that lie this near to a labelled point are of its object [m]."""


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


@dataclass(frozen=True)
class CameraCalibration:
    """What is known of a camera at present.

    Attributes:
        camera: of the image.
        cTl: extrinsic.
        time_offset_s: time offset [s].
        biases_px: mask bias by class [px]; 0 where one is missing.

    Raises:
        FactorError: no camera, no pose, no numbers.
    """

    camera: PinholeCamera
    cTl: gtsam.Pose3
    time_offset_s: float
    biases_px: Mapping[SemanticClass, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        name = "of CameraCalibration"
        checked_type(f"camera {name}", self.camera, PinholeCamera, "a PinholeCamera")
        checked_gtsam(f"cTl {name}", self.cTl, gtsam.Pose3)
        time_offset_s = checked_number(f"time_offset_s {name}", self.time_offset_s)
        object.__setattr__(self, "time_offset_s", time_offset_s)
        expected = "a dict from SemanticClass to a number"
        checked_type(f"biases_px {name}", self.biases_px, Mapping, expected)
        for c, bias in self.biases_px.items():
            checked_type(f"biases_px {name}", c, SemanticClass, expected)
            checked_number(f"biases_px {name}", bias)


@dataclass(frozen=True, eq=False)
class ScanMotion:
    """How the LiDAR and the objects in its scan move about the instant of an image.

    Attributes:
        l_twist: (6,) of the LiDAR, ``Pose3.Logmap(wTl_a.between(wTl_b)) / seconds`` [rad/s, m/s].
        l_acceleration: (6,) its rate of change [rad/s^2, m/s^2], zero by default.
        l_velocities: (3,) over ground of objects that move, in the scan's LiDAR frame, by class and number
            within the scan (the data's instance, where all points of the class carry one) [m/s]; all others
            stand.
        lTs: where the scan was taken at another time: pose of the scan's LiDAR frame in the LiDAR's frame
            at ``from_ns``, ``wTl_a.between(wTl_s)``; the scan deskewed to its stamp.
        from_ns: with ``lTs``, the LiDAR-clock stamp of the pose before the image [ns].

    Raises:
        DataError: one of ``lTs`` and ``from_ns``, or no stamp.
        FactorError: no pose, or arrays of a wrong shape.
    """

    l_twist: FloatArray
    l_acceleration: FloatArray | None = None
    l_velocities: Mapping[ObjectName, FloatArray] = field(default_factory=dict)
    lTs: gtsam.Pose3 | None = None
    from_ns: int | None = None

    def __post_init__(self) -> None:
        if (self.lTs is None) != (self.from_ns is None):
            raise DataError("ScanMotion", "one of lTs and from_ns", "both, or none")
        if self.lTs is not None:
            checked_gtsam("lTs of ScanMotion", self.lTs, gtsam.Pose3)
            object.__setattr__(self, "from_ns", checked_stamp(self.from_ns, "from_ns of ScanMotion"))
        acceleration = np.zeros(6) if self.l_acceleration is None else self.l_acceleration
        what = "l_velocities of ScanMotion"
        expected = "a dict from (SemanticClass, number within the scan) to a velocity"
        checked_type(what, self.l_velocities, Mapping, expected)
        velocities = {}
        for name, velocity in self.l_velocities.items():
            if not (isinstance(name, tuple) and len(name) == 2 and isinstance(name[0], SemanticClass)):
                raise FactorError(what, described(name), expected)
            velocities[name] = checked_array(what, velocity, (3,))
        twist = checked_array("l_twist of ScanMotion", self.l_twist, (6,))
        acceleration = checked_array("l_acceleration of ScanMotion", acceleration, (6,))
        object.__setattr__(self, "l_twist", twist)
        object.__setattr__(self, "l_acceleration", acceleration)
        object.__setattr__(self, "l_velocities", velocities)

    def of_camera(self, cTl: gtsam.Pose3) -> CameraTwist:
        """The camera's motion, by the extrinsic.

        Raises:
            FactorError: no pose.
        """
        checked_gtsam("cTl of ScanMotion.of_camera", cTl, gtsam.Pose3)
        Ad = np.asarray(cTl.AdjointMap())
        assert self.l_acceleration is not None
        return CameraTwist(Ad @ self.l_twist, Ad @ self.l_acceleration)


def expect_classes(what: str, classes: Sequence[SemanticClass]) -> None:
    """Refuse what is no sequence of classes."""
    expected = "a tuple of SemanticClass"
    checked_type(what, classes, (list, tuple), expected)
    for c in classes:
        checked_type(what, c, SemanticClass, expected)


@dataclass(frozen=True)
class FrameMatching:
    """What is matched, and how.

    Attributes:
        classes: to match. Labelled ones meet the contours of their masks. ``OBJECT`` is what stands on the
            ground, found in the scan alone, and meets the edges of the picture; where scan and image show
            labelled classes of these, only objects without such a label.
        kernel: robust kernel of the matches; its scale, times ``GATE``, is also the farthest match [px].
            Edges of the picture have :data:`EDGE_KERNEL_SHARE` of that scale, and :data:`EDGE_KERNEL_PX` at
            most.
        config: how boundary points meet contours.

    Raises:
        FactorError: no classes, no kernel.
        ConfigError: no settings.
    """

    classes: Sequence[SemanticClass] = VEHICLES
    kernel: RobustKernel = SLAM_KERNEL
    config: MatchConfig = SLAM_MATCHES

    def __post_init__(self) -> None:
        expect_classes("classes of FrameMatching", self.classes)
        checked_type("kernel of FrameMatching", self.kernel, RobustKernel, "a sst_graph.factors.RobustKernel")
        object.__setattr__(self, "config", expect_settings(self.config, MatchConfig))

    def matchers(self) -> list[tuple[frozenset[SemanticClass], RobustKernel, MatchConfig]]:
        """Classes that are matched alike, with their kernel and settings."""
        scale = min(EDGE_KERNEL_SHARE * self.kernel.scale, EDGE_KERNEL_PX)
        narrow = RobustKernel(self.kernel.kind, scale)
        labelled = frozenset(self.classes) - {SemanticClass.OBJECT}
        edges = frozenset(self.classes) - labelled
        both = [
            (labelled, self.kernel, self.config),
            (edges, narrow, replace(self.config, edge_place="peak")),
        ]
        return [each for each in both if each[0]]


SLAM_MATCHING = FrameMatching()


def align_frame(
    scan: Scan | ScanFeatures,
    image: CameraImage | ImageFeatures,
    calibration: CameraCalibration,
    motion: ScanMotion,
    matching: FrameMatching = SLAM_MATCHING,
) -> FrameAlignments:
    """Boundary points of a scan matched to an image, at the current estimate.

    Args:
        scan, image: as the data have them, or their ``scan_features``, ``image_features``, which spare work.
        calibration: of the image's camera, as it is known at present.
        motion: of the LiDAR and of objects about the image's instant, and where the scan was taken.
        matching: classes, kernel and settings.

    Returns:
        The matches, possibly none: a frame without any gives no factor.

    Raises:
        DataError: no scan, no image, or such as have a flaw.
        FactorError: no calibration, no motion, no matching.
    """
    checked_type("calibration of align_frame", calibration, CameraCalibration, "a CameraCalibration")
    checked_type("motion of align_frame", motion, ScanMotion, "a ScanMotion")
    checked_type("matching of align_frame", matching, FrameMatching, "a FrameMatching")
    points, contours = features_of(scan, image, matching.classes, calibration.camera)
    from_ns = points.stamp_ns if motion.from_ns is None else motion.from_ns
    place = calibration.cTl if motion.lTs is None else calibration.cTl * motion.lTs
    at = Calibration(place, calibration.time_offset_s)
    found: dict[SemanticClass, SilhouetteMatches] = {}
    for classes, kernel, config in matching.matchers():
        boundaries = {c: some for c, some in points.boundaries.items() if c in classes}
        velocities = velocities_of_points(motion.l_velocities, boundaries)
        pair = ScanWithImage(
            _carried(boundaries, velocities, 1e-9 * (from_ns - points.stamp_ns)),
            contours.contours,
            calibration.camera,
            (contours.stamp_ns - from_ns) * 1e-9,
            motion.of_camera(calibration.cTl),
            velocities,
        )
        found |= match_silhouettes(pair, at, calibration.biases_px, kernel, config)
    return FrameAlignments(
        tuple(found),
        tuple(matches.alignment for matches in found.values()),
        tuple(matches.objects for matches in found.values()),
        tuple(matches.sides for matches in found.values()),
    )


def features_of(
    scan: Scan | ScanFeatures,
    image: CameraImage | ImageFeatures,
    classes: Sequence[SemanticClass],
    camera: PinholeCamera,
) -> tuple[ScanFeatures, ImageFeatures]:
    """What :func:`align_frame` needs of a scan and an image.

    Raises:
        DataError: neither these nor their features, or such as have a flaw.
    """
    contours = image
    if not isinstance(contours, ImageFeatures):
        contours = image_features(0, checked_image(contours, camera), classes)
    points = scan_features_of(scan, classes)
    if points.by_geometry is None:
        return points, contours
    # A scan with labels, in which objects without a class were looked for too.
    labelled = [c for c in classes if c in points.boundaries and c in contours.contours]
    objects = _unlabelled(points.by_geometry.boundaries, points, labelled)
    return replace(points, boundaries=points.boundaries | objects, by_geometry=None), contours


def scan_features_of(scan: Scan | ScanFeatures, classes: Sequence[SemanticClass]) -> ScanFeatures:
    """What :func:`features_of` needs of a scan, whatever its image shows.

    Raises:
        DataError: no scan, or one that has a flaw.
    """
    if isinstance(scan, ScanFeatures):
        return scan
    return scan_features(0, checked_scan(scan), classes, PrepareConfig(), depth=False, with_lower_edges=False)


def _unlabelled(
    found: Mapping[SemanticClass, Boundaries], scan: ScanFeatures, labelled: Sequence[SemanticClass]
) -> dict[SemanticClass, Boundaries]:
    """Boundary points of objects found by geometry that are not of labelled ones."""
    own = [scan.boundaries[c].lPs for c in labelled]
    own.append(scan.lPs[np.isin(scan.classes, [int(c) for c in labelled])])
    tree = cKDTree(np.concatenate(own))
    kept = {}
    for c, points in found.items():
        distances, _ = tree.query(points.lPs, distance_upper_bound=_LABELLED_M)
        kept[c] = points.take(np.flatnonzero(np.isinf(distances)))
    return with_points(kept)


def _carried(
    boundaries: Mapping[SemanticClass, Boundaries],
    velocities: Mapping[SemanticClass, FloatArray],
    late_s: float,
) -> dict[SemanticClass, Boundaries]:
    """Boundary points that move over ground, where they are so much later [s]."""
    carried = dict(boundaries)
    if late_s:
        for c, velocity in velocities.items():
            points, shift = carried[c], late_s * velocity
            carried[c] = replace(points, lPs=points.lPs + shift, outward=points.outward + shift)
    return carried

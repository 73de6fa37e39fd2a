"""Close points of one scan in one image, for the caption of a picture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sst_graph.association.edge_matching import ScanWithImage, match_silhouettes
from sst_graph.drive.preparation import apart
from sst_graph.errors import count_of
from sst_graph.factors.camera import PinholeCamera
from sst_graph.factors.motion import CameraTwist, moved_points
from sst_graph.factors.robust import RobustKernel
from sst_graph.features.lidar_edges import find_boundaries
from sst_graph.features.mask_contour import ContourMap
from sst_graph.fit import CLOSE_PX
from sst_graph.graph.matching import GraphConfig
from sst_graph.quality.residuals import WIDE_PX
from sst_graph.types import Calibration, FloatArray, Frame, SemanticClass


@dataclass(frozen=True)
class ClosePoints:
    """Boundary points of vehicles that have a contour nearby.

    Attributes:
        close: of them, those within :data:`~sst_graph.fit.CLOSE_PX` of it.
        points: all of them.
    """

    close: int
    points: int

    def __add__(self, other: ClosePoints) -> ClosePoints:
        return ClosePoints(self.close + other.close, self.points + other.points)

    @property
    def words(self) -> str:
        """For a caption; says so where there is none."""
        if not self.points:
            return "no vehicle's boundary near a contour"
        share, points = f"{100.0 * self.close / self.points:.0f} %", count_of(self.points, "boundary point")
        return f"{share} of {points} of vehicles within {CLOSE_PX:g} px of the contour"


def close_points(
    frame: Frame,
    contour: ContourMap | None,
    camera: PinholeCamera,
    at: Calibration,
    c_twist: FloatArray | None,
    bias_px: float = 0.0,
) -> ClosePoints | None:
    """Boundary points of vehicles in a frame and its mask; None where either has no labels.

    The share of a whole drive leaves out objects that move; here they count as if they stood.

    Args:
        contour: of the vehicles in the frame's mask; None where it has none.
        c_twist: (6,) of the camera at the image [rad/s, m/s]; None: at rest.
        bias_px: of the masks of vehicles [px].
    """
    scan, image = frame.scan, frame.image
    if scan is None or image is None or not scan.has_labels or not image.has_mask:
        return None
    boundaries = apart(find_boundaries(scan, (SemanticClass.VEHICLE,), with_lower_edges=False))[0]
    if contour is None or not boundaries:
        return ClosePoints(0, 0)
    twist = np.zeros(6) if c_twist is None else c_twist
    base_tau_s = (image.stamp_ns - scan.stamp_ns) * 1e-9
    motion = CameraTwist(twist, np.zeros(6))
    pair = ScanWithImage(boundaries, {SemanticClass.VEHICLE: contour}, camera, base_tau_s, motion)
    kernel, biases = RobustKernel("geman_mcclure", WIDE_PX), {SemanticClass.VEHICLE: bias_px}
    found = match_silhouettes(pair, at, biases, kernel, GraphConfig()).get(SemanticClass.VEHICLE)
    if found is None:
        return ClosePoints(0, 0)
    # By the camera's own projection: the residuals of a factor are those of a lens without distortion.
    matched = found.alignment
    taus_s = at.time_offset_s + matched.base_taus_s
    cPs = moved_points(at.cTl, matched.lPs.T, taus_s, motion, "se3", None).cPs.T
    assert matched.normals is not None
    residuals_px = (matched.normals * (camera.project(cPs) - matched.pixels)).sum(axis=1) + bias_px
    return ClosePoints(int((np.abs(residuals_px) < CLOSE_PX).sum()), len(residuals_px))

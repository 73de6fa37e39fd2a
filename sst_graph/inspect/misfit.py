"""How far the cloud may sit from the picture, by a result's covariance.

In the middle of the picture by the calibration alone, in pixels and centimetres from the same covariance: one
follows from the other by depth over focal length. Towards the corners a lens that is off counts as well, and
there it can be most of the error.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sst_graph.factors.camera import PinholeCamera
from sst_graph.inspect.pixels import cP_H_cTl, pixel_covariance, pose_pixel_covariance
from sst_graph.result import CalibrationResult
from sst_graph.types import FloatArray

DEPTHS_M = (10.0, 30.0, 60.0)
"""Depths for which the error in the picture is given [m]."""
MIDDLE_M = 30.0
"""The one of them that a sentence names [m]."""
DRIVING_MPS = 10.0
"""Speed, straight ahead, for which the error in the corners is given besides that at rest [m/s]."""
_PLACES = 3
"""Places across and down the picture, its borders among them: the worst of them stands for the corners."""
_MORE_IN_CORNERS = 1.5
"""The corners have a figure of their own where it is so many times that of the middle."""
LENS_COUNTS = 1.2
"""The lens counts where with it an error is so many times that by the calibration alone."""


@dataclass(frozen=True)
class Misfit:
    """How far a point of the cloud may sit from where the picture shows it: one standard deviation.

    Attributes:
        depth_m: of the point [m].
        pixels: straight ahead, in the worst direction, by the calibration's own covariance [px].
        across_px, down_px: the same along the picture's x and y [px].
        cm: the same across the line of sight [cm].
        corner_px: at the worst place of the picture, the lens counted
            (:func:`~sst_graph.inspect.pixels.pixel_covariance`) [px].
        corner_driving_px: the same at :data:`DRIVING_MPS`, where the time offset counts too [px].
        corner_pose_px: as ``corner_px`` by the calibration's own covariance [px].
    """

    depth_m: float
    pixels: float
    across_px: float
    down_px: float
    cm: float
    corner_px: float
    corner_driving_px: float
    corner_pose_px: float

    @property
    def more_in_corners(self) -> bool:
        """Whether the error is clearly larger in the corners than straight ahead."""
        return self.corner_px >= _MORE_IN_CORNERS * self.pixels

    @property
    def lens_counts(self) -> bool:
        """Whether the lens makes the corners clearly worse than the calibration alone does."""
        return self.corner_px >= LENS_COUNTS * self.corner_pose_px


def misfits(result: CalibrationResult) -> tuple[Misfit, ...]:
    """At each of :data:`DEPTHS_M`."""
    return tuple(misfit_at(result, depth_m) for depth_m in DEPTHS_M)


def misfit_at(result: CalibrationResult, depth_m: float) -> Misfit:
    """At one depth [m]."""
    forward = result.T_camera_lidar.rotation().unrotate(np.array([0.0, 0.0, DRIVING_MPS]))
    resting, driving = np.eye(6, 7), np.eye(6, 7)
    driving[3:, 6] = -forward
    ahead = np.array([0.0, 0.0, depth_m])
    in_picture = pose_pixel_covariance(result, ahead, resting)
    across, down = np.sqrt(np.maximum(np.diag(in_picture), 0.0)).tolist()
    sideways = cP_H_cTl(result.T_camera_lidar, ahead)[:2]
    corner, corner_driving, corner_pose = np.max(
        [
            (
                _worst(pixel_covariance(result, cP, resting)),
                _worst(pixel_covariance(result, cP, driving)),
                _worst(pose_pixel_covariance(result, cP, resting)),
            )
            for cP in _places(result.camera, depth_m)
        ],
        axis=0,
    ).tolist()
    return Misfit(
        depth_m,
        _worst(in_picture),
        across,
        down,
        100.0 * _worst(sideways @ result.covariance[:6, :6] @ sideways.T),
        corner,
        corner_driving,
        corner_pose,
    )


def _places(camera: PinholeCamera, depth_m: float) -> list[FloatArray]:
    """Points (3,) at a depth that are seen all over the picture [m]."""
    us, vs = (np.linspace(0.0, size - 1.0, _PLACES) for size in (camera.width, camera.height))
    return [
        depth_m * np.array([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1.0])
        for u in us
        for v in vs
    ]


def _worst(covariance: FloatArray) -> float:
    """Largest standard deviation in any direction."""
    return float(np.sqrt(max(0.0, np.linalg.eigvalsh(covariance)[-1])))

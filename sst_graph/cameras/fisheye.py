"""Fisheye after Kannala and Brandt (2006), as in OpenCV's ``fisheye``, ROS's and Kalibr's ``equidistant``.

With theta the angle to the optical axis and phi the angle about it,

    x' = d(theta) cos(phi),  y' = d(theta) sin(phi),
    d(theta) = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8).

theta may exceed 90 degrees. The valid field ends at the lens's own angle, or where d stops growing.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.polynomial import Polynomial

from sst_graph.cameras.model import LARGEST_COEFFICIENT, CameraModel, smallest_positive_root
from sst_graph.errors import ConfigError
from sst_graph.factors.camera import MIN_DEPTH_M
from sst_graph.types import BoolArray, FloatArray

_STEPS = 512
"""Of the table that starts Newton's method."""
_ITERATIONS = 20


@dataclass(frozen=True)
class FisheyeCamera(CameraModel):
    """Kannala–Brandt with four coefficients.

    Attributes:
        coefficients: k1, k2, k3, k4.
        field_of_view_deg: of the lens, at most 360: beyond half of it from the axis nothing is projected
            [deg].
    """

    coefficients: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
    field_of_view_deg: float = 360.0

    def __post_init__(self) -> None:
        if len(self.coefficients) != 4 or not (np.abs(self.coefficients) <= LARGEST_COEFFICIENT).all():
            raise ConfigError(f"fisheye camera: found coefficients {self.coefficients}, expected k1 k2 k3 k4")
        if not 0.0 < self.field_of_view_deg <= 360.0:
            raise ConfigError(
                f"fisheye camera: found a field of view of {self.field_of_view_deg} deg,"
                " expected more than 0 to 360"
            )

    @property
    def name(self) -> str:
        return "equidistant"

    @cached_property
    def largest_angle(self) -> float:
        """Angle to the axis at which the valid field ends [rad]."""
        square = smallest_positive_root(self._slope.coef[::2])
        return float(min(np.sqrt(square), np.deg2rad(0.5 * self.field_of_view_deg)))

    @cached_property
    def _distance(self) -> Polynomial:
        """d(theta)."""
        k1, k2, k3, k4 = self.coefficients
        return Polynomial([0.0, 1.0, 0.0, k1, 0.0, k2, 0.0, k3, 0.0, k4])

    @cached_property
    def _slope(self) -> Polynomial:
        return self._distance.deriv()

    def _distorted(self, cPs: FloatArray) -> tuple[FloatArray, BoolArray]:
        x, y, z = cPs.T
        r = np.hypot(x, y)
        theta = np.arctan2(r, z)
        # Straight behind the camera phi is not defined.
        valid = (np.hypot(r, z) > MIN_DEPTH_M) & (theta <= self.largest_angle) & ((r > 0.0) | (z > 0.0))
        by_r = np.where(r > 0.0, self._distance(theta) / np.where(r > 0.0, r, 1.0), 0.0)
        return cPs[:, :2] * by_r[:, None], valid

    def _undistorted(self, xys: FloatArray) -> tuple[FloatArray, BoolArray]:
        angles = np.linspace(0.0, self.largest_angle, _STEPS)
        distances = np.hypot(*xys.T)
        most = float(self._distance(self.largest_angle))
        # Half an ulp beyond the rim is rounding of the projection.
        valid = distances <= most * (1.0 + 1e-12)
        theta = np.interp(distances, self._distance(angles), angles)
        for _ in range(_ITERATIONS):
            step = (self._distance(theta) - distances) / np.maximum(self._slope(theta), 1e-9)
            theta = np.clip(theta - step, 0.0, self.largest_angle)
            if np.abs(step[valid]).max(initial=0.0) < 1e-16:
                break
        by_distance = np.where(
            distances > 0.0, np.sin(theta) / np.where(distances > 0.0, distances, 1.0), 0.0
        )
        return np.column_stack([xys * by_distance[:, None], np.cos(theta)]), valid

"""Double sphere camera (Usenko, Demmel and Cremers, "The Double Sphere Camera Model", 3DV 2018); Kalibr's ds.

A point is projected on to a unit sphere, the sphere's centre is shifted by xi, it is projected on to a second
sphere and from a centre shifted by alpha / (1 - alpha) on to the plane (eq. 40 to 52 of the paper).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sst_graph.cameras.model import CameraModel
from sst_graph.errors import ConfigError
from sst_graph.factors.camera import MIN_DEPTH_M
from sst_graph.types import BoolArray, FloatArray


@dataclass(frozen=True)
class DoubleSphereCamera(CameraModel):
    """Double sphere.

    Attributes:
        xi: distance of the spheres' centres, -1 to 1 (without the ends).
        alpha: 0 to 1 (without the end).
    """

    xi: float = 0.0
    alpha: float = 0.0

    def __post_init__(self) -> None:
        if not (-1.0 < self.xi < 1.0 and 0.0 <= self.alpha < 1.0):
            raise ConfigError(
                f"double sphere camera: found xi = {self.xi}, alpha = {self.alpha},"
                " expected xi between -1 and 1, alpha from 0 to below 1"
            )

    @property
    def name(self) -> str:
        return "double_sphere"

    @property
    def axis_scale(self) -> float:
        return 1.0 / (1.0 + self.xi)

    def _distorted(self, cPs: FloatArray) -> tuple[FloatArray, BoolArray]:
        xi, alpha = self.xi, self.alpha
        x, y, z = cPs.T
        d1 = np.sqrt(x * x + y * y + z * z)
        shifted = xi * d1 + z
        d2 = np.sqrt(x * x + y * y + shifted * shifted)
        valid = (d1 > MIN_DEPTH_M) & (z > -self._w2 * d1)
        below = alpha * d2 + (1.0 - alpha) * shifted
        valid &= below > 0.0
        return cPs[:, :2] / np.where(valid, below, 1.0)[:, None], valid

    @property
    def _w2(self) -> float:
        """Cosine of the angle between the backward axis and the end of the valid field."""
        w1 = self.alpha / (1.0 - self.alpha) if self.alpha <= 0.5 else (1.0 - self.alpha) / self.alpha
        return float((w1 + self.xi) / np.sqrt(2.0 * w1 * self.xi + self.xi**2 + 1.0))

    def _undistorted(self, xys: FloatArray) -> tuple[FloatArray, BoolArray]:
        xi, alpha = self.xi, self.alpha
        s = np.einsum("ij,ij->i", xys, xys)
        under = 1.0 - (2.0 * alpha - 1.0) * s
        valid = under >= 0.0
        mz = (1.0 - alpha**2 * s) / (alpha * np.sqrt(np.maximum(under, 0.0)) + 1.0 - alpha)
        inner = mz**2 + (1.0 - xi**2) * s
        factor = (mz * xi + np.sqrt(np.maximum(inner, 0.0))) / (mz**2 + s)
        rays = np.column_stack([factor[:, None] * xys, factor * mz - xi])
        valid &= (inner >= 0.0) & (rays[:, 2] > -self._w2)
        return rays, valid

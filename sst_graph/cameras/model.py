"""What every camera model does: from points to pixels and from pixels to rays, with its field of validity.

A model maps a direction to the normalised image plane, [x, y], and pixels are u = fx x + cx, v = fy y + cy.
Pixel centres lie at integer coordinates, so that an image covers -0.5 <= u < width - 0.5.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sst_graph.factors.camera import PinholeCamera
from sst_graph.types import BoolArray, FloatArray

LARGEST_COEFFICIENT = 1e6
"""Of a distortion; larger ones are no lens, and their powers overflow."""


@dataclass(frozen=True)
class CameraModel(ABC):
    """A camera with one centre.

    Attributes:
        intrinsics: focal lengths, principal point and size of the image [px].
    """

    intrinsics: PinholeCamera

    @property
    @abstractmethod
    def name(self) -> str:
        """Name of the model, as ROS or Kalibr has it."""

    @property
    def width(self) -> int:
        return self.intrinsics.width

    @property
    def height(self) -> int:
        return self.intrinsics.height

    @property
    def is_pinhole(self) -> bool:
        """Whether nothing is distorted, so that the image needs no rectification."""
        return False

    @property
    def axis_scale(self) -> float:
        """Length on the normalised image plane of a radian at the optical axis."""
        return 1.0

    def project(self, cPs: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Pixels (n, 2) of points cPs (n, 3) in the camera [m], and (n,) which lie in the valid field.

        The others are NaN. A pixel may lie off the image.
        """
        xys, valid = self._distorted(np.asarray(cPs, np.float64))
        K = self.intrinsics
        uvs = xys * [K.fx, K.fy] + [K.cx, K.cy]
        valid = valid & np.isfinite(uvs).all(axis=1)
        return np.where(valid[:, None], uvs, np.nan), valid

    def unproject(self, uvs: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Unit rays (n, 3) in the camera through pixels uvs (n, 2), and (n,) which pixels have one.

        The others are NaN. A pixel may lie off the image.
        """
        K = self.intrinsics
        xys = (np.asarray(uvs, np.float64) - [K.cx, K.cy]) / [K.fx, K.fy]
        rays, valid = self._undistorted(xys)
        valid = valid & np.isfinite(rays).all(axis=1)
        return np.where(valid[:, None], rays, np.nan), valid

    @abstractmethod
    def _distorted(self, cPs: FloatArray) -> tuple[FloatArray, BoolArray]:
        """(n, 2) on the normalised image plane, and (n,) whether the model holds for the point."""

    @abstractmethod
    def _undistorted(self, xys: FloatArray) -> tuple[FloatArray, BoolArray]:
        """(n, 3) unit rays, and (n,) whether a ray of the valid field falls there."""


def smallest_positive_root(coefficients: NDArray[Any]) -> float:
    """Smallest positive root of a polynomial, the constant first; inf where there is none."""
    used = np.trim_zeros(np.array(coefficients, np.float64), "b")
    if len(used) < 2:
        return np.inf
    roots = np.polynomial.Polynomial(used).roots()
    real = roots[np.abs(roots.imag) < 1e-9 * np.maximum(1.0, np.abs(roots))].real
    return float(real[real > 0.0].min(initial=np.inf))

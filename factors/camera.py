"""Pinhole projection and its Jacobian, vectorised over points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .arguments import FloatArray, checked_count, checked_number, checked_positive, checked_rows

MIN_DEPTH_M = 0.1
"""Points nearer to the image plane than this [m], or behind it, are not projected."""


@dataclass(frozen=True)
class PinholeCamera:
    """An ideal (rectified) pinhole camera; pixel centres at integer coordinates.

    Attributes:
        fx, fy, cx, cy: intrinsics [px].
        width, height: image size [px].

    Raises:
        FactorError: focal lengths that are not above 0, a centre that is no number, sides that are no whole
            numbers above 0; and of the methods: points or pixels of another shape.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    def __post_init__(self) -> None:
        plain: dict[str, float] = {}
        for name in ("fx", "fy"):
            plain[name] = checked_positive(f"{name} of PinholeCamera", getattr(self, name))
        for name in ("cx", "cy"):
            plain[name] = checked_number(f"{name} of PinholeCamera", getattr(self, name))
        for name in ("width", "height"):
            side = getattr(self, name)
            plain[name] = checked_count(f"{name} of PinholeCamera", side, "a whole number of pixels above 0")
        for name, number in plain.items():  # of NumPy's types, whole numbers overflow and arrays have no hash
            object.__setattr__(self, name, number)

    @property
    def matrix(self) -> FloatArray:
        """(3, 3) intrinsic matrix K [px]."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def in_front(self, cPs: FloatArray) -> NDArray[np.bool_]:
        """(n,) whether points cPs (n, 3) [m] lie in front of the camera, so that they project."""
        cPs = checked_rows("cPs", cPs, 3)
        return np.asarray(cPs[:, 2] > MIN_DEPTH_M)

    def in_image(self, uvs: FloatArray) -> NDArray[np.bool_]:
        """(n,) whether pixels uvs (n, 2) fall on the image, borders included."""
        uvs = checked_rows("uvs", uvs, 2)
        u, v = uvs[:, 0], uvs[:, 1]
        return np.asarray((u >= -0.5) & (u < self.width - 0.5) & (v >= -0.5) & (v < self.height - 0.5))

    def project(self, cPs: FloatArray) -> FloatArray:
        """uv = [fx X/Z + cx, fy Y/Z + cy] of points cPs (n, 3) in the camera [m] -> (n, 2) [px].

        Points that are not :meth:`in_front` give NaN.
        """
        cPs = checked_rows("cPs", cPs, 3)
        z = np.where(self.in_front(cPs), cPs[:, 2], np.nan)
        return np.stack([self.fx * cPs[:, 0] / z + self.cx, self.fy * cPs[:, 1] / z + self.cy], axis=1)

    def uv_H_cP(self, cPs: FloatArray) -> FloatArray:
        """(n, 2, 3) derivative of the pixel by the point in the camera frame [px/m]."""
        cPs = checked_rows("cPs", cPs, 3)
        inverse_z = 1.0 / cPs[:, 2]
        x, y = cPs[:, 0] * inverse_z, cPs[:, 1] * inverse_z
        H = np.zeros((len(cPs), 2, 3))
        H[:, 0, 0] = self.fx * inverse_z
        H[:, 0, 2] = -self.fx * x * inverse_z
        H[:, 1, 1] = self.fy * inverse_z
        H[:, 1, 2] = -self.fy * y * inverse_z
        return H

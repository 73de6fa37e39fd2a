"""Pinhole with radial, tangential and thin-prism distortion: OpenCV's standard model.

With x = X/Z, y = Y/Z, s = x^2 + y^2 and the radial factor
c(s) = (1 + k1 s + k2 s^2 + k3 s^3) / (1 + k4 s + k5 s^2 + k6 s^3),

    x' = c x + 2 p1 x y + p2 (s + 2 x^2) + s1 s + s2 s^2
    y' = c y + p1 (s + 2 y^2) + 2 p2 x y + s3 s + s4 s^2

(OpenCV, "Camera Calibration and 3D Reconstruction"). The polynomial is meant for the angles of the lens only:
where the distorted radius r c(r^2) stops growing, two directions fall on one pixel. The valid field ends
there.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.polynomial import Polynomial

from sst_graph.cameras.model import LARGEST_COEFFICIENT, CameraModel, smallest_positive_root
from sst_graph.errors import ConfigError, count_of
from sst_graph.types import BoolArray, FloatArray

_NAMES = {0: "pinhole", 4: "plumb_bob", 5: "plumb_bob", 8: "rational_polynomial", 12: "thin_prism"}
_WIDEST = np.tan(np.deg2rad(89.5))
"""Slope of a ray beyond which no pinhole image reaches."""
_STEPS = 512
"""Of the table that starts Newton's method."""
_ITERATIONS = 30
_CLOSE = 1e-12
"""Of the normalised image plane: residual at which Newton's method has converged."""


@dataclass(frozen=True)
class BrownConradyCamera(CameraModel):
    """Plumb-bob (k1 k2 p1 p2 [k3]), rational (and k4 k5 k6) or thin-prism (and s1 s2 s3 s4) distortion.

    Attributes:
        coefficients: none, 4, 5, 8 or 12, in OpenCV's order.
    """

    coefficients: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if len(self.coefficients) not in _NAMES:
            found = count_of(len(self.coefficients), "distortion coefficient")
            raise ConfigError(f"camera: found {found}, expected 0, 4, 5, 8 or 12")
        if not (np.abs(self.coefficients) <= LARGEST_COEFFICIENT).all():
            raise ConfigError(f"camera: found coefficients {self.coefficients}, expected finite numbers")

    @property
    def name(self) -> str:
        return _NAMES[len(self.coefficients)]

    @property
    def is_pinhole(self) -> bool:
        return not any(self.coefficients)

    @cached_property
    def largest_radius(self) -> float:
        """r = tan(angle to the axis) at which the distorted radius turns back or has a pole; inf: nowhere."""
        N, D = self._radial
        # d/dr [r N/D] = 0 with s = r^2: (N + 2 s N') D - 2 s N D' = 0.
        s = Polynomial([0.0, 1.0])
        turn = (N + 2.0 * s * N.deriv()) * D - 2.0 * s * N * D.deriv()
        return float(np.sqrt(min(smallest_positive_root(turn.coef), smallest_positive_root(D.coef))))

    @cached_property
    def _all(self) -> FloatArray:
        """(12,) coefficients, 0 where the model has none."""
        return np.array([*self.coefficients, *[0.0] * (12 - len(self.coefficients))])

    @cached_property
    def _radial(self) -> tuple[Polynomial, Polynomial]:
        """Numerator and denominator of c(s)."""
        k1, k2, _, _, k3, k4, k5, k6 = self._all[:8]
        return Polynomial([1.0, k1, k2, k3]), Polynomial([1.0, k4, k5, k6])

    @cached_property
    def _table(self) -> tuple[FloatArray, FloatArray]:
        """Distorted radii and the radii that they come from, rising."""
        N, D = self._radial
        radii = np.tan(np.linspace(0.0, np.arctan(min(self.largest_radius, _WIDEST)), _STEPS))
        return radii * N(radii**2) / D(radii**2), radii

    def _mapped(self, xys: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(n, 2) distorted, and its (n, 2, 2) derivative."""
        _, _, p1, p2, _, _, _, _, s1, s2, s3, s4 = self._all
        N, D = self._radial
        x, y = xys.T
        s = x * x + y * y
        n, d = N(s), D(s)
        c = n / d
        c_s = (N.deriv()(s) * d - n * D.deriv()(s)) / d**2
        moved = np.stack(
            [
                c * x + 2.0 * p1 * x * y + p2 * (s + 2.0 * x * x) + s1 * s + s2 * s * s,
                c * y + p1 * (s + 2.0 * y * y) + 2.0 * p2 * x * y + s3 * s + s4 * s * s,
            ],
            axis=1,
        )
        H = np.empty((len(xys), 2, 2))
        prism_x, prism_y = s1 + 2.0 * s2 * s, s3 + 2.0 * s4 * s
        H[:, 0, 0] = c + 2.0 * x * x * c_s + 2.0 * p1 * y + 6.0 * p2 * x + 2.0 * x * prism_x
        H[:, 0, 1] = 2.0 * x * y * c_s + 2.0 * p1 * x + 2.0 * p2 * y + 2.0 * y * prism_x
        H[:, 1, 0] = 2.0 * x * y * c_s + 2.0 * p1 * x + 2.0 * p2 * y + 2.0 * x * prism_y
        H[:, 1, 1] = c + 2.0 * y * y * c_s + 6.0 * p1 * y + 2.0 * p2 * x + 2.0 * y * prism_y
        return moved, H

    def _holds(self, xys: FloatArray, H: FloatArray) -> BoolArray:
        """(n,) whether undistorted xys lie where the mapping, with derivative H, has not turned back."""
        determinant = H[:, 0, 0] * H[:, 1, 1] - H[:, 0, 1] * H[:, 1, 0]
        return np.asarray((np.hypot(*xys.T) < min(self.largest_radius, _WIDEST)) & (determinant > 0.0))

    def _distorted(self, cPs: FloatArray) -> tuple[FloatArray, BoolArray]:
        front = self.intrinsics.in_front(cPs)
        xys = np.where(front[:, None], cPs[:, :2] / np.where(front, cPs[:, 2], 1.0)[:, None], 0.0)
        with np.errstate(all="ignore"):
            moved, H = self._mapped(xys)
            return moved, front & self._holds(xys, H)

    def _undistorted(self, xys: FloatArray) -> tuple[FloatArray, BoolArray]:
        distances = np.hypot(*xys.T)
        radii = np.interp(distances, *self._table)
        guess = xys * (radii / np.maximum(distances, 1e-12))[:, None]
        with np.errstate(all="ignore"):
            for _ in range(_ITERATIONS):
                moved, H = self._mapped(guess)
                off = moved - xys
                if np.abs(off).max(initial=0.0) < 1e-16:
                    break
                (a, b), (c, d) = np.moveaxis(H, 0, -1)
                determinant = a * d - b * c
                step = np.stack([d * off[:, 0] - b * off[:, 1], a * off[:, 1] - c * off[:, 0]], axis=1)
                step /= np.where(np.abs(determinant) > 1e-15, determinant, 1e-15)[:, None]
                # A step of half the radius at most: beyond the turn of the polynomial there is no way back.
                size = np.hypot(*step.T)
                limit = 0.5 * (np.hypot(*guess.T) + 0.1)
                guess = guess - step * np.minimum(1.0, limit / np.maximum(size, 1e-300))[:, None]
            moved, H = self._mapped(guess)
            close = np.abs(moved - xys).max(axis=1, initial=0.0) < _CLOSE * np.maximum(1.0, distances)
            valid = close & self._holds(guess, H)
        rays = np.column_stack([guess, np.ones(len(guess))])
        return rays / np.linalg.norm(rays, axis=1)[:, None], valid

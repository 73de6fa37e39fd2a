"""Motion of points in the camera over a pair's interval, with closed-form Jacobians.

    cP_i = Exp(-tau_i w_i) . (cTl . lP_i),   w_i = c_twist - tau_i/2 * c_acceleration

``c_twist`` is the camera's twist at the image's instant (``tau`` = 0) and ``w_i`` its mean over the
interval under a constant acceleration. Signs are those of :mod:`factors`. The first-order model of
SST-Calib (Kodaira et al., ITSC 2022), ``model="translation"``, has

    cP_i = cTl . lP_i - tau_i v_i,   v_i the linear part of w_i (the paper's v_k is -v).

Points are columns here: (3, n); a Jacobian over k residual rows of n points is (cols, k, n).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import gtsam
import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
MotionModel = Literal["se3", "translation"]

_TERMS = 10
_SERIES_LIMIT = 1.0
"""Below this squared angle [rad^2] the power series (exact to 1e-16) stand in for the closed forms."""


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """a x b over the first axis; the other axes broadcast (np.cross is several times slower)."""
    return np.stack(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]],
    )


def left_jacobian_coefficients(squared_angles: FloatArray) -> FloatArray:
    """c_1 .. c_4 with J_l(xi) = I + sum_k c_k ad(xi)^k, from x = theta^2 (n,) -> (4, n).

    The closed forms (Barfoot, State Estimation for Robotics, 7.95) cancel badly at small angles, so
    there the series sum ad^k / (k+1)! is used, its powers above 4 reduced by ad^5 = -2 x ad^3 - x^2 ad.
    """
    x = np.asarray(squared_angles, dtype=np.float64)
    if x.size == 0 or float(x.max()) < _SERIES_LIMIT:
        return _series_coefficients(x)
    large = np.maximum(x, _SERIES_LIMIT)
    t = np.sqrt(large)
    sin, cos = np.sin(t), np.cos(t)
    closed = np.stack(
        [
            (4.0 - t * sin - 4.0 * cos) / (2.0 * t**2),
            (4.0 * t - 5.0 * sin + t * cos) / (2.0 * t**3),
            (2.0 - t * sin - 2.0 * cos) / (2.0 * t**4),
            (2.0 * t - 3.0 * sin + t * cos) / (2.0 * t**5),
        ]
    )
    return np.where(x < _SERIES_LIMIT, _series_coefficients(np.minimum(x, _SERIES_LIMIT)), closed)


def _series_coefficients(x: FloatArray) -> FloatArray:
    """ad^(2m+1) = a_m x^(m-1) ad^3 + b_m x^m ad, with a_m = (-1)^(m+1) m and b_m = (-1)^m (1-m)."""
    result = np.zeros((4, *x.shape))
    for m in reversed(range(_TERMS)):  # Horner
        sign = (-1.0) ** m
        result[0] = result[0] * x + sign * (1 - m) / math.factorial(2 * m + 2)
        result[1] = result[1] * x + sign * (1 - m) / math.factorial(2 * m + 3)
        result[2] = result[2] * x + sign * (m + 1) / math.factorial(2 * m + 4)
        result[3] = result[3] * x + sign * (m + 1) / math.factorial(2 * m + 5)
    return result


def twist_ad(xi: FloatArray) -> FloatArray:
    """(6, 6) matrix ad(xi) of one twist [omega, v]."""
    ad = np.zeros((6, 6))
    ad[:3, :3] = ad[3:, 3:] = _skew(xi[:3])
    ad[3:, :3] = _skew(xi[3:])
    return ad


def se3_left_jacobian(xi: FloatArray) -> FloatArray:
    """(6, 6) J_l: Exp(xi + d) = Exp(J_l(xi) d) Exp(xi) to first order."""
    c = left_jacobian_coefficients(np.array([xi[:3] @ xi[:3]]))[:, 0]
    ad = twist_ad(xi)
    ad2 = ad @ ad
    return np.asarray(np.eye(6) + c[0] * ad + c[1] * ad2 + c[2] * ad2 @ ad + c[3] * ad2 @ ad2)


def _skew(a: FloatArray) -> FloatArray:
    return np.array([[0.0, -a[2], a[1]], [a[2], 0.0, -a[0]], [-a[1], a[0], 0.0]])


@dataclass(frozen=True)
class MovedPoints:
    """Points at their image's instant, and what their derivatives need.

    Attributes:
        lPs: (3, n) points in the LiDAR [m].
        cPs: (3, n) points in the camera at the image's instant [m].
        taus_s: interval of each point (n,), or one float for all [s].
        cRls: (3, 3) rotation from the LiDAR to ``cPs``, or (3, 3, n).
        xis: (6,) or (6, n) twist of the displacement, -tau w.
        rates: (6,) or (6, n) -d xi / d tau = c_twist - tau c_acceleration.
        model: "se3" or "translation".
    """

    lPs: FloatArray
    cPs: FloatArray
    taus_s: FloatArray | float
    cRls: FloatArray
    xis: FloatArray
    rates: FloatArray
    model: MotionModel

    def pull_back(self, g: FloatArray, out: FloatArray, motion: bool = True) -> None:
        """Derivatives of residuals from their gradients by cP.

        Args:
            g: (3, k, n) gradient of k residuals of each point by its cP.
            out: (13, k, n), written: rows 0:6 by cTl (right perturbation, [rot, trans]), 6 by the
                offset [1/s], 7:13 by c_twist.
            motion: False writes zeros to rows 6:13 and saves their work.
        """
        n = self.lPs.shape[1]
        if self.cRls.ndim == 2:
            np.matmul(self.cRls.T, g.reshape(3, -1), out=out[3:6].reshape(3, -1))
        else:
            np.einsum("ijn,ikn->jkn", self.cRls, g, out=out[3:6])
        out[0:3] = cross(self.lPs.reshape(3, 1, n), out[3:6])
        if not motion:
            out[6:13] = 0.0
        else:
            wrench = self._pull_to_twist(g)
            np.multiply(wrench, -np.asarray(self.taus_s), out=out[7:13])
            rates = self.rates.reshape(6, 1, -1)
            out[6] = -(rates * wrench).sum(axis=0)

    def _pull_to_twist(self, g: FloatArray) -> FloatArray:
        """J_l(xi)^T [cP x g; g], (6, k, n): the gradient by xi."""
        L = np.empty((6, *g.shape[1:]))
        if self.model == "translation":
            L[:3], L[3:] = 0.0, g
            return L
        L[:3], L[3:] = cross(self.cPs.reshape(3, 1, -1), g), g
        if self.xis.ndim == 1:
            return np.asarray((se3_left_jacobian(self.xis).T @ L.reshape(6, -1)).reshape(L.shape))
        omega, v = self.xis[:3, None, :], self.xis[3:, None, :]
        coefficients = left_jacobian_coefficients((self.xis[:3] ** 2).sum(axis=0))
        result = L.copy()
        for coefficient in coefficients:  # L <- ad(xi)^T L
            L = np.concatenate([-cross(omega, L[:3]) - cross(v, L[3:]), -cross(omega, L[3:])])
            result += coefficient * L
        return result


def move_points(
    cTl: gtsam.Pose3,
    lPs: FloatArray,
    taus_s: FloatArray | float,
    c_twist: FloatArray,
    c_acceleration: FloatArray,
    model: MotionModel = "se3",
) -> MovedPoints:
    """cP = Exp(-tau w) . (cTl . lP) for points lPs (3, n) [m]; taus_s (n,), or one float for all."""
    R = np.asarray(cTl.rotation().matrix())
    t = np.asarray(cTl.translation()).reshape(3, 1)
    if isinstance(taus_s, float):
        xis = -taus_s * (c_twist - 0.5 * taus_s * c_acceleration)
        rates = c_twist - taus_s * c_acceleration
    else:
        xis = -taus_s * (c_twist[:, None] - 0.5 * taus_s * c_acceleration[:, None])
        rates = c_twist[:, None] - taus_s * c_acceleration[:, None]
    if model == "translation":
        cPs = R @ lPs + t + xis[3:].reshape(3, -1)
        return MovedPoints(lPs, cPs, taus_s, R, xis, rates, model)
    if xis.ndim == 1:
        cTl_moved = gtsam.Pose3.Expmap(xis) * cTl
        R = np.asarray(cTl_moved.rotation().matrix())
        cPs = R @ lPs + np.asarray(cTl_moved.translation()).reshape(3, 1)
        return MovedPoints(lPs, cPs, taus_s, R, xis, rates, model)
    Rs, ts = _exponentials(xis)
    cRls = np.einsum("ijn,jk->ikn", Rs, R)
    cPs = np.einsum("ijn,jn->in", Rs, R @ lPs + t) + ts
    return MovedPoints(lPs, cPs, taus_s, cRls, xis, rates, model)


def _exponentials(xis: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rotations (3, 3, n) and translations (3, n) of Exp(xi) for xis (6, n)."""
    omegas, vs = xis[:3], xis[3:]
    x = (omegas**2).sum(axis=0)
    theta = np.sqrt(x)
    a = np.sinc(theta / np.pi)
    b = 0.5 * np.sinc(theta / (2.0 * np.pi)) ** 2
    c = _sine_remainder(x)
    K = np.zeros((3, 3, xis.shape[1]))
    K[2, 1], K[0, 2], K[1, 0] = omegas
    K[1, 2], K[2, 0], K[0, 1] = -omegas
    outer = omegas[:, None, :] * omegas[None, :, :]
    Rs = a * K + b * outer
    Rs[[0, 1, 2], [0, 1, 2]] += np.cos(theta)
    wv = cross(omegas, vs)
    return Rs, vs + b * wv + c * cross(omegas, wv)


def _sine_remainder(x: FloatArray) -> FloatArray:
    """(theta - sin theta) / theta^3 from x = theta^2, without cancellation."""
    series = np.zeros_like(x)
    small = np.minimum(x, _SERIES_LIMIT)
    for m in reversed(range(_TERMS)):
        series = series * small + (-1.0) ** m / math.factorial(2 * m + 3)
    large = np.sqrt(np.maximum(x, _SERIES_LIMIT))
    return np.where(x < _SERIES_LIMIT, series, (large - np.sin(large)) / large**3)

"""Motion of points in the camera over a pair's interval, with closed-form Jacobians.

    cP_i = Exp(-tau_i w_i) . (cTl . lP_i),   w_i = c_twist - tau_i/2 * c_acceleration

``c_twist`` is the camera's twist at the image's instant (``tau`` = 0) and ``w_i`` its mean over the
interval under a constant acceleration. Signs are those of :mod:`factors`. The first-order model of
SST-Calib (Kodaira et al., ITSC 2022), ``model="translation"``, has

    cP_i = cTl . lP_i - tau_i v_i,   v_i the linear part of w_i (the paper's v_k is -v).

Points are columns here: (3, n); a Jacobian over k residual rows of n points is (cols, k, n).

Where all points share one tau, the scan moves as one rigid body, cP_i = cTl' . lP_i, and every
derivative factors through the six numbers L_i = [cP_i x g_i; g_i] of a residual's gradient g_i by cP_i
(a wrench): J_i = lift . L_i with one (13, 6) matrix for all points. :class:`RigidlyMoved` keeps that
form, which halves the work; :class:`PointwiseMoved` is the general case.
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


def write_cross(a: FloatArray, b: FloatArray, out: FloatArray) -> None:
    """a x b over the first axis into ``out``; the other axes broadcast (np.cross is several times slower)."""
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        np.multiply(a[j], b[k], out=out[i])
        out[i] -= a[k] * b[j]


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """a x b over the first axis; the other axes broadcast."""
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    write_cross(a, b, out)
    return out


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
class RigidlyMoved:
    """Points that share one tau.

    Attributes:
        cPs: (3, n) points in the camera at the image's instant [m].
        lift: (13, 6), from a wrench to the derivatives by cTl (right perturbation, [rot, trans]), offset
            and c_twist.
    """

    cPs: FloatArray
    lift: FloatArray

    def write_rows(self, g: FloatArray, out: FloatArray) -> None:
        """Wrenches [cP x g; g] into out (6, k, n), from the gradients g (3, k, n) by cP."""
        write_cross(self.cPs[:, None, :], g, out[:3])
        out[3:] = g


@dataclass(frozen=True)
class PointwiseMoved:
    """Points with a tau each.

    Attributes:
        lPs, cPs: (3, n) points in the LiDAR, and in the camera at the image's instant [m].
        lift: None, :meth:`write_rows` gives the derivatives themselves.
        taus_s: (n,) interval of each point [s].
        cRl: (3, 3) rotation of the LiDAR in the camera, before the motion.
        xis: (6, n) twist of the displacement, -tau w.
        rates: (6, n) -d xi / d tau = c_twist - tau c_acceleration.
        model: see :data:`MotionModel`.
    """

    lPs: FloatArray
    cPs: FloatArray
    lift: None
    taus_s: FloatArray
    cRl: FloatArray
    xis: FloatArray
    rates: FloatArray
    model: MotionModel

    def write_rows(self, g: FloatArray, out: FloatArray) -> None:
        """Derivatives into out (13, k, n), columns as in :class:`RigidlyMoved`, from the gradients g."""
        rotated = g if self.model == "translation" else _rotate(-self.xis[:3], g)
        np.matmul(self.cRl.T, rotated.reshape(3, -1), out=out[3:6].reshape(3, -1))
        write_cross(self.lPs[:, None, :], out[3:6], out[:3])
        wrench = self._gradient_by_xi(g)
        np.multiply(wrench, -self.taus_s, out=out[7:13])
        np.einsum("in,ikn->kn", -self.rates, wrench, out=out[6])

    def _gradient_by_xi(self, g: FloatArray) -> FloatArray:
        """J_l(xi)^T [cP x g; g], (6, k, n)."""
        L = np.zeros((6, *g.shape[1:]))
        L[3:] = g
        if self.model == "translation":
            return L
        write_cross(self.cPs[:, None, :], g, L[:3])
        omega, v = self.xis[:3, None, :], self.xis[3:, None, :]
        result = L.copy()
        for coefficient in left_jacobian_coefficients((self.xis[:3] ** 2).sum(axis=0)):
            # L <- ad(xi)^T L = [L_omega x omega + L_v x v; L_v x omega]
            L = np.concatenate([cross(L[:3], omega) + cross(L[3:], v), cross(L[3:], omega)])
            result += coefficient * L
        return result


def move_points(
    cTl: gtsam.Pose3,
    lPs: FloatArray,
    taus_s: FloatArray | float,
    c_twist: FloatArray,
    c_acceleration: FloatArray,
    model: MotionModel = "se3",
) -> RigidlyMoved | PointwiseMoved:
    """cP = Exp(-tau w) . (cTl . lP).

    Args:
        cTl: pose of the LiDAR in the camera.
        lPs: (3, n) points in the LiDAR [m].
        taus_s: (n,) interval of each point, or one float for all [s].
        c_twist: (6,) camera twist at the image's instant [rad/s, m/s].
        c_acceleration: (6,) its rate of change [rad/s^2, m/s^2].
        model: see :data:`MotionModel`.
    """
    if isinstance(taus_s, float):
        return _move_rigidly(cTl, lPs, taus_s, c_twist, c_acceleration, model)
    R = np.asarray(cTl.rotation().matrix())
    cPs = R @ lPs + np.asarray(cTl.translation()).reshape(3, 1)
    xis = np.outer(c_twist, -taus_s) + np.outer(0.5 * c_acceleration, taus_s**2)
    rates = c_twist[:, None] - np.outer(c_acceleration, taus_s)
    cPs = cPs + xis[3:] if model == "translation" else _move(xis, cPs)
    return PointwiseMoved(lPs, cPs, None, taus_s, R, xis, rates, model)


def _move_rigidly(
    cTl: gtsam.Pose3,
    lPs: FloatArray,
    tau_s: float,
    c_twist: FloatArray,
    c_acceleration: FloatArray,
    model: MotionModel,
) -> RigidlyMoved:
    xi = -tau_s * (c_twist - 0.5 * tau_s * c_acceleration)
    rate = c_twist - tau_s * c_acceleration
    if model == "translation":
        moved = gtsam.Pose3(cTl.rotation(), cTl.translation() + xi[3:])
        left = np.diag([0.0, 0.0, 0.0, 1.0, 1.0, 1.0])
    else:
        moved = gtsam.Pose3.Expmap(xi) * cTl
        left = se3_left_jacobian(xi)
    lift = np.empty((13, 6))
    lift[0:6] = moved.AdjointMap().T
    lift[6] = -left @ rate
    lift[7:13] = -tau_s * left.T
    R, t = np.asarray(moved.rotation().matrix()), np.asarray(moved.translation())
    return RigidlyMoved(R @ lPs + t.reshape(3, 1), lift)


def _rotate(omegas: FloatArray, a: FloatArray) -> FloatArray:
    """Exp(omega) a for omegas (3, n) and a (3, n) or (3, k, n), by Rodrigues' formula."""
    theta = np.sqrt((omegas**2).sum(axis=0))
    axis = omegas[:, None, :] if a.ndim == 3 else omegas
    wa = cross(axis, a)
    wwa = cross(axis, wa)
    wa *= np.sinc(theta / np.pi)
    wwa *= 0.5 * np.sinc(theta / (2.0 * np.pi)) ** 2
    wa += wwa
    wa += a
    return wa


def _move(xis: FloatArray, points: FloatArray) -> FloatArray:
    """Exp(xi) . p for xis (6, n) and points (3, n)."""
    omegas, vs = xis[:3], xis[3:]
    x = (omegas**2).sum(axis=0)
    wv = cross(omegas, vs)
    t = vs + 0.5 * np.sinc(np.sqrt(x) / (2.0 * np.pi)) ** 2 * wv + _sine_remainder(x) * cross(omegas, wv)
    return np.asarray(_rotate(omegas, points) + t)


def _sine_remainder(x: FloatArray) -> FloatArray:
    """(theta - sin theta) / theta^3 from x = theta^2, without cancellation."""
    series = np.zeros_like(x)
    small = np.minimum(x, _SERIES_LIMIT)
    for m in reversed(range(_TERMS)):
        series = series * small + (-1.0) ** m / math.factorial(2 * m + 3)
    large = np.sqrt(np.maximum(x, _SERIES_LIMIT))
    return np.where(x < _SERIES_LIMIT, series, (large - np.sin(large)) / large**3)

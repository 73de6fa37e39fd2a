"""Motion of points in the camera over a pair's interval, with closed-form Jacobians.

    cP_i = Exp(-tau_i w_i) . (cTl . lP_i),   w_i = c_twist - tau_i/2 * c_acceleration

``c_twist`` is the camera's twist at the image's instant (``tau`` = 0) and ``w_i`` its mean over the
interval under a constant acceleration. Signs are those of :mod:`factors`. The first-order model of
SST-Calib (Kodaira et al., ITSC 2022), ``model="translation"``, has

    cP_i = cTl . lP_i - tau_i v_i,   v_i the linear part of w_i (the paper's v_k is -v).

A point of an object that moves over ground by itself, with velocity u_i in the LiDAR frame of its scan, is at
lP_i + tau_i u_i at the image's instant; that takes the place of lP_i above.

Points are columns here: (3, n); a Jacobian over k residual rows of n points is (cols, k, n).

Where all points share one tau, the scan moves as one rigid body, cP_i = cTl' . lP_i, and every
derivative factors through the six numbers L_i = [cP_i x g_i; g_i] of a residual's gradient g_i by cP_i
(a wrench): J_i = lift . L_i with one (13, 6) matrix for all points. Where some objects move, a seventh number
is the derivative by the way that the point's own has made, (cRl' u_i) . g_i, and belongs to the offset.
:class:`RigidlyMoved` keeps that form, which halves the work, :class:`GroupsMoved` keeps it for the points of
many images, each with its lift; :class:`PointwiseMoved` is the general case.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, ClassVar, Literal, NamedTuple, get_args

import gtsam
import numpy as np
from numpy.typing import NDArray

from .arguments import (
    FloatArray,
    as_numbers,
    checked_array,
    checked_gtsam,
    checked_number_or_array,
    checked_type,
    described,
)
from .errors import FactorError

IntArray = NDArray[np.intp]
MotionModel = Literal["se3", "translation"]

_TERMS = 10
"""Of the power series."""
_SERIES_LIMIT = 1.0
"""Below this squared angle [rad^2] the power series (exact to 1e-16) replaces the closed forms."""


def checked_model(model: Any) -> None:
    """Nothing, where it is one of :data:`MotionModel`."""
    if not isinstance(model, str) or model not in get_args(MotionModel):
        raise FactorError("motion model", described(model), " or ".join(get_args(MotionModel)))


def write_cross(a: FloatArray, b: FloatArray, out: FloatArray) -> None:
    """a x b over the first axis into ``out``; the other axes broadcast (np.cross is several times slower)."""
    other = np.empty(out.shape[1:])
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        np.multiply(a[j], b[k], out=out[i])
        np.multiply(a[k], b[j], out=other)
        out[i] -= other


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """a x b over the first axis; the other axes broadcast."""
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    write_cross(a, b, out)
    return out


def cross_rows(a: FloatArray, b: FloatArray) -> FloatArray:
    """(n, 3) a x b of rows (n, 3), one of which may be a single vector (3,)."""
    (ax, ay, az), (bx, by, bz) = a.T, b.T
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=1)


def _series_table() -> FloatArray:
    """(terms, 4): coefficients of x^m in b, c, db/dx, dc/dx of :func:`exponential_coefficients`."""
    table = np.zeros((_TERMS, 4))
    for m in range(_TERMS):
        sign = (-1.0) ** m
        for column in range(2):
            table[m, column] = sign / math.factorial(2 * m + 2 + column)
            table[m, 2 + column] = -sign * (m + 1) / math.factorial(2 * m + 4 + column)
    return table


_SERIES = _series_table()


def exponential_coefficients(x: FloatArray) -> FloatArray:
    """b, c, db/dx, dc/dx of x = theta^2 (...) -> (4, ...).

    b = (1 - cos theta) / theta^2 and c = (theta - sin theta) / theta^3. With W = [omega]_x they give the
    exponential, R = I + (1 - c x) W + b W^2 and V = I + b W + c W^2, and its derivatives. The closed forms
    cancel badly at small angles, where the power series are used.
    """
    powers = np.minimum(x, _SERIES_LIMIT)[None]
    rows = _SERIES.reshape(_TERMS, 4, *[1] * x.ndim)
    series: FloatArray = np.zeros((4, *x.shape)) + rows[-1]
    for row in rows[-2::-1]:  # Horner
        series *= powers
        series += row
    if x.size == 0 or float(x.max()) < _SERIES_LIMIT:
        return series
    large = np.maximum(x, _SERIES_LIMIT)
    t = np.sqrt(large)
    sin, rest = np.sin(t), 1.0 - np.cos(t)
    closed = [
        rest / large,
        (t - sin) / t**3,
        (t * sin - 2.0 * rest) / (2.0 * large**2),
        (t * rest - 3.0 * (t - sin)) / (2.0 * t**5),
    ]
    return np.where(x < _SERIES_LIMIT, series, np.stack(closed))


def twist_ad(xi: FloatArray) -> FloatArray:
    """(..., 6, 6) matrices ad(xi) of twists (..., 6) [omega, v]."""
    ad = np.zeros((*xi.shape, 6))
    ad[..., :3, :3] = ad[..., 3:, 3:] = skew(xi[..., :3])
    ad[..., 3:, :3] = skew(xi[..., 3:])
    return ad


def se3_left_jacobian(xi: FloatArray) -> FloatArray:
    """(6, 6) J_l: Exp(xi + d) = Exp(J_l(xi) d) Exp(xi) to first order; gtsam has the right one, J_l(-xi)."""
    return np.asarray(gtsam.Pose3.ExpmapDerivative(-xi))


def skew(a: FloatArray) -> FloatArray:
    """(..., 3, 3) matrices [a]_x of vectors (..., 3)."""
    return np.asarray(a @ _SKEW).reshape(*a.shape, 3)


_SKEW = np.zeros((3, 9))
"""[a]_x, row by row, is linear in a."""
_SKEW[[2, 1, 2, 0, 1, 0], [1, 2, 3, 5, 6, 7]] = [-1.0, 1.0, 1.0, -1.0, -1.0, 1.0]


@dataclass(frozen=True, eq=False)
class CameraTwist:
    """The camera's twist at the instant of an image.

    Attributes:
        c_twist: (6,), or (6, n) where the points belong to several images [rad/s, m/s].
        c_acceleration: (6,) or (6, n) its rate of change [rad/s^2, m/s^2].

    Raises:
        FactorError: numbers of another shape.
    """

    c_twist: FloatArray
    c_acceleration: FloatArray

    def __post_init__(self) -> None:
        for name in ("c_twist", "c_acceleration"):
            rows = as_numbers(f"{name} of CameraTwist", getattr(self, name), "(6,) or (6, n)")
            # (g, 6) inside the package: see move_groups
            if rows.ndim not in (1, 2) or 6 not in rows.shape:
                raise FactorError(f"{name} of CameraTwist", f"shape {rows.shape}", "shape (6,) or (6, n)")
            object.__setattr__(self, name, rows)


@dataclass(frozen=True, eq=False)
class RigidlyMoved:
    """Points that share one tau.

    Attributes:
        cPs: (3, n) points in the camera at the image's instant [m].
        cTl: pose of the LiDAR in the camera with the motion.
        tau_s: interval of all points [s].
        xi, rate: (6,) twist of the displacement, -tau w, and -d xi / d tau.
        model: see :data:`MotionModel`.
        c_velocities: (3, n) of the objects that the points lie on, in the camera [m/s], or None.
    """

    cPs: FloatArray
    cTl: gtsam.Pose3
    tau_s: float
    xi: FloatArray
    rate: FloatArray
    model: MotionModel
    c_velocities: FloatArray | None = None

    @cached_property
    def lift(self) -> FloatArray:
        """(13, 6), or (13, 7) with velocities, from :meth:`write_rows` to the derivatives by cTl (right
        perturbation, [rot, trans]), offset and c_twist; made where it is asked for."""
        if self.model == "translation":
            left = np.diag([0.0, 0.0, 0.0, 1.0, 1.0, 1.0])
        else:
            left = se3_left_jacobian(self.xi)
        lift = _no_lift(self.c_velocities)
        lift[0:6, :6] = self.cTl.AdjointMap().T
        lift[6, :6] = -left @ self.rate
        lift[7:13, :6] = -self.tau_s * left.T
        return lift

    def write_rows(self, g: FloatArray, out: FloatArray) -> None:
        """Wrenches [cP x g; g] into out (6, k, n), from the gradients g (3, k, n) by cP; with velocities u
        (7, k, n), u . g the last."""
        _write_wrenches(self, g, out)


@dataclass(frozen=True, eq=False)
class GroupsMoved:
    """Groups of points, each of one image and one tau, so that every group moves as one rigid body.

    Attributes:
        cPs: (3, n) points in the camera at their image's instant [m].
        lift: (g, 13, 6) or (g, 13, 7), that of :class:`RigidlyMoved` for each group.
        c_velocities: (3, n) of the objects that the points lie on, in the camera [m/s], or None.
    """

    cPs: FloatArray
    lift: FloatArray
    c_velocities: FloatArray | None = None

    def write_rows(self, g: FloatArray, out: FloatArray) -> None:
        """Wrenches into out (6 or 7, k, n), as of :class:`RigidlyMoved`, from the gradients g (3, k, n)."""
        _write_wrenches(self, g, out)


def _no_lift(c_velocities: FloatArray | None, *groups: int) -> FloatArray:
    """(..., 13, 6) zeros; with velocities (..., 13, 7), whose last column belongs to the offset."""
    lift = np.zeros((*groups, 13, 6 if c_velocities is None else 7))
    lift[..., 6, 6:] = 1.0
    return lift


def _write_wrenches(moved: RigidlyMoved | GroupsMoved, g: FloatArray, out: FloatArray) -> None:
    write_cross(moved.cPs[:, None, :], g, out[:3])
    out[3:6] = g
    if moved.c_velocities is not None:
        np.einsum("in,ikn->kn", moved.c_velocities, g, out=out[6])


class _Exponential(NamedTuple):
    """What Exp(xi) of xis (6, n) and its derivatives are made of: x = theta^2, its coefficients
    (:func:`exponential_coefficients`), omega x v and omega x (omega x v)."""

    x: FloatArray
    b: FloatArray
    c: FloatArray
    b_x: FloatArray
    c_x: FloatArray
    wv: FloatArray
    wwv: FloatArray

    @classmethod
    def of(cls, xis: FloatArray) -> _Exponential:
        omega, v = xis[:3], xis[3:]
        x = (omega**2).sum(axis=0)
        b, c, b_x, c_x = exponential_coefficients(x)
        wv = cross(omega, v)
        return cls(x, b, c, b_x, c_x, wv, cross(omega, wv))


@dataclass(frozen=True, eq=False)
class PointwiseMoved:
    """Points with a tau each.

    Attributes:
        lPs, cPs: (3, n) points in the LiDAR, and in the camera at the image's instant, both where the objects
            they lie on have moved by themselves until then [m].
        taus_s: (n,) interval of each point [s].
        cRl: (3, 3) rotation of the LiDAR in the camera, before the motion.
        xis: (6, n) twist of the displacement, -tau w.
        rates: (6, n) -d xi / d tau = c_twist - tau c_acceleration.
        exponential: of xis; None for the model "translation".
        l_velocities: (3, n) of the objects [m/s], or None.
    """

    lift: ClassVar[None] = None
    """:meth:`write_rows` gives the derivatives themselves."""

    lPs: FloatArray
    cPs: FloatArray
    taus_s: FloatArray
    cRl: FloatArray
    xis: FloatArray
    rates: FloatArray
    exponential: _Exponential | None
    l_velocities: FloatArray | None = None

    def write_rows(self, g: FloatArray, out: FloatArray) -> None:
        """Derivatives into out (13, k, n), columns as in :class:`RigidlyMoved`, from the gradients g."""
        by_xi, pulled = self._by_motion(g)
        np.matmul(self.cRl.T, pulled.reshape(3, -1), out=out[3:6].reshape(3, -1))
        write_cross(self.lPs[:, None, :], out[3:6], out[:3])
        np.multiply(by_xi, -self.taus_s, out=out[7:13])
        by_xi *= self.rates[:, None, :]
        np.negative(by_xi.sum(axis=0), out=out[6])
        if self.l_velocities is not None:
            out[6] += np.einsum("in,ikn->kn", self.l_velocities, out[3:6])

    def _by_motion(self, g: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Gradients by xi (6, k, n), and by the point before the motion, (3, k, n)."""
        by_xi = np.zeros((6, *g.shape[1:]))
        if self.exponential is None:
            by_xi[3:] = g
            return by_xi, g
        omega, v = self.xis[:3], self.xis[3:]
        x, b, c, b_x, c_x, wv, wwv = self.exponential
        arms = self.cPs - (v + b * wv + c * wwv)  # R (cTl . lP)
        w = omega[:, None, :]
        wg = cross(w, g)
        wwg = cross(w, wg)
        pulled = g - (1.0 - c * x) * wg + b * wwg  # R^T g
        by_xi[3:] = g - b * wg + c * wwg  # V^T g
        pg = cross(arms[:, None, :], g)
        wpg = cross(w, pg)
        # V^T (arm x g) + (d(V v) / d omega)^T g
        by_xi[:3] = pg - b * wpg + c * cross(w, wpg)
        by_xi[:3] += cross((b * v + c * wv)[:, None, :], g)
        by_xi[:3] -= c * cross(v[:, None, :], wg)
        by_xi[:3] += w * np.einsum("in,ikn->kn", 2.0 * (b_x * wv + c_x * wwv), g)
        return by_xi, pulled


def move_points(
    cTl: gtsam.Pose3,
    lPs: FloatArray,
    taus_s: FloatArray | float,
    motion: CameraTwist,
    model: MotionModel = "se3",
    l_velocities: FloatArray | None = None,
) -> RigidlyMoved | PointwiseMoved:
    """cP = Exp(-tau w) . (cTl . (lP + tau u)).

    Args:
        cTl: pose of the LiDAR in the camera.
        lPs: (3, n) points in the LiDAR [m].
        taus_s: (n,) interval of each point, or one float for all [s].
        motion: of the camera at the image's instant.
        model: see :data:`MotionModel`.
        l_velocities: (3, n) velocity u over ground of the object that each point lies on, in the LiDAR frame
            [m/s]; None where all are static.

    Raises:
        FactorError: no pose, no such motion, or numbers of another shape, NaN or inf.
    """
    checked_gtsam("cTl of move_points", cTl, gtsam.Pose3)
    lPs = checked_array("lPs of move_points", lPs, (3, None))
    n = lPs.shape[1]
    checked_type("motion of move_points", motion, CameraTwist, "sst_graph.factors.CameraTwist")
    checked_model(model)
    for name in ("c_twist", "c_acceleration"):
        what, rows = f"{name} of move_points", getattr(motion, name)
        checked_array(what, rows, (6,) if rows.ndim == 1 else (6, n))
    taus_s = checked_number_or_array("taus_s of move_points", taus_s, (n,))
    if l_velocities is not None:
        l_velocities = checked_array("l_velocities of move_points", l_velocities, (3, n))
    return moved_points(cTl, lPs, taus_s, motion, model, l_velocities)


def moved_points(
    cTl: gtsam.Pose3,
    lPs: FloatArray,
    taus_s: FloatArray | float,
    motion: CameraTwist,
    model: MotionModel,
    l_velocities: FloatArray | None,
) -> RigidlyMoved | PointwiseMoved:
    """:func:`move_points` of arguments that were checked already."""
    c_twist, c_acceleration = motion.c_twist, motion.c_acceleration
    one_motion = c_twist.ndim == 1 and c_acceleration.ndim == 1
    if l_velocities is not None:
        lPs = lPs + taus_s * l_velocities
    if isinstance(taus_s, float) and one_motion:
        return _move_rigidly(cTl, lPs, taus_s, motion, model, l_velocities)
    taus_s = np.broadcast_to(np.asarray(taus_s, np.float64), lPs.shape[1:])
    R = np.asarray(cTl.rotation().matrix())
    cPs = R @ lPs + np.asarray(cTl.translation()).reshape(3, 1)
    twists, changes = c_twist.reshape(6, -1), c_acceleration.reshape(6, -1) * taus_s
    xis = -taus_s * (twists - 0.5 * changes)
    rates = twists - changes
    exponential = None if model == "translation" else _Exponential.of(xis)
    cPs = cPs + xis[3:] if exponential is None else _move(xis, exponential, cPs)
    return PointwiseMoved(lPs, cPs, taus_s, R, xis, rates, exponential, l_velocities)


def _move_rigidly(
    cTl: gtsam.Pose3,
    lPs: FloatArray,
    tau_s: float,
    motion: CameraTwist,
    model: MotionModel,
    l_velocities: FloatArray | None,
) -> RigidlyMoved:
    c_twist, c_acceleration = motion.c_twist, motion.c_acceleration
    xi = -tau_s * (c_twist - 0.5 * tau_s * c_acceleration)
    rate = c_twist - tau_s * c_acceleration
    moved = _moved_pose(cTl, xi, model)
    R, t = np.asarray(moved.rotation().matrix()), np.asarray(moved.translation())
    c_velocities = None if l_velocities is None else R @ l_velocities
    return RigidlyMoved(R @ lPs + t.reshape(3, 1), moved, tau_s, xi, rate, model, c_velocities)


def move_groups(
    cTl: gtsam.Pose3,
    lPs: FloatArray,
    bounds: IntArray,
    taus_s: FloatArray,
    motion: CameraTwist,
    l_velocities: FloatArray | None = None,
) -> GroupsMoved:
    """As :func:`move_points` of groups of points that share one tau and one image each.

    Args:
        lPs: (3, n) points, one group after the other [m].
        bounds: (g + 1,) where each group begins, and the end.
        taus_s: (g,) intervals [s].
        motion: its rows are (g, 6), of each group's image.
        l_velocities: (3, n) as of :func:`move_points` [m/s].
    """
    taus, xis = taus_s[:, None], _group_xis(taus_s, motion)
    poses = [gtsam.Pose3.Expmap(xi) * cTl for xi in xis]
    left = np.array([se3_left_jacobian(xi) for xi in xis])
    rates = motion.c_twist - taus * motion.c_acceleration
    matrices, c_velocities = np.array([pose.matrix() for pose in poses]), None
    if l_velocities is not None:
        lPs = lPs + taus_s.repeat(np.diff(bounds)) * l_velocities
        c_velocities = rotated(matrices, l_velocities, bounds)
    lift = _no_lift(c_velocities, len(xis))
    lift[:, :6, :6] = np.array([pose.AdjointMap() for pose in poses]).transpose(0, 2, 1)
    lift[:, 6, :6] = -(left @ rates[:, :, None])[:, :, 0]
    lift[:, 7:, :6] = -taus[:, :, None] * left.transpose(0, 2, 1)
    return GroupsMoved(transformed(matrices, lPs, bounds), lift, c_velocities)


def group_poses(cTl: gtsam.Pose3, taus_s: FloatArray, motion: CameraTwist) -> FloatArray:
    """(g, 4, 4) poses cTl' of groups of points, cP = cTl' . lP; arguments as in :func:`move_groups`."""
    xis = _group_xis(taus_s, motion)
    return np.array([(gtsam.Pose3.Expmap(xi) * cTl).matrix() for xi in xis])


def _group_xis(taus_s: FloatArray, motion: CameraTwist) -> FloatArray:
    """(g, 6) twists of the displacements, -tau w."""
    taus = taus_s[:, None]
    return np.asarray(-taus * (motion.c_twist - 0.5 * taus * motion.c_acceleration))


def transformed(poses: FloatArray, points: FloatArray, bounds: IntArray) -> FloatArray:
    """(3, n) points (3, n) of groups under the pose (g, 4, 4) of each; bounds (g + 1,)."""
    moved = rotated(poses, points, bounds)
    moved += poses[:, :3, 3].T.repeat(np.diff(bounds), axis=1)
    return moved


def rotated(poses: FloatArray, vectors: FloatArray, bounds: IntArray) -> FloatArray:
    """(3, n) vectors (3, n) of groups, turned by the pose (g, 4, 4) of each; bounds (g + 1,)."""
    turned = np.empty_like(vectors)
    for R, (a, b) in zip(poses[:, :3, :3], pairwise(bounds.tolist()), strict=True):
        np.matmul(R, vectors[:, a:b], out=turned[:, a:b])
    return turned


def _moved_pose(cTl: gtsam.Pose3, xi: FloatArray, model: MotionModel) -> gtsam.Pose3:
    if model == "translation":
        return gtsam.Pose3(cTl.rotation(), cTl.translation() + xi[3:])
    return gtsam.Pose3.Expmap(xi) * cTl


def _move(xis: FloatArray, exponential: _Exponential, points: FloatArray) -> FloatArray:
    """Exp(xi) . p for xis (6, n) and points (3, n)."""
    omega, v = xis[:3], xis[3:]
    x, b, c, _, _, wv, wwv = exponential
    wp = cross(omega, points)
    rotated = points + (1.0 - c * x) * wp + b * cross(omega, wp)
    return np.asarray(rotated + v + b * wv + c * wwv)

"""Reprojection residuals of frozen matches, and their Jacobian.

    r_i = uv(cP_i) - q_i                          point-to-pixel and pixel-to-point, 2 rows
    r_i = n_i . (uv(cP_i) - q_i) + bias           silhouette, 1 row

in pixels, with cP_i = Exp(-tau_i w_i) . (cTl . lP_i) (:mod:`sst_graph.factors.motion`) and uv the pinhole
projection; sources: SST-Calib (Kodaira et al., ITSC 2022), eq. 2-6, for the first.

Behind the camera. A point that is not :meth:`PinholeCamera.in_front` has no pixel: its rows are zero,
residual and Jacobian, so it has no gradient. In the *cost* it counts as a match whose residual is the
image's diagonal. So a step never gains by pushing matches behind the camera, and with a bounded
kernel, whose loss is already flat there, the cost does not jump either.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, overload

import gtsam
import numpy as np
from numpy.typing import NDArray

from .arguments import (
    FloatArray,
    as_numbers,
    checked_array,
    checked_gtsam,
    checked_number,
    checked_number_or_array,
    checked_type,
)
from .camera import MIN_DEPTH_M
from .condensed import gram, square_root
from .errors import FactorError
from .matches import Alignment
from .motion import CameraTwist, GroupsMoved, PointwiseMoved, RigidlyMoved, move_groups, moved_points


@overload
def residuals(
    alignment: Alignment,
    cTl: gtsam.Pose3,
    time_offset_s: float,
    c_twist: FloatArray,
    bias_px: float | FloatArray | None = None,
    jacobians: Literal[True] = True,
) -> tuple[FloatArray, FloatArray]: ...
@overload
def residuals(
    alignment: Alignment,
    cTl: gtsam.Pose3,
    time_offset_s: float,
    c_twist: FloatArray,
    bias_px: float | FloatArray | None = None,
    *,
    jacobians: Literal[False],
) -> tuple[FloatArray, None]: ...
def residuals(
    alignment: Alignment,
    cTl: gtsam.Pose3,
    time_offset_s: float,
    c_twist: FloatArray,
    bias_px: float | FloatArray | None = None,
    jacobians: bool = True,
) -> tuple[FloatArray, FloatArray | None]:
    """Unwhitened residuals, predicted - measured [px], and their Jacobian.

    Args:
        alignment: n matches.
        cTl: pose of the LiDAR in the camera.
        time_offset_s: time offset [s].
        c_twist: (6,) camera twist at the image's instant, or (6, n) at the instant of each match's image
            [rad/s, m/s].
        bias_px: silhouettes only: how far the mask's contour lies outside the true outline [px]
            (dilation positive), one number or (n,); given, it is the last column of the Jacobian.
        jacobians: False saves the work and returns None for J.

    Returns:
        r (rows,): first all u, then all v (or one row a match); J (rows, 13 [+1]) with columns [rot,
        trans, offset, twist (6), bias] [px/rad, px/m, px/s, ...]. Rows of points behind are zero.

    Raises:
        FactorError: no alignment, no pose, numbers of another shape, NaN or inf, a bias of point-to-pixel
            matches.
    """
    time_offset_s, c_twist, bias_px = _checked(alignment, cTl, time_offset_s, c_twist, bias_px)
    evaluated = evaluate(alignment, cTl, time_offset_s, c_twist, bias_px, jacobians)
    if not jacobians:
        return evaluated.rows[-1].reshape(-1), None
    system = evaluated.system()
    return system[-1], system[:-1].T


def weighted_residuals(
    alignment: Alignment,
    cTl: gtsam.Pose3,
    time_offset_s: float,
    c_twist: FloatArray,
    bias_px: float | FloatArray | None = None,
) -> tuple[FloatArray, FloatArray, float]:
    """Whitened and robustly weighted residuals.

    Returns:
        r and J as :func:`residuals` gives them, each row multiplied by sqrt(weight w_i) / sigma_i, and
        the constant c = 2 cost - |r|^2 >= 0 that makes ``(|r|^2 + c) / 2`` the robust cost.

    Raises:
        FactorError: as :func:`residuals`.
    """
    time_offset_s, c_twist, bias_px = _checked(alignment, cTl, time_offset_s, c_twist, bias_px)
    evaluated = evaluate(alignment, cTl, time_offset_s, c_twist, bias_px, jacobians=True)
    constant = weigh(alignment, evaluated)
    system = evaluated.system()
    return system[-1], system[:-1].T, constant


def alignment_cost(
    alignment: Alignment,
    cTl: gtsam.Pose3,
    time_offset_s: float,
    c_twist: FloatArray,
    bias_px: float | FloatArray | None = None,
) -> float:
    """Robust cost: sum weight_i rho(|r_i| / sigma_i), with points behind as the module says.

    Raises:
        FactorError: as :func:`residuals`.
    """
    time_offset_s, c_twist, bias_px = _checked(alignment, cTl, time_offset_s, c_twist, bias_px)
    return cost(alignment, evaluate(alignment, cTl, time_offset_s, c_twist, bias_px, jacobians=False))


def _checked(
    alignment: Alignment,
    cTl: gtsam.Pose3,
    time_offset_s: float,
    c_twist: FloatArray,
    bias_px: float | FloatArray | None,
) -> tuple[float, FloatArray, float | FloatArray | None]:
    """Offset, twist and bias as :func:`residuals` takes them; the other two are looked at."""
    checked_type("alignment", alignment, Alignment, "sst_graph.factors.Alignment")
    checked_gtsam("cTl", cTl, gtsam.Pose3)
    n = len(alignment)
    twist = as_numbers("c_twist", c_twist, "(6,) or (6, n)")
    twist = checked_array("c_twist", twist, (6, n) if twist.ndim == 2 else (6,))
    if bias_px is not None:
        bias_px = checked_number_or_array("bias_px", bias_px, (n,))
    return checked_number("time_offset_s", time_offset_s), twist, bias_px


@dataclass(frozen=True)
class Evaluated:
    """Residuals of an alignment, and their derivatives in a short form.

    Attributes:
        rows: (m, k, n): rows that ``lift`` turns into the Jacobian's first 13 columns, the bias's column
            where there is one, and the residual last.
        lift: (13, l), or (g, 13, l) one for each group of matches, of the first l rows; or None where the
            first 13 rows are the columns themselves.
        behind: (n,) points behind the camera, or None where there is none.
    """

    rows: FloatArray
    lift: FloatArray | None
    behind: NDArray[np.bool_] | None

    def system(self) -> FloatArray:
        """[J r], column by column: (cols + 1, k n)."""
        rows = self.rows.reshape(len(self.rows), -1)
        motion = self.motion_rows
        return rows if self.lift is None else np.concatenate([self.lift @ rows[:motion], rows[motion:]])

    def with_terms(self, coefficients: FloatArray, steps: FloatArray, jacobians: bool) -> Evaluated:
        """These residuals with linear terms added to the residuals of silhouettes, before any weighting.

        Args:
            coefficients: (k, n) derivatives of the residuals by each term's scalar.
            steps: (k,) what the scalars are beyond the values that the matches were made at.
            jacobians: whether the rows hold derivatives: the terms' then follow those of the motion.
        """
        seen = coefficients if self.behind is None else np.where(self.behind, 0.0, coefficients)
        rows = self.rows
        if jacobians:
            motion = self.motion_rows
            rows = np.concatenate([rows[:motion], seen[:, None, :], rows[motion:]])
        rows[-1, 0] += steps @ seen
        return Evaluated(rows, self.lift, self.behind)

    @property
    def motion_rows(self) -> int:
        """How many rows belong to the motion."""
        return _motion_rows(self.lift)

    def by_group(self, groups: NDArray[np.intp], count: int) -> Evaluated:
        """These rows with a bias column for each of ``count`` groups of matches; groups (n,)."""
        n = self.rows.shape[2]
        rows = np.zeros((len(self.rows) + count - 1, 1, n))
        rows[: len(self.rows) - 2], rows[-1] = self.rows[:-2], self.rows[-1]
        rows[len(self.rows) - 2 + groups, 0, np.arange(n)] = self.rows[-2, 0]
        return Evaluated(rows, self.lift, self.behind)

    def gram(self) -> FloatArray:
        """(cols + 1, cols + 1) Gram matrix of [J r]."""
        short = gram(self.rows.reshape(len(self.rows), -1))
        if self.lift is None:
            return short
        lift = self.whole_lift()
        return np.asarray(lift @ short @ lift.T)

    def root(self) -> FloatArray:
        """R (m, cols + 1) with R^T R the Gram matrix of [J r], with as many rows as the short form has."""
        R = square_root(gram(self.rows.reshape(len(self.rows), -1)))
        return R if self.lift is None else np.asarray(R @ self.whole_lift().T)

    def whole_lift(self) -> FloatArray:
        """(cols + 1, m) from all rows of the short form; (g, cols + 1, m) of groups."""
        assert self.lift is not None
        m, motion = len(self.rows), self.motion_rows
        lift = np.zeros((*self.lift.shape[:-2], 13 + m - motion, m))
        lift[..., :13, :motion] = self.lift
        lift[..., 13:, motion:] = np.eye(m - motion)
        return lift


def _motion_rows(lift: FloatArray | None) -> int:
    return 13 if lift is None else lift.shape[-1]


def evaluate(
    alignment: Alignment,
    cTl: gtsam.Pose3,
    time_offset_s: float,
    c_twist: FloatArray,
    bias_px: float | FloatArray | None,
    jacobians: bool,
) -> Evaluated:
    """Residuals and, where ``jacobians`` is true, their derivatives; arguments as in :func:`residuals`."""
    twist = np.asarray(c_twist, dtype=np.float64)
    motion = CameraTwist(twist, alignment.c_acceleration.T)
    taus_s, lPs = alignment.taus_s(float(time_offset_s)), alignment.columns[0]
    moved = moved_points(cTl, lPs, taus_s, motion, alignment.motion_model, alignment.velocity_columns)
    return evaluate_moved(alignment, moved, bias_px, jacobians)


def evaluate_moved(
    alignment: Alignment,
    moved: RigidlyMoved | GroupsMoved | PointwiseMoved,
    bias_px: float | FloatArray | None,
    jacobians: bool,
) -> Evaluated:
    """:func:`evaluate` of points that were moved to their image's instant already."""
    if bias_px is not None and alignment.normals is None:
        raise FactorError(
            "bias_px", f"{bias_px} for point-to-pixel matches", "None: only silhouettes have a bias"
        )
    Z = moved.cPs[2]
    behind = Z <= MIN_DEPTH_M
    any_behind = bool(behind.any())
    inverse_z = np.where(behind, 0.0, 1.0 / np.where(behind, 1.0, Z)) if any_behind else 1.0 / Z
    xy = moved.cPs[:2] * inverse_z

    lift = moved.lift if jacobians else None
    motion_rows = _motion_rows(lift) if jacobians else 0
    has_bias = jacobians and bias_px is not None
    rows = np.empty((motion_rows + has_bias + 1, alignment.rows_per_match, len(alignment)))
    _write_residuals(alignment, xy, bias_px, rows[-1])
    if jacobians:
        moved.write_rows(_gradients(alignment.slopes, xy, inverse_z), rows[:motion_rows])
        rows[motion_rows:-1] = 1.0  # by the bias
    if any_behind:
        rows[:, :, behind] = 0.0
    return Evaluated(rows, lift, behind if any_behind else None)


@dataclass(frozen=True)
class ImageGroups:
    """Where the matches of several images stand in one alignment, one image after the other.

    Attributes:
        bounds: (g + 1,) first match of each image, and the end.
        accelerations: (g, 6) of the twist at each image where its matches move as one rigid body, else None.
    """

    bounds: NDArray[np.intp]
    accelerations: FloatArray | None

    @classmethod
    def of(cls, alignment: Alignment, bounds: NDArray[np.intp]) -> ImageGroups:
        """The groups of an alignment whose images begin at ``bounds`` (g + 1,)."""
        starts, each = bounds[:-1], np.broadcast_to(alignment.c_acceleration, (len(alignment), 6))
        own = np.column_stack([alignment.base_taus_s, each])
        rigid = np.array_equal(own, np.repeat(own[starts], np.diff(bounds), axis=0))
        return cls(bounds, each[starts] if rigid and alignment.motion_model == "se3" else None)

    def evaluate(
        self,
        alignment: Alignment,
        cTl: gtsam.Pose3,
        time_offset_s: float,
        c_twists: FloatArray,
        bias_px: FloatArray,
    ) -> Evaluated:
        """Residuals of the matches and their derivatives, not weighted; c_twists (g, 6) at the images."""
        if self.accelerations is None:
            twists = c_twists.repeat(np.diff(self.bounds), axis=0).T
            return evaluate(alignment, cTl, time_offset_s, twists, bias_px, True)
        motion = CameraTwist(c_twists, self.accelerations)
        taus_s = time_offset_s + alignment.base_taus_s[self.bounds[:-1]]
        lPs, velocities = alignment.columns[0], alignment.velocity_columns
        moved = move_groups(cTl, lPs, self.bounds, taus_s, motion, velocities)
        return evaluate_moved(alignment, moved, bias_px, True)


def _write_residuals(
    alignment: Alignment, xy: FloatArray, bias_px: float | FloatArray | None, out: FloatArray
) -> None:
    """Residuals into out (k, n); xy (2, n): X/Z and Y/Z."""
    camera, normals = alignment.camera, alignment.columns[2]
    error = out if normals is None else np.empty_like(xy)
    np.multiply(xy, [[camera.fx], [camera.fy]], out=error)
    error -= alignment.centred
    if normals is not None:
        error *= normals
        np.add(error[0], error[1], out=out[0])
        if bias_px is not None:
            out += bias_px


def _gradients(slopes: FloatArray, xy: FloatArray, inverse_z: FloatArray) -> FloatArray:
    """(3, k, n) gradients of the residuals by cP [px/m]: (a, b, -(a x + b y)) / Z of slopes (a, b)."""
    g = np.empty((3, slopes.shape[1], len(inverse_z)))
    np.multiply(slopes, inverse_z, out=g[:2])
    np.multiply(g[0], -xy[0], out=g[2])
    g[2] -= g[1] * xy[1]
    return g


def _squares(alignment: Alignment, evaluated: Evaluated) -> FloatArray:
    """(n,) square of each match's whitened residual."""
    squares = np.square(evaluated.rows[-1] / alignment.sigmas_px)
    return np.asarray(squares[0] if len(squares) == 1 else squares[0] + squares[1])


def _behind_costs(alignment: Alignment, behind: NDArray[np.bool_]) -> float:
    """Cost of the matches behind the camera: a residual of the image's diagonal each."""
    diagonal = float(np.hypot(alignment.camera.width, alignment.camera.height))
    return float(alignment.weights[behind] @ alignment.kernel.loss(diagonal / alignment.sigmas_px[behind]))


def cost(alignment: Alignment, evaluated: Evaluated) -> float:
    """:func:`alignment_cost` from residuals that were evaluated already; they are not weighted."""
    _, losses = alignment.kernel.weight_and_loss(_squares(alignment, evaluated))
    cost = float(alignment.weights @ losses)
    if evaluated.behind is not None:
        cost += _behind_costs(alignment, evaluated.behind)
    return cost


def weigh(alignment: Alignment, evaluated: Evaluated) -> float:
    """Multiply the rows by sqrt(weight w) / sigma in place; return 2 cost - |weighted r|^2."""
    scales, rows, constant = alignment.row_scales, evaluated.rows, 0.0
    if alignment.kernel.kind != "none":
        squares = _squares(alignment, evaluated)
        w, losses = alignment.kernel.weight_and_loss(squares)
        scales = scales * np.sqrt(w)
        constant = float(alignment.weights @ (2.0 * losses - w * squares))
    np.multiply(rows, scales, out=rows)
    if evaluated.behind is not None:
        constant += 2.0 * _behind_costs(alignment, evaluated.behind)
    return max(constant, 0.0)

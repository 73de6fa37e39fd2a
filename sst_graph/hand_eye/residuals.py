"""Residuals of many pairs of camera and LiDAR motion together: one factor for all of them.

The equations are those of ``factors/hand_eye.py``, whose factors are for one pair each. A call of a factor
costs more than its arithmetic, so that a hundred pairs in one factor take little longer than one.
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.factors import Vector
from sst_graph.factors.custom.factor import custom_factor
from sst_graph.factors.hand_eye import LOW_TRANSLATION_M
from sst_graph.types import FloatArray


@dataclass(frozen=True, eq=False)
class MotionResiduals:
    """[Log(c1Rc2^-1 . R); t / sqrt(|t|^2 + s^2) - direction] of n pairs, (R, t) = cTl . l1Tl2(d) . cTl^-1 and
    s = ``LOW_TRANSLATION_M`` [rad, 1]; the last three are 0 where the direction is not used.

    Attributes:
        l1Tl2s: (n, 4, 4) motions of the LiDAR at ``time_offset_0_s``.
        twists_1, twists_2: (n, 6) of the LiDAR at their ends [rad/s, m/s].
        time_offset_0_s: the time offset at which they were measured [s].
        c1Rc2s: (n, 3, 3) measured rotations of the camera.
        directions: (n, 3) measured directions.
        directed: (n,) whether the direction is used.
    """

    l1Tl2s: FloatArray
    twists_1: FloatArray
    twists_2: FloatArray
    time_offset_0_s: float
    c1Rc2s: FloatArray
    directions: FloatArray
    directed: NDArray[np.bool_]

    def predicted(self, cTl: gtsam.Pose3, time_offset_s: float) -> FloatArray:
        """(n, 4, 4) motions of the camera that the LiDAR's predict."""
        return np.asarray(cTl.matrix() @ self._moved(time_offset_s) @ cTl.inverse().matrix())

    def evaluate(
        self, cTl: gtsam.Pose3, time_offset_s: float, jacobians: bool
    ) -> tuple[FloatArray, FloatArray]:
        """(n, 6) residuals, and where they are asked for their Jacobians (n, 6, 7) by right perturbations of
        cTl and the time offset; else (0, 6, 7)."""
        moved = self._moved(time_offset_s)
        predicted = np.asarray(cTl.matrix()) @ moved @ np.asarray(cTl.inverse().matrix())
        t, turns = predicted[:, :3, 3], np.swapaxes(self.c1Rc2s, 1, 2) @ predicted[:, :3, :3]
        logs = np.array([gtsam.Rot3.Logmap(gtsam.Rot3(turn)) for turn in turns])
        lengths = np.sqrt(np.einsum("ij,ij->i", t, t) + LOW_TRANSLATION_M**2)[:, None]
        errors = np.concatenate([logs, t / lengths - self.directions], axis=1)
        errors[~self.directed, 3:] = 0.0
        return errors, self._jacobians(cTl, moved, predicted, logs) if jacobians else np.zeros((0, 6, 7))

    def jacobians_by_camera(self, cTl: gtsam.Pose3, time_offset_s: float) -> FloatArray:
        """(n, 6, 7) Jacobians where the camera's motions take the place of the LiDAR's: the same but for the
        noise, which is another. The camera's translations have the length of the LiDAR's."""
        predicted = self.predicted(cTl, time_offset_s)
        lengths = np.linalg.norm(predicted[:, :3, 3], axis=1)[:, None]
        predicted[:, :3, :3] = self.c1Rc2s
        predicted[self.directed, :3, 3] = (lengths * self.directions)[self.directed]
        moved = np.asarray(cTl.inverse().matrix()) @ predicted @ np.asarray(cTl.matrix())
        return self._jacobians(cTl, moved, predicted, np.zeros((len(moved), 3)))

    def _jacobians(
        self, cTl: gtsam.Pose3, moved: FloatArray, predicted: FloatArray, logs: FloatArray
    ) -> FloatArray:
        """(n, 6, 7) Jacobians at motions of the LiDAR and of the camera by them (n, 4, 4), which leave turns
        (n, 3) to the measured."""
        # 1. The predicted motion's right perturbation by those of cTl and the offset.
        back, Ad = _adjoints(_inverses(moved)), np.asarray(cTl.AdjointMap())
        predicted_H = np.empty((len(moved), 6, 7))
        predicted_H[:, :, :6] = Ad @ (back - np.eye(6))
        rates = self.twists_2 - (back @ self.twists_1[..., None])[..., 0]
        predicted_H[:, :, 6] = rates @ Ad.T
        # 2. The residual by that; t of P Exp([w, v]) is t + R v.
        R, t = predicted[:, :3, :3], predicted[:, :3, 3]
        lengths = np.sqrt(np.einsum("ij,ij->i", t, t) + LOW_TRANSLATION_M**2)[:, None]
        H = np.empty_like(predicted_H)
        H[:, :3] = np.array([gtsam.Rot3.LogmapDerivative(log) for log in logs]) @ predicted_H[:, :3]
        across = np.eye(3) - t[:, :, None] * t[:, None, :] / lengths[..., None] ** 2
        H[:, 3:] = across / lengths[..., None] @ R @ predicted_H[:, 3:]
        H[~self.directed, 3:] = 0.0
        return H

    def _moved(self, time_offset_s: float) -> FloatArray:
        """(n, 4, 4) motions of the LiDAR at a time offset."""
        d = time_offset_s - self.time_offset_0_s
        if d == 0.0:
            return self.l1Tl2s
        before = np.array([gtsam.Pose3.Expmap(-d * twist).matrix() for twist in self.twists_1])
        after = np.array([gtsam.Pose3.Expmap(d * twist).matrix() for twist in self.twists_2])
        return np.asarray(before @ self.l1Tl2s @ after)


def residuals_factor(E: int, D: int, residuals: MotionResiduals, roots: FloatArray) -> gtsam.CustomFactor:
    """One factor of all pairs on the extrinsic E and the time offset D; roots: (n, 6, 6) of the information,
    by which the residuals are multiplied."""
    rows = 6 * len(roots)

    def whitened(
        cTl: gtsam.Pose3, offset: FloatArray, jacobians: bool
    ) -> tuple[FloatArray, list[FloatArray] | None]:
        errors, H = residuals.evaluate(cTl, float(offset[0]), jacobians)
        error = (roots @ errors[..., None]).reshape(rows)
        if not jacobians:
            return error, None
        J = (roots @ H).reshape(rows, 7)
        return error, [J[:, :6], J[:, 6:]]

    unit = gtsam.noiseModel.Unit.Create(rows)
    return custom_factor(unit, {"E": E, "D": D}, whitened, [gtsam.Pose3, Vector(1)], rows, "residuals_factor")


def _inverses(poses: FloatArray) -> FloatArray:
    """(n, 4, 4) inverses of poses (n, 4, 4)."""
    result = np.tile(np.eye(4), (len(poses), 1, 1))
    back = np.swapaxes(poses[:, :3, :3], 1, 2)
    result[:, :3, :3] = back
    result[:, :3, 3] = -(back @ poses[:, :3, 3, None])[..., 0]
    return result


def _adjoints(poses: FloatArray) -> FloatArray:
    """(n, 6, 6) adjoint maps [[R, 0], [t^ R, R]] of poses (n, 4, 4)."""
    R, (x, y, z) = poses[:, :3, :3], poses[:, :3, 3].T
    zero = np.zeros_like(x)
    skew = np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]]).transpose(2, 0, 1)
    result = np.zeros((len(poses), 6, 6))
    result[:, :3, :3] = result[:, 3:, 3:] = R
    result[:, 3:, :3] = skew @ R
    return result

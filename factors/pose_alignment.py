"""Alignment in a user's own graph: on the poses of a trajectory instead of a twist.

    cP_i = Exp(-tau_i c_twist) . cTl . lTs . lP_i,      residuals as in :mod:`sst_graph.factors.reprojection`
    c_twist = Ad(cTl) Ad(lTb) Log(wTb_a^-1 wTb_b) / seconds
    lTs = lTb . wTb_a^-1 . wTb_s . bTl

X_a and X_b are two poses of the trajectory around the image's instant, ``seconds`` apart, between which
the body moves with one twist; tau is the interval from X_a to the image, so that the camera is at
the pose interpolated between X_a and X_b. The scan was taken at X_s, X_a itself by default (lTs = 1): a
scan at an earlier pose constrains X_s relative to X_a and X_b, which improves the trajectory.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

import gtsam
import numpy as np

from .alignment import FrameResidual, GroupedBias, Quantities, frame_residual, image_factor
from .arguments import FloatArray, checked_type
from .camera_motion import Between
from .condensed import condense_gram
from .custom.variables import Argument, Variables, Vector, number_or_key, pose_or_key
from .errors import FactorError
from .matches import Alignment
from .motion import se3_left_jacobian, twist_ad


def pose_alignment_factor(
    alignments: Sequence[Alignment],
    between: Between,
    cTl: int | gtsam.Pose3,
    time_offset_s: int | float,
    biases_px: Sequence[int | float | GroupedBias | None] | int | float | GroupedBias | None = None,
    noise: gtsam.noiseModel.Base | None = None,
) -> gtsam.CustomFactor:
    """1/2 |error|^2 = sum_i weight_i rho(|r_i| / sigma_i), r_i as in the module, of one image [px].

    One factor on the user's own keys for all alignments of the image.

    Goes into any ``NonlinearFactorGraph``, LM, iSAM2 or fixed-lag smoother. Its matches are frozen: make
    a new one when the estimate has moved by more than about a pixel.

    Args:
        alignments: one or more, over the same image. With ``X_scan`` their points count as taken at the
            instant of X_a: ``base_taus_s`` is t_image_stamp - t_a. Where they have a ``c_acceleration``, one
            for all, the twist at the image's instant is the mean one plus (offset +
            ``between.image_after_middle_s``) times it.
        between: where the image falls in the trajectory, and the scan's pose.
        cTl: key of the extrinsic, or a fixed pose.
        time_offset_s: key of the time offset, or a fixed offset [s].
        biases_px: as in :func:`sst_graph.factors.frame_factor`.
        noise: of one dimension, over the whole image: ``Isotropic.Sigma(1, s)`` multiplies every match's
            sigma by s; a ``Robust`` around it gives the image one weight, by its distance
            sqrt(2 cost) / s, which is near sqrt(number of matches) where they fit. None: each match counts
            by its own sigma and kernel.

    Returns:
        A factor on the distinct keys: X_a, X_b, X_scan, cTl, time_offset_s, biases; its noise is the unit's
        or, in all its rows, the given one.

    Raises:
        FactorError: keys that make no factor, or several accelerations; see also
            :func:`sst_graph.factors.frame_factor`.
    """
    checked_type(f"between of {NAME}", between, Between, "a sst_graph.factors.Between")
    expected = "a gtsam.noiseModel of dimension 1, or None"
    checked_type(f"noise of {NAME}", noise, (gtsam.noiseModel.Base, type(None)), expected)
    if noise is not None and noise.dim() != 1:
        raise FactorError(f"noise of {NAME}", f"dimension {noise.dim()}", "dimension 1, for the whole image")
    E, D = pose_or_key(NAME, "cTl", cTl), number_or_key(NAME, "time_offset_s", time_offset_s)
    inner = frame_residual(alignments, Quantities(_EXTRINSIC, D, between.X_a), biases_px, name=NAME)
    arguments = [
        Argument("X_a", between.X_a, gtsam.Pose3),
        Argument("X_b", between.X_b, gtsam.Pose3),
        Argument("X_scan", between.X_s, gtsam.Pose3, shared_with="X_"),
        Argument("cTl", E, gtsam.Pose3),
        Argument("time_offset_s", D, Vector(1)),
    ]
    arguments += [
        Argument(name, key, Vector(1))
        for name, key in inner.variables.named.items()
        if name.startswith("bias")
    ]
    variables, acceleration = Variables.of(NAME, arguments), _common_acceleration(alignments)
    return image_factor(_PoseFrame(inner, variables, between, E, D, acceleration), noise, NAME)


@dataclass(frozen=True)
class _PoseFrame:
    """The chain from poses to the frame's own quantities.

    Attributes:
        inner: residuals over extrinsic (in effect, with the scan's motion), offset, twist and biases. The
            twist goes under the key X_a there; the extrinsic is always a variable.
        variables: of the factor.
        between: the poses.
        cTl, time_offset_s: key or constant.
        c_acceleration: (6,) [rad/s^2, m/s^2].
    """

    inner: FrameResidual
    variables: Variables
    between: Between
    cTl: int | gtsam.Pose3
    time_offset_s: int | float
    c_acceleration: FloatArray

    @property
    def match_rows(self) -> int:
        """Rows of all matches."""
        return self.inner.match_rows

    def cost(self, values: Sequence[Any]) -> float:
        return self.inner.cost(self.inner_values(values))

    def condensed(self, values: Sequence[Any]) -> tuple[FloatArray, FloatArray]:
        G, constant = self.inner.gram(self.inner_values(values))
        lift = np.zeros((len(G), self.variables.cols + 1))
        lift[:-1, :-1], lift[-1, -1] = self.lift(values), 1.0
        return condense_gram(lift.T @ G @ lift, constant)

    def stacked(self, values: Sequence[Any]) -> tuple[FloatArray, FloatArray]:
        error, J = self.inner.stacked(self.inner_values(values))
        return error, J @ self.lift(values)

    def stacked_error(self, values: Sequence[Any]) -> FloatArray:
        return self.inner.stacked_error(self.inner_values(values))

    def _by_key(self, values: Sequence[Any]) -> dict[int, Any]:
        return dict(zip(self.variables.keys, values, strict=True))

    def _extrinsic(self, named: dict[int, Any]) -> gtsam.Pose3:
        return self.cTl if isinstance(self.cTl, gtsam.Pose3) else cast(gtsam.Pose3, named[self.cTl])

    def _after_middle_s(self, named: dict[int, Any]) -> float:
        """True time of the image after the middle between X_a and X_b [s]."""
        time_offset_s = (
            named[self.time_offset_s][0] if isinstance(self.time_offset_s, int) else self.time_offset_s
        )
        return float(time_offset_s) + self.between.image_after_middle_s

    def _step(self, named: dict[int, Any]) -> FloatArray:
        """Log(wTb_a^-1 wTb_b)."""
        return np.asarray(gtsam.Pose3.Logmap(named[self.between.X_a].between(named[self.between.X_b])))

    def _lTs(self, named: dict[int, Any]) -> gtsam.Pose3:
        aTs = cast(gtsam.Pose3, named[self.between.X_a].between(named[self.between.X_s]))
        return self.between.lTb * aTs * self.between.lTb.inverse()

    def inner_values(self, values: Sequence[Any]) -> list[Any]:
        """Values of the inner residual's keys."""
        named = self._by_key(values)
        cTl = self._extrinsic(named)
        l_twist = np.asarray(self.between.lTb.AdjointMap()) @ self._step(named) / self.between.seconds
        c_twist = np.asarray(cTl.AdjointMap()) @ l_twist
        special = {
            _EXTRINSIC: cTl if self.between.X_s == self.between.X_a else cTl * self._lTs(named),
            self.between.X_a: c_twist + self._after_middle_s(named) * self.c_acceleration,
        }
        return [special[key] if key in special else named[key] for key in self.inner.variables.keys]

    def lift(self, values: Sequence[Any]) -> FloatArray:
        """(inner cols, cols) derivative of the inner variables by those of the factor."""
        named = self._by_key(values)
        outer, inner = self.variables.columns, self.inner.variables.columns
        L = np.zeros((self.inner.cols, self.variables.cols))
        for key, place in inner.items():
            if key not in (_EXTRINSIC, self.between.X_a):
                L[place, outer[key]] += np.eye(place.stop - place.start)
        cTl = self._extrinsic(named)
        self._lift_twist(L[inner[self.between.X_a]], outer, named, np.asarray(cTl.AdjointMap()))
        self._lift_extrinsic(L[inner[_EXTRINSIC]], outer, named)
        return L

    def _lift_twist(
        self, rows: FloatArray, outer: dict[int, slice], named: dict[int, Any], Ad_cTl: FloatArray
    ) -> None:
        step = self._step(named)
        Ad_lTb = np.asarray(self.between.lTb.AdjointMap())
        scaled = Ad_cTl @ Ad_lTb / self.between.seconds
        # Log(Exp(-d_a) Exp(step) Exp(d_b)): J_l(step)^-1 on the left, J_r^-1 = J_l(-step)^-1 on the right
        rows[:, outer[self.between.X_a]] -= scaled @ np.linalg.inv(se3_left_jacobian(step))
        rows[:, outer[self.between.X_b]] += scaled @ np.linalg.inv(se3_left_jacobian(-step))
        if isinstance(self.cTl, int):
            rows[:, outer[self.cTl]] -= Ad_cTl @ twist_ad(Ad_lTb @ step / self.between.seconds)
        if isinstance(self.time_offset_s, int):
            rows[:, outer[self.time_offset_s]] += self.c_acceleration[:, None]

    def _lift_extrinsic(self, rows: FloatArray, outer: dict[int, slice], named: dict[int, Any]) -> None:
        """By cTl, and where the scan has a pose of its own by X_s and X_a."""
        if self.between.X_s == self.between.X_a:
            if isinstance(self.cTl, int):
                rows[:, outer[self.cTl]] += np.eye(6)
            return
        sTl = self._lTs(named).inverse()
        if isinstance(self.cTl, int):
            rows[:, outer[self.cTl]] += np.asarray(sTl.AdjointMap())
        rows[:, outer[self.between.X_s]] += np.asarray(self.between.lTb.AdjointMap())
        rows[:, outer[self.between.X_a]] -= np.asarray((sTl * self.between.lTb).AdjointMap())


_EXTRINSIC = 2**64 - 1
"""Stands for the extrinsic in effect among the inner residual's keys; gtsam.symbol makes no such key."""
NAME = "pose_alignment_factor"


def _common_acceleration(alignments: Sequence[Alignment]) -> FloatArray:
    first = alignments[0].c_acceleration
    if any((alignment.c_acceleration != first).any() for alignment in alignments):
        raise FactorError("c_acceleration of the alignments", "several", "one for all: they share the image")
    return first

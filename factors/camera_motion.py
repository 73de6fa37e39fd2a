"""Visual odometry in a user's own graph: the camera's motion between two images, on trajectory poses.

    c1Tc2 = cTl . lTb . wTb(t_1 + D)^-1 . wTb(t_2 + D) . bTl . cTl^-1
    wTb(t) = X_a Exp(s Log(X_a^-1 X_b)),      s = (t - t_a) / (t_b - t_a)

Each image falls between two poses of the trajectory, stamped by the LiDAR's clock, between which the body
moves with one twist. The camera's motion so corrects the trajectory through the calibration, and the
trajectory the calibration: a hand-eye constraint (:mod:`sst_graph.factors.hand_eye`) with both sides unknown.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import gtsam
import numpy as np

from .arguments import FloatArray, checked_number, checked_positive, checked_type
from .custom.factor import custom_factor
from .custom.variables import (
    Argument,
    Variables,
    Vector,
    body_in_lidar,
    checked_key,
    key_name,
    number_or_key,
    pose_or_key,
)
from .errors import FactorError
from .hand_eye import CameraMotion, MotionError, camera_motion_error

_NAME = "camera_motion_factor"


@dataclass(frozen=True)
class Between:
    """An image between two poses of a trajectory.

    Attributes:
        X_a, X_b: keys of the poses wTb before and after (Pose3), distinct.
        seconds: from X_a to X_b, in the LiDAR's clock [s].
        image_after_a_s: image stamp minus stamp of X_a [s]; the offset is added to it. The image may fall
            beyond X_a or X_b: the twist then goes on.
        X_scan: key of wTb at the stamp of the scan that the image is aligned with, where that is another pose
            than X_a.
        bTl: pose of the LiDAR in the body, known; None where the poses are the LiDAR's own.

    Raises:
        FactorError: no keys, one key for both poses, or no time between them.
    """

    X_a: int
    X_b: int
    seconds: float
    image_after_a_s: float
    X_scan: int | None = None
    bTl: gtsam.Pose3 | None = None

    def __post_init__(self) -> None:
        for name in ("X_a", "X_b", "X_scan"):
            if name != "X_scan" or self.X_scan is not None:
                object.__setattr__(self, name, checked_key("Between", name, getattr(self, name)))
        if self.X_a == self.X_b:
            raise FactorError("keys of Between", f"{key_name(self.X_a)} for X_a and X_b", "distinct keys")
        object.__setattr__(self, "seconds", checked_positive("seconds between the poses", self.seconds))
        image_after_a_s = checked_number("image_after_a_s of Between", self.image_after_a_s)
        object.__setattr__(self, "image_after_a_s", image_after_a_s)
        _ = self.lTb  # checked

    @cached_property
    def lTb(self) -> gtsam.Pose3:
        """Pose of the body in the LiDAR."""
        return body_in_lidar("Between", self.bTl)

    @property
    def X_s(self) -> int:
        """Key of the pose at the scan's stamp."""
        return self.X_a if self.X_scan is None else self.X_scan

    @property
    def image_after_middle_s(self) -> float:
        """Image stamp minus the middle between X_a and X_b [s]."""
        return self.image_after_a_s - 0.5 * self.seconds


def camera_motion_factor(
    first: Between,
    second: Between,
    cTl: int | gtsam.Pose3,
    time_offset_s: int | float,
    camera_motion: CameraMotion,
) -> gtsam.CustomFactor:
    """Log(c1Tc2^-1 . cTl . l1Tl2(X, D) . cTl^-1), predicted - measured [rad, m]; l1Tl2 as in the module.

    See :func:`sst_graph.factors.hand_eye_factor` for a motion of unknown scale.

    Args:
        first, second: where the two images fall, of one body; they may share poses.
        cTl: key of the extrinsic, or a fixed pose.
        time_offset_s: key of the time offset, or a fixed offset [s].
        camera_motion: measured from the first image to the second.

    Returns:
        A factor of 6 rows on the distinct keys: poses of the first, of the second, cTl, time_offset_s.

    Raises:
        FactorError: one key for two variables, or another place of the LiDAR in the body at each image.
    """
    for name, where in (("first", first), ("second", second)):
        checked_type(f"{name} of {_NAME}", where, Between, "a sst_graph.factors.Between")
    checked_type(f"camera_motion of {_NAME}", camera_motion, CameraMotion, "a sst_graph.factors.CameraMotion")
    if not first.lTb.equals(second.lTb, 1e-9):
        raise FactorError(f"bTl of {_NAME}", "one at the first image, another at the second", "one for both")
    error_of, noise = camera_motion_error(camera_motion)
    E, D = pose_or_key(_NAME, "cTl", cTl), number_or_key(_NAME, "time_offset_s", time_offset_s)
    arguments = [
        Argument(f"{end} of the {name}", getattr(where, end), gtsam.Pose3, shared_with="X_")
        for name, where in (("first", first), ("second", second))
        for end in ("X_a", "X_b")
    ]
    arguments += [Argument("cTl", E, gtsam.Pose3), Argument("time_offset_s", D, Vector(1))]
    variables = Variables.of(_NAME, arguments)
    function = partial(_error, variables.keys, _Chain(first, second, E, D), error_of)
    return custom_factor(noise, variables.named, function, variables.kinds, 6, _NAME)


def _error(
    keys: tuple[int, ...], chain: _Chain, error_of: MotionError, *values: Any, jacobians: bool
) -> tuple[FloatArray, list[FloatArray] | None]:
    predicted, P_H = chain.motion(dict(zip(keys, values, strict=True)), jacobians)
    error, error_H_P = error_of(predicted, jacobians)
    return error, None if error_H_P is None else [error_H_P @ P_H[key] for key in keys]


@dataclass(frozen=True)
class _Chain:
    """From poses, extrinsic and offset to the camera's motion; attributes as in the factor's arguments."""

    first: Between
    second: Between
    cTl: int | gtsam.Pose3
    time_offset_s: int | float

    def motion(self, named: dict[int, Any], jacobians: bool) -> tuple[gtsam.Pose3, dict[int, FloatArray]]:
        """c1Tc2, and its right derivatives (6, dim) by the variables, where they are asked for."""
        cTl, time_offset_s = self.cTl, self.time_offset_s
        extrinsic = cTl if isinstance(cTl, gtsam.Pose3) else named[cTl]
        offset = named[time_offset_s][0] if isinstance(time_offset_s, int | np.integer) else time_offset_s
        wTl_1, H_1 = _lidar_at(self.first, named, offset)
        wTl_2, H_2 = _lidar_at(self.second, named, offset)
        l1Tl2 = wTl_1.between(wTl_2)
        predicted = extrinsic * l1Tl2 * extrinsic.inverse()
        if not jacobians:
            return predicted, {}
        # right perturbations: of cTl M cTl^-1 by M and cTl, of M = wTl_1^-1 wTl_2 by both
        cAd, back = extrinsic.AdjointMap(), l1Tl2.inverse().AdjointMap()
        H = {key: np.zeros((6, 6)) for p in (self.first, self.second) for key in (p.X_a, p.X_b)}
        by_offset = np.zeros((6, 1))
        for where, L_H, lead in ((self.first, H_1, -cAd @ back), (self.second, H_2, cAd)):
            H[where.X_a] += lead @ L_H[0]
            H[where.X_b] += lead @ L_H[1]
            by_offset[:, 0] += lead @ L_H[2]
        if isinstance(time_offset_s, int | np.integer):
            H[int(time_offset_s)] = by_offset
        if not isinstance(cTl, gtsam.Pose3):
            H[int(cTl)] = cAd @ (back - np.eye(6))
        return predicted, H


def _lidar_at(
    where: Between, named: dict[int, Any], time_offset_s: float
) -> tuple[gtsam.Pose3, tuple[FloatArray, FloatArray, FloatArray]]:
    """wTl at an image's instant, and its right derivatives by X_a (6, 6), X_b (6, 6) and the offset (6,)."""
    X_a, X_b = named[where.X_a], named[where.X_b]
    xi = np.asarray(gtsam.Pose3.Logmap(X_a.between(X_b)))
    s = (where.image_after_a_s + time_offset_s) / where.seconds
    part = gtsam.Pose3.Expmap(s * xi)
    # Log(X_a^-1 X_b Exp(d)) = xi + Jr^-1(xi) d, and by X_a with Jl^-1(xi) = Jr^-1(-xi)
    stretch = s * np.asarray(gtsam.Pose3.ExpmapDerivative(s * xi))
    by_b = stretch @ gtsam.Pose3.LogmapDerivative(xi)
    by_a = part.inverse().AdjointMap() - stretch @ gtsam.Pose3.LogmapDerivative(-xi)
    lAd = where.lTb.AdjointMap()
    wTl = X_a * part * where.lTb.inverse()
    return wTl, (lAd @ by_a, lAd @ by_b, lAd @ xi / where.seconds)

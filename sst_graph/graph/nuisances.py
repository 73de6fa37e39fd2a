"""The parameters of assumptions in a problem: matches made under their values, and their Jacobian columns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from sst_graph.assumptions import ASSUMPTIONS, Effect, combined
from sst_graph.assumptions.model import Scene
from sst_graph.drive.twists import TwistSamples
from sst_graph.factors.alignment import Alignment, residuals
from sst_graph.factors.motion import CameraTwist, moved_points
from sst_graph.types import BoolArray, FloatArray, IntArray


@dataclass(frozen=True)
class Deviation:
    """The assumptions' parameters that are not 0, applied to one scan and image.

    Attributes:
        values: the parameters, by name.
        scene: of the scan and the image.
    """

    values: Mapping[str, float]
    scene: Scene

    def effect(self, lPs: FloatArray, offsets_s: FloatArray, uvs: FloatArray) -> Effect:
        """Effect on points (n, 3) [m] with times (n,) [s] and ideal pixels (n, 2) [px]."""
        view = self.scene.view(lPs, offsets_s, uvs)
        return combined([(theta, ASSUMPTIONS[name].effect(view)) for name, theta in self.values.items()])

    def take(self, index: IntArray) -> Deviation:
        """The deviation of some of the points, by position."""
        return replace(self, scene=taken(self.scene, index))


def taken(scene: Scene, index: IntArray) -> Scene:
    """The scene of some of the points, by position."""
    if np.ndim(scene.image_s) == 0:
        return scene
    return replace(scene, image_s=np.asarray(scene.image_s)[index], l_twist=scene.l_twist[index])


def deviation_of(nuisances: Mapping[str, float], scene: Scene) -> Deviation | None:
    """The deviation at these parameters; None where all are 0."""
    values = {name: theta for name, theta in nuisances.items() if theta != 0.0}
    return Deviation(values, scene) if values else None


def moved_twists(samples: TwistSamples, nuisances: Mapping[str, float], scene: Scene) -> TwistSamples:
    """The LiDAR's twists as they are under the parameters, from the measured ones.

    Args:
        scene: with a row of ``l_twist`` for each.
    """
    deviation = deviation_of(nuisances, scene)
    if deviation is None:
        return samples
    n = len(samples.twists)
    shift = deviation.effect(np.zeros((n, 3)), np.zeros(n), np.zeros((n, 2))).twist_shift
    return samples if shift is None else replace(samples, twists=samples.twists + shift)


def residual_columns(
    alignment: Alignment,
    scene: Scene,
    offsets_s: FloatArray,
    pose: tuple[gtsam.Pose3, float, FloatArray],
    names: Sequence[str],
    J: FloatArray | None = None,
) -> dict[str, FloatArray]:
    """Derivatives (n,) of the residuals of silhouettes by assumptions' parameters [px per unit], by name.

    Args:
        alignment: the matches.
        scene: of their scan and image; of several with a row for each match.
        offsets_s: (n,) time of each point relative to its scan's stamp, as it was measured: the intervals of
            the matches may hold what parameters change [s].
        pose: the extrinsic, the time offset [s], and the camera's twist (6,) or (6, n) [rad/s, m/s].
        names: of the assumptions.
        J: (n, 14) of the residuals by [rot, trans, offset, twist, bias], where it is known; where it is
            weighted, the derivatives are, too.
    """
    effects = _effects(alignment, scene, offsets_s, pose, names)
    # Where pixels move alone, a residual follows its pixel, and the motion's Jacobian is not needed.
    if J is None and not all(map(_moves_pixels_alone, effects)):
        J = residuals(alignment, *pose, 0.0)[1]
    return {name: _column(alignment, J, pose[0], effect) for name, effect in zip(names, effects, strict=True)}


@dataclass(frozen=True)
class _Effect:
    """What one unit of a parameter does to matches: their effect, and (n,) whether they are in front of the
    camera; nothing is known of the others."""

    of: Effect
    seen: BoolArray


def _effects(
    alignment: Alignment,
    scene: Scene,
    offsets_s: FloatArray,
    pose: tuple[gtsam.Pose3, float, FloatArray],
    names: Sequence[str],
) -> list[_Effect]:
    view = scene.view(alignment.lPs, offsets_s, _pixels(alignment, *pose))
    seen = np.asarray(np.isfinite(view.uvs).all(axis=1))
    return [_Effect(ASSUMPTIONS[name].effect(view), seen) for name in names]


def _moves_pixels_alone(effect: _Effect) -> bool:
    moved = effect.of.l_shift, effect.of.time_s, effect.of.twist_shift
    return all(each is None for each in moved)


def _column(alignment: Alignment, J: FloatArray | None, cTl: gtsam.Pose3, effect: _Effect) -> FloatArray:
    """Derivatives (n,) of residuals by one parameter, from their rows J (n, 14); without these where they are
    not weighted and pixels move alone."""
    total, of = np.zeros(len(alignment)), effect.of
    if J is not None and of.l_shift is not None:
        # A step of the extrinsic's translation (right perturbation) moves the point in the LiDAR frame.
        total += np.einsum("ij,ij->i", J[:, 3:6], of.l_shift)
    if J is not None and of.time_s is not None:
        total += J[:, 6] * of.time_s
    if of.pixel_shift is not None:
        normals = alignment.columns[2]
        assert normals is not None
        along = np.einsum("ji,ij->i", normals, of.pixel_shift)
        total += along if J is None else J[:, 13] * along
    if J is not None and of.twist_shift is not None:
        total += (J[:, 7:13] @ np.asarray(cTl.AdjointMap()) * of.twist_shift).sum(axis=1)
    return np.where(effect.seen, total, 0.0)


def _pixels(alignment: Alignment, cTl: gtsam.Pose3, time_offset_s: float, c_twist: FloatArray) -> FloatArray:
    """(n, 2) pixels of the matches' points by the ideal camera; NaN behind it."""
    lPs, _, _ = alignment.columns
    velocities = alignment.velocity_columns
    taus = alignment.taus_s(time_offset_s)
    motion = CameraTwist(c_twist, alignment.c_acceleration.T)
    moved = moved_points(cTl, lPs, taus, motion, alignment.motion_model, velocities)
    return alignment.camera.project(moved.cPs.T)

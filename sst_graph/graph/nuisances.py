"""The parameters of assumptions in a problem: matches made under their values, and their Jacobian columns."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from sst_graph.assumptions import ASSUMPTIONS, Effect, combined
from sst_graph.assumptions.model import Scene
from sst_graph.drive.twists import TwistSamples
from sst_graph.factors.alignment import Alignment, residuals
from sst_graph.factors.motion import CameraTwist, moved_points
from sst_graph.types import FloatArray, IntArray


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
        """On points (n, 3) [m] with times (n,) [s] and ideal pixels (n, 2) [px]."""
        view = self.scene.view(lPs, offsets_s, uvs)
        return combined([(theta, ASSUMPTIONS[name].effect(view)) for name, theta in self.values.items()])

    def take(self, index: IntArray) -> Deviation:
        """Of some of the points, by position."""
        return replace(self, scene=taken(self.scene, index))


def taken(scene: Scene, index: IntArray) -> Scene:
    """The scene of some of the points, by position."""
    return scene if np.ndim(scene.image_s) == 0 else replace(scene, image_s=np.asarray(scene.image_s)[index])


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
    shift = deviation.effect(np.zeros((0, 3)), np.zeros(0), np.zeros((0, 2))).twist_shift
    return samples if shift is None else replace(samples, twists=samples.twists + shift)


def residual_columns(
    alignment: Alignment,
    scene: Scene,
    base_tau_s: float | FloatArray,
    pose: tuple[gtsam.Pose3, float, FloatArray],
    names: Iterable[str],
) -> dict[str, FloatArray]:
    """Derivatives (n,) of the residuals of silhouettes by assumptions' parameters [px per unit].

    Args:
        alignment: the matches.
        scene: of their scan and image; of several with a row for each match.
        base_tau_s: stamp of the image minus that of the scan, one for all or (n,) [s].
        pose: the extrinsic, the time offset [s], and the camera's twist (6,) or (6, n) [rad/s, m/s].
        names: of the assumptions.
    """
    names = list(names)
    _, J = residuals(alignment, *pose, 0.0)
    columns = columns_of_jacobian(J, alignment, scene, base_tau_s, pose, names)
    return dict(zip(names, columns.T, strict=True))


def columns_of_jacobian(
    J: FloatArray,
    alignment: Alignment,
    scene: Scene,
    base_tau_s: float | FloatArray,
    pose: tuple[gtsam.Pose3, float, FloatArray],
    names: Sequence[str],
) -> FloatArray:
    """Derivatives (n, k) of residuals by assumptions' parameters, from the Jacobian J; weighted as its rows
    are.

    Args:
        J: (n, 14) by [rot, trans, offset, twist, bias], of residuals as they are or weighted.
        alignment, scene, base_tau_s, pose, names: as of :func:`residual_columns`.
    """
    view = scene.view(alignment.lPs, base_tau_s - alignment.base_taus_s, _pixels(alignment, *pose))
    seen = np.isfinite(view.uvs).all(axis=1)
    columns = np.zeros((len(alignment), len(names)))
    for place, name in enumerate(names):
        column = _column(alignment, J, pose[0], ASSUMPTIONS[name].effect(view))
        columns[:, place] = np.where(seen, column, 0.0)
    return columns


def _column(alignment: Alignment, J: FloatArray, cTl: gtsam.Pose3, effect: Effect) -> FloatArray:
    """Derivatives (n,) of residuals by one parameter, from their rows J (n, 14)."""
    total = np.zeros(len(alignment))
    if effect.l_shift is not None:
        # A step of the extrinsic's translation (right perturbation) moves the point in the LiDAR frame.
        total += np.einsum("ij,ij->i", J[:, 3:6], effect.l_shift)
    if effect.time_s is not None:
        total += J[:, 6] * effect.time_s
    if effect.pixel_shift is not None:
        normals = alignment.columns[2]
        assert normals is not None
        total += J[:, 13] * np.einsum("ji,ij->i", normals, effect.pixel_shift)
    if effect.twist_shift is not None:
        total += (J[:, 7:13] @ np.asarray(cTl.AdjointMap()) * effect.twist_shift).sum(axis=1)
    return total


def _pixels(alignment: Alignment, cTl: gtsam.Pose3, time_offset_s: float, c_twist: FloatArray) -> FloatArray:
    """(n, 2) pixels of the matches' points by the ideal camera; NaN behind it."""
    lPs, _, _ = alignment.columns
    velocities = alignment.velocity_columns
    taus = alignment.taus_s(time_offset_s)
    motion = CameraTwist(c_twist, alignment.c_acceleration.T)
    moved = moved_points(cTl, lPs, taus, motion, alignment.motion_model, velocities)
    return alignment.camera.project(moved.cPs.T)

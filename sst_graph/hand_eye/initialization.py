"""Initialization of hand-eye calibration: time offsets on a grid, the rotation in closed form."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from sst_graph.drive.path import SensorPath
from sst_graph.hand_eye.graph import CameraStep, MotionPairs, pair_motions
from sst_graph.sampling import spread_places
from sst_graph.types import FloatArray, Guess

LEAST_SHARE = 0.4
"""A time offset for which a smaller share of the pairs has LiDAR motion is not tried."""
MAX_OFFSET_S = 0.5
"""Half width of the time offsets that are tried [s]: clocks of one machine differ by less."""
_STEP_S = 0.02
"""Between time offsets [s]: a fifth of the usual time between scans."""
_SELECTED = 4
"""Most time offsets, each the best of its neighbourhood, that are refined."""
_MAX_PAIRS = 150
"""Most pairs that are compared, evenly spread: more cost time only."""
_LEVER_SIGMA_M = 0.4
"""Translation of the extrinsic, which the directions leave out, as a sigma [m]."""
_TRUNCATION = 5.0
"""Whitened size from which a residual costs no more: of outliers."""
_GUESS_SIGMA_RAD = 1.0
"""Sigma of the guess's rotation [rad]: it decides only what the motion leaves open."""
_ROUNDS = 6
"""Times that robust weights and rotation are found in turn; more cost time only."""


@dataclass(frozen=True)
class MotionStart:
    """An initial rotation and time offset, and their mean cost of a pair."""

    cRl: gtsam.Rot3
    time_offset_s: float
    cost: float


def motion_starts(
    steps: Sequence[CameraStep],
    paths: Sequence[SensorPath],
    guess: Guess,
    max_offset_s: float = MAX_OFFSET_S,
) -> list[MotionStart]:
    """The best starts, one for each minimum over the time offset, cheapest first; none without motion.

    Rotation vectors and directions of travel of the LiDAR are turned into the camera's (Kabsch, robustly
    weighted) at every time offset of the grid. Directions leave out the lever arm.

    Args:
        max_offset_s: half width of the time offsets that are tried around the guess [s].
    """
    some = [steps[i] for i in spread_places(np.arange(len(steps)), _MAX_PAIRS)]
    count = int(np.ceil(max_offset_s / _STEP_S))
    grid = guess.time_offset_s + _STEP_S * np.arange(-count, count + 1)
    found: list[MotionStart | None] = []
    for time_offset_s in grid:
        pairs = pair_motions(some, paths, float(time_offset_s))
        enough = len(pairs) >= max(2, LEAST_SHARE * len(some))
        found.append(_best_rotation(pairs, float(time_offset_s), guess.cTl) if enough else None)
    return _minima(found)[:_SELECTED]


def _minima(found: Sequence[MotionStart | None]) -> list[MotionStart]:
    """Local minima of the cost, the lowest first."""
    costs = np.array([np.inf if one is None else one.cost for one in found])
    around = np.concatenate([[np.inf], costs, [np.inf]])
    lowest = np.isfinite(costs) & (costs <= around[:-2]) & (costs <= around[2:])
    return sorted((one for one, low in zip(found, lowest, strict=True) if one and low), key=lambda s: s.cost)


def _best_rotation(pairs: MotionPairs, time_offset_s: float, guess: gtsam.Pose3 | None) -> MotionStart:
    """Robust Kabsch over rotation vectors and directions."""
    l_vectors, c_vectors, sigmas = _vectors(pairs)
    prior = np.zeros((3, 3)) if guess is None else guess.rotation().matrix() / _GUESS_SIGMA_RAD**2
    weights = np.ones(len(sigmas))
    R = np.eye(3)
    for _ in range(_ROUNDS):
        moment = (c_vectors * (weights / sigmas**2)[:, None]).T @ l_vectors + prior
        U, _, Vt = np.linalg.svd(moment)
        R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
        size = np.linalg.norm(c_vectors - l_vectors @ R.T, axis=1) / sigmas
        weights = 1.0 / (1.0 + (size / _TRUNCATION) ** 2) ** 2
    cost = float(np.minimum(size, _TRUNCATION) @ np.minimum(size, _TRUNCATION)) / len(size)
    return MotionStart(gtsam.Rot3(R), time_offset_s, cost)


def _vectors(pairs: MotionPairs) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(n, 3) vectors in the LiDAR, (n, 3) the same in the camera, (n,) sigmas: rotations, then directions."""
    lidars, motions = pairs.lidars, [camera.motion for camera in pairs.cameras]
    of_lidar = np.array([gtsam.Rot3.Logmap(gtsam.Rot3(aTb[:3, :3])) for aTb in lidars.aTbs])
    of_camera = np.array([camera.turned for camera in pairs.cameras])
    by_camera = np.array([motion.covariance for motion in motions])
    by_lidar = lidars.covariances
    variances = _trace(by_camera[:, :3, :3]) + _trace(by_lidar[:, :3, :3])
    translations = lidars.aTbs[:, :3, 3]
    lengths = np.linalg.norm(translations, axis=1)
    levers = _LEVER_SIGMA_M * np.linalg.norm(of_lidar, axis=1)
    ok = np.array([motion.ok for motion in motions])
    directed = np.flatnonzero(ok & (lengths >= 2.0 * levers) & (lengths >= 1e-3))
    lengths = lengths[directed]
    across = _trace(by_lidar[directed, 3:, 3:]) / 3.0 + levers[directed] ** 2
    sigmas = np.sqrt(_trace(by_camera[directed, 3:, 3:]) / 2.0 + across / lengths**2)
    directions = np.array([motions[k].direction for k in directed]).reshape(-1, 3)
    return (
        np.concatenate([of_lidar, translations[directed] / lengths[:, None]]),
        np.concatenate([of_camera, directions]),
        np.concatenate([np.sqrt(variances / 3.0), sigmas]),
    )


def _trace(matrices: FloatArray) -> FloatArray:
    """(n,) traces of matrices (n, k, k)."""
    return np.asarray(np.trace(matrices, axis1=1, axis2=2))

"""Rotation from motion in closed form: ``calibrateHandEye`` of OpenCV 4, the method of Park, Martin (1994).

OpenCV 5 has no such function, so it is written here. Motions: LiDAR odometry against visual odometry of
this package, over the true time offset. Visual odometry has no scale, so the translation stays at the start;
the start's rotation is not used.
"""

from __future__ import annotations

import gtsam
import numpy as np

from sst_graph.errors import EstimationError, count_of
from sst_graph.experiments.peers.frames import PeerProblem
from sst_graph.hand_eye.graph import camera_steps, lidar_paths, pair_motions
from sst_graph.types import FloatArray

_FEWEST = 3
"""Pairs of motions: two axes determine a rotation, noise needs more."""


def solve_hand_eye(problem: PeerProblem, start: gtsam.Pose3) -> gtsam.Pose3:
    """The start's translation with the rotation of the motions.

    Raises:
        EstimationError: too few pairs of motions.
    """
    pairs = pair_motions(camera_steps([problem.drive]), lidar_paths([problem.drive]), problem.time_offset_s)
    if len(pairs) < _FEWEST:
        raise EstimationError(f"{count_of(len(pairs), 'pair')} of motions, {_FEWEST} are needed")
    of_camera = np.array([camera.turned for camera in pairs.cameras])
    of_lidar = np.array([gtsam.Rot3.Logmap(gtsam.Rot3(aTb[:3, :3])) for aTb in pairs.lidars.aTbs])
    return gtsam.Pose3(park_martin(of_camera, of_lidar), start.translation())


def park_martin(alphas: FloatArray, betas: FloatArray) -> gtsam.Rot3:
    """R of least sum |alpha - R beta|^2 over rotation vectors (n, 3): (M'M)^-1/2 M', M = sum beta alpha'.

    Raises:
        EstimationError: all turns have one axis, or there is none.
    """
    M = betas.T @ alphas
    values, vectors = np.linalg.eigh(M.T @ M)
    if values[0] <= 1e-12 * values[2]:
        raise EstimationError("the vehicle turned about one axis only")
    R = vectors @ np.diag(1.0 / np.sqrt(values)) @ vectors.T @ M.T
    if np.linalg.det(R) < 0.0:
        raise EstimationError("the motions determine no rotation (a reflection fits them best)")
    return gtsam.Rot3.ClosestTo(R)

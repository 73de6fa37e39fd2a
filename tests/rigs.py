"""Made-up rigs for tests."""

from __future__ import annotations

from collections.abc import Mapping

import gtsam
import numpy as np
from numpy.typing import NDArray
from stored import simulated

from sst_graph.factors.camera import PinholeCamera
from sst_graph.result import CalibrationResult
from sst_graph.rig import KnownRig, RigMarginal, RigResult
from sst_graph.simulator import SimulatedDrive, SimulationConfig
from sst_graph.simulator.rig import beside, stereo_pose, with_mounts

CAMERA = PinholeCamera(700.0, 700.0, 600.0, 180.0, 1242, 375)
SIGMAS = np.array([0.001, 0.001, 0.001, 0.01, 0.01, 0.01, 0.002])


def stereo(street: SimulationConfig) -> Mapping[str, SimulatedDrive]:
    """A rendered street seen by a stereo rig with one trigger: left and right."""
    drive = simulated(street)
    return with_mounts(drive, {"right": beside(drive, stereo_pose())}, "left")


def covariance_of(cameras: int, seed: int = 0, scale: float = 1.0) -> NDArray[np.float64]:
    """A joint covariance of correlated cameras."""
    rng = np.random.default_rng(seed)
    n = 7 * cameras
    root = 0.5 * rng.standard_normal((n, n)) / np.sqrt(n) + np.eye(n)
    sigmas = scale * np.tile(SIGMAS, cameras)
    return np.asarray(root @ root.T * np.outer(sigmas, sigmas))


def marginal_of(cameras: int = 2, seed: int = 0, scale: float = 1.0) -> RigMarginal:
    rng = np.random.default_rng([seed, 1])
    return RigMarginal(
        tuple(f"cam{k}" for k in range(cameras)),
        tuple(gtsam.Pose3.Expmap(rng.standard_normal(6)) for _ in range(cameras)),
        tuple(rng.uniform(-0.1, 0.1, cameras).tolist()),
        covariance_of(cameras, seed, scale),
    )


def result_of(marginal: RigMarginal, known: KnownRig | None = None) -> RigResult:
    cameras = {
        name: CalibrationResult(cTl, offset_s, marginal.of_camera(name), "ok", CAMERA, camera_name=name)
        for name, cTl, offset_s in zip(
            marginal.names, marginal.extrinsics, marginal.time_offsets_s, strict=True
        )
    }
    return RigResult(cameras, marginal.covariance, "ok", (), known or KnownRig(), {"sides_in_common": 3})

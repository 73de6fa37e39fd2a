"""Seeded scenes for the tests of the factors."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gtsam
import numpy as np
import pytest

from sst_graph.factors import Alignment, PinholeCamera

KITTI = PinholeCamera(718.0, 700.0, 607.0, 185.0, 1242, 375)
# LiDAR x forward, y left, z up -> camera x right, y down, z forward
FORWARD = gtsam.Rot3(np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]))


def scene(
    seed: int,
    n: int = 30,
    *,
    per_point: bool = False,
    normals: bool = False,
    noise_px: float = 3.0,
    **options: Any,
) -> tuple[Alignment, gtsam.Pose3, float, np.ndarray]:
    """Matches that fit a random extrinsic, non-zero delay and twist up to ``noise_px``."""
    rng = np.random.default_rng(seed)
    cTl = gtsam.Pose3(FORWARD, np.array([0.06, -0.08, -0.27])).retract(rng.normal(0.0, 0.05, 6))
    time_offset_s, twist = (
        float(rng.uniform(0.05, 0.3)),
        rng.normal(0.0, 1.0, 6) * [0.3, 0.5, 0.2, 1.0, 0.5, 8.0],
    )
    lPs = np.stack([rng.uniform(6, 40, n), rng.uniform(-6, 6, n), rng.uniform(-2, 1, n)], axis=1)
    taus = rng.uniform(-0.05, 0.05, n) if per_point else np.full(n, -0.02)
    acceleration = rng.normal(0.0, 0.5, 6)
    cPs = [
        gtsam.Pose3.Expmap(-tau * (twist - 0.5 * tau * acceleration)).transformFrom(cTl.transformFrom(lP))
        for tau, lP in zip(time_offset_s + taus, lPs, strict=True)
    ]
    pixels = KITTI.project(np.array(cPs).reshape(-1, 3)) + rng.normal(0.0, noise_px, (n, 2))
    angles = rng.uniform(0.0, 2.0 * np.pi, n)
    alignment = Alignment(
        KITTI,
        lPs,
        taus,
        pixels,
        rng.uniform(1.0, 3.0, n),
        np.stack([np.cos(angles), np.sin(angles)], axis=1) if normals else None,
        c_acceleration=acceleration,
        **options,
    )
    return alignment, cTl, time_offset_s, twist


@pytest.fixture
def make_scene() -> Callable[..., tuple[Alignment, gtsam.Pose3, float, np.ndarray]]:
    """The factory :func:`scene`."""
    return scene


@pytest.fixture
def make_values() -> Callable[..., gtsam.Values]:
    """Values from {key: Pose3, float or vector}."""

    def build(**variables: Any) -> gtsam.Values:
        values = gtsam.Values()
        for name, value in variables.items():
            is_pose = isinstance(value, gtsam.Pose3)
            values.insert(gtsam.symbol(name[0], int(name[1:])), value if is_pose else np.atleast_1d(value))
        return values

    return build

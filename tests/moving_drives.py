"""Drives of motions alone: odometry of both sensors under known noise."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import gtsam
import numpy as np

from sst_graph.drive.preparation import Drive, ImageFeatures, ScanFeatures
from sst_graph.factors.camera import PinholeCamera
from sst_graph.odometry.features import Tracks as ImageTracks
from sst_graph.odometry.relative import DirectionMotion
from sst_graph.odometry.visual import ImagePair
from sst_graph.types import RelativeMotion

TRUE = gtsam.Pose3(
    gtsam.Rot3(np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])), np.array([0.1, -0.2, -0.3])
).retract(np.array([0.03, -0.05, 0.02, 0.0, 0.0, 0.0]))
OFFSET_S = 0.13
PERIOD_S = 0.1
SIGMA_RAD, SIGMA_M, SIGMA_DIRECTION = 1e-4, 2e-3, 1e-3
PoseAt = Callable[[float], gtsam.Pose3]


def weaving(t: float) -> gtsam.Pose3:
    """Turns to both sides on a hilly, rough road."""
    rotation = gtsam.Rot3.RzRyRx(0.02 * np.sin(5.0 * t), 0.1 * np.sin(1.1 * t), 0.8 * np.sin(0.9 * t))
    return gtsam.Pose3(rotation, np.array([8.0 * t, 3.0 * np.sin(0.9 * t), 0.5 * np.sin(1.1 * t)]))


def straight(t: float) -> gtsam.Pose3:
    """10 m/s, dead straight, on a road as smooth as none is."""
    return gtsam.Pose3(gtsam.Rot3(), np.array([10.0 * t, 0.0, 0.0]))


def resting(t: float) -> gtsam.Pose3:
    return gtsam.Pose3()


@dataclass(frozen=True)
class Clock:
    """When the frames of a sensor are taken, and their stamps [ns]."""

    taken: Sequence[int]
    stamps: Sequence[int]


def regular(frames: int) -> Clock:
    """A frame a period, with right stamps."""
    taken = [round(k * PERIOD_S * 1e9) for k in range(frames)]
    return Clock(taken, taken)


def jumping(frames: int, places: Sequence[int], clock_set: bool) -> Clock:
    """From each of some frames on the stamps are 34 ms later, and so are the frames unless the clock was
    set."""
    taken = regular(frames).taken
    stamps = [at + 34_000_000 * sum(k >= place for place in places) for k, at in enumerate(taken)]
    return Clock(taken if clock_set else stamps, stamps)


def made_drive(
    wTl: PoseAt,
    frames: int = 50,
    seed: int = 0,
    noise: float = 1.0,
    yaw_noise: float = 1.0,
    lidar_noise: float = 1.0,
    image_clock: Clock | None = None,
    scan_clock: Clock | None = None,
) -> Drive:
    """Odometry of both sensors under known noise; the LiDAR's poses err, not its steps.

    Args:
        lidar_noise: factor on the noise of the LiDAR alone, of which the odometry does not know.
        yaw_noise: factor on the LiDAR's noise about its z axis, of which the odometry does not know.
        image_clock, scan_clock: of the frames, :func:`regular` where None.
    """
    rng = np.random.default_rng(seed)
    sigmas = noise * lidar_noise * np.repeat([SIGMA_RAD, SIGMA_M], 3)
    sigmas[2] *= yaw_noise
    seen, swept = image_clock or regular(frames), scan_clock or regular(frames)
    poses = [wTl(at * 1e-9).retract(sigmas * rng.standard_normal(6)) for at in swept.taken]
    lidar = tuple(
        RelativeMotion(a, b, p.between(q), np.diag(2.0 * np.repeat([SIGMA_RAD, SIGMA_M], 3) ** 2))
        for (a, b), (p, q) in zip(pairwise(swept.stamps), pairwise(poses), strict=True)
    )
    camera = tuple(
        ImagePair(ImageTracks(*stamps, np.zeros((0, 2)), np.zeros((0, 2))), _motion(*taken, wTl, rng, noise))
        for stamps, taken in zip(pairwise(seen.stamps), pairwise(seen.taken), strict=True)
    )
    blank, none = np.zeros((1, 1), np.uint8), np.zeros((0, 3))
    images = tuple(ImageFeatures(k, stamp, blank, {}) for k, stamp in enumerate(seen.stamps))
    empty = none, np.zeros(0, np.uint8), none[:, 0], none.astype(np.float32), none[:, 0].astype(np.float32)
    scans = tuple(ScanFeatures(k, stamp, {}, *empty) for k, stamp in enumerate(swept.stamps))
    return Drive("made", PinholeCamera(700, 700, 600, 180, 1242, 375), scans, images, lidar, camera)


def _motion(a: int, b: int, wTl: PoseAt, rng: np.random.Generator, noise: float) -> DirectionMotion:
    """The camera's between two images."""
    ends = [wTl(stamp * 1e-9 + OFFSET_S) * TRUE.inverse() for stamp in (a, b)]
    aTb = ends[0].between(ends[1])
    turn = aTb.rotation() * gtsam.Rot3.Expmap(noise * SIGMA_RAD * rng.standard_normal(3))
    length = float(np.linalg.norm(aTb.translation()))
    direction = aTb.translation() / length if length > 1e-6 else np.array([0.0, 0.0, 1.0])
    seen = np.asarray(
        gtsam.Unit3(direction).retract(noise * SIGMA_DIRECTION * rng.standard_normal(2)).point3()
    )
    covariance = np.diag([SIGMA_RAD**2] * 3 + [SIGMA_DIRECTION**2] * 2)
    return DirectionMotion(turn, turn, seen, covariance, 0.1, length > 0.1)

"""SST-Calib as printed (Kodaira, Zhou, Zang, Zhan, Tomizuka, ITSC 2022): the static and the joint stage.

Where the print is silent: frames are those of equal stamps, spread over the drive; the time offset starts
at the guess; camera velocity comes from visual odometry with LiDAR depth, renewed every few steps because
the depth hangs on extrinsic and offset; a re-match is followed by one Levenberg-Marquardt step.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sst_graph.baselines.nearest_pixel_frames import (
    Calibration,
    FramePair,
    MatchFrame,
    frame_pairs,
    frozen_covariance,
    match_frames,
    spread,
    step_once,
)
from sst_graph.config import Settings, setting
from sst_graph.drive.preparation import Drive, Progress
from sst_graph.errors import ConfigError, EstimationError
from sst_graph.factors import beta_regularizer
from sst_graph.graph.state import EXTRINSIC
from sst_graph.odometry import metric_motions, standstill_frames
from sst_graph.types import RelativeMotion, SemanticClass

_LOG = logging.getLogger(__name__)
FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class PaperConfig(Settings):
    """Both stages, with the paper's numbers.

    Attributes:
        static_weights, static_iterations: w_l of each phase of the static stage, and its iterations.
        joint_weight, joint_iterations: w_l of the joint stage, and its iterations.
        lambda_t, lambda_r: weights of the regularizer beta [1/m^2], [1/rad^2].
        pixel_share: share of the mask's pixels that are matched.
        static_frames, joint_frames: most frames of each stage.
        velocity_every: iterations of the joint stage between renewals of the velocities.
        seed: of the sample of pixels.
    """

    static_weights: tuple[float, ...] = setting((20.0, 1.0, 0.02), at_least=0.0, at_most=1e6, length=(1, 20))
    static_iterations: tuple[int, ...] = setting((20, 30, 10), at_least=1, at_most=1000, length=(1, 20))
    joint_weight: float = setting(5.0, at_least=0.0, at_most=1e6)
    joint_iterations: int = setting(20, at_least=1, at_most=1000)
    lambda_t: float = setting(1e6, at_least=1e-6, at_most=1e15)
    lambda_r: float = setting(1e9, at_least=1e-6, at_most=1e15)
    pixel_share: float = setting(0.02, at_least=0.0001, at_most=1.0)
    static_frames: int = setting(5, at_least=1, at_most=1000)
    joint_frames: int = setting(20, at_least=1, at_most=1000)
    velocity_every: int = setting(5, at_least=1, at_most=1000)
    seed: int = setting(0, at_least=0, at_most=10**15)

    def __post_init__(self) -> None:
        weights, iterations = len(self.static_weights), len(self.static_iterations)
        if weights != iterations:
            raise ConfigError(
                f"static_weights: found {weights} of them, expected {iterations}, one for each of "
                "static_iterations"
            )


@dataclass(frozen=True)
class NearestSolution:
    """Where a nearest-pixel method ended.

    Attributes:
        calibration: the estimate.
        covariance: (7, 7) of the frozen matches.
        creep: (7,) way that the last step would make in as many steps again as its phase had [rad, m, s]:
            a fixed number of steps may end on the way.
        frames: those that took part, moving as they were taken to.
        reasons: what was missing.
        diagnostics: JSON-able numbers.
    """

    calibration: Calibration
    covariance: FloatArray
    creep: FloatArray
    frames: tuple[MatchFrame, ...]
    reasons: tuple[str, ...] = ()
    diagnostics: dict[str, object] = field(default_factory=dict)


@dataclass(frozen=True)
class StillFrames:
    """Frames for a stage without motion, and a reason where they may move."""

    frames: tuple[MatchFrame, ...]
    reasons: tuple[str, ...] = ()


def solve_paper(
    drives: Sequence[Drive],
    guess: Calibration,
    classes: Sequence[SemanticClass],
    config: PaperConfig,
    progress: Progress | None = None,
) -> NearestSolution:
    """The static stage on standing frames, then the joint stage on moving ones.

    Raises:
        EstimationError: no standing frame, or no point of a class on any image.
    """
    # 1. Standing and moving frames by visual odometry.
    pairs = frame_pairs(drives)
    motions = camera_motions(drives, guess, [None] * len(drives))
    stands = _standing_images(drives, motions)
    still = _standing(pairs, drives, stands, classes, config)
    if not still:
        raise EstimationError(
            "no standing frame shows the classes to both sensors: the static stage needs the vehicle at rest"
        )
    # 2. The static stage.
    static, static_creep = _static_stage(still, guess, config, progress)
    # 3. The joint stage.
    moving = _moving(pairs, drives, motions, stands, classes, config)
    if not moving:
        covariance = frozen_covariance(still, static, config.static_weights[-1])
        reason = "no moving frame with a known velocity: the joint stage was left out"
        counts: dict[str, object] = {"standstill_frames": len(still)}
        return NearestSolution(static, covariance, static_creep, tuple(still), (reason,), counts)
    joint, creep, moving = _joint_stage(drives, moving, static, motions, config, progress)
    # 4. What holds the extrinsic is the standing frames themselves: they stand in beta's place.
    covariance = frozen_covariance([*still, *moving], joint, config.joint_weight)
    counts = {"standstill_frames": len(still), "moving_frames": len(moving)}
    # beta holds the extrinsic where the static stage left it: that stage's way is still to go.
    creep[:6] = static_creep[:6]
    return NearestSolution(joint, covariance, creep, (*still, *moving), (), counts)


def solve_static(
    drives: Sequence[Drive],
    guess: Calibration,
    classes: Sequence[SemanticClass],
    config: PaperConfig,
    progress: Progress | None = None,
) -> NearestSolution:
    """The static stage alone; the time offset stays at the guess.

    Raises:
        EstimationError: no frame shows a class to both sensors, or no point falls on any image.
    """
    still = still_frames(drives, guess, classes, config)
    answer, creep = _static_stage(still.frames, guess, config, progress)
    covariance = frozen_covariance(still.frames, answer, config.static_weights[-1])
    counts: dict[str, object] = {"frames": len(still.frames)}
    return NearestSolution(answer, covariance, creep, still.frames, still.reasons, counts)


def still_frames(
    drives: Sequence[Drive],
    guess: Calibration,
    classes: Sequence[SemanticClass],
    config: PaperConfig,
) -> StillFrames:
    """Standing frames that show the classes, or all frames that do where none is known to stand.

    Raises:
        EstimationError: no frame shows a class to both sensors.
    """
    pairs = frame_pairs(drives)
    motions = camera_motions(drives, guess, [None] * len(drives))
    stands = _standing_images(drives, motions)
    still = _standing(pairs, drives, stands, classes, config)
    if still:
        return StillFrames(tuple(still))
    every = match_frames(pairs, drives, classes, config.pixel_share, config.seed)
    if not every:
        names = " or ".join(c.name.lower() for c in classes)
        raise EstimationError(f"no frame in which LiDAR and camera both show {names}")
    return StillFrames(
        tuple(spread(every, config.static_frames)),
        ("no frame is known to stand: motion between scan and image was ignored",),
    )


def camera_motions(
    drives: Sequence[Drive],
    at: Calibration,
    former: Sequence[Sequence[RelativeMotion] | None],
) -> list[list[RelativeMotion]]:
    """Metric motions of each drive's camera, with LiDAR depth placed by a calibration.

    Args:
        former: motions found earlier, which carry the depth to the image's instant; None: at rest.
    """
    return [
        metric_motions(drive.image_pairs, drive.camera, _Depth(drive, at, before))
        for drive, before in zip(drives, former, strict=True)
    ]


class _Depth:
    """LiDAR points in the camera at an image's instant, by the image's position."""

    def __init__(self, drive: Drive, at: Calibration, former: Sequence[RelativeMotion] | None) -> None:
        self._drive, self._at, self._former = drive, at, former
        self._scans = {scan.index: scan for scan in drive.scans}

    def __call__(self, position: int) -> FloatArray:
        """(m, 3) points of the scan of the same frame [m]; none where it is missing."""
        image = self._drive.images[position]
        scan = self._scans.get(image.index)
        if scan is None:
            return np.zeros((0, 3))
        cPs = np.asarray(self._at.cTl.transformFrom(scan.depth_lPs.T.astype(np.float64))).T
        if not self._former:
            return cPs
        tau_s = self._at.offset_s + (image.stamp_ns - scan.stamp_ns) * 1e-9
        return np.asarray(cPs - tau_s * velocity_at(self._former, position))


def _standing_images(
    drives: Sequence[Drive], motions: Sequence[Sequence[RelativeMotion]]
) -> list[NDArray[np.bool_]]:
    """Whether the vehicle stands at each image of each drive; nowhere where no motion is known."""
    return [
        standstill_frames(found) if found else np.zeros(len(drive.images), np.bool_)
        for drive, found in zip(drives, motions, strict=True)
    ]


def velocity_at(motions: Sequence[RelativeMotion], image: int) -> FloatArray:
    """(3,) camera velocity at an image, from the motion that ended there [m/s]; v_k of the paper is -v."""
    return np.asarray(motions[max(0, image - 1)].mean_twist[3:])


def _standing(
    pairs: Sequence[FramePair],
    drives: Sequence[Drive],
    stands: Sequence[NDArray[np.bool_]],
    classes: Sequence[SemanticClass],
    config: PaperConfig,
) -> list[MatchFrame]:
    chosen = [p for p in pairs if stands[p.drive][p.image_position]]
    frames = match_frames(chosen, drives, classes, config.pixel_share, config.seed)
    return spread(frames, config.static_frames)


def _moving(
    pairs: Sequence[FramePair],
    drives: Sequence[Drive],
    motions: Sequence[Sequence[RelativeMotion]],
    stands: Sequence[NDArray[np.bool_]],
    classes: Sequence[SemanticClass],
    config: PaperConfig,
) -> list[MatchFrame]:
    chosen = []
    for p in pairs:
        known = motions[p.drive]
        if known and not stands[p.drive][p.image_position] and known[max(0, p.image_position - 1)].ok:
            chosen.append(p)
    frames = match_frames(chosen, drives, classes, config.pixel_share, config.seed)
    return spread(frames, config.joint_frames)


def _static_stage(
    frames: Sequence[MatchFrame], start: Calibration, config: PaperConfig, progress: Progress | None
) -> tuple[Calibration, FloatArray]:
    """The estimate and its creep."""
    at, creep = start, np.zeros(7)
    done, total = 0, sum(config.static_iterations)
    for weight, iterations in zip(config.static_weights, config.static_iterations, strict=True):
        for _ in range(iterations):
            last, at = at, step_once(frames, at, weight)
            creep = iterations * last.to(at)
            done += 1
            if progress is not None:
                progress("static stage", done, total)
    return at, creep


def _joint_stage(
    drives: Sequence[Drive],
    frames: Sequence[MatchFrame],
    static: Calibration,
    motions: list[list[RelativeMotion]],
    config: PaperConfig,
    progress: Progress | None,
) -> tuple[Calibration, FloatArray, list[MatchFrame]]:
    """The estimate, its creep, and the frames with the velocities that it was made with."""
    beta = beta_regularizer(EXTRINSIC, static.cTl, config.lambda_t, config.lambda_r)
    at, creep, moving = static, np.zeros(7), list(frames)
    for iteration in range(config.joint_iterations):
        if iteration % config.velocity_every == 0:
            motions = camera_motions(drives, at, motions)
            moving = [f.moving_at(velocity_at(motions[f.pair.drive], f.pair.image_position)) for f in moving]
        last, at = at, step_once(moving, at, config.joint_weight, beta, offset_free=True)
        creep = config.joint_iterations * last.to(at)
        if progress is not None:
            progress("joint stage", iteration + 1, config.joint_iterations)
    _LOG.info("paper: offset %.4f s after %d joint iterations", at.offset_s, config.joint_iterations)
    return at, creep, moving

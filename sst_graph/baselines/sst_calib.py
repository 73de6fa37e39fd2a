"""SST-Calib as printed (Kodaira, Zhou, Zang, Zhan, Tomizuka, ITSC 2022): the static and the joint stage.

Where the paper says nothing: frames are those of equal stamps, spread over the drive; the time offset starts
at the guess; camera velocity comes from visual odometry with LiDAR depth, computed again every few
steps because the depth depends on extrinsic and offset; one Levenberg-Marquardt step follows each match.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sst_graph.baselines.nearest_pixel_frames import (
    FramePair,
    MatchFrame,
    frame_pairs,
    frozen_covariance,
    match_frames,
    step_once,
)
from sst_graph.config import Settings, internal, setting
from sst_graph.drive.preparation import Drive, Progress
from sst_graph.errors import EstimationError
from sst_graph.factors import beta_regularizer
from sst_graph.graph.state import EXTRINSIC
from sst_graph.odometry import metric_motions, standstill_frames
from sst_graph.odometry.visual import DepthProvider
from sst_graph.sampling import evenly_spread
from sst_graph.types import Calibration, FloatArray, RelativeMotion, SemanticClass

_LOG = logging.getLogger(__name__)


_STATIC_PHASES = ((20.0, 20), (1.0, 30), (0.02, 10))
"""w_l of each phase of the static stage, and its iterations: the paper's."""
_JOINT_WEIGHT, _JOINT_ITERATIONS = 5.0, 20
"""w_l of the joint stage, and its iterations: the paper's."""
_PIXEL_SHARE = 0.02
"""Share of the mask's pixels that are matched: the paper's."""
_VELOCITY_EVERY = 5
"""Iterations of the joint stage between renewals of the velocities: the paper does not say how many."""


@dataclass(frozen=True)
class PaperConfig(Settings):
    """What the paper leaves open, and the weights of its regularizer.

    Attributes:
        seed: of the sampled pixels and poses; the calibration's.
    """

    lambda_t: float = setting(
        1e6,
        at_least=1e-6,
        at_most=1e15,
        unit="1/m^2",
        doc="Weight of the translation in SST-Calib's regularizer. Change to compare with the paper.",
    )
    lambda_r: float = setting(
        1e9,
        at_least=1e-6,
        at_most=1e15,
        unit="1/rad^2",
        doc="Weight of the rotation in SST-Calib's regularizer. Change to compare with the paper.",
    )
    static_frames: int = setting(
        5,
        at_least=1,
        at_most=1000,
        doc="Most frames of SST-Calib's static stage. Raise it for more data, at a cost in time.",
    )
    joint_frames: int = setting(
        20,
        at_least=1,
        at_most=1000,
        doc="Most frames of SST-Calib's joint stage. Raise it for more data, at a cost in time.",
    )
    bidirectional: bool = setting(
        True,
        doc="Match pixels with points, too, as SST-Calib does. Set to false for its single-directional loss, "
        "points to pixels only (w_l = 0).",
    )
    seed: int = internal(0)

    def weight(self, w_l: float) -> float:
        """Weight of the loss from pixels to points: w_l, or 0 where it is left out."""
        return w_l if self.bidirectional else 0.0


@dataclass(frozen=True)
class NearestSolution:
    """Where a nearest-pixel method ended.

    Attributes:
        calibration: the estimate.
        covariance: (7, 7) of the frozen matches.
        remaining_step: (7,) the last step times the number of steps of its phase [rad, m, s]: a fixed number
            of steps may end before the optimum.
        frames: those that took part, with the velocities that were used.
        reasons: what was missing.
        diagnostics: JSON-able numbers.
    """

    calibration: Calibration
    covariance: FloatArray
    remaining_step: FloatArray
    frames: tuple[MatchFrame, ...]
    reasons: tuple[str, ...] = ()
    diagnostics: dict[str, object] = field(default_factory=dict)


@dataclass(frozen=True)
class StillFrames:
    """Frames for a stage without motion, and a reason where they may move."""

    frames: tuple[MatchFrame, ...]
    reasons: tuple[str, ...] = ()


@dataclass(frozen=True)
class PaperProblem:
    """Drives for the nearest-pixel methods, and how they are matched.

    Attributes:
        drives: what is kept of them.
        classes: to match.
        config: settings of both stages.
        progress: called with (stage, steps done, steps in all).
    """

    drives: Sequence[Drive]
    classes: Sequence[SemanticClass]
    config: PaperConfig
    progress: Progress | None = None

    def motions(self, at: Calibration) -> list[list[RelativeMotion]]:
        """Motions of each drive's camera, with the depth of LiDAR points at rest."""
        return camera_motions(self.drives, at, [None] * len(self.drives))

    def standstill(self, motions: Sequence[Sequence[RelativeMotion]]) -> list[NDArray[np.bool_]]:
        """Whether the vehicle stands at each image of each drive; nowhere where no motion is known."""
        return [
            standstill_frames(found) if found else np.zeros(len(drive.images), np.bool_)
            for drive, found in zip(self.drives, motions, strict=True)
        ]

    def frames(self, pairs: Sequence[FramePair], most: int | None = None) -> list[MatchFrame]:
        """Frames of those pairs that show a class to both sensors; at most so many, evenly spread."""
        found = match_frames(pairs, self.drives, self.classes, _PIXEL_SHARE, self.config.seed)
        return found if most is None else evenly_spread(found, most)

    def still(self, stands: Sequence[NDArray[np.bool_]]) -> list[MatchFrame]:
        """Standing frames for the static stage."""
        chosen = [p for p in frame_pairs(self.drives) if stands[p.drive][p.image_position]]
        return self.frames(chosen, self.config.static_frames)

    def moving(
        self, motions: Sequence[Sequence[RelativeMotion]], stands: Sequence[NDArray[np.bool_]]
    ) -> list[MatchFrame]:
        """Moving frames whose velocity is known, for the joint stage."""
        chosen = []
        for p in frame_pairs(self.drives):
            known = motions[p.drive]
            if known and not stands[p.drive][p.image_position] and known[max(0, p.image_position - 1)].ok:
                chosen.append(p)
        return self.frames(chosen, self.config.joint_frames)


def solve_paper(problem: PaperProblem, guess: Calibration) -> NearestSolution:
    """The static stage on standing frames, then the joint stage on moving ones.

    Raises:
        EstimationError: no standing frame, or no point of a class on any image.
    """
    # 1. Standing and moving frames by visual odometry.
    motions = problem.motions(guess)
    stands = problem.standstill(motions)
    still = problem.still(stands)
    if not still:
        raise EstimationError(
            "no standing frame shows the classes to both sensors: the static stage needs the vehicle at rest"
        )
    # 2. The static stage.
    static, static_remaining = _static_stage(problem, still, guess)
    # 3. The joint stage.
    moving = problem.moving(motions, stands)
    if not moving:
        covariance = frozen_covariance(still, static, problem.config.weight(_STATIC_PHASES[-1][0]))
        reason = "no moving frame with a known velocity: the joint stage was left out"
        counts: dict[str, object] = {"standstill_frames": len(still)}
        return NearestSolution(static, covariance, static_remaining, tuple(still), (reason,), counts)
    joint, remaining, moving = _joint_stage(problem, moving, static, motions)
    # 4. Covariance: the standing frames hold the extrinsic, in beta's place.
    covariance = frozen_covariance([*still, *moving], joint, problem.config.weight(_JOINT_WEIGHT))
    counts = {"standstill_frames": len(still), "moving_frames": len(moving)}
    # beta holds the extrinsic where the static stage left it, so that stage's remaining step counts.
    remaining[:6] = static_remaining[:6]
    return NearestSolution(joint, covariance, remaining, (*still, *moving), (), counts)


def solve_static(problem: PaperProblem, guess: Calibration) -> NearestSolution:
    """The static stage alone; the time offset stays at the guess.

    Raises:
        EstimationError: no frame shows a class to both sensors, or no point falls on any image.
    """
    still = still_frames(problem, guess)
    result, remaining = _static_stage(problem, still.frames, guess)
    covariance = frozen_covariance(still.frames, result, problem.config.weight(_STATIC_PHASES[-1][0]))
    counts: dict[str, object] = {"frames": len(still.frames)}
    return NearestSolution(result, covariance, remaining, still.frames, still.reasons, counts)


def still_frames(problem: PaperProblem, guess: Calibration) -> StillFrames:
    """Standing frames that show the classes, or all frames that do where none is known to stand.

    Raises:
        EstimationError: no frame shows a class to both sensors.
    """
    still = problem.still(problem.standstill(problem.motions(guess)))
    if still:
        return StillFrames(tuple(still))
    every = problem.frames(frame_pairs(problem.drives))
    if not every:
        names = " or ".join(c.name.lower() for c in problem.classes)
        raise EstimationError(f"no frame in which LiDAR and camera both show {names}")
    return StillFrames(
        tuple(evenly_spread(every, problem.config.static_frames)),
        ("no frame is known to stand: motion between scan and image was ignored",),
    )


def camera_motions(
    drives: Sequence[Drive],
    at: Calibration,
    former: Sequence[Sequence[RelativeMotion] | None],
) -> list[list[RelativeMotion]]:
    """Metric motions of each drive's camera, with LiDAR depth placed by a calibration.

    Args:
        former: motions found earlier, by which the points are moved to the image's instant; None: at rest.
    """
    return [
        metric_motions(drive.image_pairs, drive.camera, _depths_of(drive, at, before))
        for drive, before in zip(drives, former, strict=True)
    ]


def _depths_of(drive: Drive, at: Calibration, former: Sequence[RelativeMotion] | None) -> DepthProvider:
    """LiDAR points in the camera at an image's instant, of the scan of the same frame."""
    scans = {scan.index: scan for scan in drive.scans}

    def depths(position: int) -> FloatArray:
        image = drive.images[position]
        scan = scans.get(image.index)
        if scan is None:
            return np.zeros((0, 3))
        cPs = np.asarray(at.cTl.transformFrom(scan.depth_lPs.T.astype(np.float64))).T
        if not former:
            return cPs
        tau_s = at.time_offset_s + (image.stamp_ns - scan.stamp_ns) * 1e-9
        return np.asarray(cPs - tau_s * velocity_at(former, position))

    return depths


def velocity_at(motions: Sequence[RelativeMotion], image: int) -> FloatArray:
    """(3,) camera velocity at an image, from the motion that ended there [m/s]; v_k of the paper is -v."""
    return np.asarray(motions[max(0, image - 1)].mean_twist[3:])


def _static_stage(
    problem: PaperProblem, frames: Sequence[MatchFrame], start: Calibration
) -> tuple[Calibration, FloatArray]:
    """The estimate and its remaining step."""
    at, remaining = start, np.zeros(7)
    done, total = 0, sum(iterations for _, iterations in _STATIC_PHASES)
    for weight, iterations in _STATIC_PHASES:
        for _ in range(iterations):
            last, at = at, step_once(frames, at, problem.config.weight(weight))
            remaining = iterations * last.local_coordinates(at)
            done += 1
            if problem.progress is not None:
                problem.progress("static stage", done, total)
    return at, remaining


def _joint_stage(
    problem: PaperProblem,
    frames: Sequence[MatchFrame],
    static: Calibration,
    motions: list[list[RelativeMotion]],
) -> tuple[Calibration, FloatArray, list[MatchFrame]]:
    """The estimate, its remaining step, and the frames with the velocities that it was made with."""
    beta = beta_regularizer(EXTRINSIC, static.cTl, problem.config.lambda_t, problem.config.lambda_r)
    at, remaining, moving = static, np.zeros(7), list(frames)
    for iteration in range(_JOINT_ITERATIONS):
        if iteration % _VELOCITY_EVERY == 0:
            motions = camera_motions(problem.drives, at, motions)
            moving = [f.moving_at(velocity_at(motions[f.pair.drive], f.pair.image_position)) for f in moving]
        weight = problem.config.weight(_JOINT_WEIGHT)
        last, at = at, step_once(moving, at, weight, beta, offset_free=True)
        remaining = _JOINT_ITERATIONS * last.local_coordinates(at)
        if problem.progress is not None:
            problem.progress("joint stage", iteration + 1, _JOINT_ITERATIONS)
    _LOG.info("paper: offset %.4f s after %d joint iterations", at.time_offset_s, _JOINT_ITERATIONS)
    return at, remaining, moving

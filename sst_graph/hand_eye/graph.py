"""Pairs of camera and LiDAR motion, and their factor graph on E and D; no label, no depth.

The camera's motion enters by rotation and direction alone: its length would depend on LiDAR depth placed by
the extrinsic that is to be estimated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.drive.path import PathStep, SensorPath
from sst_graph.drive.preparation import Drive
from sst_graph.factors import (
    CameraMotion,
    LidarMotion,
    hand_eye_factor,
    rotation_hand_eye,
    time_offset_prior,
)
from sst_graph.factors.custom.factor import recipe_of
from sst_graph.factors.robust import RobustKernel
from sst_graph.graph.state import EXTRINSIC, State, time_offset_key
from sst_graph.odometry.relative import DirectionMotion
from sst_graph.odometry.standstill import zero_velocity_update

FloatArray = NDArray[np.float64]

MIN_LENGTH_M = 0.1
"""Shorter motions of the camera do not determine a direction [m]."""
MAX_ROTATION_SIGMA_RAD = 0.02
"""Camera motions whose rotation is known worse are left out [rad]."""
PRIOR_SIGMAS: FloatArray = np.array([1.0] * 3 + [0.5] * 3 + [0.3])
"""(7,) deviations from the guess, or from the start without one [rad, m, s]: so wide that they matter only
where the motion says nothing."""
_KERNEL = RobustKernel("cauchy", 3.0)
"""Of whitened rotations and directions, scale in sigmas: odometry fails on single pairs; what lies
within three sigmas counts nearly in full."""
_LEAST_SCALE = 0.3
"""The odometry's sigmas are never made smaller by more than this factor, however well few pairs fit."""
_MEDIAN_CHI2 = {3: 2.366, 2: 1.386}
"""Median of the chi-squared distribution by degrees of freedom."""


@dataclass(frozen=True)
class CameraStep:
    """The camera's motion between two images.

    Attributes:
        drive: number of the drive.
        image: index of the frame that the first image is of.
        from_ns, to_ns: stamps of the images, camera clock [ns].
        motion: rotation, and direction where it is ok.
    """

    drive: int
    image: int
    from_ns: int
    to_ns: int
    motion: DirectionMotion

    @property
    def rotation(self) -> gtsam.Rot3:
        """Rotation of the second camera in the first."""
        return self.motion.rotation if self.motion.ok else self.motion.turn


@dataclass(frozen=True)
class MotionPair:
    """A camera's motion and the LiDAR's over the same time, as the time offset has it."""

    camera: CameraStep
    lidar: PathStep


@dataclass(frozen=True)
class NoiseScales:
    """By what the sigmas of the odometry are multiplied so that the residuals fit them."""

    rotation: float = 1.0
    direction: float = 1.0


def camera_steps(drives: Sequence[Drive]) -> list[CameraStep]:
    """The camera's motion between tracked images of all drives, where at least its rotation is known."""
    indices = [{image.stamp_ns: image.index for image in drive.images} for drive in drives]
    return [
        CameraStep(number, indices[number][tracks.from_ns], tracks.from_ns, tracks.to_ns, pair.direction)
        for number, drive in enumerate(drives)
        for pair, tracks in ((pair, pair.tracks) for pair in drive.image_pairs)
        if np.trace(pair.direction.covariance[:3, :3]) < 3.0 * MAX_ROTATION_SIGMA_RAD**2
    ]


def lidar_paths(drives: Sequence[Drive]) -> list[SensorPath]:
    """The LiDAR's path in each drive, constant where each motion by itself is surely zero.

    Not several motions together: the noise's scale is fitted to all pairs, and noise that is removed would
    make the others too sure.
    """
    return [SensorPath(zero_velocity_update(drive.lidar_motions, together=1)) for drive in drives]


def pair_motions(
    steps: Sequence[CameraStep], paths: Sequence[SensorPath], time_offset_s: float
) -> list[MotionPair]:
    """Each camera motion with the LiDAR's over its stamps + offset, where the path reaches."""
    shift = round(time_offset_s * 1e9)
    found = ((step, paths[step.drive].step(step.from_ns + shift, step.to_ns + shift)) for step in steps)
    return [MotionPair(step, lidar) for step, lidar in found if lidar is not None]


@dataclass(frozen=True)
class HandEyeTerm:
    """One factor of the graph and what it was made of.

    Attributes:
        pair: the motions.
        factor: on E and D.
        covariance: (6, 6) of [rotation rad, direction], or (3, 3) where only the rotation is used.
        noise_pull: half of the expected change of the squared whitened residual as the offset grows and
            the LiDAR's noise is averaged more or less [1/s].
        rows_H_step: (6, 6) or (3, 6) the residual by a right perturbation of the LiDAR's motion, in units of
            the scaled noise.
    """

    pair: MotionPair
    factor: gtsam.CustomFactor
    covariance: FloatArray
    noise_pull: float
    rows_H_step: FloatArray

    @property
    def has_direction(self) -> bool:
        return len(self.covariance) == 6

    def residual(self, values: gtsam.Values) -> FloatArray:
        """(6,) or (3,) predicted - measured, unwhitened."""
        return np.asarray(self.factor.unwhitenedError(values))


def hand_eye_terms(pairs: Sequence[MotionPair], state: State) -> tuple[list[HandEyeTerm], NoiseScales]:
    """A factor for every pair, and the scales at which half of the residuals are within their sigmas.

    The factors' noise is scaled so; robust weights are frozen at the state.
    """
    values = state_values(state)
    terms = [_term(pair, state) for pair in pairs]
    turns, swerves = np.array([_sizes(term, values) for term in terms]).T
    directed = swerves[np.isfinite(swerves)]
    scales = NoiseScales(
        max(_scale(turns, 3), _LEAST_SCALE), max(_scale(directed, 2), _LEAST_SCALE) if len(directed) else 1.0
    )
    turn_weights = _KERNEL.weight(turns / (scales.rotation * np.sqrt(3.0)))
    swerve_weights = _KERNEL.weight(np.nan_to_num(swerves) / (scales.direction * np.sqrt(2.0)))
    weights = np.maximum(np.stack([turn_weights, swerve_weights], axis=1), 1e-6)
    return [_scaled(term, scales, w) for term, w in zip(terms, weights, strict=True)], scales


def _scale(sizes: FloatArray, freedom: int) -> float:
    """Ratio of the median whitened size to what it should be."""
    return float(np.sqrt(np.median(sizes**2) / _MEDIAN_CHI2[freedom]))


def hand_eye_graph(terms: Sequence[HandEyeTerm], centre: State) -> gtsam.NonlinearFactorGraph:
    """The terms and the priors around ``centre``."""
    graph = gtsam.NonlinearFactorGraph()
    for term in terms:
        graph.add(term.factor)
    noise, sigma_s = gtsam.noiseModel.Diagonal.Sigmas(PRIOR_SIGMAS[:6]), float(PRIOR_SIGMAS[6])
    graph.add(gtsam.PriorFactorPose3(EXTRINSIC, centre.cTl, noise))
    # An offset between two stamps of the LiDAR averages its noise, which looks like a better fit. A linear
    # cost takes back what that is expected to gain; together with the prior it is a prior elsewhere.
    pull = sum(term.noise_pull for term in terms)
    mean_s = centre.time_offsets_s[0] + pull * sigma_s**2
    graph.add(time_offset_prior(time_offset_key(), mean_s, sigma_s))
    return graph


def state_values(state: State) -> gtsam.Values:
    """E and D of a state."""
    values = gtsam.Values()
    values.insert(EXTRINSIC, state.cTl)
    values.insert(time_offset_key(), np.array(state.time_offsets_s[:1]))
    return values


def _term(pair: MotionPair, state: State) -> HandEyeTerm:
    """The factor of a pair, with the noise that the odometry states."""
    step, motion = pair.lidar, pair.camera.motion
    predicted = state.cTl * step.aTb * state.cTl.inverse()
    length = float(np.linalg.norm(predicted.translation()))
    directed = motion.ok and length >= MIN_LENGTH_M
    # 1. The noise of both motions as that of a pose of the predicted length.
    basis = np.asarray(gtsam.Unit3(motion.direction).basis())
    across = np.zeros((6, 5))
    across[:3, :3] = np.eye(3)
    across[3:, 3:] = length * pair.camera.rotation.matrix().T @ basis
    Ad = np.asarray(state.cTl.AdjointMap())
    covariance = Ad @ step.covariance @ Ad.T + across @ motion.covariance @ across.T
    # 2. The factor.
    turn, D = pair.camera.rotation, time_offset_key()
    lidar_motion = LidarMotion(step.aTb, step.twist_a, step.twist_b, state.time_offsets_s[0])
    if directed:
        measured = gtsam.Pose3(turn, length * motion.direction)
        camera_motion = CameraMotion(measured, covariance, scale_known=False)
        factor = hand_eye_factor(EXTRINSIC, D, camera_motion, lidar_motion)
        noise = factor.noiseModel()
        assert isinstance(noise, gtsam.noiseModel.Gaussian)
        own = np.asarray(noise.covariance())
    else:
        own = covariance[:3, :3]
        factor = rotation_hand_eye(EXTRINSIC, D, turn, lidar_motion, own)
    # 3. How the LiDAR's noise reaches the residual.
    transfer = np.eye(6)
    d = motion.direction
    transfer[3:, 3:] = (np.eye(3) - np.outer(d, d)) / max(length, MIN_LENGTH_M) @ turn.matrix()
    carried = (transfer @ Ad)[: len(own)]
    return HandEyeTerm(pair, factor, own, _noise_pull(own, carried, step), carried)


def _scaled(term: HandEyeTerm, scales: NoiseScales, weights: FloatArray) -> HandEyeTerm:
    """A term with its sigmas multiplied by the scales; weights (2,) of rotation and direction."""
    spread = np.repeat([scales.rotation, scales.direction], 3)[: len(term.covariance)]
    widened = spread / np.repeat(np.sqrt(weights), 3)[: len(spread)]
    own, carried = np.outer(widened, widened) * term.covariance, spread[:, None] * term.rows_H_step
    recipe = recipe_of(term.factor)
    assert recipe is not None
    factor = replace(recipe, noise=gtsam.noiseModel.Gaussian.Covariance(own)).build()
    return HandEyeTerm(term.pair, factor, own, _noise_pull(own, carried, term.pair.lidar), carried)


def _noise_pull(covariance: FloatArray, rows_H_step: FloatArray, step: PathStep) -> float:
    """``noise_pull`` of a :class:`HandEyeTerm`."""
    rate = rows_H_step @ step.covariance_rate @ rows_H_step.T
    return 0.5 * float(np.trace(np.linalg.solve(covariance, rate)))


def _sizes(term: HandEyeTerm, values: gtsam.Values) -> tuple[float, float]:
    """Whitened length of the rotation's and of the direction's residual; NaN where there is none."""
    r, C = term.residual(values), term.covariance
    turn = float(np.sqrt(r[:3] @ np.linalg.solve(C[:3, :3], r[:3])))
    if not term.has_direction:
        return turn, np.nan
    return turn, float(np.sqrt(r[3:] @ np.linalg.solve(C[3:, 3:], r[3:])))

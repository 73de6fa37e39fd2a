"""Pairs of camera and LiDAR motion, and their factor graph on E and D; no label, no depth.

The camera's motion enters by rotation and direction alone: its length would depend on LiDAR depth placed by
the extrinsic that is to be estimated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import gtsam
import numpy as np

from sst_graph.drive.path import PathSteps, SensorPath
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
from sst_graph.hand_eye.residuals import MotionResiduals, residuals_factor
from sst_graph.odometry.relative import DirectionMotion
from sst_graph.odometry.standstill import zero_velocity_update
from sst_graph.types import FloatArray

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

    @cached_property
    def matrix(self) -> FloatArray:
        """(3, 3) that rotation."""
        return np.asarray(self.rotation.matrix())

    @cached_property
    def turned(self) -> FloatArray:
        """(3,) its rotation vector [rad]."""
        return np.asarray(gtsam.Rot3.Logmap(self.rotation))

    @cached_property
    def across(self) -> FloatArray:
        """(3, 2) how the two unknowns of the direction move the translation, by its length, in the second
        camera."""
        return np.asarray(self.matrix.T @ gtsam.Unit3(self.motion.direction).basis())


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


@dataclass(frozen=True)
class MotionPairs:
    """Pairs of a camera's motion and the LiDAR's over the same time, as the time offset has it."""

    cameras: tuple[CameraStep, ...]
    lidars: PathSteps

    def __len__(self) -> int:
        return len(self.cameras)


def pair_motions(
    steps: Sequence[CameraStep], paths: Sequence[SensorPath], time_offset_s: float
) -> MotionPairs:
    """Each camera motion with the LiDAR's over its stamps + offset, where the path reaches."""
    shift = round(time_offset_s * 1e9)
    stamps = np.array([(step.from_ns, step.to_ns) for step in steps], np.int64).reshape(-1, 2) + shift
    drive_of = np.array([step.drive for step in steps], np.intp)
    parts = []
    for number, path in enumerate(paths):
        own = np.flatnonzero(drive_of == number)
        part = path.steps(*stamps[own].T)
        parts.append(replace(part, found=own[part.found]))
    lidars = PathSteps.joined(parts)
    return MotionPairs(tuple(steps[k] for k in lidars.found), lidars)


@dataclass(frozen=True, eq=False)
class HandEyeTerms:
    """All pairs of the graph, one factor together, and what it was made of.

    Rows of a direction that is not used are 0, and their block of the covariance is the identity.

    Attributes:
        pairs: the motions.
        residuals: of the motions.
        covariances: (n, 6, 6) of [rotation rad, direction].
        noise_slopes: (n,) half of the expected change of the squared whitened residual as the offset grows
            and the LiDAR's noise is averaged more or less [1/s].
        rows_H_step: (n, 6, 6) the residual by a right perturbation of the LiDAR's motion, in units of the
            scaled noise.
        smoothed_away: (n, 6) the residual by what the LiDAR's interpolated motions lack of fast motion.
    """

    pairs: MotionPairs
    residuals: MotionResiduals
    covariances: FloatArray
    noise_slopes: FloatArray
    rows_H_step: FloatArray
    smoothed_away: FloatArray

    def __len__(self) -> int:
        return len(self.pairs)

    @cached_property
    def roots(self) -> FloatArray:
        """(n, 6, 6) square roots of the information, upper triangles."""
        information = np.linalg.inv(self.covariances)
        return np.swapaxes(np.linalg.cholesky(0.5 * (information + np.swapaxes(information, 1, 2))), 1, 2)

    def factor(self) -> gtsam.CustomFactor:
        """One factor of all pairs, on E and D."""
        return residuals_factor(EXTRINSIC, time_offset_key(), self.residuals, self.roots)

    def linearized(self, state: State) -> tuple[FloatArray, FloatArray]:
        """Whitened Jacobians (n, 6, 7) by [E, D], and residuals (n, 6)."""
        error, H = self.residuals.evaluate(state.cTl, state.time_offsets_s[0], True)
        return self.roots @ H, (self.roots @ error[..., None])[..., 0]

    def each(self) -> list[gtsam.NonlinearFactor]:
        """A factor for each pair by itself."""
        return [self._factor_of(k) for k in range(len(self))]

    def _factor_of(self, k: int) -> gtsam.NonlinearFactor:
        camera, lidars, own = self.pairs.cameras[k], self.pairs.lidars, self.covariances[k]
        D = time_offset_key()
        aTb, at_s = gtsam.Pose3(lidars.aTbs[k]), self.residuals.time_offset_0_s
        motion = LidarMotion(aTb, lidars.twists_a[k], lidars.twists_b[k], at_s)
        if not self.residuals.directed[k]:
            return rotation_hand_eye(EXTRINSIC, D, camera.rotation, motion, own[:3, :3])
        measured = CameraMotion(
            gtsam.Pose3(camera.rotation, camera.motion.direction), np.eye(6), scale_known=False
        )
        recipe = recipe_of(hand_eye_factor(EXTRINSIC, D, measured, motion))
        assert recipe is not None
        return replace(recipe, noise=gtsam.noiseModel.Gaussian.Covariance(own)).build()


def hand_eye_terms(pairs: MotionPairs, state: State) -> tuple[HandEyeTerms, NoiseScales]:
    """The terms of all pairs, and the scales at which half of the residuals are within their sigmas.

    The noise is scaled so; robust weights are frozen at the state.
    """
    terms = _terms(pairs, state)
    directed = terms.residuals.directed
    error, C = terms.residuals.evaluate(state.cTl, state.time_offsets_s[0], False)[0], terms.covariances
    rotation_sizes = _whitened_lengths(error[:, :3], C[:, :3, :3])
    direction_sizes = _whitened_lengths(error[:, 3:], C[:, 3:, 3:])
    scales = NoiseScales(
        max(_scale(rotation_sizes, 3), _LEAST_SCALE),
        max(_scale(direction_sizes[directed], 2), _LEAST_SCALE) if directed.any() else 1.0,
    )
    rotation_weights = _KERNEL.weight(rotation_sizes / (scales.rotation * np.sqrt(3.0)))
    direction_weights = _KERNEL.weight(direction_sizes / (scales.direction * np.sqrt(2.0)))
    weights = np.maximum(np.stack([rotation_weights, direction_weights], axis=1), 1e-6)
    return _scaled(terms, scales, weights), scales


def _whitened_lengths(errors: FloatArray, covariances: FloatArray) -> FloatArray:
    """(n,) lengths of errors (n, k) in units of covariances (n, k, k)."""
    whitened = np.linalg.solve(covariances, errors[..., None])[..., 0]
    return np.asarray(np.sqrt(np.einsum("ij,ij->i", errors, whitened)))


def _scale(sizes: FloatArray, freedom: int) -> float:
    """Ratio of the median whitened size to what it should be."""
    return float(np.sqrt(np.median(sizes**2) / _MEDIAN_CHI2[freedom]))


def hand_eye_graph(terms: HandEyeTerms, centre: State) -> gtsam.NonlinearFactorGraph:
    """The terms and the priors around ``centre``."""
    graph = gtsam.NonlinearFactorGraph()
    graph.add(terms.factor())
    noise, sigma_s = gtsam.noiseModel.Diagonal.Sigmas(PRIOR_SIGMAS[:6]), float(PRIOR_SIGMAS[6])
    graph.add(gtsam.PriorFactorPose3(EXTRINSIC, centre.cTl, noise))
    # An offset between two stamps of the LiDAR averages its noise, which looks like a better fit. A linear
    # cost takes back what that is expected to gain; together with the prior it is a prior elsewhere.
    slope = float(terms.noise_slopes.sum())
    mean_s = centre.time_offsets_s[0] + slope * sigma_s**2
    graph.add(time_offset_prior(time_offset_key(), mean_s, sigma_s))
    return graph


def state_values(state: State) -> gtsam.Values:
    """E and D of a state."""
    values = gtsam.Values()
    values.insert(EXTRINSIC, state.cTl)
    values.insert(time_offset_key(), np.array(state.time_offsets_s[:1]))
    return values


def _terms(pairs: MotionPairs, state: State) -> HandEyeTerms:
    """The terms with the noise that the odometry states."""
    cameras, lidars, n = pairs.cameras, pairs.lidars, len(pairs)
    ok = np.array([camera.motion.ok for camera in cameras])
    turns = np.array([camera.matrix for camera in cameras])
    directions = np.array([camera.motion.direction for camera in cameras])
    residuals = MotionResiduals(
        lidars.aTbs, lidars.twists_a, lidars.twists_b, state.time_offsets_s[0], turns, directions, ok
    )
    predicted = residuals.predicted(state.cTl, state.time_offsets_s[0])
    lengths = np.linalg.norm(predicted[:, :3, 3], axis=1)
    residuals = replace(residuals, directed=ok & (lengths >= MIN_LENGTH_M))
    # 1. The noise of both motions as that of a pose of the predicted length.
    across = np.zeros((n, 6, 5))
    across[:, :3, :3] = np.eye(3)
    across[:, 3:, 3:] = lengths[:, None, None] * np.array([camera.across for camera in cameras])
    motion_covariances = np.array([camera.motion.covariance for camera in cameras])
    Ad = np.asarray(state.cTl.AdjointMap())
    covariances = Ad @ lidars.covariances @ Ad.T
    covariances += across @ motion_covariances @ np.swapaxes(across, 1, 2)
    # 2. The same of rotation and unit direction. Along the direction, where the difference of two unit
    # vectors is of second order, the mean of the two across keeps it regular.
    along = directions[:, :, None] * directions[:, None, :]
    transfer = np.zeros((n, 6, 6))
    transfer[:, :3, :3] = np.eye(3)
    transfer[:, 3:, 3:] = (np.eye(3) - along) / np.maximum(lengths, MIN_LENGTH_M)[:, None, None] @ turns
    own = transfer @ covariances @ np.swapaxes(transfer, 1, 2)
    own[:, 3:, 3:] += 0.5 * np.trace(own[:, 3:, 3:], axis1=1, axis2=2)[:, None, None] * along
    own = 0.5 * (own + np.swapaxes(own, 1, 2))
    # 3. How the LiDAR's noise reaches the residual.
    carried = transfer @ Ad
    own[~residuals.directed, 3:] = own[~residuals.directed, :, 3:] = carried[~residuals.directed, 3:] = 0.0
    own[~residuals.directed, 3:, 3:] = np.eye(3)
    lacking = (carried @ lidars.smoothed_away[..., None])[..., 0]
    return HandEyeTerms(pairs, residuals, own, _noise_slopes(own, carried, lidars), carried, lacking)


def _scaled(terms: HandEyeTerms, scales: NoiseScales, weights: FloatArray) -> HandEyeTerms:
    """The terms with sigmas multiplied by the scales; weights (n, 2) of rotation and direction."""
    spread = np.tile(np.repeat([scales.rotation, scales.direction], 3), (len(terms), 1))
    spread[~terms.residuals.directed, 3:] = 1.0
    widened = spread / np.repeat(np.sqrt(weights), 3, axis=1)
    widened[~terms.residuals.directed, 3:] = 1.0
    own = widened[:, :, None] * widened[:, None, :] * terms.covariances
    carried = spread[:, :, None] * terms.rows_H_step
    slopes = _noise_slopes(own, terms.rows_H_step, terms.pairs.lidars)
    return replace(terms, covariances=own, noise_slopes=slopes, rows_H_step=carried)


def _noise_slopes(covariances: FloatArray, rows_H_step: FloatArray, lidars: PathSteps) -> FloatArray:
    """``noise_slopes`` of :class:`HandEyeTerms`.

    By the noise that the path itself shows, whatever the covariances allow for: more would draw the offset to
    the LiDAR's stamps.
    """
    back = np.swapaxes(rows_H_step, 1, 2) @ np.linalg.solve(covariances, rows_H_step)
    return np.asarray(0.5 * np.einsum("nii,ni->n", back, lidars.noise_rates))

"""Metric camera motion between two images: tracks, some of which have LiDAR depth."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from sst_graph.factors.camera import PinholeCamera
from sst_graph.factors.motion import skew
from sst_graph.odometry.depth import RANGE_SIGMA, InverseDepths, inverse_depths
from sst_graph.odometry.features import Tracks
from sst_graph.odometry.relative import MIN_NOISE_PX, DirectionMotion, huber_weights, rays
from sst_graph.spread import robust_sigma
from sst_graph.types import BoolArray, FloatArray, RelativeMotion

MIN_SCALED_DEPTH = 1e-2
"""Points are kept at least this part of their depth in front of camera b."""
PAIR_KNEE, PAIR_GATE = 2.0, 4.5
"""Whitened size of a residual pair from which it is down-weighted, and from which it is left out."""


_MIN_DEPTHS = 10
"""Fewest features with depth from which a metric motion is estimated."""
_NEAREST_M = 1.0
"""No feature lies nearer than this [m]."""
_PRIOR_INVERSE_M, _PRIOR_SIGMA_INVERSE_M = 0.05, 0.1
"""Inverse depth expected where none is measured, and its sigma [1/m]: so wide that it does not inform the
length, yet at standstill it makes such a track a full constraint on the rotation."""
_ITERATIONS = 15
"""Most Gauss-Newton steps; it stops where a step is below 1e-5."""
_FAILED_RAD, _FAILED_M = 0.1, 3.0
"""Sigmas of a motion that could not be estimated [rad, m]: the distance in 0.1 s at 30 m/s."""


@dataclass(frozen=True)
class TrackErrors:
    """Errors that all tracks of a motion have in common, which no residual shows.

    Attributes:
        scale_sigma: relative sigma of the length that all depths share (calibration, interpolation).
        floor_rad, floor_m: sigmas added to every motion [rad, m].
    """

    scale_sigma: float = 0.006
    floor_rad: float = 1e-4
    floor_m: float = 2e-3


_TRACK_ERRORS = TrackErrors()


def metric_motion(
    tracks: Tracks,
    direction_motion: DirectionMotion,
    depth_points_c: FloatArray,
    camera: PinholeCamera,
) -> RelativeMotion:
    """Pose of camera b in camera a with covariance, from reprojection of every track.

    uv_b = project(aRb^T (f_a - rho t)), rho the inverse depth of the feature: measured where LiDAR
    points surround it, else free (then only the distance from the epipolar line counts).

    Args:
        tracks: from image a to image b.
        direction_motion: start of the estimation, see :func:`sst_graph.odometry.relative.relative_pose`.
        depth_points_c: (m, 3) LiDAR points in camera a at the instant of image a [m].
        camera: intrinsics of both images.
    """
    depths = inverse_depths(tracks.uv_a, depth_points_c, camera)
    return motion_from_depths(tracks, direction_motion, depths, camera)


def motion_from_depths(
    tracks: Tracks,
    direction_motion: DirectionMotion,
    depths: InverseDepths,
    camera: PinholeCamera,
    shared: TrackErrors = _TRACK_ERRORS,
) -> RelativeMotion:
    """:func:`metric_motion` with the inverse depth of each track already known."""
    if np.count_nonzero(depths.known) < _MIN_DEPTHS:
        return _failed(tracks, direction_motion)
    known = depths.known
    rho = np.where(known, depths.value, _PRIOR_INVERSE_M)
    sigma = np.where(known, depths.sigma, _PRIOR_SIGMA_INVERSE_M)
    problem = _Problem(rays(tracks.uv_a, camera), tracks.uv_b, rho, sigma, known, camera)
    # 1. The best of a few starts.
    noise = max(MIN_NOISE_PX, direction_motion.noise_px)
    pose = min(_starts(problem, direction_motion), key=lambda start: problem.cost(start, noise))
    # 2. Robust Gauss-Newton, with the noise estimated at each step.
    for _ in range(_ITERATIONS):
        terms, noise = problem.linearize(pose, noise)
        step = np.linalg.solve(terms.information + 1e-9 * np.eye(6), -terms.gradient)
        pose = pose.retract(step)
        if np.abs(step).max() < 1e-5:
            break
    terms, _ = problem.linearize(pose, noise)
    if terms.depth_inliers < _MIN_DEPTHS:
        return _failed(tracks, direction_motion)
    # 3. Covariance, with the errors that all tracks share.
    covariance = terms.covariance()
    t = pose.rotation().matrix().T @ pose.translation()
    covariance[3:, 3:] += shared.scale_sigma**2 * np.outer(t, t)
    covariance += np.diag(np.repeat([shared.floor_rad, shared.floor_m], 3) ** 2)
    return RelativeMotion(tracks.from_ns, tracks.to_ns, pose, covariance)


@dataclass(frozen=True)
class _Terms:
    """A linearized problem in whitened units.

    Attributes:
        information, gradient: (6, 6), (6,) with robust weights.
        plain: (6, 6) information of the inliers without weights.
        efficiency: variance that the weights cost (Huber 1981, eq. 7.6.7).
        depth_inliers: number of tracks with depth that agree.
    """

    information: FloatArray
    gradient: FloatArray
    plain: FloatArray
    efficiency: float
    depth_inliers: int

    def covariance(self) -> FloatArray:
        """(6, 6) of the pose, right perturbation."""
        return np.asarray(self.efficiency * np.linalg.inv(self.plain + 1e-9 * np.eye(6)))


@dataclass(frozen=True)
class _Residuals:
    """Pixels, predicted minus measured, turned along and across the epipolar lines.

    Attributes:
        value: (n, 2) [along, across], the depth at its measured or expected value [px].
        J: (n, 2, 6) derivative by the pose [px/rad, px/m].
        slope: (n,) pixels along the line per inverse depth [px m].
    """

    value: FloatArray
    J: FloatArray
    slope: FloatArray


@dataclass(frozen=True)
class _Problem:
    """Tracks as constraints on aTb.

    Attributes:
        fa: (n, 3) rays in camera a.
        uv_b: (n, 2) [px].
        rho, sigma: (n,) inverse depth and its sigma, the prior's where it is not measured [1/m].
        measured: (n,) whether it is.
        camera: intrinsics.
    """

    fa: FloatArray
    uv_b: FloatArray
    rho: FloatArray
    sigma: FloatArray
    measured: BoolArray
    camera: PinholeCamera

    def cost(self, pose: gtsam.Pose3, noise_px: float) -> float:
        """Truncated whitened squares of the tracks with depth, by which starts are compared."""
        residuals = self._residuals(pose, noise_px)
        along_sigma = np.hypot(noise_px, residuals.slope * self.sigma)
        whitened = residuals.value / np.column_stack([along_sigma, np.full(len(self.fa), noise_px)])
        return float(np.sum(np.minimum(np.sum(whitened[self.measured] ** 2, axis=1), PAIR_GATE**2)))

    def linearize(self, pose: gtsam.Pose3, noise_px: float) -> tuple[_Terms, float]:
        """Normal equations at a pose, and the noise of the tracks found there [px]."""
        residuals = self._residuals(pose, noise_px)
        noise = max(MIN_NOISE_PX, robust_sigma(residuals.value[:, 1]))
        along_sigma = np.hypot(noise, residuals.slope * self.sigma)
        if self.measured.any():
            # Depths that fit worse than they claim count for less.
            misfit = robust_sigma((residuals.value[:, 0] / along_sigma)[self.measured])
            along_sigma = np.where(self.measured, along_sigma * max(1.0, misfit), along_sigma)
        whitener = np.stack([1.0 / along_sigma, np.full(len(self.fa), 1.0 / noise)], axis=1)
        r = residuals.value * whitener
        J = residuals.J * whitener[:, :, None]
        # A track is good or bad as a whole: one weight for both of its rows.
        size = np.linalg.norm(r, axis=1)
        weight = huber_weights(size, PAIR_KNEE, PAIR_GATE)
        kept = weight > 0.0
        weighted = (weight[:, None, None] * J).reshape(-1, 6)
        flat = J[kept].reshape(-1, 6)
        # The row along the line of a free depth counts by what is known of it.
        share = np.stack([np.where(self.measured, 1.0, (noise / along_sigma) ** 2), np.ones(len(r))], axis=1)
        score = float(np.sum(share * (weight[:, None] * r) ** 2) / max(np.sum(share[kept]), 1e-9))
        slope = np.where(size < PAIR_KNEE, 1.0, 0.5 * weight)[kept]
        terms = _Terms(
            weighted.T @ J.reshape(-1, 6),
            weighted.T @ r.reshape(-1),
            flat.T @ flat,
            score / max(float(np.mean(slope)) if kept.any() else 1.0, 0.1) ** 2,
            int(np.count_nonzero(kept & self.measured)),
        )
        return terms, noise

    def _residuals(self, pose: gtsam.Pose3, noise_px: float) -> _Residuals:
        """Residuals at a pose; free depths are set to fit the track and their prior."""
        focal = np.array([self.camera.fx, self.camera.fy])
        bRa = pose.rotation().matrix().T
        far, shift = self.fa @ bRa.T, bRa @ pose.translation()
        q = far - self.rho[:, None] * shift
        along = self._slopes(q, shift)
        slope = np.linalg.norm(along, axis=1)
        line = np.where(slope[:, None] > 1e-9, along / np.maximum(slope, 1e-9)[:, None], [1.0, 0.0])
        # 1. Depth of the free tracks: where the line passes the measured pixel, and the prior.
        centred = self.uv_b - [self.camera.cx, self.camera.cy]
        row = np.column_stack([line * focal, -np.einsum("ij,ij->i", line, centred)])
        top, bottom = np.einsum("ij,ij->i", row, far), row @ shift
        fit = np.clip(top / np.where(np.abs(bottom) > 1e-9, bottom, np.inf), 0.0, 1.0 / _NEAREST_M)
        gain = slope**2 / noise_px**2
        blend = (gain * fit + self.rho / self.sigma**2) / (gain + 1.0 / self.sigma**2)
        rho = np.where(self.measured, self.rho, blend)
        # 2. Residual and slope there, the depth moved back to what is known of it.
        q = far - rho[:, None] * shift
        q[:, 2] = np.maximum(q[:, 2], MIN_SCALED_DEPTH)
        slope = np.einsum("ij,ij->i", self._slopes(q, shift), line)
        error = q[:, :2] / q[:, 2:] * focal - centred
        turn = np.stack([line, np.column_stack([-line[:, 1], line[:, 0]])], axis=1)
        value = np.einsum("nij,nj->ni", turn, error)
        value[:, 0] += slope * (self.rho - rho)
        # 3. The fitted depth depends on the noise along the line, so it may change only the row across it.
        q_H_pose = np.concatenate([skew(q), np.broadcast_to(-np.eye(3), (len(q), 3, 3))], axis=2)
        J = turn @ self.camera.uv_H_cP(q) @ q_H_pose
        J[:, 0, 3:] *= self.rho[:, None]
        J[:, 1, 3:] *= rho[:, None]
        return _Residuals(value, J, slope)

    def _slopes(self, q: FloatArray, shift: FloatArray) -> FloatArray:
        """(n, 2) derivative of the pixel by the inverse depth [px m]."""
        z = np.maximum(q[:, 2], MIN_SCALED_DEPTH)
        x, y = q[:, 0] / z, q[:, 1] / z
        return np.column_stack(
            [
                self.camera.fx * (x * shift[2] - shift[0]) / z,
                self.camera.fy * (y * shift[2] - shift[1]) / z,
            ]
        )


def _starts(problem: _Problem, motion: DirectionMotion) -> list[gtsam.Pose3]:
    """Poses from which to begin: each rotation with the translation that most depths agree on."""
    camera, known = problem.camera, problem.measured
    fa, fb, rho = problem.fa[known], rays(problem.uv_b[known], camera), problem.rho[known]
    noise = max(MIN_NOISE_PX, motion.noise_px) / min(camera.fx, camera.fy)
    rotations = (motion.rotation, motion.turn) if motion.ok else (motion.turn,)
    return [
        gtsam.Pose3(aRb, consensus_translation(aRb, fa, fb, rho, noise, RANGE_SIGMA)) for aRb in rotations
    ]


def _failed(tracks: Tracks, motion: DirectionMotion) -> RelativeMotion:
    """The rotation, if it is known, and a translation of zero with a wide sigma."""
    sigmas = np.repeat([_FAILED_RAD, _FAILED_M], 3)
    pose = gtsam.Pose3(motion.rotation, np.zeros(3))
    return RelativeMotion(tracks.from_ns, tracks.to_ns, pose, np.diag(sigmas**2), ok=False)


HYPOTHESES = 128
"""Samples of two tracks; with half of the tracks wrong, all are bad in (1 - 1/4)^128 = 1e-16 of cases."""
TRUNCATION_SIGMAS = 4.0
"""Residuals count up to this many sigmas."""


def consensus_translation(
    aRb: gtsam.Rot3, fa: FloatArray, fb: FloatArray, rho: FloatArray, noise: float, depth_sigma: float
) -> FloatArray:
    """(3,) translation of camera b in camera a that the largest part of the tracks agrees on [m].

    The point fa / rho seen along fb gives two equations that are linear in the translation,
    (aRb^T (fa - rho t))_xy = (aRb^T (fa - rho t))_z (fb)_xy. Two tracks make a hypothesis (least
    squares of four equations); the one with the least truncated error wins and is fitted to its
    supporters. Samples are drawn with a fixed seed.

    Args:
        aRb: rotation of camera b in camera a.
        fa, fb: (n, 3) rays [x, y, 1] in camera a and b, n >= 2.
        rho: (n,) inverse depth in camera a [1/m].
        noise: sigma of fb's x and y [1].
        depth_sigma: relative sigma of the inverse depths.
    """
    bRa = aRb.matrix().T
    far = fa @ bRa.T
    # A t = b, rows of x and y of each track, divided by the depth so that the error is an angle.
    rows = np.stack([bRa[0] - fb[:, :1] * bRa[2], bRa[1] - fb[:, 1:2] * bRa[2]], axis=1)
    A = rho[:, None, None] * rows / far[:, 2, None, None]
    b = (far[:, :2] - fb[:, :2] * far[:, 2:]) / far[:, 2:]
    truncation = (TRUNCATION_SIGMAS * noise) ** 2 + (TRUNCATION_SIGMAS * depth_sigma) ** 2 * np.sum(
        b**2, axis=1
    )
    # 1. Hypotheses of two tracks each.
    samples = np.random.default_rng(0).integers(0, len(fa), (HYPOTHESES, 2))
    As, bs = A[samples].reshape(HYPOTHESES, 4, 3), b[samples].reshape(HYPOTHESES, 4)
    normal = As.transpose(0, 2, 1) @ As
    ridge = 1e-9 * np.trace(normal, axis1=1, axis2=2) + 1e-15
    normal += ridge[:, None, None] * np.eye(3)
    hypotheses = np.linalg.solve(normal, np.einsum("hij,hi->hj", As, bs)[:, :, None])[:, :, 0]
    # 2. Truncated errors; standstill is a hypothesis, too.
    hypotheses = np.concatenate([hypotheses, np.zeros((1, 3))])
    errors = np.sum((np.einsum("nij,hj->hni", A, hypotheses) - b) ** 2, axis=2)
    best = int(np.argmin(np.sum(np.minimum(errors / truncation, 1.0), axis=1)))
    # 3. Least squares over the supporters.
    kept = errors[best] < truncation
    if np.count_nonzero(kept) < 3:
        return np.asarray(hypotheses[best])
    return np.asarray(np.linalg.lstsq(A[kept].reshape(-1, 3), b[kept].reshape(-1), rcond=None)[0])

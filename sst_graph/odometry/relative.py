"""Rotation and direction of the camera's motion from tracks alone: 5-point, then least squares."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import gtsam
import numpy as np
from numpy.typing import NDArray

from factors.camera import PinholeCamera
from sst_graph.odometry.features import Tracks

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True)
class RelativeConfig:
    """How the epipolar geometry of two images is found.

    Attributes:
        threshold_px: distance from the epipolar line up to which a track supports a hypothesis [px].
        confidence: wanted probability of having tried an uncontaminated sample.
        min_tracks: fewest tracks from which anything is estimated.
        min_noise_px: track noise is never taken smaller than this [px].
        min_parallax_ratio: the direction counts only where the parallax is this many times the noise.
        iterations: Gauss-Newton steps of the refinement.
    """

    threshold_px: float = 1.0
    confidence: float = 0.999
    min_tracks: int = 20
    min_noise_px: float = 0.05
    min_parallax_ratio: float = 2.0
    iterations: int = 8


@dataclass(frozen=True)
class DirectionMotion:
    """Motion of the camera up to its length.

    Attributes:
        rotation: aRb, rotation of camera b in camera a.
        direction: (3,) unit vector from camera a to camera b, in camera a.
        covariance: (5, 5) of the essential matrix as gtsam has it: [rotation aRb * Exp(xi) in rad,
            direction in the basis of ``gtsam.Unit3(direction)`` in rad].
        inliers: (n,) tracks that agree.
        noise_px: sigma of a track's coordinate [px].
        parallax_px: root mean square motion of the inliers that rotation does not explain [px].
        ok: whether the direction means anything; where False its sigma is pi, and only the
            rotation (ok or not, see its covariance) can be used.
    """

    rotation: gtsam.Rot3
    direction: FloatArray
    covariance: FloatArray
    inliers: BoolArray
    noise_px: float
    parallax_px: float
    ok: bool


def relative_pose(
    tracks: Tracks, camera: PinholeCamera, config: RelativeConfig | None = None
) -> DirectionMotion:
    """Rotation and unit direction between two images, with covariance.

    Five-point essential matrix (Nister, PAMI 2004) in USAC-MAGSAC (Barath et al., CVPR 2020), then
    least squares on the distance from the epipolar line in image b. Where the parallax drowns in
    the noise only a rotation is estimated: the five-point direction would be noise.
    """
    config = config or RelativeConfig()
    if len(tracks) < config.min_tracks:
        return _unknown(len(tracks))
    fa, fb = rays(tracks.uv_a, camera), rays(tracks.uv_b, camera)
    # 1. Rotation alone, and what it leaves unexplained.
    rotation, left = _rotation_only(fa, fb, camera)
    noise = max(config.min_noise_px, 1.4826 * float(np.median(np.abs(left))))
    direction, inliers = np.array([0.0, 0.0, 1.0]), np.linalg.norm(left, axis=1) < 3.0 * noise
    # 2. Five points, and the refinement of the motion that puts the tracks in front of both cameras.
    hypothesis = _five_point(tracks, fa, fb, camera, config)
    if hypothesis is not None:
        matrix, aTb_direction, supporters = hypothesis
        refined = _refine(matrix, aTb_direction, fa, fb, supporters, camera, config)
        size = _trimmed_size(left[refined.inliers])
        if size > config.min_parallax_ratio * refined.noise_px * np.sqrt(2.0):
            # Noise in the parallax itself looks like knowledge of the direction: take it out.
            genuine = 1.0 - 2.0 * refined.noise_px**2 / size**2
            covariance = refined.covariance / genuine
            return DirectionMotion(
                gtsam.Rot3(refined.rotation),
                refined.direction,
                covariance,
                refined.inliers,
                refined.noise_px,
                size,
                True,
            )
    # 3. No usable parallax: the rotation stands, the direction is anything.
    size = _trimmed_size(left[inliers])
    covariance = np.diag([np.inf] * 3 + [np.pi**2] * 2)
    covariance[:3, :3] = _rotation_covariance(rotation, fb[inliers], noise, camera)
    return DirectionMotion(gtsam.Rot3(rotation), direction, covariance, inliers, noise, size, False)


def rays(uvs: FloatArray, camera: PinholeCamera) -> FloatArray:
    """(n, 3) rays [x, y, 1] through pixels uvs (n, 2) in the camera frame."""
    return np.column_stack(
        [(uvs[:, 0] - camera.cx) / camera.fx, (uvs[:, 1] - camera.cy) / camera.fy, np.ones(len(uvs))]
    )


def huber_weights(size: FloatArray, knee: float = 1.345, gate: float = 4.0) -> FloatArray:
    """Weight of whitened residuals of given size; 0 beyond the gate, where nothing is noise."""
    size = np.abs(size)
    weights = np.minimum(1.0, knee / np.maximum(size, 1e-12))
    return np.asarray(np.where(size > gate, 0.0, weights))


def skew(vectors: FloatArray) -> FloatArray:
    """(n, 3, 3) cross-product matrices of vectors (n, 3)."""
    result = np.zeros((len(vectors), 3, 3))
    x, y, z = vectors.T
    result[:, 0, 1], result[:, 0, 2] = -z, y
    result[:, 1, 0], result[:, 1, 2] = z, -x
    result[:, 2, 0], result[:, 2, 1] = -y, x
    return result


@dataclass(frozen=True)
class _Refined:
    rotation: FloatArray
    direction: FloatArray
    covariance: FloatArray
    inliers: BoolArray
    noise_px: float


def _five_point(
    tracks: Tracks, fa: FloatArray, fb: FloatArray, camera: PinholeCamera, config: RelativeConfig
) -> tuple[FloatArray, FloatArray, BoolArray] | None:
    """aRb (3, 3), direction (3,) and supporters (n,) of the best essential matrix, or None."""
    essential, mask = cv2.findEssentialMat(
        np.ascontiguousarray(tracks.uv_a),
        np.ascontiguousarray(tracks.uv_b),
        camera.matrix,
        method=cv2.USAC_MAGSAC,
        prob=config.confidence,
        threshold=config.threshold_px,
    )
    if essential is None or np.shape(essential) != (3, 3) or not np.isfinite(essential).all():
        return None
    supporters = np.asarray(mask).reshape(-1).astype(bool)
    if np.count_nonzero(supporters) < config.min_tracks:
        return None
    first, second, b_t_a = (np.asarray(part, np.float64) for part in cv2.decomposeEssentialMat(essential))
    candidates: list[tuple[int, FloatArray, FloatArray]] = []
    for aRb in (first.T, second.T):
        for direction in (aRb @ b_t_a.reshape(3), -aRb @ b_t_a.reshape(3)):
            front = _in_front_of_both(aRb, direction, fa[supporters], fb[supporters])
            candidates.append((int(np.count_nonzero(front)), aRb, direction / np.linalg.norm(direction)))
    _, aRb, direction = max(candidates, key=lambda candidate: candidate[0])
    return aRb, direction, supporters


def _in_front_of_both(aRb: FloatArray, direction: FloatArray, fa: FloatArray, fb: FloatArray) -> BoolArray:
    """(n,) whether the rays fa and aRb fb + direction meet in front of both cameras."""
    gb = fb @ aRb.T
    aa, ab, bb = (np.einsum("ij,ij->i", x, y) for x, y in ((fa, fa), (fa, gb), (gb, gb)))
    at, bt = fa @ direction, gb @ direction
    determinant = aa * bb - ab * ab
    return np.asarray((at * bb - ab * bt > 0) & (ab * at - aa * bt > 0) & (determinant > 0))


def _refine(
    aRb: FloatArray,
    direction: FloatArray,
    fa: FloatArray,
    fb: FloatArray,
    inliers: BoolArray,
    camera: PinholeCamera,
    config: RelativeConfig,
) -> _Refined:
    """Robust Gauss-Newton on r = fa.[t]x aRb.fb / |epipolar line| (in image b, px)."""
    supporters, noise = inliers, config.min_noise_px
    for iteration in range(config.iterations):
        basis = np.asarray(gtsam.Unit3(direction).basis())
        residual, J = _line_distance(aRb, direction, basis, fa, fb, camera)
        noise = max(config.min_noise_px, 1.4826 * float(np.median(np.abs(residual[supporters]))))
        supporters = np.abs(residual) < 4.0 * noise
        weights = huber_weights(residual / noise)
        normal = J.T @ (weights[:, None] * J)
        if iteration == config.iterations - 1:
            break
        step = -np.linalg.solve(normal + 1e-9 * np.eye(5) * np.trace(normal), J.T @ (weights * residual))
        aRb = aRb @ np.asarray(gtsam.Rot3.Expmap(step[:3]).matrix())
        direction = np.asarray(gtsam.Unit3(direction).retract(step[3:]).point3())
        if np.abs(step).max() < 1e-7:
            break
    information = J[supporters].T @ J[supporters]
    variance = noise**2 * _huber_loss_of_efficiency(residual[supporters] / noise)
    covariance = variance * np.linalg.inv(information + 1e-9 * np.eye(5) * np.trace(information))
    return _Refined(aRb, direction, covariance, supporters, noise)


def _line_distance(
    aRb: FloatArray,
    direction: FloatArray,
    basis: FloatArray,
    fa: FloatArray,
    fb: FloatArray,
    camera: PinholeCamera,
) -> tuple[FloatArray, FloatArray]:
    """(n,) signed distance of pixel b from its epipolar line [px], and its (n, 5) Jacobian."""
    gb = fb @ aRb.T
    line_a = np.cross(fa, direction)
    line_b = line_a @ aRb
    error = np.einsum("ij,ij->i", line_a, gb)
    length = np.hypot(line_b[:, 0] / camera.fx, line_b[:, 1] / camera.fy)
    length = np.maximum(length, 1e-12)
    J = np.empty((len(fa), 5))
    J[:, :3] = np.cross(fb, line_b)
    J[:, 3:] = np.cross(gb, fa) @ basis
    # The length of the line's normal turns with the motion, too.
    line_H_motion = np.concatenate([skew(line_b), aRb.T @ skew(fa) @ basis], axis=2)
    normal = np.column_stack([line_b[:, 0] / camera.fx**2, line_b[:, 1] / camera.fy**2])
    J -= (error / length**2)[:, None] * np.einsum("ni,nij->nj", normal, line_H_motion[:, :2])
    return error / length, J / length[:, None]


def _huber_loss_of_efficiency(whitened: FloatArray, knee: float = 1.345) -> float:
    """E[psi^2] / E[psi']^2: what the robust weights cost in variance (Huber 1981, eq. 7.6.7)."""
    psi = np.clip(whitened, -knee, knee)
    inside = float(np.mean(np.abs(whitened) < knee))
    return float(np.mean(psi**2)) / max(inside, 0.1) ** 2


def _parallax(aRb: FloatArray, fa: FloatArray, fb: FloatArray, camera: PinholeCamera) -> FloatArray:
    """(n, 2) pixels by which b differs from a turned by the rotation alone."""
    turned = fa @ aRb
    return np.asarray((fb[:, :2] - turned[:, :2] / turned[:, 2:]) * [camera.fx, camera.fy])


def _trimmed_size(vectors: FloatArray) -> float:
    """Root mean square length of the shortest nine tenths of vectors (n, 2)."""
    square = np.sort(np.sum(vectors**2, axis=1))[: max(1, (9 * len(vectors)) // 10)]
    return float(np.sqrt(np.mean(square))) if len(vectors) else 0.0


def _rotation_only(fa: FloatArray, fb: FloatArray, camera: PinholeCamera) -> tuple[FloatArray, FloatArray]:
    """aRb (3, 3) that best explains all tracks robustly, and the (n, 2) pixels it leaves."""
    aRb = np.eye(3)
    for _ in range(6):
        left = _parallax(aRb, fa, fb, camera)
        scale = max(0.05, 1.4826 * float(np.median(np.abs(left))))
        weights = np.repeat(huber_weights(np.linalg.norm(left, axis=1) / scale), 2)
        J = _rotation_jacobian(aRb, fa, camera)
        step = np.linalg.lstsq(
            J * np.sqrt(weights)[:, None], -left.reshape(-1) * np.sqrt(weights), rcond=None
        )[0]
        aRb = aRb @ np.asarray(gtsam.Rot3.Expmap(step).matrix())
    return aRb, _parallax(aRb, fa, fb, camera)


def _rotation_jacobian(aRb: FloatArray, fa: FloatArray, camera: PinholeCamera) -> FloatArray:
    """(2n, 3) derivative of the parallax [px] by a right perturbation of aRb."""
    turned = fa @ aRb
    x, y = turned[:, 0] / turned[:, 2], turned[:, 1] / turned[:, 2]
    one = np.ones_like(x)
    # Exp(-theta) turned moves by turned x theta; the parallax is b minus its projection.
    J = np.stack(
        [
            np.stack([x * y * camera.fx, -(one + x * x) * camera.fx, y * camera.fx], axis=1),
            np.stack([(one + y * y) * camera.fy, -x * y * camera.fy, -x * camera.fy], axis=1),
        ],
        axis=1,
    )
    return np.asarray(-J.reshape(-1, 3))


def _rotation_covariance(
    aRb: FloatArray, fb: FloatArray, noise_px: float, camera: PinholeCamera
) -> FloatArray:
    """(3, 3) covariance of a rotation estimated from pixels of given noise [rad^2]."""
    if len(fb) < 3:
        return np.eye(3)
    J = _rotation_jacobian(np.eye(3), fb, camera)
    return np.asarray(noise_px**2 * np.linalg.inv(J.T @ J))


def _unknown(n: int) -> DirectionMotion:
    """Nothing known: too few tracks."""
    covariance = np.diag([1.0] * 3 + [np.pi**2] * 2)
    return DirectionMotion(
        gtsam.Rot3(), np.array([0.0, 0.0, 1.0]), covariance, np.zeros(n, np.bool_), 1.0, 0.0, False
    )

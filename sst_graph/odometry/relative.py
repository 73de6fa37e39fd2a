"""Rotation and direction of the camera's motion from tracks alone: 5-point, then least squares."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import gtsam
import numpy as np

from sst_graph.factors.camera import PinholeCamera
from sst_graph.factors.motion import cross_rows, skew
from sst_graph.odometry.features import Tracks
from sst_graph.spread import robust_sigma
from sst_graph.types import BoolArray, FloatArray

EPIPOLE_PX = 40.0
"""Tracks nearer to the epipole than this lose their weight [px]."""


_INLIER_PX = 1.0
"""Distance from the epipolar line up to which a track supports a five-point hypothesis [px]."""
_CONFIDENCE = 0.999
"""Wanted probability of having tried a sample without outliers."""
_MIN_TRACKS = 20
"""Fewest tracks from which anything is estimated: four times the five that a hypothesis needs."""
MIN_NOISE_PX = 0.05
"""Track noise is never taken smaller than this, so that tracks without any do not divide by zero [px]."""
_MIN_PARALLAX_RATIO = 4.0
"""The direction counts only where the parallax is this many times the noise; below, the five-point method's
direction is noise."""
_KNEE = 1.345
"""Whitened residual beyond which Huber's weights fall."""
_ITERATIONS = 8
"""Most Gauss-Newton steps of the refinement; it stops where a step is below 1e-5."""


@dataclass(frozen=True)
class DirectionMotion:
    """Motion of the camera up to its length.

    Attributes:
        rotation: aRb, rotation of camera b in camera a.
        turn: aRb that explains the tracks best without any translation.
        direction: (3,) unit vector from camera a to camera b, in camera a.
        covariance: (5, 5) of the essential matrix as gtsam has it: [rotation aRb * Exp(xi) in rad,
            direction in the basis of ``gtsam.Unit3(direction)`` in rad].
        noise_px: sigma of a track's coordinate [px].
        ok: whether the direction means anything; where False its sigma is pi, and only the
            rotation (ok or not, see its covariance) can be used.
    """

    rotation: gtsam.Rot3
    turn: gtsam.Rot3
    direction: FloatArray
    covariance: FloatArray
    noise_px: float
    ok: bool


def relative_pose(tracks: Tracks, camera: PinholeCamera) -> DirectionMotion:
    """Rotation and unit direction between two images, with covariance.

    Five-point essential matrix (Nister, PAMI 2004) in USAC-MAGSAC (Barath et al., CVPR 2020), then
    least squares on the distance from the epipolar line in image b. Where the parallax is lost in
    the noise only a rotation is estimated: the five-point direction would be noise.
    """
    if len(tracks) < _MIN_TRACKS:
        return _unknown()
    fa, fb = rays(tracks.uv_a, camera), rays(tracks.uv_b, camera)
    # 1. Rotation alone, and what it leaves unexplained.
    rotation, left = _rotation_only(fa, fb, camera)
    # 2. Least squares from the five points, and from the direction that best suits that rotation.
    starts = [(rotation, _direction_given_rotation(rotation, fa, fb))]
    hypothesis = _five_point(tracks, fa, fb, camera)
    if hypothesis is not None:
        starts.append(hypothesis)
    refined = [_refine(aRb, direction, fa, fb, camera) for aRb, direction in starts]
    best = min(refined, key=lambda one: one.noise_px)
    # 3. The direction means something only where there is parallax to see it by.
    size = _trimmed_size(left[best.inliers])
    if size > _MIN_PARALLAX_RATIO * np.sqrt(2.0) * best.noise_px:
        direction = best.direction * _side(best.rotation, best.direction, fa[best.inliers], fb[best.inliers])
        found, turn = gtsam.Rot3(best.rotation), gtsam.Rot3(rotation)
        return DirectionMotion(found, turn, direction, best.covariance, best.noise_px, True)
    return _turn(rotation, left, fb, camera)


def _turn(aRb: FloatArray, left: FloatArray, fb: FloatArray, camera: PinholeCamera) -> DirectionMotion:
    """The rotation alone: the parallax is too small to see a direction."""
    noise = max(MIN_NOISE_PX, robust_sigma(left))
    inliers = np.linalg.norm(left, axis=1) < 4.0 * noise
    covariance = np.diag([1.0] * 3 + [np.pi**2] * 2)
    if np.count_nonzero(inliers) >= _MIN_TRACKS:
        J = _rotation_jacobian(np.eye(3), fb[inliers], camera)
        covariance[:3, :3] = noise**2 * np.linalg.inv(J.T @ J)
    forward = np.array([0.0, 0.0, 1.0])
    return DirectionMotion(gtsam.Rot3(aRb), gtsam.Rot3(aRb), forward, covariance, noise, False)


def rays(uvs: FloatArray, camera: PinholeCamera) -> FloatArray:
    """(n, 3) rays [x, y, 1] through pixels uvs (n, 2) in the camera frame."""
    return np.column_stack(
        [(uvs[:, 0] - camera.cx) / camera.fx, (uvs[:, 1] - camera.cy) / camera.fy, np.ones(len(uvs))]
    )


def huber_weights(size: FloatArray, knee: float = _KNEE, gate: float = 4.0) -> FloatArray:
    """Weight of whitened residuals of given size; 0 beyond the gate, where nothing is noise."""
    size = np.abs(size)
    weights = np.minimum(1.0, knee / np.maximum(size, 1e-12))
    return np.asarray(np.where(size > gate, 0.0, weights))


@dataclass(frozen=True)
class _Refined:
    rotation: FloatArray
    direction: FloatArray
    covariance: FloatArray
    inliers: BoolArray
    noise_px: float


def _five_point(
    tracks: Tracks, fa: FloatArray, fb: FloatArray, camera: PinholeCamera
) -> tuple[FloatArray, FloatArray] | None:
    """aRb (3, 3) and direction (3,) of the best essential matrix, or None."""
    essential, mask = cv2.findEssentialMat(
        np.ascontiguousarray(tracks.uv_a),
        np.ascontiguousarray(tracks.uv_b),
        camera.matrix,
        method=cv2.USAC_MAGSAC,
        prob=_CONFIDENCE,
        threshold=_INLIER_PX,
    )
    if essential is None or np.shape(essential) != (3, 3) or not np.isfinite(essential).all():
        return None
    supporters = np.asarray(mask).reshape(-1).astype(bool)
    first, second, b_t_a = (np.asarray(part, np.float64) for part in cv2.decomposeEssentialMat(essential))
    candidates: list[tuple[int, FloatArray, FloatArray]] = []
    for aRb in (first.T, second.T):
        direction = aRb @ b_t_a.reshape(3)
        for signed in (direction, -direction):
            front = _in_front_of_both(aRb, signed, fa[supporters], fb[supporters])
            candidates.append((int(np.count_nonzero(front)), aRb, signed / np.linalg.norm(signed)))
    _, aRb, direction = max(candidates, key=lambda candidate: candidate[0])
    return aRb, direction


def _in_front_of_both(aRb: FloatArray, direction: FloatArray, fa: FloatArray, fb: FloatArray) -> BoolArray:
    """(n,) whether the rays fa and aRb fb + direction meet in front of both cameras."""
    gb = fb @ aRb.T
    aa, ab, bb = (np.einsum("ij,ij->i", x, y) for x, y in ((fa, fa), (fa, gb), (gb, gb)))
    at, bt = fa @ direction, gb @ direction
    determinant = aa * bb - ab * ab
    return np.asarray((at * bb - ab * bt > 0) & (ab * at - aa * bt > 0) & (determinant > 0))


def _side(aRb: FloatArray, direction: FloatArray, fa: FloatArray, fb: FloatArray) -> float:
    """1, or -1 where the opposite direction puts more tracks in front of both cameras."""
    front, back = (np.count_nonzero(_in_front_of_both(aRb, s * direction, fa, fb)) for s in (1.0, -1.0))
    return 1.0 if front >= back else -1.0


def _direction_given_rotation(aRb: FloatArray, fa: FloatArray, fb: FloatArray) -> FloatArray:
    """(3,) direction to which the parallax of most tracks points: least |n.t|, n = aRb fb x fa."""
    normals = cross_rows(fb @ aRb.T, fa)
    weights = np.ones(len(fa))
    direction = np.array([0.0, 0.0, 1.0])
    for _ in range(10):
        direction = np.linalg.eigh((weights[:, None] * normals).T @ normals)[1][:, 0]
        error = np.abs(normals @ direction)
        weights = 1.0 / (error + 1e-2 * float(np.median(np.linalg.norm(normals, axis=1))) + 1e-12)
    return np.asarray(direction * _side(aRb, direction, fa, fb))


def _refine(
    aRb: FloatArray,
    direction: FloatArray,
    fa: FloatArray,
    fb: FloatArray,
    camera: PinholeCamera,
) -> _Refined:
    """Robust Gauss-Newton on r = fa.[t]x aRb.fb / |epipolar line| (in image b, px)."""
    for _ in range(_ITERATIONS):
        residual, J = _line_distance(aRb, direction, fa, fb, camera)
        noise = max(MIN_NOISE_PX, robust_sigma(residual))
        weighted = huber_weights(residual / noise)[:, None] * J
        normal = weighted.T @ J
        step = -np.linalg.solve(normal + 1e-9 * np.eye(5) * np.trace(normal), weighted.T @ residual)
        aRb = aRb @ np.asarray(gtsam.Rot3.Expmap(step[:3]).matrix())
        direction = np.asarray(gtsam.Unit3(direction).retract(step[3:]).point3())
        if np.abs(step).max() < 1e-5:
            break
    residual, J = _line_distance(aRb, direction, fa, fb, camera)
    noise = max(MIN_NOISE_PX, robust_sigma(residual))
    supporters = np.abs(residual) < 4.0 * noise
    variance = noise**2 * _cost_of_weights(residual[supporters] / noise)
    information = J[supporters].T @ J[supporters]
    spurious = noise**2 * _spurious_information(aRb, direction, fa[supporters], camera)
    covariance = variance * _inverse_of_genuine(information, spurious)
    return _Refined(aRb, direction, covariance, supporters, noise)


def _line_distance(
    aRb: FloatArray, direction: FloatArray, fa: FloatArray, fb: FloatArray, camera: PinholeCamera
) -> tuple[FloatArray, FloatArray]:
    """(n,) signed distance of pixel b from its epipolar line [px], and its (n, 5) Jacobian."""
    basis = np.asarray(gtsam.Unit3(direction).basis())
    gb = fb @ aRb.T
    line_a = fa @ skew(-direction[None])[0].T
    line_b = line_a @ aRb
    error = np.einsum("ij,ij->i", line_a, gb)
    length = _softened(np.hypot(line_b[:, 0] / camera.fx, line_b[:, 1] / camera.fy), camera)
    J = np.empty((len(fa), 5))
    J[:, :3] = cross_rows(fb, line_b)
    J[:, 3:] = cross_rows(gb, fa) @ basis
    # The length of the line's normal turns with the motion, too.
    normal = line_b * [camera.fx**-2, camera.fy**-2, 0.0]
    turn = np.column_stack([cross_rows(normal, line_b), cross_rows(normal @ aRb.T, fa) @ basis])
    J -= (error / length**2)[:, None] * turn
    return error / length, J / length[:, None]


def _softened(length: FloatArray, camera: PinholeCamera) -> FloatArray:
    """Length of line normals, never near zero: about the epipole a line may turn anywhere."""
    return np.asarray(np.hypot(length, EPIPOLE_PX / (camera.fx * camera.fy)))


def _spurious_information(
    aRb: FloatArray, direction: FloatArray, fa: FloatArray, camera: PinholeCamera
) -> FloatArray:
    """(5, 5) information that one pixel of noise along the epipolar lines seems to bring.

    The direction is seen by the parallax, and noise in the parallax looks like more of it.
    """
    line_b = cross_rows(fa, np.broadcast_to(direction, fa.shape)) @ aRb
    normal = np.column_stack([line_b[:, 0] / camera.fx, line_b[:, 1] / camera.fy])
    length = _softened(np.linalg.norm(normal, axis=1), camera)
    along = np.column_stack([-normal[:, 1] / camera.fx, normal[:, 0] / camera.fy, np.zeros(len(fa))])
    J = cross_rows((along / length[:, None]) @ aRb.T, fa) @ np.asarray(gtsam.Unit3(direction).basis())
    J /= length[:, None]
    result = np.zeros((5, 5))
    result[3:, 3:] = J.T @ J
    return result


def _inverse_of_genuine(information: FloatArray, spurious: FloatArray) -> FloatArray:
    """(5, 5) inverse of information - spurious, which is kept positive: what noise brought is not known."""
    scale = np.linalg.cholesky(information + 1e-9 * np.eye(5) * np.trace(information))
    whitener = np.linalg.inv(scale)
    values, vectors = np.linalg.eigh(np.eye(5) - whitener @ spurious @ whitener.T)
    root = whitener.T @ vectors
    return np.asarray((root / np.maximum(values, 0.02)) @ root.T)


def _cost_of_weights(whitened: FloatArray) -> float:
    """E[psi^2] / E[psi']^2: what the robust weights cost in variance (Huber 1981, eq. 7.6.7)."""
    psi = np.clip(whitened, -_KNEE, _KNEE)
    inside = float(np.mean(np.abs(whitened) < _KNEE))
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
        scale = max(0.05, robust_sigma(left))
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


def _unknown() -> DirectionMotion:
    """Nothing known: too few tracks."""
    covariance = np.diag([1.0] * 3 + [np.pi**2] * 2)
    rotation, forward = gtsam.Rot3(), np.array([0.0, 0.0, 1.0])
    return DirectionMotion(rotation, rotation, forward, covariance, 1.0, False)

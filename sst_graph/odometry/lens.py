"""The lens by the camera alone: bundle adjustment of corners that are followed through many images.

A pinhole camera that moves on sees a point run along a path that two parameters of the point and the motion
fix; a lens that bends makes it run otherwise towards the picture's edges. The motion's size comes from the
LiDAR, which no lens bends. Poses, points and the camera (gtsam.Cal3DS2) are adjusted together.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import gtsam
import numpy as np
from numpy.typing import NDArray

from factors.camera import PinholeCamera
from sst_graph.odometry.chains import FeatureChain

FloatArray = NDArray[np.float64]

_PIXEL_SIGMA = 0.5
"""Deviation of a followed corner [px]; the result is scaled to what the residuals show."""
_KERNEL = 2.0
"""Scale of the Cauchy kernel, in these deviations."""
_ROTATION_SIGMA_RAD = 1e-3
_TRANSLATION_SIGMA_M = (0.005, 0.02)
"""Deviation of the motion between two images: a constant, and a share of its length."""
_LEAST_FLOW_PX = 5.0
"""A chain is looked at again after it has moved so far."""
_LEAST_VIEWS = 4
_LEAST_CHAINS = 40
_MOST_CHAINS = 600
_GROUPS = 8
"""Parts of the chains that are left out in turn for the estimate's deviation."""
_CALIBRATION = gtsam.symbol("K", 0)
_K1 = 5
"""Place of k1 in Cal3DS2: fx, fy, s, u0, v0, k1, k2, p1, p2."""


@dataclass(frozen=True)
class LensEstimate:
    """Radial distortion k1 that the followed corners show, with its deviation; chains that tell it."""

    k1: float
    sigma: float
    chains: int


@dataclass(frozen=True)
class _Point:
    """A chain's views: numbers of the images, pixels (n, 2), and the point in the world [m]."""

    images: tuple[int, ...]
    uvs: FloatArray
    place: FloatArray


def lens_from_chains(
    chains: Sequence[FeatureChain], wTcs: Mapping[int, gtsam.Pose3], camera: PinholeCamera
) -> LensEstimate | None:
    """What the corners tell of the lens; None where too few of them move far enough.

    Args:
        chains: followed corners.
        wTcs: pose of the camera at each image, by its number, from the LiDAR's odometry.
        camera: the pinhole that is assumed.
    """
    points = _points(chains, wTcs, camera)
    if len(points) < _LEAST_CHAINS:
        return None
    values, k1 = _adjust(points, wTcs, camera, None)
    # Corners err together, near each other and along their ways: the spread over parts of them tells.
    rng = np.random.default_rng(0)
    group = rng.permutation(len(points)) % _GROUPS
    parts = [
        _adjust([p for p, g in zip(points, group, strict=True) if g != out], wTcs, camera, values)[1]
        for out in range(_GROUPS)
    ]
    variance = (_GROUPS - 1) / _GROUPS * float(np.square(np.array(parts) - np.mean(parts)).sum())
    return LensEstimate(k1, float(np.sqrt(variance)), len(points))


def _points(
    chains: Sequence[FeatureChain], wTcs: Mapping[int, gtsam.Pose3], camera: PinholeCamera
) -> list[_Point]:
    """The chains that move far enough, triangulated; those of most views."""
    found = []
    for chain in chains:
        images, uvs = _views(chain, wTcs)
        if len(images) >= _LEAST_VIEWS and (place := _triangulated(images, uvs, wTcs, camera)) is not None:
            found.append(_Point(images, uvs, place))
    return sorted(found, key=lambda point: -len(point.images))[:_MOST_CHAINS]


def _views(chain: FeatureChain, wTcs: Mapping[int, gtsam.Pose3]) -> tuple[tuple[int, ...], FloatArray]:
    """The views of a chain that lie apart in the picture."""
    kept: list[int] = []
    for k in range(len(chain)):
        if chain.first + k not in wTcs:
            continue
        if not kept or np.linalg.norm(chain.uvs[k] - chain.uvs[kept[-1]]) >= _LEAST_FLOW_PX:
            kept.append(k)
    return tuple(chain.first + k for k in kept), chain.uvs[kept]


def _triangulated(
    images: Sequence[int], uvs: FloatArray, wTcs: Mapping[int, gtsam.Pose3], camera: PinholeCamera
) -> FloatArray | None:
    """Where the rays of the views meet, in the world [m]; None where they do not, in front of all."""
    rays = np.column_stack(
        [(uvs[:, 0] - camera.cx) / camera.fx, (uvs[:, 1] - camera.cy) / camera.fy, np.ones(len(uvs))]
    )
    A, b = np.zeros((3, 3)), np.zeros(3)
    for image, ray in zip(images, rays, strict=True):
        wTc = wTcs[image]
        way = np.asarray(wTc.rotation().matrix()) @ (ray / np.linalg.norm(ray))
        across = np.eye(3) - np.outer(way, way)
        A, b = A + across, b + across @ np.asarray(wTc.translation())
    if np.linalg.eigvalsh(A)[0] < 1e-5 * len(images):
        return None
    place = np.asarray(np.linalg.solve(A, b), np.float64)
    cPs = np.array([wTcs[image].transformTo(place) for image in images])
    if (cPs[:, 2] < 1.0).any():
        return None
    errors = np.linalg.norm(camera.project(cPs) - uvs, axis=1)
    # A bent lens leaves residuals, a corner on something that moves larger ones.
    return place if float(np.median(errors)) < 10.0 else None


def _adjust(
    points: Sequence[_Point],
    wTcs: Mapping[int, gtsam.Pose3],
    camera: PinholeCamera,
    start: gtsam.Values | None,
) -> tuple[gtsam.Values, float]:
    """The adjusted problem's values, and k1 in them."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    pinhole = gtsam.Cal3DS2(camera.fx, camera.fy, 0.0, camera.cx, camera.cy, 0.0, 0.0)
    sigmas = np.array([1e-3 * camera.fx, 1e-3 * camera.fy, 1e-6, 1.0, 1.0, 0.3, 1e-6, 1e-6, 1e-6])
    graph.add(gtsam.PriorFactorCal3DS2(_CALIBRATION, pinhole, gtsam.noiseModel.Diagonal.Sigmas(sigmas)))
    values.insert(_CALIBRATION, pinhole if start is None else start.atCal3DS2(_CALIBRATION))
    used = sorted({image for point in points for image in point.images})
    _add_motion(graph, values, used, wTcs, start)
    cauchy = gtsam.noiseModel.mEstimator.Cauchy.Create(_KERNEL)
    noise = gtsam.noiseModel.Robust.Create(cauchy, gtsam.noiseModel.Isotropic.Sigma(2, _PIXEL_SIGMA))
    for number, point in enumerate(points):
        key = gtsam.symbol("p", number)
        values.insert(key, point.place)
        for image, uv in zip(point.images, point.uvs, strict=True):
            pose = gtsam.symbol("x", image)
            graph.add(gtsam.GeneralSFMFactor2Cal3DS2(uv, noise, pose, key, _CALIBRATION))
    params = gtsam.LevenbergMarquardtParams()
    params.setMaxIterations(15)
    params.setRelativeErrorTol(1e-4)
    values = gtsam.LevenbergMarquardtOptimizer(graph, values, params).optimize()
    return values, float(values.atCal3DS2(_CALIBRATION).vector()[_K1])


def _add_motion(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    images: Sequence[int],
    wTcs: Mapping[int, gtsam.Pose3],
    start: gtsam.Values | None,
) -> None:
    """Poses of the images, and what odometry says of the motions between them."""
    first = gtsam.symbol("x", images[0])
    graph.add(gtsam.PriorFactorPose3(first, wTcs[images[0]], gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)))
    for image in images:
        key = gtsam.symbol("x", image)
        known = start is not None and start.exists(key)
        values.insert(key, start.atPose3(key) if start is not None and known else wTcs[image])
    for a, b in pairwise(images):
        motion = wTcs[a].between(wTcs[b])
        length = float(np.linalg.norm(motion.translation()))
        shift = _TRANSLATION_SIGMA_M[0] + _TRANSLATION_SIGMA_M[1] * length
        sigmas = np.repeat([_ROTATION_SIGMA_RAD, shift], 3)
        noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
        graph.add(gtsam.BetweenFactorPose3(gtsam.symbol("x", a), gtsam.symbol("x", b), motion, noise))

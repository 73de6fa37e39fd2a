"""Inverse depth at image features, interpolated from projected LiDAR points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sst_graph.config import Settings, setting
from sst_graph.factors.camera import PinholeCamera

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class DepthConfig(Settings):
    """When LiDAR points around a feature tell its depth.

    Attributes:
        neighbours: points from which a feature's depth is interpolated.
        radius_px: farthest neighbour [px].
        max_spread: largest ratio of the farthest to the nearest neighbour's depth: beyond it,
            foreground and background meet at the feature.
        max_residual: largest root mean square misfit of a plane, relative to the inverse depth.
        max_leverage: largest leverage of the feature's place: beyond it the plane is extrapolated.
        range_sigma: relative sigma of a depth that even a perfect plane keeps.
    """

    neighbours: int = setting(8, at_least=3, at_most=100)
    radius_px: float = setting(16.0, at_least=1.0, at_most=500.0)
    max_spread: float = setting(1.3, at_least=1.0, at_most=100.0)
    max_residual: float = setting(0.02, at_least=0.0001, at_most=10.0)
    max_leverage: float = setting(0.7, at_least=0.01, at_most=100.0)
    range_sigma: float = setting(0.005, at_least=0.0, at_most=1.0)


@dataclass(frozen=True)
class InverseDepths:
    """Inverse depth Z^-1 at features.

    Attributes:
        value: (n,) [1/m], NaN where unknown.
        sigma: (n,) [1/m].
    """

    value: FloatArray
    sigma: FloatArray

    @property
    def known(self) -> NDArray[np.bool_]:
        """(n,) whether there is a value."""
        return np.isfinite(self.value)


def inverse_depths(
    uvs: FloatArray, cPs: FloatArray, camera: PinholeCamera, config: DepthConfig | None = None
) -> InverseDepths:
    """Inverse depth at pixels uvs (n, 2) from points cPs (m, 3) in the camera [m].

    On a plane Z^-1 is an affine function of the pixel, so one is fitted to the neighbours of each
    feature; where it does not fit (an edge between foreground and background) or would be
    extrapolated the depth is unknown.
    """
    config = config or DepthConfig()
    value = np.full(len(uvs), np.nan)
    sigma = np.full(len(uvs), np.nan)
    points = cPs[camera.in_front(cPs)]
    pixels = camera.project(points)
    margin = config.radius_px
    u, v = pixels.T
    near_image = (u > -margin) & (u < camera.width + margin) & (v > -margin) & (v < camera.height + margin)
    pixels, rho = pixels[near_image], 1.0 / points[near_image, 2]
    if len(pixels) < config.neighbours or len(uvs) == 0:
        return InverseDepths(value, sigma)
    tree = cKDTree(pixels, balanced_tree=False, compact_nodes=False)
    distance, index = tree.query(uvs, k=config.neighbours, distance_upper_bound=margin)
    full = np.isfinite(distance).all(axis=1)
    index, offsets = index[full], pixels[index[full]] - uvs[full, None, :]
    fitted, misfit, leverage = _plane_at_origin(offsets, rho[index])
    spread = rho[index].max(axis=1) / rho[index].min(axis=1)
    good = (
        (spread < config.max_spread)
        & (misfit < config.max_residual * fitted)
        & (leverage < config.max_leverage)
        & (fitted > 0.0)
    )
    where = np.flatnonzero(full)[good]
    value[where] = fitted[good]
    own = np.hypot(misfit * np.sqrt(leverage), config.range_sigma * fitted)
    sigma[where] = own[good]
    return InverseDepths(value, sigma)


def _plane_at_origin(offsets: FloatArray, rho: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Least-squares plane rho = c0 + c.offset of each feature's neighbours, at the feature itself.

    Args:
        offsets: (n, k, 2) neighbours minus feature [px].
        rho: (n, k) inverse depths [1/m].

    Returns:
        (n,) value at the feature, (n,) root mean square misfit, (n,) leverage of the feature's place.
    """
    n, k = rho.shape
    A = np.concatenate([np.ones((n, k, 1)), offsets], axis=2)
    normal = A.transpose(0, 2, 1) @ A
    # One line of points spans no plane: a ridge of (1 px)^2 keeps it solvable, its leverage stays large.
    normal[:, [1, 2], [1, 2]] += 1.0
    inverse = np.linalg.inv(normal)
    coefficients = np.einsum("nij,nkj,nk->ni", inverse, A, rho)
    misfit = rho - np.einsum("nkj,nj->nk", A, coefficients)
    rms = np.sqrt(np.sum(misfit**2, axis=1) / max(k - 3, 1))
    return coefficients[:, 0], rms, inverse[:, 0, 0]

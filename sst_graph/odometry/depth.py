"""Inverse depth at image features, interpolated from projected LiDAR points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sst_graph.factors.camera import PinholeCamera
from sst_graph.types import FloatArray

_NEIGHBOURS = 8
"""Points from which a feature's depth is interpolated."""
_RADIUS_PX = 16.0
"""Farthest neighbour [px]; scan lines of an HDL-64E are 5 px apart (0.4 deg at a focal length of 720 px)."""
_MAX_SPREAD = 1.3
"""Largest ratio of the farthest to the nearest neighbour's depth: beyond it, foreground and background meet
at the feature."""
_MAX_RESIDUAL = 0.02
"""Largest root mean square misfit of a plane, relative to the inverse depth."""
_MAX_LEVERAGE = 0.7
"""Largest leverage of the feature's place: beyond it the plane is extrapolated."""
RANGE_SIGMA = 0.005
"""Relative sigma of a depth that even a perfect plane keeps: 2 cm, an HDL-64E's range noise, at 4 m."""


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


def inverse_depths(uvs: FloatArray, cPs: FloatArray, camera: PinholeCamera) -> InverseDepths:
    """Inverse depth at pixels uvs (n, 2) from points cPs (m, 3) in the camera [m].

    On a plane Z^-1 is an affine function of the pixel, so one is fitted to the neighbours of each
    feature; where it does not fit (an edge between foreground and background) or would be
    extrapolated the depth is unknown.
    """
    value = np.full(len(uvs), np.nan)
    sigma = np.full(len(uvs), np.nan)
    points = cPs[camera.in_front(cPs)]
    pixels = camera.project(points)
    margin = _RADIUS_PX
    u, v = pixels.T
    near_image = (u > -margin) & (u < camera.width + margin) & (v > -margin) & (v < camera.height + margin)
    pixels, rho = pixels[near_image], 1.0 / points[near_image, 2]
    if len(pixels) < _NEIGHBOURS or len(uvs) == 0:
        return InverseDepths(value, sigma)
    tree = cKDTree(pixels, balanced_tree=False, compact_nodes=False)
    distance, index = tree.query(uvs, k=_NEIGHBOURS, distance_upper_bound=margin)
    full = np.isfinite(distance).all(axis=1)
    index, offsets = index[full], pixels[index[full]] - uvs[full, None, :]
    fitted, misfit, leverage = _plane_at_origin(offsets, rho[index])
    spread = rho[index].max(axis=1) / rho[index].min(axis=1)
    good = (
        (spread < _MAX_SPREAD)
        & (misfit < _MAX_RESIDUAL * fitted)
        & (leverage < _MAX_LEVERAGE)
        & (fitted > 0.0)
    )
    where = np.flatnonzero(full)[good]
    value[where] = fitted[good]
    own = np.hypot(misfit * np.sqrt(leverage), RANGE_SIGMA * fitted)
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

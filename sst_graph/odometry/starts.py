"""Translation of the camera by consensus of tracks with depth, the rotation given."""

from __future__ import annotations

import gtsam
import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

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

"""Pictures that shift against the cloud from one image to the next, and what that adds to a covariance.

A mount that vibrates, pictures that are stabilised, or stamps that jitter move all contours of an image
alike, by another amount in the next image. Neighbouring objects then err together, which the error model of
single sides (:mod:`sst_graph.covariance.error_model`) does not know. The matches of each image are fitted
with a shift of its picture; what the shifts vary by beyond their own variances is the variance s^2 of the
picture, across and down (random effects: DerSimonian and Laird, Meta-analysis in clinical trials, 1986). With
J_k and H_k the rows of image k by the unknowns and by its shift, and P the inverse of the information, it
adds

    sum_k P J_k'H_k diag(s^2) H_k'J_k P.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from sst_graph.covariance.cluster_robust import RobustCovariance
from sst_graph.covariance.considered import columns_of, weighted_columns
from sst_graph.covariance.error_model import spread_beyond
from sst_graph.covariance.match_table import MatchTable
from sst_graph.covariance.sums import summed_rows
from sst_graph.covariance.undecided_sweep import MATTERS
from sst_graph.graph.matching import PairMatches
from sst_graph.graph.state import State
from sst_graph.types import FloatArray, IntArray

_LEAST_SIDES = 4
"""Fewest sides of objects in an image that its shift (2 numbers) is fitted to: with fewer, its variance
cannot be told from the sides' scatter."""


@dataclass(frozen=True)
class ImageShifts:
    """How the pictures of a calibration shift from image to image.

    Attributes:
        sigmas_px: (2,) deviation of the shift across and down [px].
        covariance: (s, s) of extrinsic and offsets by it.
    """

    sigmas_px: FloatArray
    covariance: FloatArray

    def sentence(self, covariance: FloatArray) -> str:
        """That the pictures shift, where it makes up much of a covariance (7, 7); else empty."""
        shares = np.sqrt(np.diag(self.covariance)[:7] / np.diag(covariance))
        if shares.max() <= MATTERS:
            return ""
        across, down = self.sigmas_px
        return (
            f"the pictures shift against the cloud from image to image, by {across:.1f} px across and "
            f"{down:.1f} px up or down (one sigma): look for a mount that vibrates, pictures that are "
            "stabilised, or stamps that jitter; it is in the sigmas"
        )


def image_shifts(
    robust: RobustCovariance, pairs: Sequence[PairMatches], values: gtsam.Values, state: State
) -> ImageShifts:
    """The shifts of the pictures, from the residuals of an estimate.

    Args:
        robust: its covariance and matches.
        pairs, values, state: its last frozen problem.
    """
    H = weighted_columns(robust.table, pairs, columns_of(pairs, values, state, ("cx", "cy")))
    numbers: dict[tuple[int, int], int] = {}
    of_pair = [numbers.setdefault((pair.drive, pair.pair.image), len(numbers)) for pair in pairs]
    images = np.repeat(of_pair, [len(pair) for pair in pairs])
    return shifts_of(robust.table, robust.bread[: 6 + len(state.time_offsets_s)], H, images)


def shifts_of(table: MatchTable, bread: FloatArray, H: FloatArray, images: IntArray) -> ImageShifts:
    """The shifts of the pictures, and what they add to the covariance.

    Args:
        table: the matches.
        bread: (s, n) inverse of the information, rows of those unknowns whose covariance is wanted.
        H: (m, 2) derivatives of the residuals by a shift of the picture, weighted [1/px].
        images: (m,) number of the image.
    """
    order = np.argsort(images, kind="stable")
    members = np.split(order, np.flatnonzero(np.diff(images[order])) + 1)
    # 1. The variance of the shifts.
    r = table.root_weights * table.r
    fits = [_fitted(H[own], r[own], table.sides[own]) for own in members]
    variances = _variances([fit for fit in fits if fit is not None])
    # 2. What it does to the estimate.
    effects = [bread @ (table.J[own].T @ H[own]) for own in members]
    covariance = sum(((G * variances) @ G.T for G in effects), np.zeros((len(bread), len(bread))))
    return ImageShifts(np.sqrt(variances), np.asarray(covariance))


@dataclass(frozen=True)
class _Fit:
    """The shift of one picture [px].

    Attributes:
        shift: (2,) across, down.
        independent: (2,) its variances if all matches erred by themselves.
        by_sides: (2,) the same from the scatter of the sides of objects.
    """

    shift: FloatArray
    independent: FloatArray
    by_sides: FloatArray


def _fitted(H: FloatArray, r: FloatArray, sides: IntArray) -> _Fit | None:
    """The shift by the matches of one image; None where they do not determine it.

    Args:
        H: (m, 2) derivatives of the residuals, weighted.
        r: (m,) residuals, weighted.
        sides: (m,) numbers of the sides of objects.
    """
    information = H.T @ H
    if np.linalg.matrix_rank(information, hermitian=True) < 2:
        return None
    inverse = np.linalg.inv(information)
    shift = inverse @ (H.T @ r)
    names, scores = summed_rows(H * (r - H @ shift)[:, None], sides)
    if len(names) < _LEAST_SIDES:
        return None
    scores = scores @ inverse * np.sqrt(len(names) / (len(names) - 2.0))
    return _Fit(shift, np.diag(inverse), (scores**2).sum(axis=0))


def _variances(fits: Sequence[_Fit]) -> FloatArray:
    """(2,) variances of the shifts across and down beyond those of their fits [px^2]; 0 of a single image.

    The scatter of one image's few sides tells little: images share the ratio by which it is larger than that
    of independent matches.
    """
    if len(fits) < 2:
        return np.zeros(2)
    shifts, independent, by_sides = (
        np.array([getattr(fit, name) for fit in fits]) for name in ("shift", "independent", "by_sides")
    )
    own = independent * (by_sides.sum(axis=0) / independent.sum(axis=0))
    together = np.zeros(len(fits), np.intp)
    return np.array([spread_beyond(shifts[:, k], own[:, k], together) for k in range(2)])

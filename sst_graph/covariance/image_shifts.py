"""Errors that all matches of an image share, others in the next image, and what they add to a covariance.

A mount that vibrates or pictures that are stabilised move all contours of an image alike, stamps that jitter
move each point by its own motion. Neighbouring objects then err together, which the error model of single
sides (:mod:`sst_graph.covariance.error_model`) does not know. The matches of each image are fitted with a
shift of its picture and of its stamp; what these vary by beyond their own variances is their variance s^2
(random effects: DerSimonian and Laird, Meta-analysis in clinical trials, 1986). With J_k and H_k the rows of
image k by the unknowns and by its shifts, and P the inverse of the information, they add

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

_LEAST_SIDES = 2
"""Fewest sides of objects in an image beyond the number of its shifts: with fewer, their variance cannot be
told from the sides' scatter."""
_UNITS = np.array([1.0, 1.0, 1e-3])
"""Pixels and milliseconds: variances are compared in these."""
_WIDEST_STAMP_S = 0.1
"""An image's stamp that its matches determine worse than this (the vehicle stands) is not fitted [s]."""


@dataclass(frozen=True)
class ImageShifts:
    """How the pictures of a calibration shift from image to image, and their stamps.

    Attributes:
        sigmas: (3,) deviation of the shift across and down [px] and of the stamp [s].
        parts: (3, s, s) covariance of extrinsic and offsets by each.
    """

    sigmas: FloatArray
    parts: FloatArray

    @property
    def covariance(self) -> FloatArray:
        """(s, s) of extrinsic and offsets by all of them."""
        return np.asarray(self.parts.sum(axis=0))

    def sentences(self, covariance: FloatArray) -> tuple[str, ...]:
        """That the pictures shift, and that their stamps jitter, where it makes up much of a covariance
        (7, 7)."""
        of_picture, of_stamp = (
            np.sqrt(np.diag(part)[:7] / np.diag(covariance)).max() > MATTERS
            for part in (self.parts[:2].sum(axis=0), self.parts[2])
        )
        across, down, late_s = self.sigmas
        found = []
        if of_stamp:
            found.append(
                f"the stamps of the images jitter by {1e3 * late_s:.1f} ms (one sigma), or scans too far "
                "apart in time leave the motion between them open: stamp images by their trigger or "
                "exposure, not by their arrival, and scan at 10 Hz or more; it is in the sigmas"
            )
        if of_picture:
            found.append(
                f"the pictures shift against the cloud from image to image, by {across:.1f} px across and "
                f"{down:.1f} px up or down (one sigma): look for a mount that vibrates, or pictures that are "
                "stabilised; it is in the sigmas"
            )
        return tuple(found)


def image_shifts(
    robust: RobustCovariance, pairs: Sequence[PairMatches], values: gtsam.Values, state: State
) -> ImageShifts:
    """The shifts of the pictures, from the residuals of an estimate.

    Args:
        robust: its covariance and matches.
        pairs, values, state: its last frozen problem.
    """
    size = 6 + len(state.time_offsets_s)
    return shifts_of(robust.table, robust.bread[:size], *columns_by_image(robust.table, pairs, values, state))


def columns_by_image(
    table: MatchTable, pairs: Sequence[PairMatches], values: gtsam.Values, state: State
) -> tuple[FloatArray, IntArray]:
    """Derivatives of the residuals by a shift of their picture (2) and of its stamp, and numbers of images.

    Args:
        table: the matches.
        pairs, values, state: the frozen problem that they are of.
    """
    of_picture = weighted_columns(table, pairs, columns_of(pairs, values, state, ("cx", "cy")))
    # A match has one drive's offset.
    of_stamp = table.J[:, 6 : 6 + len(state.time_offsets_s)].sum(axis=1)
    numbers: dict[tuple[int, int], int] = {}
    of_pair = [numbers.setdefault((pair.drive, pair.pair.image), len(numbers)) for pair in pairs]
    return np.column_stack([of_picture, of_stamp]), np.repeat(of_pair, [len(pair) for pair in pairs])


def shifts_of(table: MatchTable, bread: FloatArray, H: FloatArray, images: IntArray) -> ImageShifts:
    """The shifts of pictures and stamps, and what they add to the covariance.

    Args:
        table: the matches.
        bread: (s, n) inverse of the information, rows of those unknowns whose covariance is wanted.
        H: (m, 3) derivatives of the residuals by a shift of the picture and of its stamp, weighted
            [1/px, 1/px, 1/s].
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
    parts = [sum(np.outer(G[:, k], G[:, k]) for G in effects) * variances[k] for k in range(3)]
    return ImageShifts(np.sqrt(variances), np.array(parts))


@dataclass(frozen=True)
class _Fit:
    """The shifts of one picture [px, px] and of its stamp [s]; infinite variances where it is not fitted.

    Attributes:
        shift: (3,) across, down, later.
        independent: (3,) variances if all matches erred by themselves.
        by_sides: (3,) the same from the scatter of the sides of objects.
    """

    shift: FloatArray
    independent: FloatArray
    by_sides: FloatArray


def _fitted(H: FloatArray, r: FloatArray, sides: IntArray) -> _Fit | None:
    """The shifts by the matches of one image, of the picture alone where they do not determine the stamp's;
    None where they determine neither.

    Args:
        H: (m, 3) derivatives of the residuals, weighted.
        r: (m,) residuals, weighted.
        sides: (m,) numbers of the sides of objects.
    """
    for used in (3, 2):
        own = H[:, :used]
        scale = 1.0 / np.maximum(np.linalg.norm(own, axis=0), 1e-12)
        information = (own * scale).T @ (own * scale)
        if np.linalg.matrix_rank(information, hermitian=True) < used:
            continue
        inverse = np.linalg.inv(information) * np.outer(scale, scale)
        if used == 3 and inverse[2, 2] > _WIDEST_STAMP_S**2:
            continue
        shift = inverse @ (own.T @ r)
        names, scores = summed_rows(own * (r - own @ shift)[:, None], sides)
        if len(names) < used + _LEAST_SIDES:
            continue
        scores = scores @ inverse * np.sqrt(len(names) / (len(names) - used))
        found = np.stack([shift, np.diag(inverse), (scores**2).sum(axis=0)])
        return _Fit(*np.pad(found, ((0, 0), (0, 3 - used)), constant_values=np.inf))
    return None


def _variances(fits: Sequence[_Fit]) -> FloatArray:
    """(3,) variances of the shifts beyond those of their fits [px^2, px^2, s^2]; 0 of a single image.

    The scatter of one image's few sides tells little: images share the ratio by which it is larger than that
    of independent matches.
    """
    every = np.array([(fit.shift, fit.independent, fit.by_sides) for fit in fits]).reshape(-1, 3, 3)
    found = np.zeros(3)
    for k, of_kind in enumerate(every.transpose(2, 0, 1)):
        shift, independent, by_sides = of_kind[np.isfinite(of_kind[:, 0])].T
        if len(shift) > 1:
            own = independent * (by_sides.sum() / independent.sum())
            found[k] = spread_beyond(shift / _UNITS[k], own / _UNITS[k] ** 2, np.zeros(len(own), np.intp))
    return np.asarray(found * _UNITS**2)

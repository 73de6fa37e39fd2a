"""Errors that all matches of an image share, others in the next image, and what they add to a covariance.

A mount that vibrates or pictures that are stabilised move all contours of an image alike, stamps that jitter
move each point by its own motion. Neighbouring objects then err together, which the error model of single
sides (:mod:`sst_graph.covariance.error_model`) does not know. The matches of each image are fitted with a
shift of its picture and of its stamp; what these vary by beyond their own variances is their variance s^2
(random effects: DerSimonian and Laird, Meta-analysis in clinical trials, 1986). Under robust weights, which
are frozen, such a fit falls short by the ratio of mean curvature to mean weight. With J_k and H_k the rows of
image k by the unknowns and by its shifts, and P the inverse of the information, they add

    sum_k P J_k'H_k diag(s^2) H_k'J_k P.

A batch sees all images at once; a tracker adds up the moments of the shifts and the scores J_k'H_k of those
that leave its window.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from sst_graph.covariance.cluster_robust import RobustCovariance
from sst_graph.covariance.considered import columns_of, weighted_columns
from sst_graph.covariance.jackknife import bounded_ratio
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

    @classmethod
    def none(cls) -> ImageShifts:
        """None, of extrinsic and one offset."""
        return cls(np.zeros(3), np.zeros((3, 7, 7)))

    @property
    def covariance(self) -> FloatArray:
        """(s, s) of extrinsic and offsets by all of them."""
        return np.asarray(self.parts.sum(axis=0))

    @property
    def diagnostics(self) -> dict[str, Any]:
        """JSON-able: the deviations [px, px], [ms]."""
        return {
            "image_shift_px": self.sigmas[:2].round(3).tolist(),
            "stamp_jitter_ms": round(1e3 * float(self.sigmas[2]), 3),
        }

    def sentences(self, covariance: FloatArray) -> tuple[str, ...]:
        """Sentences that say that the pictures shift, or that their stamps jitter; none where it makes up
        little of a covariance (7, 7)."""
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
    moments = sum((shift_moments(H[own], r[own], table.sides[own]) for own in members), NO_MOMENTS)
    variances = shift_variances(moments) * bounded_ratio(table.weight_curvature_ratio) ** 2
    # 2. What it does to the estimate.
    effects = [bread @ (table.J[own].T @ H[own]) for own in members]
    parts = [sum(np.outer(G[:, k], G[:, k]) for G in effects) * variances[k] for k in range(3)]
    return ImageShifts(np.sqrt(variances), np.array(parts))


NO_MOMENTS: FloatArray = np.zeros((3, 7))
"""Moments of no image."""


def shift_moments(H: FloatArray, r: FloatArray, sides: IntArray) -> FloatArray:
    """(3, 7) what the matches of one image tell of each of its shifts, to be summed over images; 0 of a shift
    that they do not determine.

    With s the shift and v its variance [px, px, ms]: 1, v if all matches err by themselves, v from the
    scatter of the sides of objects; and of the former 1 / v, 1 / v^2, s / v, s^2 / v.

    Args:
        H: (m, 3) derivatives of the residuals by a shift across, down, and of the stamp, weighted.
        r: (m,) residuals, weighted.
        sides: (m,) numbers of the sides of objects.
    """
    found = NO_MOMENTS.copy()
    # The picture alone where the matches do not determine the shift of the stamp.
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
        units = _UNITS[:used]
        s, alone = shift / units, np.maximum(np.diag(inverse) / units**2, _LEAST_VARIANCE)
        by_sides = (scores**2).sum(axis=0) / units**2
        v = 1.0 / alone
        found[:used] = np.stack([np.ones(used), alone, by_sides, v, v**2, v * s, v * s**2], axis=1)
        break
    return found


_LEAST_VARIANCE = 1e-9
"""Of a shift [px^2, ms^2]: no image tells more."""


def shift_variances(moments: FloatArray) -> FloatArray:
    """(3,) variances of the shifts beyond those of their fits [px^2, px^2, s^2]; 0 of a single image.

    The scatter of one image's few sides tells little: images share the ratio by which it is larger than that
    of independent matches.

    Args:
        moments: (3, 7) summed over the images, of :func:`shift_moments`.
    """
    found = np.zeros(3)
    for k, (count, alone, by_sides, v, v2, vs, vss) in enumerate(moments):
        weight = v - v2 / v if count > 1 else 0.0
        if weight > 1e-9:
            # By the method of moments, with weights by the variances of independent matches.
            beyond = vss - vs**2 / v - by_sides / alone * (count - 1)
            found[k] = max(0.0, beyond / weight)
    return np.asarray(found * _UNITS**2)

"""Whether marginals that are to be fused agree: their constant at the common optimum is a chi-squared."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np
from scipy.special import chdtrc

from sst_graph.covariance.contradiction import Difference, PartEstimate, disagreement, name_step
from sst_graph.errors import ContradictionError, EstimationError, count_of
from sst_graph.graph.linear import unit_scale
from sst_graph.marginal import CalibrationMarginal, Separated
from sst_graph.types import FloatArray

SIGNIFICANCE = 1e-3
"""Probability that marginals which agree, with covariances that hold, are refused."""
_ROUNDING = 1e-6
"""Information below zero by this share of the whole is rounding."""
_FAR_SIGMA = 1e3
"""Sigma of a direction that a marginal does not determine [rad, m, s]."""


def check_agreement(
    parts: Sequence[Separated],
    cTl: gtsam.Pose3,
    names: Sequence[str] = (),
    significance: float = SIGNIFICANCE,
) -> None:
    """Refuse marginals about one point that do not agree, each with the others and all together.

    Args:
        parts: the marginals; what they have in common explains differences between them only as far as it
            moves them differently.
        cTl: the point's extrinsic, for the words.
        names: of the parts; numbers from 0 where none are given.
        significance: probability of an error where they agree; 0 checks nothing.

    Raises:
        ContradictionError: they do not.
        EstimationError: one is no estimate of its own: it takes information away.
    """
    if len(parts) < 2 or significance <= 0.0:
        return
    _check_answers([part.own.information for part in parts], names)
    estimates = [_estimate(part) for part in parts]
    # 1. All together: how much the costs are above their own minima, for 7 numbers a part more than needed.
    chi2, freedom = disagreement(estimates), 7 * (len(parts) - 1)
    # 2. Each against the others: what it adds to all of that.
    against = Difference.each_from_others(estimates)
    worst = int(np.argmax([difference.chi2 for difference in against]))
    p_value = min(float(chdtrc(freedom, chi2)), len(parts) * against[worst].p_value)
    if 2.0 * p_value < significance:
        name = repr(names[worst]) if names else f"number {worst}"
        raise ContradictionError(
            f"{count_of(len(parts), 'marginal')} contradict one another (chi-squared {chi2:.0f} of "
            f"{freedom}): {name} "
            f"differs from the others in {name_step(against[worst], cTl).sentence}; fuse what was recorded "
            "with one mount and one clock, or give significance=0 to fuse all the same"
        )


def check_apart(marginals: Sequence[CalibrationMarginal], names: Sequence[str] = ()) -> None:
    """Refuse two that are of the same scans, which counted twice make the fused result too sure.

    Two are where they have scans in common, or where their numbers are the same to the last bit.

    Raises:
        EstimationError: two are.
    """
    owners: dict[str | bytes, int] = {}
    for k, one in enumerate(marginals):
        numbers = (one.cTl.matrix(), np.array(one.time_offset_s), one.information, one.vector)
        own: list[str | bytes] = [*one.common.scan_hashes, b"".join(array.tobytes() for array in numbers)]
        known = [owners[mark] for mark in own if mark in owners]
        if known:
            first, second = (repr(names[i]) if names else f"number {i}" for i in (known[0], k))
            raise EstimationError(
                f"marginals {first} and {second} are of the same scans: counted twice these make the fused "
                "result too sure; give each drive once, or significance=0 to fuse all the same"
            )
        owners.update(dict.fromkeys(own, k))


def _check_answers(informations: Sequence[FloatArray], names: Sequence[str]) -> None:
    """Refuse what is no estimate of its own but a difference of two, as a growing marginal's parts are."""
    scale = unit_scale(np.sum(informations, axis=0))
    for k, information in enumerate(informations):
        least = float(np.linalg.eigvalsh(information * np.outer(scale, scale))[0])
        if least < -_ROUNDING:
            name = repr(names[k]) if names else f"number {k}"
            raise EstimationError(
                f"marginal {name}: found information of {least:.2g} of the whole in a direction, expected at "
                "least 0; parts of a marginal that grows are added (plus), or give significance=0"
            )


def _estimate(part: Separated) -> PartEstimate:
    """A marginal's own optimum; a direction that it does not determine has a large variance."""
    covariance = np.asarray(np.linalg.inv(part.own.information + np.eye(7) / _FAR_SIGMA**2), np.float64)
    return PartEstimate(covariance @ part.own.vector, covariance, common=part.errors)

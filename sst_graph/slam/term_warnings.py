"""Warnings about alignment terms in a graph, each with its figure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import gtsam
import numpy as np

from sst_graph.association.edge_matching import GATE
from sst_graph.graph.linear import covariance_root
from sst_graph.slam.alignment_keys import AlignmentKeys
from sst_graph.slam.alignment_term import TermMatches
from sst_graph.slam.config import RematchConfig
from sst_graph.types import FloatArray

MOST_SIGMAS = 4.3
"""An estimate farther from where the other factors have it contradicts them: chi-squared of 7 exceeds its
square once in a hundred [sigma]."""
LONGEST_INTERVAL_S = 0.3
"""Between poses farther apart the motion is hardly steady: braking with 2 m/s^2 puts the interpolated pose
off by 2 m/s^2 (0.3 s)^2 / 8 = 2 cm in the middle [s]."""
MOST_LINEAR_PX = 1.0
"""An estimate farther than this from where the solver linearized is not what the matches say [px]."""


class WarningKind(Enum):
    """What may be wrong with a solution."""

    WIDE_UNCERTAINTY = "the calibration is less certain than the matches reach"
    FAR_FROM_START = "the estimate lies farther from where the rest of the graph has it than that allows"
    FAR_LINEARIZATION = "the solver has linearized away from the estimate"
    LEFT_INTERVAL = "stamp + offset has left the interval between its two poses"
    LONG_INTERVAL = "poses between which the camera's are interpolated lie far apart"
    NO_MATCHES = "terms without a factor"
    NOT_CONVERGED = "matching again still moves the matched points"
    WEAK_DIRECTION = "a combination of extrinsic and time offset that the graph hardly determines"
    OVERCONFIDENT_MARGINAL = (
        "the graph's own marginal is smaller than the matches allow; use the covariance of the solution"
    )
    MASK_BIAS = "outlines that differ from the edges, and no mask bias in the graph (AlignmentKeys.biases_px)"


@dataclass(frozen=True)
class TermWarning:
    """One thing that may be wrong, with the figure behind it.

    Attributes:
        kind: what.
        value, limit: the figure and what it should not exceed, in ``unit``.
        unit: px, ms, terms, or of what the figure is a multiple.
        detail: which direction or class, and what to do; may be empty.
    """

    kind: WarningKind
    value: float
    limit: float
    unit: str
    detail: str = ""

    def __str__(self) -> str:
        what = f"{self.kind.value}: {self.value:.3g} {self.unit}"
        if self.unit != "times the limit":
            what += f", at most {self.limit:.3g} {self.unit}"
        return f"{what}: {self.detail}" if self.detail else what


def wide_uncertainty(
    matches: Sequence[TermMatches],
    values: gtsam.Values,
    covariance: FloatArray,
    reach_px: float | None = None,
) -> list[TermWarning]:
    """A warning where the calibration may err by more than matches reach.

    Args:
        matches: of all terms.
        values: the estimate.
        covariance: (7, 7) of extrinsic and offset: at the start by all but these matches, at the end by all.
        reach_px: limit; by default the search range of the matches [px].
    """
    found = [each for each in matches if each.factor is not None]
    if not found:
        return []
    limit = GATE * max(each.scale_px for each in found) if reach_px is None else reach_px
    sigma_px = uncertainty_px(found, values, covariance)
    return [TermWarning(WarningKind.WIDE_UNCERTAINTY, sigma_px, limit, "px")] if sigma_px > limit else []


def uncertainty_px(matches: Sequence[TermMatches], values: gtsam.Values, covariance: FloatArray) -> float:
    """How far the calibration may err in the image, one sigma, RMS over the terms with a factor [px].

    Args:
        covariance: (7, 7) of extrinsic and offset; zeros for what is constant.
    """
    if not np.isfinite(covariance).all():
        return float("inf")
    sigmas = [each.predicted_sigma_px(values, covariance) for each in matches if each.factor is not None]
    return float(np.sqrt(np.mean(np.square(sigmas)))) if sigmas else float("inf")


def far_from_start(
    keys: AlignmentKeys, start: gtsam.Values, values: gtsam.Values, covariance: FloatArray
) -> list[TermWarning]:
    """A warning where matches have led to another calibration than the other factors have.

    Args:
        start: the estimate without the matches.
        covariance: (7, 7) of extrinsic and offset there, by all but the matches.
    """
    if not np.isfinite(covariance).all():
        return []
    _, whiten = covariance_root(covariance)
    sigmas = float(np.linalg.norm(whiten @ _step(keys, start, values)))
    if sigmas <= MOST_SIGMAS:
        return []
    return [TermWarning(WarningKind.FAR_FROM_START, sigmas, MOST_SIGMAS, "sigma")]


def far_linearization(
    keys: AlignmentKeys,
    matches: Sequence[TermMatches],
    point: gtsam.Values,
    values: gtsam.Values,
    smoother: bool = False,
) -> list[TermWarning]:
    """A warning where the solver's linear model of extrinsic and offset was made elsewhere in the image.

    Args:
        point: the solver's linearization point.
        smoother: whether it marginalizes poses. It then linearizes extrinsic and offset never again, whatever
            its parameters are: they are on the factor that stands for what has left.
    """
    step = _step(keys, point, values)
    far_px = uncertainty_px(matches, values, np.outer(step, step))
    if not np.isfinite(far_px) or far_px <= MOST_LINEAR_PX:
        return []
    advice = "ISAM2Params: relinearizeSkip = 1, setRelinearizeThreshold(1e-4)"
    if smoother:
        advice += (
            "; a smoother that has them keeps extrinsic and time offset linearized where they were when the "
            "first pose left it: begin nearer, or with a longer lag"
        )
    return [TermWarning(WarningKind.FAR_LINEARIZATION, far_px, MOST_LINEAR_PX, "px", advice)]


def _step(keys: AlignmentKeys, start: gtsam.Values, values: gtsam.Values) -> FloatArray:
    """(7,) of extrinsic and offset from one estimate to another [rad, m, s]."""
    return keys.calibration(start).local_coordinates(keys.calibration(values))


def last_warnings(
    matches: Sequence[TermMatches], values: gtsam.Values, covariance: FloatArray, config: RematchConfig
) -> list[TermWarning]:
    """What may be wrong with the last matches at the estimate."""
    warnings = wide_uncertainty(matches, values, covariance, config.last_px)
    left_ms = 1e3 * max((each.left_interval_s(values) for each in matches), default=0.0)
    if left_ms > 0.0:
        warnings.append(TermWarning(WarningKind.LEFT_INTERVAL, left_ms, 0.0, "ms"))
    interval_s = max((each.place.between.seconds for each in matches if each.place is not None), default=0.0)
    if interval_s > LONGEST_INTERVAL_S:
        detail = "add poses by odometry between the keys"
        warnings.append(TermWarning(WarningKind.LONG_INTERVAL, interval_s, LONGEST_INTERVAL_S, "s", detail))
    without = sum(each.factor is None for each in matches)
    if without > 0.5 * len(matches):
        warnings.append(TermWarning(WarningKind.NO_MATCHES, without, 0.5 * len(matches), "terms"))
    return warnings

"""The calibration of one vehicle over its drives: a random walk, on extrinsic and time offset, with steps.

Every drive k has an extrinsic E(k) and a time offset D(k), and on them the marginal of its result as one
factor (:func:`sst_graph.export.marginal_of_result`). Consecutive drives are tied by random walks
(:func:`sst_graph.factors.extrinsic_drift`, :func:`sst_graph.factors.time_offset_drift`) over the days
between them. Where a step is, that tie is left out. The chain is solved by eliminating each drive's variables
in turn, once forward and once back: the two marginals at a drive together are the smoothed one, and each
alone is what a step is tested with. What the drives have in common (the assumptions about their sensors) is
carried along apart from their own errors, with the same weights.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import gtsam
import numpy as np

from sst_graph.config import Settings, setting
from sst_graph.export import EXTRINSIC, TIME_OFFSET, CalibrationMarginal, marginal_of_graph
from sst_graph.factors import extrinsic_drift, time_offset_drift
from sst_graph.marginal import Separated, separated
from sst_graph.types import Calibration, FloatArray

_DAY_S = 86400.0
_LEAST_DAYS = 1.0 / 24.0
"""Drives of one date, or of one hour, count as an hour apart."""


@dataclass(frozen=True)
class WalkConfig(Settings):
    """How fast a calibration may change between drives without that being a step.

    Attributes:
        rotation_deg: standard deviation of the rotation about each axis after one day [deg].
        translation_m: of the translation along each axis after one day [m].
        time_offset_s: of the time offset after one day [s].
        false_alarm_rate: probability that anything is named of a vehicle whose calibration only walks.
    """

    rotation_deg: float = setting(0.005, at_least=1e-4, at_most=10.0)
    translation_m: float = setting(0.0005, at_least=1e-5, at_most=10.0)
    time_offset_s: float = setting(0.0001, at_least=1e-6, at_most=10.0)
    false_alarm_rate: float = setting(1e-3, at_least=1e-9, at_most=0.5)


@dataclass(frozen=True, eq=False)
class DriveEstimate:
    """What one drive says of its vehicle's calibration.

    Attributes:
        name: of the drive.
        day: when it was driven, in days from any fixed day.
        marginal: of its result.
    """

    name: str
    day: float
    marginal: CalibrationMarginal


@dataclass(frozen=True, eq=False)
class Smoothed(Calibration):
    """The calibration at one drive, by all drives of its stretch.

    Attributes:
        covariance: (7, 7) right perturbation, order of the conventions: that of differences from drive to
            drive, without what all drives have in common.
        common: (7, 7) covariance by that.
    """

    covariance: FloatArray = field(kw_only=True)
    common: FloatArray = field(default_factory=lambda: np.zeros((7, 7)))


def smoothed(drives: Sequence[DriveEstimate], steps: Collection[int], config: WalkConfig) -> list[Smoothed]:
    """The calibration at every drive, by all drives of its stretch.

    Args:
        drives: in the order of their days.
        steps: k for a step between drive k - 1 and drive k.

    Raises:
        EstimationError: a direction that no drive determines.
    """
    both_ways = passes(drives, steps, config)
    found = []
    for upto, after in zip(both_ways.upto, both_ways.after, strict=True):
        both = upto if after is None else upto.plus(after)
        own, common = both.own.covariance(), both.common_covariance()
        found.append(Smoothed(**vars(both.own.best()), covariance=own, common=common))
    return found


@dataclass(frozen=True, eq=False)
class Passes:
    """What the drives before each drive, and those after it, say of the calibration at that drive.

    Attributes:
        before: for each drive, the earlier ones of its stretch, walked up to it; None where there is none.
        after: for each drive, the later ones of its stretch, walked back to it; None where there is none.
        upto: for each drive, itself with ``before``; since: itself with ``after``.
    """

    before: list[Separated | None]
    after: list[Separated | None]
    upto: list[Separated]
    since: list[Separated]


def passes(drives: Sequence[DriveEstimate], steps: Collection[int], config: WalkConfig) -> Passes:
    """One pass forward over the drives and one back, each drive's variables eliminated as it goes."""
    parts = [separated(drive.marginal) for drive in drives]
    days = [abs(k.day - j.day) for j, k in pairwise(drives)]
    before, upto = _one_pass(parts, days, steps, config)
    mirrored = [len(drives) - k for k in steps]
    after, since = _one_pass(parts[::-1], days[::-1], mirrored, config)
    return Passes(before, after[::-1], upto, since[::-1])


def _one_pass(
    parts: Sequence[Separated], days: Sequence[float], steps: Collection[int], config: WalkConfig
) -> tuple[list[Separated | None], list[Separated]]:
    """Before each drive, and with it; days: from each to the next."""
    predictions: list[Separated | None] = []
    together: list[Separated] = []
    for k, part in enumerate(parts):
        prediction = None
        if k and k not in steps:
            last = together[-1]
            prediction = Separated(walked(last.own, days[k - 1], config), last.errors)
        both = part if prediction is None else prediction.plus(part)
        predictions.append(prediction)
        together.append(both.carried(both.own.best()))
    return predictions, together


def walked(marginal: CalibrationMarginal, days: float, config: WalkConfig) -> CalibrationMarginal:
    """What a marginal says after a random walk of so many days."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(marginal.factor(_E(0), _D(0)))
    for factor in _walk(days, config):
        graph.add(factor)
    cTl, time_offset_s = marginal.best()
    for k in (0, 1):
        values.insert(_E(k), cTl)
        values.insert(_D(k), np.array([time_offset_s]))
    return marginal_of_graph(graph, values, _E(1), _D(1))


def _walk(days: float, config: WalkConfig) -> tuple[gtsam.BetweenFactorPose3, gtsam.NoiseModelFactor]:
    """The ties between two drives."""
    seconds, root = max(days, _LEAST_DAYS) * _DAY_S, np.sqrt(_DAY_S)
    rotation, translation = np.radians(config.rotation_deg) / root, config.translation_m / root
    return (
        extrinsic_drift(_E(0), _E(1), seconds, rotation, translation),
        time_offset_drift(_D(0), _D(1), seconds, config.time_offset_s / root),
    )


def _E(k: int) -> int:
    return EXTRINSIC + k


def _D(k: int) -> int:
    return TIME_OFFSET + k

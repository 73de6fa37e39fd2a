"""Covariance of the motion between a scan without neighbours and its image.

A single scan has no odometry, so the vehicle is assumed to stand at it, and no residual shows otherwise: the
whole of speed times interval goes into the estimate. The interval is known as well as the time offset, so the
error is a product of two unknowns, which does not show in a linearization about standstill.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sst_graph.config import Settings, setting
from sst_graph.graph.matching import PairMatches
from sst_graph.graph.state import State
from sst_graph.types import FloatArray


@dataclass(frozen=True)
class UnknownMotionConfig(Settings):
    """Deviations of the motion of a vehicle of which there is a single scan; both 0 where it stood."""

    speed_mps: float = setting(
        10.0,
        at_least=0.0,
        at_most=200.0,
        doc="Deviation of the speed along each axis where a single scan leaves it unknown. 0 where "
        "the vehicle stood.",
    )
    turn_deg_per_s: float = setting(
        6.0,
        at_least=0.0,
        at_most=360.0,
        doc="Deviation of the turn rate about each axis where a single scan leaves it unknown. 0 "
        "where the vehicle stood.",
    )


def unknown_motion_covariance(
    pairs: Sequence[PairMatches], state: State, variance_s2: float, config: UnknownMotionConfig
) -> FloatArray:
    """(7, 7) covariance of extrinsic and offset by unmeasured motion, to be added to that of the matches.

    In the LiDAR's frame the scan is displaced by ``twist * interval``: a step of the
    extrinsic's tangent (right perturbation: rotation [rad], translation [m]) of this variance.

    Args:
        pairs: matches of an estimate.
        state: the estimate, for its time offsets.
        variance_s2: of the time offset [s^2].
    """
    covariance = np.zeros((7, 7))
    alone = [pair for pair in pairs if pair.l_twist is None]
    if not alone:
        return covariance
    share = sum(len(pair) for pair in alone) / sum(len(pair) for pair in pairs)
    intervals = [pair.pair.base_tau_s + state.time_offset_s(pair.drive) for pair in alone]
    square_s2 = variance_s2 + float(np.square(intervals).max())
    rates = np.repeat([np.radians(config.turn_deg_per_s), config.speed_mps], 3)
    covariance[:6, :6] = np.diag((share * rates) ** 2 * square_s2)
    return covariance

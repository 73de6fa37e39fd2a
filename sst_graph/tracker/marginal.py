"""A tracker's estimate as a cost on (E, D), and what to add to an earlier one."""

from __future__ import annotations

from dataclasses import dataclass, replace

import gtsam
import numpy as np

from sst_graph.marginal import CalibrationMarginal


@dataclass(frozen=True, eq=False)
class TrackedMarginal(CalibrationMarginal):
    """A tracker's marginal.

    Attributes:
        start: number of the start that its estimate comes from; that of another start is of another
            calibration.
    """

    start: int = 0


def moved_to(whole: TrackedMarginal, previous: CalibrationMarginal) -> TrackedMarginal:
    """A marginal about its own optimum as the cost about another point that leads back to it exactly.

    With s = Log(T0^-1 T) from the other point T0 to the optimum T, and J the derivative of
    Log(T0^-1 T Exp(d)) at d = 0, information about T0 is J^-T L J^-1: the inverse of
    :func:`sst_graph.marginal.carried`.
    """
    step = previous.cTl.between(whole.cTl)
    xi = np.asarray(gtsam.Pose3.Logmap(step))
    back = np.eye(7)
    back[:6, :6] = np.linalg.inv(np.asarray(gtsam.Pose3.LogmapDerivative(xi)))
    shift = np.append(xi, whole.time_offset_s - previous.time_offset_s)
    information = back.T @ whole.information @ back
    information = 0.5 * (information + information.T)
    vector = information @ shift
    return replace(
        whole,
        cTl=previous.cTl,
        time_offset_s=previous.time_offset_s,
        information=information,
        vector=vector,
        constant=float(shift @ vector),
    )


def increment(whole: TrackedMarginal, previous: TrackedMarginal) -> TrackedMarginal:
    """What to add to a marginal to come to another, about the former's point.

    It may be negative in some direction: where later frames show that labels err more than they seemed to,
    the covariance grows. The sum is the tracker's own information. Without further frames only rounding is
    left, which need not be symmetric.
    """
    there = moved_to(whole, previous)
    more = there.information - previous.information
    return replace(
        there,
        information=0.5 * (more + more.T),
        vector=there.vector - previous.vector,
        constant=there.constant - previous.constant,
    )

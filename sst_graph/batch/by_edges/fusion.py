"""Two estimates of one calibration from different frames, as one.

Matches of one kind share errors that no single match shows: masks on one side of an object in all frames,
edges inside an object that draw its outline inwards. So the graph of both has a copy of extrinsic and time
offset for each kind, which its matches are on, and between the copy and the calibration a factor with the
covariance of what the kind's matches share beyond their own errors. The two kinds are of different frames,
and share no other variable: what each says of the calibration is one Gaussian, its estimate and whole
covariance, and the estimate of that graph is their product.

Camera and LiDAR are the same for both: a principal point that is off moves both alike, which no weighting
averages. With x_1 + K (x_2 - x_1) the estimate and X the covariance of the two by the assumptions, its
covariance (I - K) C_1 (I - K)' + K C_2 K' grows by (I - K) X K' and the transpose of that, and the covariance
of x_2 - x_1 shrinks by X + X'.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import gtsam
import numpy as np

from sst_graph.batch.method_estimate import MethodEstimate
from sst_graph.batch.motion_factor import UNLIKELY_CHI2
from sst_graph.covariance.shared_errors import by_common_errors
from sst_graph.graph.state import State, difference
from sst_graph.types import FloatArray


@dataclass(frozen=True)
class Fused:
    """The product of two Gaussians on extrinsic and time offset.

    Attributes:
        state: its mean.
        covariance: (7, 7) larger where the two differ by more than theirs allow.
        by_sweeps: (7, 7) part of it by sweeps that the scans leave undecided.
        step: (7,) from the first to the second.
        chi2: of 7, of that step under its covariance.
        assumption_steps: (7,) step by one deviation of each assumption, by name.
    """

    state: State
    covariance: FloatArray
    by_sweeps: FloatArray
    step: FloatArray
    chi2: float
    assumption_steps: Mapping[str, FloatArray]

    @classmethod
    def of(cls, first: MethodEstimate, second: MethodEstimate) -> Fused:
        """Of two estimates that share no match.

        Undecided sweeps move both at once. Their parts of the covariance are added once more, which is enough
        however the two correlate.
        """
        a = state_of(first)
        step = difference(a, state_of(second))
        total = first.covariance + second.covariance
        gain = np.asarray(np.linalg.solve(total, first.covariance).T)
        cross = by_common_errors(first.assumption_steps, second.assumption_steps)
        chi2 = float(step @ np.linalg.solve(total - cross - cross.T, step))
        moved, rest = gain @ step, np.eye(7) - gain
        covariance = rest @ first.covariance @ rest.T + gain @ second.covariance @ gain.T
        covariance += rest @ cross @ gain.T + gain @ cross.T @ rest.T
        by_sweeps = rest @ first.by_sweeps @ rest.T + gain @ second.by_sweeps @ gain.T
        covariance += by_sweeps
        if chi2 > UNLIKELY_CHI2:
            covariance *= chi2 / 7.0
        covariance = 0.5 * (covariance + covariance.T)
        none, known = np.zeros(7), (first.assumption_steps, second.assumption_steps)
        steps = {
            name: rest @ known[0].get(name, none) + gain @ known[1].get(name, none)
            for name in dict.fromkeys((*known[0], *known[1]))
        }
        return cls(a.moved(moved), covariance, 2.0 * by_sweeps, step, chi2, steps)


def state_of(estimate: MethodEstimate) -> State:
    """Extrinsic and time offset of an estimate."""
    return State(gtsam.Pose3(estimate.cTl), (estimate.time_offset_s,))

"""How well a running estimate is known."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sst_graph.covariance.considered import steps_by
from sst_graph.errors import EstimationError
from sst_graph.graph.linear import scaled_inverse
from sst_graph.tracker.monitor.alarm import Joint
from sst_graph.tracker.track_update import UNKNOWN_SIGMAS
from sst_graph.tracker.window.smoother import WindowSmoother

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Known:
    """Covariance of an estimate, and what stands behind it.

    Attributes:
        joint: cluster-robust covariance of all unknowns.
        inflation: how much larger it is than that of independent matches.
        by_static: (7, 7) covariance of extrinsic and offset by static objects alone; None where no
            object moves.
        steps: (7,) how extrinsic and offset follow each parameter that is held at 0, by name.
    """

    joint: Joint
    inflation: float = 1.0
    by_static: FloatArray | None = None
    steps: Mapping[str, FloatArray] = field(default_factory=dict)

    @classmethod
    def nothing(cls) -> Known:
        """Before there is an estimate."""
        return cls(Joint(np.diag(np.square(UNKNOWN_SIGMAS)), (), len(UNKNOWN_SIGMAS)))

    @classmethod
    def of(cls, smoother: WindowSmoother) -> Known:
        """Of a smoother's estimate.

        Raises:
            EstimationError: it has no covariance.
        """
        information = smoother.information()
        matrix, naive = smoother.covariance(information)
        if not (np.isfinite(matrix).all() and (np.diag(matrix) > 0.0).all()):
            raise EstimationError("a covariance that is not finite")
        m = smoother.past.point.core_size
        share = np.trace(np.linalg.solve(naive[:m, :m], matrix[:m, :m])) / m
        inflation = max(1.0, float(share))
        by_static = None
        alone = smoother.static_information()
        if alone is not None:
            wider = scaled_inverse(alone)[:7, :7] - naive[:7, :7]
            by_static = matrix[:7, :7] + inflation * wider
        steps = steps_by(smoother.held_names, naive, information[: len(naive), len(naive) :], 7)
        return cls(Joint(matrix, smoother.past.point.tracks, m), inflation, by_static, steps)

    @property
    def covariance(self) -> FloatArray:
        """(m, m) covariance of extrinsic, offset, mask biases and estimated parameters."""
        m = self.joint.core_size
        return self.joint.matrix[:m, :m]

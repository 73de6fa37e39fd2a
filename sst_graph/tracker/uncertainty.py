"""Covariance of a running estimate."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from sst_graph.batch.by_edges.positions import POSITIONS
from sst_graph.batch.method_estimate import UNKNOWN_SIGMAS
from sst_graph.covariance.considered import steps_by
from sst_graph.covariance.image_shifts import ImageShifts
from sst_graph.errors import EstimationError
from sst_graph.graph.linear import scaled_inverse
from sst_graph.tracker.monitor.statistic import ComparedEstimate, EstimateCovariance
from sst_graph.tracker.sums.held import EDGE_ERRORS, SHIFTS
from sst_graph.tracker.sums.running_sums import RunningSums
from sst_graph.tracker.window.smoother import WindowSmoother
from sst_graph.types import FloatArray


@dataclass(frozen=True)
class Uncertainty:
    """Covariance of an estimate, and its parts.

    Attributes:
        joint: cluster-robust covariance of all unknowns, with what shifts of pictures and stamps add.
        inflation: how much larger the cluster-robust covariance is than that of independent matches.
        by_static_objects: (7, 7) covariance of extrinsic and offset by static objects alone; None where no
            object moves.
        steps: (7,) derivative of extrinsic and offset by each parameter of an assumption that is held at 0,
            by name.
        edge_steps: (k, 7) step of extrinsic and offset by one deviation of where edges lie between the beams.
        edge_share: (7, k) how extrinsic and offset follow a shift of them as all edges see it; k is 7, or 0
            without edges.
        shifts: how pictures and stamps shift from image to image, and what of the covariance of extrinsic and
            offset it is.
    """

    joint: EstimateCovariance
    inflation: float = 1.0
    by_static_objects: FloatArray | None = None
    steps: Mapping[str, FloatArray] = field(default_factory=dict)
    edge_steps: FloatArray = field(default_factory=lambda: np.zeros((0, 7)))
    edge_share: FloatArray = field(default_factory=lambda: np.zeros((7, 0)))
    shifts: ImageShifts = field(default_factory=ImageShifts.none)

    @classmethod
    def nothing(cls) -> Uncertainty:
        """Before there is an estimate."""
        return cls(EstimateCovariance(np.diag(np.square(UNKNOWN_SIGMAS)), (), len(UNKNOWN_SIGMAS)))

    @classmethod
    def of(cls, smoother: WindowSmoother) -> Uncertainty:
        """The uncertainty of a smoother's estimate.

        Raises:
            EstimationError: it has no covariance.
        """
        information, sums = smoother.information(), smoother.sums_on_last_epoch()
        matrix, naive = smoother.covariance(information, sums)
        if not (np.isfinite(matrix).all() and (np.diag(matrix) > 0.0).all()):
            raise EstimationError("a covariance that is not finite")
        m = smoother.past.point.core_size
        share = np.trace(np.linalg.solve(naive[:m, :m], matrix[:m, :m])) / m
        inflation = max(1.0, float(share))
        by_static_objects = None
        static = smoother.static_information()
        if static is not None:
            wider = scaled_inverse(static)[:7, :7] - naive[:7, :7]
            by_static_objects = matrix[:7, :7] + inflation * wider
        held = steps_by(smoother.held_names, naive, information[: len(naive), len(naive) :], 7)
        steps = {name: step for name, step in held.items() if name not in EDGE_ERRORS}
        positions = np.array([held[name] for name in POSITIONS if name in held]).reshape(-1, 7)
        share = np.array([-held[name] for name in SHIFTS if name in held]).reshape(-1, 7).T
        shifts, by_shifts = _shifts(sums, naive)
        joint = EstimateCovariance(matrix + by_shifts, smoother.past.point.tracks, m)
        return cls(joint, inflation, by_static_objects, steps, positions, share, shifts)

    def compared(self, smoother: WindowSmoother, variance_ratio: float) -> ComparedEstimate:
        """A smoother's estimate with this covariance, for the comparison of frames with it."""
        scans = tuple(smoother.entries)
        return ComparedEstimate(smoother.point, self.joint, smoother.model, scans, variance_ratio)

    @property
    def covariance(self) -> FloatArray:
        """(m, m) covariance of extrinsic, offset, mask biases and estimated parameters."""
        m = self.joint.core_size
        return self.joint.matrix[:m, :m]


def _shifts(sums: RunningSums, naive: FloatArray) -> tuple[ImageShifts, FloatArray]:
    """Shifts of pictures and stamps from image to image, and (n, n) what they add to the covariance.

    Args:
        naive: (n, n) covariance of independent matches.
    """
    n = len(naive)
    parts = naive @ sums.shift_excess[:, :n, :n] @ naive
    return ImageShifts(np.sqrt(sums.shift_variances), parts[:, :7, :7]), np.asarray(parts.sum(axis=0))

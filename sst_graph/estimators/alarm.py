"""Has the calibration changed? Chi-square of new frames against what all before them say."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sst_graph.estimators.scores import PairScore
from sst_graph.estimators.tracker_config import AlarmConfig
from sst_graph.uncertainty.covariance import ErrorModel

FloatArray = NDArray[np.float64]

_LEAST_INFORMATION = 1.0
"""Frames that tell a direction worse than 1 rad, m, s or px tell nothing: at standstill the offset's score is
rounding over rounding."""


class StepAlarm:
    """The score of the last few new frames at the estimate made before them.

    Where nothing changed, the gradient g of their cost at the estimate is zero-mean with variance
    M + H P H (M: of the matches, cluster-robust; P: of the estimate), whatever the frames can tell, so

        T = g' (M + H P H)^-1 g

    follows chi-square over the unknowns. Its usual size on this data is learnt and divided out, where it is
    more than the model says.
    """

    def __init__(self, config: AlarmConfig) -> None:
        self.config = config
        self.recent: deque[PairScore] = deque(maxlen=config.frames)
        self.usual: deque[float] = deque(maxlen=config.baseline)
        self.raised = 0
        self.quiet = 0

    def restart(self) -> None:
        """Forget the frames, not their usual size: a new calibration begins."""
        self.recent.clear()
        self.raised = 0
        self.quiet = 0

    def check(self, scores: Sequence[PairScore], covariance: FloatArray, model: ErrorModel) -> float | None:
        """The statistic with new frames' scores, over its usual size; None while it can't be told."""
        self.recent.extend(scores)
        if not scores or len(self.recent) < self.config.frames:
            return None
        statistic = chi_square(list(self.recent), covariance, model)
        scale = self._scale(len(covariance))
        value = statistic / scale
        self.quiet += 1
        if value > self.config.chi2:
            self.raised += 1
        else:
            self.raised = 0
            self.usual.append(statistic)
        return value

    @property
    def alarm(self) -> bool:
        """Past the threshold often enough in a row."""
        config = self.config
        return self.quiet > config.warm_up and self.raised >= config.confirmations

    def _scale(self, freedom: int) -> float:
        """How much larger than chi-square's the usual statistic is, at its 90th percentile; at least 1."""
        if len(self.usual) < 10:
            return 1.0
        expected = freedom + 1.28 * float(np.sqrt(2.0 * freedom))
        return max(1.0, float(np.quantile(self.usual, 0.9)) / expected)


def chi_square(scores: Sequence[PairScore], covariance: FloatArray, model: ErrorModel) -> float:
    """T of the new frames, see :class:`StepAlarm`."""
    n = len(covariance)
    H, g, M = np.zeros((n, n)), np.zeros(n), np.zeros((n, n))
    by_side: dict[int, FloatArray] = {}
    for score in scores:
        H += score.belief.information
        g += score.belief.vector
        M += max(1.0, model.match) * score.JJ
        rows = score.sides.scores
        M += model.side_frame * (rows.T @ rows)
        for side, row in zip(score.sides.sides.tolist(), rows, strict=True):
            by_side[side] = by_side[side] + row if side in by_side else row
    if by_side:
        rows = np.stack(list(by_side.values()))
        M += model.side * (rows.T @ rows)
    variance = M + H @ covariance @ H + _LEAST_INFORMATION * np.eye(n)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(variance), 1e-30))
    scaled = variance * np.outer(scale, scale) + 1e-9 * np.eye(n)
    return float((scale * g) @ np.linalg.solve(scaled, scale * g))

"""Has the calibration changed? Chi-square of new frames against what all before them say."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sst_graph.covariance.error_model import ErrorModel
from sst_graph.covariance.sums import total
from sst_graph.tracker.config import AlarmConfig
from sst_graph.tracker.sums.linearized_pair import LinearizedPair

FloatArray = NDArray[np.float64]

_LEAST_INFORMATION = 1.0
"""Frames that tell a direction worse than 1 rad, m, s or px tell nothing: at standstill the offset's score is
rounding over rounding."""


@dataclass(frozen=True)
class Joint:
    """Covariance of the estimate.

    Attributes:
        matrix: (n, n) over [extrinsic, offset, biases, object biases].
        tracks: of the objects.
        core_size: unknowns before the objects' biases.
    """

    matrix: FloatArray
    tracks: tuple[int, ...]
    core_size: int

    def seeing(self, places: Mapping[int, int], sigma_px: float) -> FloatArray:
        """(m, m) covariance of [extrinsic, offset, biases, and some objects' biases].

        Args:
            places: place of its class's bias by the object's track; the bias of an object that is not known
                yet is its class's, give or take ``sigma_px``.
        """
        source, extra = list(range(self.core_size)), [0.0] * self.core_size
        for track, place in places.items():
            known = track in self.tracks
            source.append(self.core_size + self.tracks.index(track) if known else 7 + place)
            extra.append(0.0 if known else sigma_px**2)
        return np.asarray(self.matrix[np.ix_(source, source)] + np.diag(extra))


class StepAlarm:
    """The score of the last few new frames at the estimate made before them.

    Where nothing changed, the gradient g of their cost by extrinsic, offset and biases at the estimate is
    zero-mean with variance M + H P H' (M: of the matches, cluster-robust; P: of the estimate, the objects'
    biases included; H: how g depends on it), whatever the frames can tell, so

        T = g' (M + H P H')^-1 g

    follows chi-square over the unknowns. Its usual size on this data is learnt and divided out, where it is
    more than the model says.

    Attributes:
        compared: the latest frames that were checked, against the estimate before them.
    """

    def __init__(self, config: AlarmConfig, object_sigma_px: float = 0.0) -> None:
        """object_sigma_px: deviation of a new object's mask bias from its class's [px]."""
        self.config = config
        self.object_sigma_px = object_sigma_px
        self.recent: deque[LinearizedPair] = deque(maxlen=config.frames)
        self.usual: deque[float] = deque(maxlen=config.baseline)
        self.raised = 0
        self.compared: Comparison | None = None

    def restart(self) -> None:
        """Forget the frames, not their usual size: a new calibration begins."""
        self.recent.clear()
        self.compared = None
        self.raised = 0

    def check(self, scores: Sequence[LinearizedPair], joint: Joint, model: ErrorModel) -> float | None:
        """The statistic with new frames' scores, over its usual size; None while it can't be told."""
        self.recent.extend(scores)
        if not scores or len(self.recent) < self.config.frames:
            return None
        self.compared = self.compare(self.recent, joint, model)
        statistic = self.compared.chi2()
        value = statistic / self._scale(joint.core_size)
        if value > self.config.chi2:
            self.raised += 1
        else:
            self.raised = 0
            self.usual.append(statistic)
        return value

    def compare(self, scores: Collection[LinearizedPair], joint: Joint, model: ErrorModel) -> Comparison:
        """Any frames' scores against an estimate; nothing is learnt from it."""
        return Comparison.of(scores, joint, model, self.object_sigma_px)

    def value(self, compared: Comparison) -> float:
        """The statistic over its usual size."""
        return compared.chi2() / self._scale(len(compared.gradient))

    def shown(self, compared: Comparison, steps: FloatArray) -> NDArray[np.bool_]:
        """(k,) which steps (7, k) of extrinsic and offset would be past the threshold."""
        least = self.config.chi2 * self._scale(len(compared.gradient))
        return np.asarray(compared.chi2_of(steps) > least)

    @property
    def alarm(self) -> bool:
        """Past the threshold often enough in a row."""
        return self.raised >= self.config.confirmations

    def _scale(self, freedom: int) -> float:
        """How much larger than chi-square's the usual statistic is, at its 90th percentile; at least 1."""
        if len(self.usual) < 10:
            return 1.0
        expected = freedom + 1.28 * float(np.sqrt(2.0 * freedom))
        return max(1.0, float(np.quantile(self.usual, 0.9)) / expected)


@dataclass(frozen=True)
class Comparison:
    """What new frames say about an estimate that has not heard them.

    Attributes:
        gradient: (n,) of their cost by extrinsic, offset and biases, there.
        change: (n, m) how it depends on these and on the biases of the objects seen.
        noise: (n, n) its variance by the matches.
        known: (m, m) covariance of the estimate.
    """

    gradient: FloatArray
    change: FloatArray
    noise: FloatArray
    known: FloatArray

    @classmethod
    def of(
        cls, scores: Collection[LinearizedPair], joint: Joint, model: ErrorModel, object_sigma_px: float
    ) -> Comparison:
        """object_sigma_px: deviation of a new object's mask bias from its class's [px]."""
        n = joint.core_size
        places = {track: place for score in scores for track, place in score.places.items()}
        order = list(places)
        H, g = np.zeros((n, n + len(order))), np.zeros(n)
        for score in scores:
            own = [*range(n), *(n + order.index(track) for track in score.information.point.tracks)]
            H[:, own] += score.information.information[:n]
            g += score.information.vector[:n]
        core = [score.scores.columns(slice(n)) for score in scores]
        # Without biases of the objects, for these frames may be of few: no less than independent matches.
        least = replace(model, match=max(1.0, model.match))
        M = total(n, core, [np.arange(n)] * len(core)).variance(least)
        return cls(g, H, M + _LEAST_INFORMATION * np.eye(n), joint.seeing(places, object_sigma_px))

    def chi2(self) -> float:
        """T of the frames."""
        return _squared(self.gradient, self.noise + self.change @ self.known @ self.change.T)

    def chi2_of(self, steps: FloatArray) -> FloatArray:
        """(k,) T that steps (7, k) of extrinsic and offset would make, were the estimate exact."""
        biases = self.known.copy()
        biases[:7], biases[:, :7] = 0.0, 0.0
        variance = self.noise + self.change @ biases @ self.change.T
        return np.array([_squared(gradient, variance) for gradient in (self.change[:, :7] @ steps).T])


def _squared(gradient: FloatArray, variance: FloatArray) -> float:
    """g' V^-1 g, scaled so that units do not matter."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(variance), 1e-30))
    scaled = variance * np.outer(scale, scale) + 1e-9 * np.eye(len(scale))
    return float((scale * gradient) @ np.linalg.solve(scaled, scale * gradient))

"""Chi-squared of frames against an estimate that was made without them."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from sst_graph.covariance.error_model import ErrorModel
from sst_graph.covariance.sums import ScoreSums, total
from sst_graph.tracker.sums.linearized_pair import LinearizedPair
from sst_graph.tracker.window.gaussian import Point
from sst_graph.types import FloatArray

FRAMES = 4
"""New frames that are compared together: with fewer a turn hardly shows, with more the alarm is later."""
CONFIRMATIONS = 3
"""Frames in a row past the threshold that make a change certain."""
_LEAST_INFORMATION = 1.0
"""Added to the score's variance [1/rad^2, 1/m^2, 1/s^2, 1/px^2]: at standstill the score of the time offset
is a quotient of rounding errors, and frames that determine a direction worse than 1 rad, m, s or px do not
count."""
_USUAL_FRAMES = 300
"""Quiet frames from which the usual size of the statistic is taken: errors of real labels are larger than the
model's."""
_LEAST_USUAL_FRAMES = 10
"""Quiet frames before the statistic is scaled by its usual size."""


@dataclass(frozen=True)
class EstimateCovariance:
    """Covariance of the estimate.

    Attributes:
        matrix: (n, n) over [extrinsic, offset, biases, object biases].
        tracks: of the objects.
        core_size: unknowns before the objects' biases.
    """

    matrix: FloatArray
    tracks: tuple[int, ...]
    core_size: int

    def with_objects(self, places: Mapping[int, int], sigma_px: float) -> FloatArray:
        """(m, m) covariance of [extrinsic, offset, biases, and the biases of these objects].

        Args:
            places: place of its class's bias by the object's track.
            sigma_px: standard deviation of a new object's bias from its class's [px].
        """
        source, extra = list(range(self.core_size)), [0.0] * self.core_size
        for track, place in places.items():
            known = track in self.tracks
            source.append(self.core_size + self.tracks.index(track) if known else 7 + place)
            extra.append(0.0 if known else sigma_px**2)
        return np.asarray(self.matrix[np.ix_(source, source)] + np.diag(extra))


@dataclass(frozen=True)
class ComparedEstimate:
    """An estimate that frames are compared with.

    Attributes:
        point: the estimate.
        covariance: of it.
        model: variances of residuals, for the frames' scores.
        scans: numbers of the scans that it was made of.
        variance_ratio: how many times the variance of the scores is that of frozen matches: edges of pictures
            follow the pose, contours of masks do not.
        reported: (7, 7) covariance of extrinsic and time offset that is reported; None: as in ``covariance``.
    """

    point: Point
    covariance: EstimateCovariance
    model: ErrorModel
    scans: tuple[int, ...] = ()
    variance_ratio: float = 1.0
    reported: FloatArray | None = None


@dataclass(frozen=True)
class FrameScores:
    """Scores of frames at an estimate that was made without them.

    Where nothing has changed, the gradient g of the frames' cost is zero-mean with variance M + H P H', so

        T = g' (M + H P H')^-1 g

    follows chi-squared over the unknowns, however little the frames determine.

    Attributes:
        gradient: g (n,) by extrinsic, offset and biases, at the estimate.
        jacobian: H (n, m) of g by these and by the biases of the objects seen.
        noise: M (n, n) variance of g by the matches, cluster-robust.
        prior: P (m, m) covariance of the estimate.
        variance_ratio: of the estimate.
    """

    gradient: FloatArray
    jacobian: FloatArray
    noise: FloatArray
    prior: FloatArray
    variance_ratio: float

    def chi2(self) -> float:
        """T of the frames."""
        return _squared(self.gradient, self.noise + self.jacobian @ self.prior @ self.jacobian.T)

    def chi2_of(self, steps: FloatArray) -> FloatArray:
        """(k,) T that steps (7, k) of extrinsic and offset would make, were the estimate exact."""
        biases = self.prior.copy()
        biases[:7], biases[:, :7] = 0.0, 0.0
        variance = self.noise + self.jacobian @ biases @ self.jacobian.T
        return np.array([_squared(gradient, variance) for gradient in (self.jacobian[:, :7] @ steps).T])


@dataclass(frozen=True)
class ComparedScores:
    """The scores of k pairs, made ready for comparisons of parts of them with one estimate.

    Attributes:
        gradients, jacobians: (k, n), (k, n, m) of each pair, as of :class:`FrameScores`.
        sums: of each pair's scores, in the n unknowns.
        prior: P (m, m).
        model: variances of residuals.
        variance_ratio: of the estimate.
    """

    gradients: FloatArray
    jacobians: FloatArray
    sums: Sequence[ScoreSums]
    prior: FloatArray
    model: ErrorModel
    variance_ratio: float

    @classmethod
    def of(
        cls, scores: Collection[LinearizedPair], estimate: ComparedEstimate, object_sigma_px: float
    ) -> ComparedScores:
        """object_sigma_px: standard deviation of a new object's mask bias from its class's [px]."""
        covariance, model = estimate.covariance, estimate.model
        n = covariance.core_size
        places = {track: place for score in scores for track, place in score.places.items()}
        column = {track: n + k for k, track in enumerate(places)}
        H, g = np.zeros((len(scores), n, n + len(places))), np.zeros((len(scores), n))
        for k, score in enumerate(scores):
            own = [*range(n), *(column[track] for track in score.information.point.tracks)]
            H[k][:, own] = score.information.information[:n]
            g[k] = score.information.vector[:n]
        # A few frames do not determine the objects' biases; at least the variance of independent matches.
        least = replace(model, match=max(1.0, model.match))
        sums = [score.scores.columns(slice(n)) for score in scores]
        prior = covariance.with_objects(places, object_sigma_px)
        return cls(g, H, sums, prior, least, estimate.variance_ratio)

    def part(self, start: int, end: int) -> FrameScores:
        """The comparison of some of the pairs, one after the other."""
        n, sums = self.gradients.shape[1], self.sums[start:end]
        noise = total(n, sums, [np.arange(n)] * len(sums)).variance(self.model)
        noise = noise + _LEAST_INFORMATION * np.eye(n)
        gradient, jacobian = (each[start:end].sum(axis=0) for each in (self.gradients, self.jacobians))
        return FrameScores(gradient, jacobian, noise, self.prior, self.variance_ratio)


class ChangeStatistic:
    """T of the latest frames, divided by its usual size on these data.

    Attributes:
        threshold: beyond it, frames contradict the estimate.
        object_sigma_px: standard deviation of a new object's mask bias from its class's [px].
        recent: scores of the latest frames.
        usual: T of earlier quiet frames.
        exceeded: frames in a row past the threshold.
        newest: the statistic of the newest frame alone: the first one after a step hardly shows it together
            with those before it.
        latest: the latest comparison; None before one.
    """

    def __init__(self, threshold: float, object_sigma_px: float = 0.0) -> None:
        self.threshold, self.object_sigma_px = threshold, object_sigma_px
        self.recent: deque[LinearizedPair] = deque(maxlen=FRAMES)
        self.usual: deque[float] = deque(maxlen=_USUAL_FRAMES)
        self.exceeded, self.newest = 0, 0.0
        self.latest: FrameScores | None = None

    def restart(self) -> None:
        """Forget the frames, not their usual size: a new calibration begins."""
        self.recent.clear()
        self.latest = None
        self.exceeded, self.newest = 0, 0.0

    def add(self, scores: Sequence[LinearizedPair], estimate: ComparedEstimate) -> float | None:
        """The statistic with new frames' scores; None while there are too few."""
        self.recent.extend(scores)
        if not scores or len(self.recent) < FRAMES:
            return None
        compared, count = ComparedScores.of(self.recent, estimate, self.object_sigma_px), len(self.recent)
        self.latest = compared.part(0, count)
        self.newest = self.normalized(compared.part(max(0, count - len(scores)), count))
        T = self.latest.chi2()
        value = T / self._scale(self.latest)
        if value > self.threshold:
            self.exceeded += 1
        else:
            self.exceeded = 0
            self.usual.append(T)
        return value

    def compare(self, scores: Collection[LinearizedPair], estimate: ComparedEstimate) -> FrameScores:
        """Scores of any frames against an estimate."""
        return ComparedScores.of(scores, estimate, self.object_sigma_px).part(0, len(scores))

    def largest_of_parts(
        self,
        scores: Sequence[LinearizedPair],
        parts: Collection[tuple[int, int]],
        estimate: ComparedEstimate,
    ) -> tuple[float, tuple[int, int]]:
        """Largest :meth:`normalized` statistic of parts (start, end) of the scores, and which part has it; 0
        and (0, 0) without any."""
        compared = ComparedScores.of(scores, estimate, self.object_sigma_px)
        values = {(a, b): self.normalized(compared.part(a, b)) for a, b in parts if b > a}
        largest = max(values, key=values.__getitem__, default=(0, 0))
        return values.get(largest, 0.0), largest

    def normalized(self, comparison: FrameScores) -> float:
        """T over its usual size."""
        return comparison.chi2() / self._scale(comparison)

    def detectable(self, comparison: FrameScores, steps: FloatArray) -> NDArray[np.bool_]:
        """(k,) which steps (7, k) of extrinsic and offset would be past the threshold.

        Matches that follow the pose show a step by so many times less than frozen ones.
        """
        shown = comparison.chi2_of(steps) / comparison.variance_ratio
        return np.asarray(shown > self.threshold * self._usual_scale(comparison))

    @property
    def contradicted(self) -> bool:
        """Whether the newest frame alone, or the latest ones twice in a row, are past the threshold."""
        return self.exceeded > 1 or self.newest > self.threshold

    @property
    def confirmed(self) -> bool:
        """Past the threshold often enough in a row."""
        return self.exceeded >= CONFIRMATIONS

    def _scale(self, comparison: FrameScores) -> float:
        """How much larger than chi-squared T is; before that is known, the variance ratio bounds it."""
        if len(self.usual) < _LEAST_USUAL_FRAMES:
            return comparison.variance_ratio
        return self._usual_scale(comparison)

    def _usual_scale(self, comparison: FrameScores) -> float:
        """How much larger than chi-squared's the usual 90th percentile is; 1 where that is not known."""
        if len(self.usual) < _LEAST_USUAL_FRAMES:
            return 1.0
        freedom = len(comparison.gradient)
        expected = freedom + 1.28 * float(np.sqrt(2.0 * freedom))
        return max(1.0, _ninetieth(tuple(self.usual)) / expected)


@lru_cache(maxsize=1)
def _ninetieth(values: tuple[float, ...]) -> float:
    """Their 90th percentile; cached, for a frame is compared several times."""
    return float(np.quantile(values, 0.9))


def _squared(gradient: FloatArray, variance: FloatArray) -> float:
    """g' V^-1 g, scaled so that units do not matter."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(variance), 1e-30))
    scaled = variance * np.outer(scale, scale) + 1e-9 * np.eye(len(scale))
    return float((scale * gradient) @ np.linalg.solve(scaled, scale * gradient))

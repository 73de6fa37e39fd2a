"""iSAM2 over a window of pairs whose matches are renewed; what leaves it stays as one linear factor."""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from dataclasses import replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.errors import EstimationError
from sst_graph.estimators.change import Change, TwistFactor, read_point
from sst_graph.estimators.epochs import Entry, Epoch, EpochSums, Found, RetiredEpoch
from sst_graph.estimators.gaussian import Gaussian, Point, insert_point, scaled_inverse
from sst_graph.estimators.score_sums import ScoreSums
from sst_graph.estimators.tracker_config import DriftConfig
from sst_graph.estimators.undecided import Undecided
from sst_graph.problem.graph import GraphConfig
from sst_graph.problem.state import bias_key, delay_key, object_bias_key, underside_track
from sst_graph.types import SemanticClass
from sst_graph.uncertainty.covariance import ErrorModel
from sst_graph.uncertainty.object_spread import composed

FloatArray = NDArray[np.float64]

_RELINEARIZE = {
    "E": np.repeat([2e-4, 1e-3], 3),
    "D": np.array([5e-4]),
    "B": np.array([0.02]),
    "O": np.array([0.1]),
    "V": np.repeat([0.005, 0.03], 3),
}
"""Steps beyond these [rad, m], [s], [px], [rad/s, m/s] are relinearized: far below what a frame tells."""


def _parameters() -> gtsam.ISAM2Params:
    params = gtsam.ISAM2Params()
    thresholds = gtsam.ISAM2ThresholdMap()
    for name, steps in _RELINEARIZE.items():
        thresholds.insert((name, steps))
    params.setRelinearizeThreshold(thresholds)
    params.relinearizeSkip = 1
    params.findUnusedFactorSlots = True
    return params


class WindowSmoother:
    """The graph of the window; every update happens whole or not at all."""

    def __init__(
        self,
        past: Gaussian,
        start_ns: int,
        classes: Sequence[SemanticClass],
        graph: GraphConfig,
        drift: DriftConfig,
        sums: ScoreSums | None = None,
        model: ErrorModel | None = None,
        prior: Gaussian | None = None,
        bent: Gaussian | None = None,
    ) -> None:
        """past: prior, or what an earlier run left behind (with sums, error model, prior, bent past)."""
        self.classes, self.graph, self.drift = tuple(classes), graph, drift
        self.past, self.bent = past, bent or past
        self.undecided = Undecided.none(past.point.size)
        self.prior = prior or past
        self.sums = sums or ScoreSums.empty(past.point.size)
        self.entries: dict[int, Entry] = {}
        self.model = model or ErrorModel(0.0, 0.0, 1.0)
        self.retired: list[RetiredEpoch] = []
        self._epochs: tuple[Epoch, ...] = (Epoch(0, start_ns),)
        self.ids: dict[int, int] = {}
        self.twists: dict[int, TwistFactor] = {}
        self.isam, self.past_id = self._begun()
        self._point = self.bent.mean()
        self.epoch_sums = EpochSums.empty(past.point)

    @property
    def point(self) -> Point:
        """The present estimate (of the last epoch)."""
        return self._point

    @property
    def epochs(self) -> tuple[Epoch, ...]:
        """Epochs whose calibration is still a variable, oldest first."""
        return self._epochs

    @property
    def matches(self) -> int:
        """Matches of the window."""
        return sum(entry.score.matches for entry in self.entries.values())

    def keys(self, epoch: int, tracks: Sequence[int] = ()) -> list[int]:
        """Keys of [E, D, biases..., biases of some objects...] of an epoch."""
        biases = [bias_key(0, c) for c in self.classes]
        biases += [object_bias_key(0, underside_track(c)) for c in self.classes]
        objects = [object_bias_key(0, track) for track in tracks]
        return [int(gtsam.symbol("E", epoch)), delay_key(epoch), *biases, *objects]

    def _begun(self) -> tuple[gtsam.ISAM2, int]:
        isam, graph, values = gtsam.ISAM2(_parameters()), gtsam.NonlinearFactorGraph(), gtsam.Values()
        keys = self.keys(self._epochs[0].number, self.past.point.tracks)
        graph.add(self.bent.factor(keys))
        insert_point(values, keys, self.bent.mean())
        result = isam.update(graph, values)
        return isam, int(result.getNewFactorsIndices()[0])

    def update(
        self,
        found: Mapping[int, Found],
        dropped: set[int],
        first_scan: int,
        alive: Container[int] = (),
    ) -> None:
        """Renew or add pairs, retire those before ``first_scan``.

        Args:
            found: new matches by scan.
            dropped: scans that no longer have a match and leave without a trace.
            first_scan: the window's first scan.
            alive: tracks of objects that may be seen again; the biases of all others are marginalized out
                as soon as no pair of the window sees them.

        Raises:
            EstimationError: the update fails or gives numbers that are not finite; nothing has changed.
        """
        change = Change(self, found, dropped, first_scan, alive)
        try:
            change.apply()
        except (RuntimeError, ValueError, np.linalg.LinAlgError) as error:
            raise EstimationError(f"the update failed: {' '.join(str(error).split())[:200]}") from error
        self._take(change)

    def _take(self, change: Change) -> None:
        self.isam, self.past_id, self._epochs = change.isam, change.past_id, change.epochs
        self.ids, self.twists, self.entries = change.ids, change.twists, change.entries
        self.past, self.bent, self.sums = change.past, change.bent, change.sums
        self.undecided = change.undecided
        self.epoch_sums, self._point = change.epoch_sums, change.point
        self.retired += change.retired
        if self.entries or self.sums.recent:
            self.model = self.sums.error_model([entry.score for entry in self.entries.values()])

    def rest_at(self, point: Point) -> None:
        """Answer this estimate until the next update (that of a checkpoint).

        Matches made anew may see objects that it does not know: their biases stay.
        """
        own = zip(self._point.tracks, self._point.object_biases_px.tolist(), strict=True)
        for track, bias in own:
            if track not in point.tracks:
                point = point.with_object(track, bias)
        self._point = point

    def polish(self, iterations: int = 10) -> None:
        """Levenberg-Marquardt on the whole window, and a fresh iSAM2 linearized where it ends.

        Raises:
            EstimationError: it fails; nothing has changed.
        """
        graph, factors = gtsam.NonlinearFactorGraph(), self.isam.getFactorsUnsafe()
        order = [self.past_id]
        order += [index for epoch in self._epochs for index in epoch.links or ()]
        order += [*self.ids.values(), *(twist.index for twist in self.twists.values())]
        for index in order:
            graph.add(factors.at(index))
        params = gtsam.LevenbergMarquardtParams()
        params.setMaxIterations(iterations)
        params.setlambdaInitial(1e-6)
        params.setRelativeErrorTol(1e-9)
        try:
            values = gtsam.LevenbergMarquardtOptimizer(
                graph, self.isam.calculateEstimate(), params
            ).optimize()
            isam = gtsam.ISAM2(_parameters())
            new = dict(zip(order, isam.update(graph, values).getNewFactorsIndices(), strict=True))
            tracks = self.past.point.tracks
            point = read_point(isam, self.keys(self._epochs[-1].number, tracks), tracks)
        except (RuntimeError, ValueError) as error:
            raise EstimationError(f"the window's optimisation failed: {error}") from error
        self.isam, self.past_id, self._point = isam, new[self.past_id], point
        self.ids = {scan: new[index] for scan, index in self.ids.items()}
        self.twists = {image: replace(twist, index=new[twist.index]) for image, twist in self.twists.items()}
        self._epochs = tuple(
            replace(epoch, links=None if epoch.links is None else (new[epoch.links[0]], new[epoch.links[1]]))
            for epoch in self._epochs
        )

    def walk(self, seconds: float) -> FloatArray:
        """(m,) variances of the random walk of [extrinsic, offset, biases] over some seconds."""
        drift = self.drift
        rates = [np.radians(drift.rotation_deg)] * 3 + [drift.translation_m] * 3 + [drift.offset_s]
        return np.asarray(seconds * np.square([*rates, *[0.0] * len(self.prior.point.biases_px)]))

    def _information(self) -> FloatArray:
        """(n, n) of past and window together on the last epoch, matches taken as independent."""
        belief = self.past
        for i, epoch in enumerate(self._epochs):
            if i > 0:
                walk = self.walk(self._seconds(i))
                belief = belief.drifted(walk)
            seen = [e.score.belief for e in self.entries.values() if e.epoch == epoch.number]
            belief = replace(belief, information=belief.information_with(seen))
        return belief.information

    def _seconds(self, i: int) -> float:
        """From the start of epoch i - 1 to that of epoch i [s]."""
        return max(1e-3, (self._epochs[i].start_ns - self._epochs[i - 1].start_ns) * 1e-9)

    def covariance(self) -> tuple[FloatArray, FloatArray]:
        """(n, n) cluster-robust covariance of the unknowns of ``past``, and that of independent matches.

        Raises:
            EstimationError: a direction without any information.
        """
        information = self._information()
        try:
            naive = scaled_inverse(information)
        except np.linalg.LinAlgError as error:
            raise EstimationError(str(error)) from error
        point, scores = self.past.point, [entry.score for entry in self.entries.values()]
        columns = [point.columns(score.belief.point.tracks) for score in scores]
        robust = naive + naive @ self.sums.surplus(scores, columns, self.model) @ naive
        spread = None
        if not self.drift.enabled:
            found = [score.objects for score in scores if score.objects is not None]
            point_now = self.past.at(self._point).point
            spread = self.sums.objects.spread(found, naive, point_now)
        robust = composed(robust, spread, self.sums.flatness(scores))
        return 0.5 * (robust + robust.T), naive

    def live_epochs(self) -> list[RetiredEpoch]:
        """Epochs of the window, as if they retired now."""
        found = []
        for i, epoch in enumerate(self._epochs):
            sums = self.epoch_sums.copy() if i == 0 else EpochSums.empty(self.past.point)
            for scan, entry in self.entries.items():
                if entry.epoch == epoch.number:
                    sums.add(entry.score, scan, self.graph.object_bias_sigma_px)
            found.append(sums.retired(epoch.start_ns, self.model))
        return found

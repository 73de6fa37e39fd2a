"""iSAM2 over a window of pairs whose matches are renewed; what leaves it stays as one linear factor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from factors import delay_drift, extrinsic_drift
from sst_graph.errors import EstimationError
from sst_graph.estimators.epochs import Entry, Epoch, EpochSums, RetiredEpoch
from sst_graph.estimators.gaussian import Gaussian, Point, insert_point, scaled_inverse
from sst_graph.estimators.scores import PairScore, ScoreSums, pair_factors
from sst_graph.estimators.tracker_config import DriftConfig
from sst_graph.problem.graph import GraphConfig, PairMatches
from sst_graph.problem.state import bias_key, delay_key, twist_key
from sst_graph.types import SemanticClass
from sst_graph.uncertainty.covariance import ErrorModel

FloatArray = NDArray[np.float64]

_RELINEARIZE = {
    "E": np.repeat([2e-4, 1e-3], 3),
    "D": np.array([5e-4]),
    "B": np.array([0.02]),
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


def read_point(isam: gtsam.ISAM2, keys: Sequence[int]) -> Point:
    """The estimate under [E, D, biases...].

    Raises:
        ValueError: it is not finite.
    """
    cTl = isam.calculateEstimatePose3(keys[0])
    scalars = np.array([isam.calculateEstimateVector(key)[0] for key in keys[1:]])
    if not (np.isfinite(scalars).all() and np.isfinite(cTl.matrix()).all()):
        raise ValueError("an estimate that is not finite")
    return Point(cTl, float(scalars[0]), scalars[1:])


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
    ) -> None:
        """past: prior, or what an earlier run left behind (with its sums, error model and prior)."""
        self.classes, self.graph, self.drift = tuple(classes), graph, drift
        self.past = past
        self.prior = prior or past
        self.sums = sums or ScoreSums.empty(past.point.size)
        self.entries: dict[int, Entry] = {}
        self.model = model or ErrorModel(0.0, 0.0, 1.0)
        self.retired: list[RetiredEpoch] = []
        self._epochs: tuple[Epoch, ...] = (Epoch(0, start_ns),)
        self._ids: dict[int, tuple[int, int]] = {}
        self._isam, self._past_id = self._begun()
        self._point = past.mean()
        self._epoch_sums = EpochSums.empty(past.point)

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

    def keys(self, epoch: int) -> list[int]:
        """Keys of [E, D, biases...] of an epoch."""
        biases = [bias_key(0, c) for c in self.classes]
        return [int(gtsam.symbol("E", epoch)), delay_key(epoch), *biases]

    def _begun(self) -> tuple[gtsam.ISAM2, int]:
        isam, graph, values = gtsam.ISAM2(_parameters()), gtsam.NonlinearFactorGraph(), gtsam.Values()
        keys = self.keys(self._epochs[0].number)
        graph.add(self.past.factor(keys))
        insert_point(values, keys, self.past.mean())
        result = isam.update(graph, values)
        return isam, int(result.getNewFactorsIndices()[0])

    def update(
        self, found: Mapping[int, tuple[PairMatches, PairScore, int]], dropped: set[int], first_scan: int
    ) -> None:
        """Renew or add pairs, retire those before ``first_scan``.

        Args:
            found: by scan: its matches, their score, the scan's stamp [ns].
            dropped: scans that no longer have a match and leave without a trace.
            first_scan: the window's first scan.

        Raises:
            EstimationError: the update fails or gives numbers that are not finite; nothing has changed.
        """
        change = _Change(self, found, dropped, first_scan)
        try:
            change.apply()
        except (RuntimeError, ValueError, np.linalg.LinAlgError) as error:
            raise EstimationError(f"the update failed: {' '.join(str(error).split())[:200]}") from error
        self._take(change)

    def _take(self, change: _Change) -> None:
        self._isam, self._past_id, self._epochs = change.isam, change.past_id, change.epochs
        self._ids, self.entries = change.ids, change.entries
        self.past, self.sums = change.past, change.sums
        self._epoch_sums, self._point = change.epoch_sums, change.point
        self.retired += change.retired
        if self.entries or self.sums.recent:
            self.model = self.sums.error_model([entry.score for entry in self.entries.values()])

    def rest_at(self, point: Point) -> None:
        """Answer this estimate until the next update (that of a checkpoint)."""
        self._point = point

    def polish(self, iterations: int = 10) -> None:
        """Levenberg-Marquardt on the whole window, and a fresh iSAM2 linearized where it ends.

        Raises:
            EstimationError: it fails; nothing has changed.
        """
        graph, factors = gtsam.NonlinearFactorGraph(), self._isam.getFactorsUnsafe()
        order = [self._past_id]
        order += [index for epoch in self._epochs for index in epoch.links or ()]
        order += [index for pair in self._ids.values() for index in pair]
        for index in order:
            graph.add(factors.at(index))
        params = gtsam.LevenbergMarquardtParams()
        params.setMaxIterations(iterations)
        params.setlambdaInitial(1e-6)
        params.setRelativeErrorTol(1e-9)
        try:
            values = gtsam.LevenbergMarquardtOptimizer(
                graph, self._isam.calculateEstimate(), params
            ).optimize()
            isam = gtsam.ISAM2(_parameters())
            new = dict(zip(order, isam.update(graph, values).getNewFactorsIndices(), strict=True))
            point = read_point(isam, self.keys(self._epochs[-1].number))
        except (RuntimeError, ValueError) as error:
            raise EstimationError(f"the window's optimisation failed: {error}") from error
        self._isam, self._past_id, self._point = isam, new[self._past_id], point
        self._ids = {scan: (new[a], new[b]) for scan, (a, b) in self._ids.items()}
        self._epochs = tuple(
            replace(epoch, links=None if epoch.links is None else (new[epoch.links[0]], new[epoch.links[1]]))
            for epoch in self._epochs
        )

    def walk(self, seconds: float) -> FloatArray:
        """(n,) variances of the random walk over some seconds."""
        drift = self.drift
        rates = [np.radians(drift.rotation_deg)] * 3 + [drift.translation_m] * 3 + [drift.offset_s]
        return np.asarray(seconds * np.square([*rates, *[0.0] * len(self.classes)]))

    def belief(self) -> Gaussian:
        """What past and window say together about the last epoch, matches taken as independent."""
        belief = self.past
        for i, epoch in enumerate(self._epochs):
            if i > 0:
                belief = belief.drifted(self.walk(self._seconds(i)))
            for entry in self.entries.values():
                if entry.epoch == epoch.number:
                    belief = belief.plus(entry.score.belief)
        return belief

    def _seconds(self, i: int) -> float:
        """From the start of epoch i - 1 to that of epoch i [s]."""
        return max(1e-3, (self._epochs[i].start_ns - self._epochs[i - 1].start_ns) * 1e-9)

    def covariance(self) -> tuple[FloatArray, FloatArray]:
        """(n, n) cluster-robust covariance of the estimate, and the one of independent matches.

        Raises:
            EstimationError: a direction without any information.
        """
        try:
            naive = scaled_inverse(self.belief().information)
        except np.linalg.LinAlgError as error:
            raise EstimationError(str(error)) from error
        surplus = self.sums.surplus([entry.score for entry in self.entries.values()], self.model)
        robust = naive + naive @ surplus @ naive
        return 0.5 * (robust + robust.T), naive

    def live_epochs(self) -> list[RetiredEpoch]:
        """Epochs of the window, as if they retired now."""
        found = []
        for i, epoch in enumerate(self._epochs):
            sums = self._epoch_sums.copy() if i == 0 else EpochSums.empty(self.past.point)
            for scan, entry in self.entries.items():
                if entry.epoch == epoch.number:
                    sums.add(entry.score, scan)
            found.append(RetiredEpoch(epoch.start_ns, sums.belief, sums.surplus(self.model)))
        return found


class _Change:
    """One update, prepared on copies."""

    def __init__(
        self,
        smoother: WindowSmoother,
        found: Mapping[int, tuple[PairMatches, PairScore, int]],
        dropped: set[int],
        first_scan: int,
    ) -> None:
        self._smoother, self._found, self._dropped, self._first_scan = smoother, found, dropped, first_scan
        self.isam = gtsam.ISAM2(smoother._isam)
        self.entries, self.ids = dict(smoother.entries), dict(smoother._ids)
        self.past, self.past_id = smoother.past, smoother._past_id
        self.epochs = smoother.epochs
        self.epoch_sums = smoother._epoch_sums.copy()
        self.sums = smoother.sums.copy()
        self.retired: list[RetiredEpoch] = []
        self.point = smoother.point
        self._graph, self._values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self._remove: list[int] = []
        self._added: list[tuple[str, int]] = []

    def apply(self) -> None:
        """Prepare all changes, update the copy of iSAM2, read the estimate."""
        # 1. What goes, what comes again, what is new.
        self._retire()
        self._enter()
        self._close_epochs()
        if self.past is not self._smoother.past:
            self._replace_past()
        # 2. Everything at once.
        result = self.isam.update(self._graph, self._values, self._remove)
        self._number(list(result.getNewFactorsIndices()))
        # 3. The estimate, if it is one.
        keys = self._smoother.keys(self.epochs[-1].number)
        self.point = read_point(self.isam, keys)

    def _retire(self) -> None:
        for scan in sorted(scan for scan in self.entries if scan < self._first_scan):
            entry = self.entries.pop(scan)
            self._remove += self.ids.pop(scan)
            while entry.epoch > self.epochs[0].number:
                self._next_epoch()
            self.past = self.past.plus(entry.score.belief)
            self.sums.add(entry.score, scan)
            if self._smoother.drift.enabled:
                self.epoch_sums.add(entry.score, scan)
        for scan in self._dropped & set(self.entries):
            del self.entries[scan]
            self._remove += self.ids.pop(scan)

    def _enter(self) -> None:
        smoother = self._smoother
        for scan, (pair, score, stamp_ns) in sorted(self._found.items()):
            known = self.entries.get(scan)
            epoch = self._epoch_at(stamp_ns) if known is None else known.epoch
            if known is not None:
                self._remove += self.ids[scan]
            point = score.belief.point
            key = twist_key(0, scan)
            factors = pair_factors(
                pair, smoother.classes, smoother.keys(epoch), key, point.offset_s, point.cTl, smoother.graph
            )
            for factor in factors:
                self._add(factor, "pair", scan)
            if known is None:
                self._values.insert(key, pair.motion.c_twist)
            self.entries[scan] = Entry(pair, score, epoch)

    def _epoch_at(self, stamp_ns: int) -> int:
        """The epoch of a stamp; a new one where the last has lasted long enough."""
        smoother, last = self._smoother, self.epochs[-1]
        seconds = (stamp_ns - last.start_ns) * 1e-9
        if not smoother.drift.enabled or seconds < smoother.drift.epoch_s:
            for epoch in reversed(self.epochs):
                if stamp_ns >= epoch.start_ns:
                    return epoch.number
            return self.epochs[0].number
        number, drift = last.number + 1, smoother.drift
        a, b = smoother.keys(last.number), smoother.keys(number)
        rate = float(np.radians(drift.rotation_deg))
        self._add(extrinsic_drift(a[0], b[0], seconds, rate, drift.translation_m), "link", number)
        self._add(delay_drift(a[1], b[1], seconds, drift.offset_s), "link", -number)
        self._values.insert(b[0], smoother.point.cTl)
        self._values.insert(b[1], np.array([smoother.point.offset_s]))
        self.epochs = (*self.epochs, Epoch(number, stamp_ns))
        return number

    def _close_epochs(self) -> None:
        """Epochs that no pair of the window sees any more go into the past."""
        while len(self.epochs) > 1 and all(e.epoch > self.epochs[0].number for e in self.entries.values()):
            if self.epochs[1].links is None:
                break
            self._next_epoch()

    def _next_epoch(self) -> None:
        """The past moves on to the next epoch by the random walk."""
        smoother = self._smoother
        old, new = self.epochs[0], self.epochs[1]
        variances = smoother.walk(max(1e-3, (new.start_ns - old.start_ns) * 1e-9))
        surplus = self.epoch_sums.surplus(smoother.model)
        self.retired.append(RetiredEpoch(old.start_ns, self.epoch_sums.belief, surplus))
        self.epoch_sums = EpochSums.empty(self.past.point)
        self.sums.advance(self.past.transition(variances))
        self.past = self.past.drifted(variances)
        self._remove += new.links or ()
        self.epochs = (replace(new, links=None), *self.epochs[2:])

    def _replace_past(self) -> None:
        self._remove.append(self.past_id)
        self.past = self.past.at(self.point)
        self._add(self.past.factor(self._smoother.keys(self.epochs[0].number)), "past", 0)

    def _add(self, factor: gtsam.NonlinearFactor, kind: str, number: int) -> None:
        self._graph.add(factor)
        self._added.append((kind, number))

    def _number(self, indices: list[int]) -> None:
        """Remember under which index iSAM2 keeps each new factor."""
        pairs: dict[int, list[int]] = {}
        links: dict[int, int] = {}
        for (kind, number), index in zip(self._added, indices, strict=True):
            if kind == "past":
                self.past_id = index
            elif kind == "pair":
                pairs.setdefault(number, []).append(index)
            else:
                links[number] = index
        self.ids.update({scan: (a, b) for scan, (a, b) in pairs.items()})
        self.epochs = tuple(
            replace(epoch, links=(links[epoch.number], links[-epoch.number]))
            if epoch.number in links
            else epoch
            for epoch in self.epochs
        )

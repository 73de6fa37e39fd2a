"""iSAM2 over a window of pairs; pairs that leave it are kept as one linear factor."""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import Any

import gtsam
import numpy as np

from sst_graph.association.edge_matching import SIDES
from sst_graph.assumptions import ASSUMPTIONS, named_sigmas
from sst_graph.covariance.error_model import ErrorModel
from sst_graph.covariance.jackknife import composed
from sst_graph.errors import EstimationError, one_line
from sst_graph.factors import extrinsic_drift, time_offset_drift
from sst_graph.graph.building import motion_factor, silhouettes_factor
from sst_graph.graph.matching import GraphConfig
from sst_graph.graph.state import (
    bias_key,
    lower_edge_track,
    nuisance_key,
    object_bias_key,
    time_offset_key,
    twist_key,
)
from sst_graph.tracker.config import DriftConfig
from sst_graph.tracker.sums.held import held_names
from sst_graph.tracker.sums.linearized_pair import LinearizedPair
from sst_graph.tracker.sums.running_sums import RunningSums
from sst_graph.tracker.window.epochs import Epoch, EpochSums, MatchedPair, RetiredEpoch
from sst_graph.tracker.window.gaussian import Gaussian, Point, insert_point, inverted
from sst_graph.tracker.window.smoother_update import SmootherUpdate, TwistFactor, read_point
from sst_graph.types import FloatArray, IntArray, SemanticClass

_RELINEARIZE = {
    "E": np.repeat([2e-4, 1e-3], 3),
    "D": np.array([5e-4]),
    "B": np.array([0.02]),
    "O": np.array([0.1]),
    "V": np.repeat([0.005, 0.03], 3),
}
"""Steps beyond these [rad, m], [s], [px], [rad/s, m/s] are relinearized: far below one frame's sigmas."""


_RELINEARIZE_SPANS = 1e-3
"""The same of an assumption's parameter, in units of what it may be: a few hundredths of a pixel."""
_SHORTEST_S = 1e-3
"""Least time between two epochs, so that their random walk has a variance [s]."""


def _parameters(estimate: Sequence[str]) -> gtsam.ISAM2Params:
    """estimate: names and deviations of the parameters that are variables."""
    params = gtsam.ISAM2Params()
    thresholds = gtsam.ISAM2ThresholdMap()
    for name, steps in _RELINEARIZE.items():
        thresholds.insert((name, steps))
    # One threshold for all keys of a letter: the least of them.
    spans = [ASSUMPTIONS[name].span for name, _ in named_sigmas(estimate)]
    if spans:
        thresholds.insert(("N", np.array([_RELINEARIZE_SPANS * min(spans)])))
    params.setRelinearizeThreshold(thresholds)
    params.relinearizeSkip = 1
    params.findUnusedFactorSlots = True
    return params


class WindowSmoother:
    """The graph of the window; every update happens whole or not at all.

    Attributes:
        entries: matched pairs of the window, by the number of their scan.
        past: information of the prior and of all that has left the window, matches weighted as in the graph.
        observed: the same with the robust loss's second derivatives; one linear factor of the graph.
        static: the same as ``past`` by static objects alone.
        sums: of the covariance, over all that has left the window.
        model: error model of the matches.
        epochs: those whose calibration is still a variable, oldest first.
        point: the estimate of the last epoch.
        retired: epochs that have left the window, until the history takes them over.
        begun: the prior's factor in the graph is that of ``past``; it is from the first update on.
    """

    def __init__(
        self,
        prior: Gaussian,
        start_ns: int,
        classes: Sequence[SemanticClass],
        graph: GraphConfig,
        drift: DriftConfig,
        begin: Point | None,
    ) -> None:
        """
        Args:
            prior: of the first epoch.
            begin: where the graph is linearized first; None: at the prior's mean.
        """
        self.classes, self.graph, self.drift = tuple(classes), graph, drift
        self.held_names = held_names(graph.estimate, classes)
        self.prior = self.static = prior
        self.past = self.observed = prior.holding(len(self.held_names))
        self.sums = RunningSums.empty(prior.point.size, len(self.held_names))
        self.entries: dict[int, MatchedPair] = {}
        self.model = ErrorModel(0.0, 0.0, 1.0)
        self.retired: list[RetiredEpoch] = []
        self.epochs: tuple[Epoch, ...] = (Epoch(0, start_ns),)
        self.ids: dict[int, int] = {}
        self.twists: dict[int, TwistFactor] = {}
        values = gtsam.Values()
        self.begun, held_there = begin is None, None
        if begin is None:
            begin = prior.mean()
        else:
            # iSAM2 would move to the mean of the prior before it takes the first pairs.
            held_there = gtsam.NonlinearFactorGraph()
            centred = Gaussian(begin, prior.information, np.zeros(begin.size))
            held_there.add(centred.factor(self.keys(0, begin.tracks)))
        insert_point(values, self.keys(0, prior.point.tracks), begin)
        self.isam, (self.past_id,) = self._linearized(values, held_there)
        self.point = begin
        self.epoch_sums = EpochSums.empty(prior.point)

    @property
    def matches(self) -> int:
        """Matches of the window."""
        return sum(entry.linear.matches for entry in self.entries.values())

    def keys(self, epoch: int, tracks: Sequence[int] = ()) -> list[int]:
        """Keys of [E, D, biases..., parameters..., biases of some objects...] of an epoch."""
        biases = [bias_key(0, c) for c in self.classes]
        biases += [object_bias_key(0, lower_edge_track(c)) for c in self.classes]
        parameters = [nuisance_key(name) for name in self.prior.point.names]
        objects = [object_bias_key(0, track) for track in tracks]
        return [int(gtsam.symbol("E", epoch)), time_offset_key(epoch), *biases, *parameters, *objects]

    def update(
        self,
        found: Mapping[int, MatchedPair],
        dropped: set[int],
        first_scan: int,
        alive: Container[int] = (),
    ) -> None:
        """Add pairs or replace them by new matches, retire those before ``first_scan``.

        Args:
            found: new matches by scan.
            dropped: scans that have no match now: they are removed, and not added to ``past``.
            first_scan: the window's first scan.
            alive: tracks of objects that may be seen again; the biases of all others are marginalized out
                as soon as no pair of the window sees them.

        Raises:
            EstimationError: the update fails or gives numbers that are not finite; nothing has changed.
        """
        update = SmootherUpdate(self, found, dropped, first_scan, alive)
        try:
            update.run()
        except (RuntimeError, ValueError, np.linalg.LinAlgError) as error:
            raise EstimationError(f"the update failed: {one_line(error):.200}") from error
        self._keep(update)

    def _keep(self, update: SmootherUpdate) -> None:
        """Go on with what an update has prepared."""
        self.isam, self.past_id, self.epochs = update.isam, update.past_id, update.epochs
        self.ids, self.twists, self.entries = update.ids, update.twists, update.entries
        self.past, self.observed, self.static = update.past, update.observed, update.static
        self.begun = True
        self.sums, self.epoch_sums = update.sums, update.epoch_sums
        self.point = update.point
        self.retired += update.retired
        if self.entries or self.sums.recent:
            self.model = self.sums.error_model([entry.linear for entry in self.entries.values()])

    def pair_factor(self, entry: MatchedPair) -> gtsam.NonlinearFactor:
        """The matches of a pair."""
        (E, D), V = self.keys(entry.epoch)[:2], twist_key(0, entry.image)
        at = entry.linear.information.point.nuisances
        return silhouettes_factor(entry.pair, E, D, V, partial(bias_key, 0), at)

    def twist_factor(self, entry: MatchedPair) -> gtsam.NonlinearFactor:
        """Odometry's measurement of the twist of a pair's image."""
        (E, D), V, at = self.keys(entry.epoch)[:2], twist_key(0, entry.image), entry.linear.information.point
        return motion_factor(entry.pair, E, D, V, at.cTl, at.time_offset_s)

    def drift_factors(self, old: Epoch, new: Epoch) -> tuple[gtsam.NonlinearFactor, gtsam.NonlinearFactor]:
        """The random walk of extrinsic and offset from one epoch to the next."""
        a, b, drift = self.keys(old.number), self.keys(new.number), self.drift
        seconds, rate = (new.start_ns - old.start_ns) * 1e-9, float(np.radians(drift.rotation_deg))
        turn = extrinsic_drift(a[0], b[0], seconds, rate, drift.translation_m)
        return turn, time_offset_drift(a[1], b[1], seconds, drift.time_offset_s)

    def optimize(self, iterations: int) -> None:
        """Levenberg-Marquardt on the whole window, and a fresh iSAM2 linearized where it ends.

        Raises:
            EstimationError: it fails; nothing has changed.
        """
        params = gtsam.LevenbergMarquardtParams()
        params.setMaxIterations(iterations)
        params.setlambdaInitial(1e-6)
        params.setRelativeErrorTol(1e-9)
        try:
            optimizer = gtsam.LevenbergMarquardtOptimizer(
                self._whole(), self.isam.calculateEstimate(), params
            )
            isam, indices = self._linearized(optimizer.optimize())
            tracks, names = self.past.point.tracks, self.past.point.names
            point = read_point(isam, self.keys(self.epochs[-1].number, tracks), tracks, names)
        except (RuntimeError, ValueError) as error:
            raise EstimationError(f"the window's optimisation failed: {error}") from error
        self._replace_isam(isam, indices)
        self.point = point

    def relinearize(self) -> None:
        """A fresh iSAM2, linearized at the estimate as after loading; the estimate stays."""
        self._replace_isam(*self._linearized(self.isam.calculateEstimate(), self._present_factors()))

    def _present_factors(self) -> gtsam.NonlinearFactorGraph:
        """As :meth:`_whole`, the very factors that iSAM2 holds."""
        links = [link for epoch in self.epochs for link in epoch.links or ()]
        twists = [twist.index for twist in self.twists.values()]
        held, graph = self.isam.getFactorsUnsafe(), gtsam.NonlinearFactorGraph()
        for index in [self.past_id, *links, *self.ids.values(), *twists]:
            graph.add(held.at(index))
        return graph

    def _whole(self) -> gtsam.NonlinearFactorGraph:
        """Every factor of the window: the past, the walks, the pairs, the twists."""
        graph = gtsam.NonlinearFactorGraph()
        keys = self.keys(self.epochs[0].number, self.past.point.tracks)
        graph.add(self.observed.without_held().factor(keys))
        for old, new in pairwise(self.epochs):
            for factor in self.drift_factors(old, new):
                graph.add(factor)
        for scan in self.ids:
            graph.add(self.pair_factor(self.entries[scan]))
        for twist in self.twists.values():
            graph.add(self.twist_factor(self.entries[twist.scan]))
        return graph

    def _linearized(
        self, values: gtsam.Values, graph: gtsam.NonlinearFactorGraph | None = None
    ) -> tuple[gtsam.ISAM2, list[int]]:
        """A fresh iSAM2 of all factors (made again where None) at some values, and the factors' indices."""
        isam = gtsam.ISAM2(_parameters(self.graph.estimate))
        whole = self._whole() if graph is None else graph
        return isam, list(isam.update(whole, values).getNewFactorsIndices())

    def _replace_isam(self, isam: gtsam.ISAM2, indices: Sequence[int]) -> None:
        """Go on with an iSAM2 of :meth:`_whole` and its factors' indices."""
        new = iter(indices)
        self.isam, self.past_id = isam, next(new)
        first, *others = self.epochs
        linked = (replace(epoch, links=(next(new), next(new))) for epoch in others)
        self.epochs = (replace(first, links=None), *linked)
        self.ids = {scan: next(new) for scan in self.ids}
        self.twists = {image: replace(twist, index=next(new)) for image, twist in self.twists.items()}

    def __getstate__(self) -> dict[str, Any]:
        """All but iSAM2; of that, where it is linearized."""
        values = self.isam.getLinearizationPoint()
        known = [
            (key, values.atPose3(key) if gtsam.symbolChr(key) == ord("E") else values.atVector(key))
            for key in values.keys()  # noqa: SIM118
        ]
        return {**vars(self), "isam": known}

    def __setstate__(self, state: Mapping[str, Any]) -> None:
        vars(self).update(state)
        values = gtsam.Values()
        for key, value in state["isam"]:
            values.insert(key, value)
        self._replace_isam(*self._linearized(values))

    def walk(self, old: Epoch | RetiredEpoch, new: Epoch | RetiredEpoch) -> FloatArray:
        """(m,) variances of the random walk of [extrinsic, offset, biases, parameters] from one epoch to the
        next."""
        drift, seconds = self.drift, max(_SHORTEST_S, (new.start_ns - old.start_ns) * 1e-9)
        rates = [np.radians(drift.rotation_deg)] * 3 + [drift.translation_m] * 3 + [drift.time_offset_s]
        return np.asarray(seconds * np.square([*rates, *[0.0] * (self.prior.point.core_size - 7)]))

    def information(self) -> FloatArray:
        """(n, n) of past and window together on the last epoch, matches taken as independent, over the
        unknowns of ``past`` and what it holds."""
        return self._with_pairs(self.past, self.entries).information

    def vector(self) -> FloatArray:
        """(n,) negative gradient of the cost of past and window by the last epoch, at the estimate, over the
        unknowns of ``past`` and what it holds."""
        return self._with_pairs(self.observed.at(self.point), self.entries).vector

    def window_with(self, found: Mapping[int, MatchedPair], point: Point) -> Gaussian:
        """Past and window by the last epoch, about a point at which all scans were matched again, with the
        motion of each pair marginalised out."""
        places = {t: place for pair in found.values() for t, place in pair.linear.places.items()}
        new = {t: place for t, place in places.items() if t not in self.past.point.tracks}
        point = point.with_objects({t: place for t, place in new.items() if t not in point.tracks})
        past = self.observed.without_held().with_objects(new, self.graph.object_bias_sigma_px)
        return self._with_pairs(past.at(point), found)

    def _with_pairs(self, past: Gaussian, pairs: Mapping[int, MatchedPair], static: bool = False) -> Gaussian:
        """A past and pairs, by scan, on the last epoch, about the past's point.

        Args:
            static: of the pairs, the static objects alone.
        """
        total, numbers = past, {scan: self._epoch_of(scan, pair) for scan, pair in pairs.items()}
        for i, epoch in enumerate(self.epochs):
            if i > 0:
                total = total.drifted(self.walk(self.epochs[i - 1], epoch))
            own = [pair.linear for scan, pair in pairs.items() if numbers[scan] == epoch.number]
            seen = [linear.by_static_objects if static else linear.information for linear in own]
            total = Gaussian(total.point, total.information_with(seen), total.vector_with(seen))
        return total

    def _epoch_of(self, scan: int, pair: MatchedPair) -> int:
        """Number of the epoch of a pair, which need not be in the graph."""
        if scan in self.entries:
            return self.entries[scan].epoch
        begun = [epoch.number for epoch in self.epochs if epoch.start_ns <= pair.stamp_ns]
        return max(begun, default=self.epochs[0].number)

    def static_information(self) -> FloatArray | None:
        """(n, n) the same by static objects alone; None where no match is of a dynamic one."""
        dynamic = any(entry.linear.static is not None for entry in self.entries.values())
        if not dynamic and np.array_equal(self.static.information, self.past.without_held().information):
            return None
        return self._with_pairs(self.static, self.entries, static=True).information

    def covariance(self, information: FloatArray, sums: RunningSums) -> tuple[FloatArray, FloatArray]:
        """(n, n) cluster-robust covariance of the unknowns of ``past``, and that of independent matches.

        Args:
            information: of :meth:`information`.
            sums: of :meth:`sums_on_last_epoch`.

        Raises:
            EstimationError: a direction without any information.
        """
        n = self.past.point.size
        naive = inverted(information[:n, :n])
        robust = naive + naive @ sums.excess(self.model) @ naive
        spread = None
        if not self.drift.enabled:
            found = [e.linear.objects for e in self.entries.values() if e.linear.objects is not None]
            spread = self.sums.objects.spread(found, naive, self.past.at(self.point).point)
        robust = composed(robust, spread, sums.weight_curvature_ratio)
        return 0.5 * (robust + robust.T), naive

    def sums_on_last_epoch(self) -> RunningSums:
        """The sums over past and window, carried to the last epoch by the random walks."""
        sums, total = self.sums.with_pairs(*self._pairs_of(self.epochs[0])), self.past
        for old, new in pairwise(self.epochs):
            window, _ = self._pairs_of(old)
            total = replace(total, information=total.information_with([pair.information for pair in window]))
            variances = self.walk(old, new)
            sums = sums.carried(total.transition(variances)).with_pairs(*self._pairs_of(new))
            total = total.drifted(variances)
        return sums

    def _pairs_of(self, epoch: Epoch) -> tuple[list[LinearizedPair], list[IntArray]]:
        """The pairs of the window that see an epoch's calibration, and the columns of each in ``past``."""
        point = self.past.point
        pairs = [entry.linear for entry in self.entries.values() if entry.epoch == epoch.number]
        return pairs, [point.columns(pair.information.point.tracks, self.past.held) for pair in pairs]

    @property
    def objects(self) -> int:
        """How many objects past and window have seen."""
        sides = [self.sums.scores.sides, *(entry.linear.scores.sides for entry in self.entries.values())]
        live = {*self.sums.objects.live, *(np.concatenate(sides) // SIDES).tolist()}
        return self.sums.objects.count + len(live)

    def live_epochs(self) -> list[RetiredEpoch]:
        """Epochs of the window, as if they retired now."""
        found, shift_variances = [], self.sums_on_last_epoch().shift_variances
        for i, epoch in enumerate(self.epochs):
            sums = self.epoch_sums.copy() if i == 0 else EpochSums.empty(self.past.point)
            for scan, entry in self.entries.items():
                if entry.epoch == epoch.number:
                    sums.add(entry.linear, scan, self.graph.object_bias_sigma_px)
            found.append(sums.retired(epoch.start_ns, self.model, shift_variances))
        return found

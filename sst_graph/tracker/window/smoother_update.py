"""One update of the window's smoother, prepared on copies."""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import gtsam
import numpy as np

from sst_graph.graph.linear import scaled_inverse
from sst_graph.graph.state import object_bias_key, twist_key
from sst_graph.tracker.window.epochs import EPOCH_S, Epoch, EpochSums, MatchedPair, RetiredEpoch
from sst_graph.tracker.window.gaussian import Point

if TYPE_CHECKING:
    from sst_graph.tracker.window.smoother import WindowSmoother


def read_point(
    isam: gtsam.ISAM2, keys: Sequence[int], tracks: tuple[int, ...], names: tuple[str, ...]
) -> Point:
    """The estimate under [E, D, biases..., parameters..., biases of the objects...].

    Args:
        tracks: of the objects.
        names: of the parameters.

    Raises:
        ValueError: it is not finite.
    """
    cTl = isam.calculateEstimatePose3(keys[0])
    scalars = np.array([isam.calculateEstimateVector(key)[0] for key in keys[1:]])
    if not (np.isfinite(scalars).all() and np.isfinite(cTl.matrix()).all()):
        raise ValueError("an estimate that is not finite")
    objects = len(scalars) - len(tracks)
    parameters = objects - len(names)
    biases, own = scalars[1:parameters], scalars[objects:]
    return Point(cTl, float(scalars[0]), biases, tracks, own, names, scalars[parameters:objects])


@dataclass(frozen=True)
class TwistFactor:
    """Odometry's measurement of an image's twist: one, however many scans meet the image.

    Attributes:
        index: of the factor in iSAM2.
        scan: the scan whose matches it was made with.
    """

    index: int
    scan: int


class SmootherUpdate:
    """One update, prepared on copies."""

    def __init__(
        self,
        smoother: WindowSmoother,
        found: Mapping[int, MatchedPair],
        dropped: set[int],
        first_scan: int,
        alive: Container[int],
    ) -> None:
        self._smoother, self._found, self._dropped, self._first_scan = smoother, found, dropped, first_scan
        self._alive = alive
        self.isam = gtsam.ISAM2(smoother.isam)
        self.entries, self.ids = dict(smoother.entries), dict(smoother.ids)
        self.twists = dict(smoother.twists)
        self.past, self.past_id = smoother.past, smoother.past_id
        self.observed, self.static = smoother.observed, smoother.static
        self.epochs = smoother.epochs
        self.epoch_sums = smoother.epoch_sums.copy()
        self.sums = smoother.sums.copy()
        self.retired: list[RetiredEpoch] = []
        self.point = smoother.point
        self._graph, self._values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self._remove: list[int] = []
        self._added: list[tuple[str, int]] = []
        self._tied: dict[int, int] = {}

    def run(self) -> None:
        """Prepare all changes, update the copy of iSAM2, read the estimate."""
        # 1. Pairs and objects that leave, pairs that are matched again, new ones.
        self._retire()
        self._insert_objects()
        self._add_pairs()
        self._tie_twists()
        self._close_epochs()
        self._marginalize_objects()
        before = self._smoother
        if self.past is not before.past or self.observed is not before.observed or not before.begun:
            self._replace_past()
        # 2. Everything at once.
        result = self.isam.update(self._graph, self._values, self._remove)
        self._number(list(result.getNewFactorsIndices()))
        # 3. The estimate, if it is finite.
        tracks = self.past.point.tracks
        keys = self._smoother.keys(self.epochs[-1].number, tracks)
        self.point = read_point(self.isam, keys, tracks, self.past.point.names)

    def _retire(self) -> None:
        for scan in sorted(scan for scan in self.entries if scan < self._first_scan):
            entry = self.entries.pop(scan)
            self._remove.append(self.ids.pop(scan))
            linear, drift = entry.linear, self._smoother.drift
            while entry.epoch > self.epochs[0].number:
                self._next_epoch()
            self.past = self.past.plus(linear.information)
            self.observed = self.observed.plus(linear.observed)
            self.static = self.static.plus(linear.by_static_objects)
            own = linear.information
            columns = self.past.point.columns(own.point.tracks, own.held)
            self.sums.add(linear, columns, scan, by_object=not drift.enabled)
            if drift.enabled:
                self.epoch_sums.add(linear, scan, self._smoother.graph.object_bias_sigma_px)
        for scan in self._dropped & set(self.entries):
            del self.entries[scan]
            self._remove.append(self.ids.pop(scan))

    def _insert_objects(self) -> None:
        """Objects seen for the first time get a mask bias of their own, tied to their class's."""
        known, new = set(self.past.point.tracks), dict[int, int]()
        for found in self._found.values():
            new.update({t: place for t, place in found.linear.places.items() if t not in known})
        if not new:
            return
        sigma_px = self._smoother.graph.object_bias_sigma_px
        gaussians = (self.past, self.observed, self.static)
        self.past, self.observed, self.static = (g.with_objects(new, sigma_px) for g in gaussians)
        self.sums.grow(self.past.point.size)
        self.point = self.point.with_objects(new)
        for track, place in new.items():
            self._values.insert(object_bias_key(0, track), self.point.biases_px[[place]])

    def _marginalize_objects(self) -> None:
        """Objects that the window does not see, and that will not be seen again, leave the unknowns."""
        seen = {track for entry in self.entries.values() for track in entry.linear.places}
        gone = [t for t in self.past.point.tracks if t not in seen and t not in self._alive]
        if not self._smoother.drift.enabled:
            self._close_objects()
        if gone:
            self.past, T = self.past.without(gone)
            self.observed, _ = self.observed.without(gone)
            self.static, _ = self.static.without(gone)
            self.sums.transform(T)

    def _close_objects(self) -> None:
        """Objects that cannot be seen again are not kept one by one."""
        kept = {
            track
            for entry in self.entries.values()
            if entry.linear.objects is not None
            for track in entry.linear.objects.tracks
        }
        kept |= {track for track in self.sums.objects.live if track in self._alive}
        if all(track in kept for track in self.sums.objects.live):
            return
        seen = [entry.linear.information for entry in self.entries.values()]
        n = self.past.point.size
        information = self.past.information_with(seen)[:n, :n]
        point = self.past.at(self.point).point
        self.sums.objects.close(kept, information, scaled_inverse(information), point)

    def _add_pairs(self) -> None:
        """New pairs, and those matched again in the place of the old."""
        smoother = self._smoother
        for scan, new in sorted(self._found.items()):
            known = self.entries.get(scan)
            epoch = self._epoch_at(new.stamp_ns) if known is None else known.epoch
            if known is not None:
                self._remove.append(self.ids[scan])
            self.entries[scan] = replace(new, epoch=epoch)
            self._add(smoother.pair_factor(self.entries[scan]), "pair", scan)
            key = twist_key(0, new.image)
            if not (self.isam.valueExists(key) or self._values.exists(key)):
                self._values.insert(key, new.pair.motion.c_twist)

    def _tie_twists(self) -> None:
        """Odometry's factor on each image's twist, by the first scan that meets it, as in the batch."""
        firsts: dict[int, int] = {}
        for scan in sorted(self.entries):
            firsts.setdefault(self.entries[scan].image, scan)
        for image, twist in list(self.twists.items()):
            if firsts.get(image) != twist.scan or twist.scan in self._found:
                self._remove.append(self.twists.pop(image).index)
        smoother = self._smoother
        for image, scan in firsts.items():
            if image not in self.twists:
                self._add(smoother.twist_factor(self.entries[scan]), "twist", image)
                self._tied[image] = scan

    def _epoch_at(self, stamp_ns: int) -> int:
        """The epoch of a stamp; a new one where the last has lasted long enough."""
        smoother, last = self._smoother, self.epochs[-1]
        seconds = (stamp_ns - last.start_ns) * 1e-9
        if not smoother.drift.enabled or seconds < EPOCH_S:
            for epoch in reversed(self.epochs):
                if stamp_ns >= epoch.start_ns:
                    return epoch.number
            return self.epochs[0].number
        new = Epoch(last.number + 1, stamp_ns)
        turn, shift = smoother.drift_factors(last, new)
        self._add(turn, "link", new.number)
        self._add(shift, "link", -new.number)
        E, D = smoother.keys(new.number)[:2]
        self._values.insert(E, smoother.point.cTl)
        self._values.insert(D, np.array([smoother.point.time_offset_s]))
        self.epochs = (*self.epochs, new)
        return new.number

    def _close_epochs(self) -> None:
        """Epochs of which the window has no pair go into the past."""
        while len(self.epochs) > 1 and all(e.epoch > self.epochs[0].number for e in self.entries.values()):
            if self.epochs[1].links is None:
                break
            self._next_epoch()

    def _next_epoch(self) -> None:
        """The past moves on to the next epoch by the random walk."""
        smoother = self._smoother
        old, new = self.epochs[0], self.epochs[1]
        variances = smoother.walk(old, new)
        shift_variances = smoother.sums_on_last_epoch().shift_variances
        self.retired.append(self.epoch_sums.retired(old.start_ns, smoother.model, shift_variances))
        self.epoch_sums = EpochSums.empty(self.past.point)
        self.sums.transform(self.past.transition(variances))
        gaussians = (self.past, self.observed, self.static)
        self.past, self.observed, self.static = (g.drifted(variances) for g in gaussians)
        self._remove += new.links or ()
        self.epochs = (replace(new, links=None), *self.epochs[2:])

    def _replace_past(self) -> None:
        self._remove.append(self.past_id)
        gaussians = (self.past, self.observed, self.static)
        self.past, self.observed, self.static = (g.at(self.point) for g in gaussians)
        keys = self._smoother.keys(self.epochs[0].number, self.past.point.tracks)
        self._add(self.observed.without_held().factor(keys), "past", 0)

    def _add(self, factor: gtsam.NonlinearFactor, kind: str, number: int) -> None:
        self._graph.add(factor)
        self._added.append((kind, number))

    def _number(self, indices: list[int]) -> None:
        """Remember under which index iSAM2 keeps each new factor."""
        links: dict[int, int] = {}
        for (kind, number), index in zip(self._added, indices, strict=True):
            if kind == "past":
                self.past_id = index
            elif kind == "pair":
                self.ids[number] = index
            elif kind == "twist":
                self.twists[number] = TwistFactor(index, self._tied[number])
            else:
                links[number] = index
        self.epochs = tuple(
            replace(epoch, links=(links[epoch.number], links[-epoch.number]))
            if epoch.number in links
            else epoch
            for epoch in self.epochs
        )

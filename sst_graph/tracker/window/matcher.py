"""Matches of the window's scans at any point, with the window's tracks and velocities of the objects."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sst_graph.association.edge_matching import GATE
from sst_graph.association.time_pairing import pair_by_time
from sst_graph.batch.lower_edges import LowerEdgeSupport, lower_edge_support
from sst_graph.drive.preparation import Drive, boundaries_of, boundary_count
from sst_graph.drive.twists import GrowingTwists
from sst_graph.factors import alignment_cost
from sst_graph.factors.robust import RobustKernel
from sst_graph.features.mask_contour import ContourMap
from sst_graph.graph.drive_motion import DriveMotion
from sst_graph.graph.matching import (
    DYNAMIC_REACH_M,
    GraphConfig,
    PairMatches,
    associate,
)
from sst_graph.graph.outer_loop import KERNELS_PX
from sst_graph.points import transformed_points
from sst_graph.tracker.by_edges.kinds import EDGE_KERNEL_SHARE, by_edges, by_labels, of_kind
from sst_graph.tracker.config import TrackerConfig
from sst_graph.tracker.sums.held import held_names
from sst_graph.tracker.sums.linearized_pair import LinearizedPair, linearize_pairs, with_share
from sst_graph.tracker.sums.rows import PairColumns
from sst_graph.tracker.window.epochs import MatchedPair
from sst_graph.tracker.window.gaussian import Point
from sst_graph.tracker.window.window import Window
from sst_graph.types import SemanticClass

_MIN_MATCHES = 8
"""Fewest matches of a scan that enters the graph: fewer hardly determine anything."""
_SMOOTHED = 12
"""So many of the latest motions are smoothed again with every scan."""
_OF_EACH_MATCH = ("objects", "sides", "index", "level_px", "offsets_s")
"""The arrays of matches that have a row for each."""


@dataclass(frozen=True)
class InView:
    """What should be visible of a scan in its image.

    Attributes:
        counts: boundary points of each object, by its track.
        contour_px: length of all contours that the image's labels have [px].
    """

    counts: Mapping[int, int]
    contour_px: int


class WindowMatcher:
    """Pairs and matches the scans of a window: dynamic objects left out, each object with its track."""

    def __init__(self, window: Window, config: TrackerConfig) -> None:
        self.window = window
        self.config = config
        self.classes = config.calibration.classes
        self.graph = config.calibration.noise
        self.held_names = held_names(self.graph.estimate, self.classes)
        self.kernel = RobustKernel("geman_mcclure", KERNELS_PX[-1])
        self._motion: tuple[int, DriveMotion] | None = None
        self._growing = GrowingTwists(_SMOOTHED)
        self._last: tuple[Point, dict[int, PairMatches]] | None = None

    def __getstate__(self) -> dict[str, Any]:
        """All but the cache for the present frame."""
        return {**vars(self), "_motion": None, "_last": None}

    def check_lower_edges(self, point: Point) -> None:
        """Match lower edges from now on, of classes whose labels agree about them."""
        if self.config.calibration.lower_edges != "never":
            self.set_lower_edges(self.lower_edge_support(point, None))

    def lower_edge_support(self, point: Point, chosen: Collection[int] | None) -> LowerEdgeSupport:
        """How well the labels agree with the lower edges of some scans (None: all) at a point."""
        drive, numbers = self.window.drive(chosen)
        motion, state = self._motion_of(drive, numbers), point.state(self.classes)
        if by_edges(self.classes):
            drive = of_kind(drive, edges=False)
        return lower_edge_support([drive], [motion], state, self.config.calibration.joint)

    def set_lower_edges(self, support: LowerEdgeSupport) -> None:
        """Match lower edges from now on, of classes whose labels agree by this support."""
        chosen, _ = support.agreed(self.config.calibration.lower_edges)
        self.graph = replace(self.config.calibration.noise, lower_edges=chosen)

    def match(
        self,
        point: Point,
        chosen: Collection[int] | None,
        kernel: RobustKernel | None = None,
        share: float = 1.0,
    ) -> tuple[dict[int, MatchedPair], set[int]]:
        """Matches of some scans (None: all) at a point, and the scans that have none.

        Args:
            share: factor on the weights of all matches.
        """
        pairs, numbers = self._pairs(point, chosen, kernel or self.kernel)
        if kernel is None:
            self._last = (point, pairs)
        kept = {number: pair for number, pair in pairs.items() if len(pair) >= _MIN_MATCHES}
        if share != 1.0:
            kept = {number: with_share(pair, share) for number, pair in kept.items()}
        by_object = not self.config.drift.enabled
        linear = self._linearized(kept, point, share, by_object, self.held_names)
        stamps, found = self.window.stamps_ns(), {}
        for (number, pair), own in zip(kept.items(), linear, strict=True):
            image = self.window.images[pair.pair.image]
            out = self.left_out(pair, number, point.time_offset_s)
            found[number] = MatchedPair(pair, own, stamps[number], image.index, left_out=out)
        return found, set(numbers) - set(found)

    def linearized_at(
        self, point: Point, chosen: Collection[int], kernel: RobustKernel, without: Collection[int]
    ) -> list[LinearizedPair]:
        """Some scans matched and linearized at a point, without the objects of some tracks."""
        return self.linearized(self.pairs_at(point, chosen, kernel), point, without)

    def pairs_at(self, point: Point, chosen: Collection[int], kernel: RobustKernel) -> dict[int, PairMatches]:
        """Matches of some scans at a point."""
        return self._pairs(point, chosen, kernel)[0]

    def linearized(
        self, pairs: Mapping[int, PairMatches], point: Point, without: Collection[int]
    ) -> list[LinearizedPair]:
        """Matches of scans, made at a point, linearized there without the objects of some tracks."""
        if without:
            pairs = {number: self._leaving_out(pair, number, without) for number, pair in pairs.items()}
        some = {number: pair for number, pair in pairs.items() if len(pair)}
        return self._linearized(some, point, 1.0, by_object=False)

    def in_view(self, point: Point, chosen: Collection[int], without: Collection[int]) -> dict[int, InView]:
        """What should be visible of the objects of scans that have an image, by the scan's number.

        Args:
            without: tracks of objects that do not count.
        """
        part, numbers = self.window.drive(chosen)
        found = {}
        for pair in pair_by_time(
            part.scan_stamps_ns, part.image_stamps_ns, point.time_offset_s, part.image_period_s
        ):
            number, contours = numbers[pair.scan], part.images[pair.image].contours
            counts: dict[int, int] = {}
            for c, points in boundaries_of(part.scans[pair.scan], self.graph.lower_edges).items():
                if c in contours and not (
                    c == SemanticClass.OBJECT and part.have_labels(pair.scan, pair.image)
                ):
                    cPs = transformed_points(point.cTl, points.lPs)
                    inside = points.objects[part.camera.in_image(part.camera.project(cPs))]
                    seen = np.bincount(inside) if len(inside) else np.zeros(0, np.intp)
                    tracks = self.window.tracks[number]
                    counts.update({tracks[c, o]: int(seen[o]) for o in np.flatnonzero(seen).tolist()})
            kept = {track: count for track, count in counts.items() if track not in without}
            shown = sum(m.contour_px for m in contours.values() if isinstance(m, ContourMap))
            found[number] = InView(kept, shown)
        return found

    def left_out(
        self, pair: PairMatches, number: int, time_offset_s: float
    ) -> frozenset[tuple[SemanticClass, int, int]]:
        """The dynamic objects of a scan whose weight is lower with the image of a pair, or 0."""
        return self.window.left_out(number, time_offset_s + pair.pair.base_tau_s, DYNAMIC_REACH_M)

    def tracks_of(self, chosen: Collection[int]) -> set[int]:
        """Tracks of all objects of some scans."""
        return {track for number in chosen for track in self.window.tracks.get(number, {}).values()}

    def _leaving_out(self, pair: PairMatches, number: int, out: Collection[int]) -> PairMatches:
        tracks, matches, own, terms = self.window.tracks[number], {}, {}, {}
        for c, m in pair.matches.items():
            kept = np.flatnonzero([tracks[c, int(name)] not in out for name in m.objects])
            if len(kept):
                part = {name: getattr(m, name)[kept] for name in _OF_EACH_MATCH}
                matches[c] = replace(m, alignment=m.alignment.take(kept), **part)
                if c in pair.tracks:
                    own[c] = pair.tracks[c][kept]
                if c in pair.terms:
                    terms[c] = {name: column[kept] for name, column in pair.terms[c].items()}
        return replace(pair, matches=matches, tracks=own, terms=terms)

    def cost(self, point: Point, chosen: Collection[int], kernel: RobustKernel | None = None) -> float | None:
        """Mean cost of the boundary points of some scans at a point; None where none is in view.

        Args:
            kernel: None for that of the estimate.
        """
        kernel = kernel or self.kernel
        if self._last is not None and self._last[0] is point and kernel == self.kernel:
            pairs = {number: pair for number, pair in self._last[1].items() if number in chosen}
        else:
            pairs, _ = self._pairs(point, chosen, kernel)
        scans, below = dict(self.window.scans), self.graph.lower_edges
        counted = [(pair, boundary_count(scans[number], below)) for number, pair in pairs.items()]
        return mean_cost(counted, point, self.classes, kernel)

    def _pairs(
        self, point: Point, chosen: Collection[int] | None, kernel: RobustKernel
    ) -> tuple[dict[int, PairMatches], list[int]]:
        part, numbers = self.window.drive(chosen)
        state = point.state(self.classes)
        motion, pairs = self._motion_of(part, numbers), list[PairMatches]()
        for drive, own_kernel, graph in self._by_kind(part, kernel):
            pairs += associate([drive], [motion], state, own_kernel, graph)
        return {numbers[pair.pair.scan]: pair for pair in pairs}, numbers

    def _by_kind(
        self, part: Drive, kernel: RobustKernel
    ) -> Iterator[tuple[Drive, RobustKernel, GraphConfig]]:
        """What is matched by labels, and what by edges: the drive with their boundary points, kernel and
        settings. A pair of scan and image is matched by one of them.

        Edges are matched to the peak of the picture's edge, with the information of a match that follows the
        pose: matched to the centre of mass, the few steps of a frame would fall short.
        """
        if not by_edges(self.classes):
            yield part, kernel, self.graph
            return
        if by_labels(self.classes):
            yield of_kind(part, edges=False), kernel, self.graph
        narrow = replace(kernel, scale=EDGE_KERNEL_SHARE * kernel.scale)
        yield of_kind(part, edges=True), narrow, replace(self.graph, edge_place="peak")

    def _linearized(
        self,
        pairs: Mapping[int, PairMatches],
        point: Point,
        share: float,
        by_object: bool,
        held: Sequence[str] = (),
    ) -> list[LinearizedPair]:
        columns = [PairColumns(self.classes, self.window.tracks[n], held, self.graph) for n in pairs]
        return linearize_pairs(list(pairs.values()), point, columns, share, by_object)

    def _motion_of(self, part: Drive, numbers: list[int]) -> DriveMotion:
        """Motion of the LiDAR, made once a scan, and of the objects where they have biases."""
        if self._motion is None or self._motion[0] != self.window.next_scan:
            self._motion = (self.window.next_scan, DriveMotion(self._growing.of(part.lidar_motions)))
        motion = self._motion[1]
        if self.graph.object_bias_sigma_px == 0.0:
            return motion
        posed = replace(motion, poses=[self.window.poses[number] for number in numbers])
        return posed.with_objects(*self.window.objects_of(numbers))


def mean_cost(
    pairs: Sequence[tuple[PairMatches, int]],
    point: Point,
    classes: tuple[SemanticClass, ...],
    kernel: RobustKernel,
) -> float | None:
    """Mean robust cost of boundary points, given each pair's matches and number of boundary points.

    A point that finds no contour costs as much as the farthest match. None where none is in view.
    """
    cost, count = 0.0, 0
    for pair, total in pairs:
        own = next((matches.alignment.kernel for matches in pair.matches.values()), kernel)
        count += total
        cost += float(own.loss(GATE * own.scale)) * (total - len(pair))
        for c, matches in pair.matches.items():
            bias = float(point.biases_px[classes.index(c)])
            cost += alignment_cost(
                matches.alignment, point.cTl, point.time_offset_s, pair.motion.c_twist, bias
            )
    return cost / count if count else None

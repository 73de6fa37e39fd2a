"""From a state to matches: a drive's scans and images paired in true time, and matched all at once.

What a scan shows stays the same from one outer iteration to the next: :class:`DriveEdges` gathers it once for
a whole solution. What depends on the state (the pairs, the motion between them, the pixels) is computed for
all pairs in the same arrays: with the few hundred points of one pair, the calls would cost more than the
work.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise

import gtsam
import numpy as np
from numpy.typing import NDArray

from sst_graph.association.edge_matching import (
    BOTTOM,
    EdgeMatches,
    MatchConfig,
    PairedEdges,
    SilhouetteMatches,
    match_edges,
    numbered_through,
)
from sst_graph.association.time_pairing import Pair, pair_by_time, pair_every_image
from sst_graph.assumptions import named_sigmas
from sst_graph.assumptions.model import Scene
from sst_graph.config import internal, setting
from sst_graph.drive.preparation import Drive, boundaries_of
from sst_graph.drive.twists import TwistSample, TwistSamples
from sst_graph.errors import ConfigError
from sst_graph.factors.matches import Alignment
from sst_graph.factors.motion import CameraTwist
from sst_graph.factors.robust import RobustKernel
from sst_graph.features.lidar_edges import Boundaries, joined
from sst_graph.graph.drive_motion import DriveMotion, DynamicObjects
from sst_graph.graph.nuisances import deviation_of, moved_twists, residual_columns
from sst_graph.graph.state import State, lower_edge_track
from sst_graph.objects.dynamic_objects import dynamic_object_weights
from sst_graph.objects.tracks import numbers_in, of_each
from sst_graph.sampling import spread_places, step_for
from sst_graph.types import Calibration, FloatArray, IntArray, SemanticClass


@dataclass(frozen=True)
class GraphConfig(MatchConfig):
    """Noise of the joint graph.

    Attributes:
        lower_edges: classes whose edges towards the ground are matched too; chosen by
            :mod:`sst_graph.batch.lower_edges`. They determine roll and height where both sides label them
            alike; hand-drawn outlines often cover the gap above the ground.
        estimate: assumptions whose parameters are variables: ``name=sigma`` with the deviation from 0; from
            the settings of the assumptions.
        every_image: match a scan with every image that is nearest to it, where images are denser than scans;
            otherwise with the nearest one alone.
    """

    mask_bias_sigma_px: float = setting(
        3.0,
        at_least=0.001,
        at_most=1000.0,
        doc="Prior deviation of a class's mask bias (masks drawn too large or too small) from 0. "
        "Raise it for networks whose masks are far too large.",
    )
    object_bias_sigma_px: float = setting(
        0.5,
        at_least=0.0,
        at_most=1000.0,
        doc="Prior deviation of an object's mask bias from its class's. 0: one bias for all objects "
        "of a class.",
    )
    time_offset_sigma_s: float = setting(
        0.3,
        at_least=1e-6,
        at_most=100.0,
        doc="Prior deviation of the time offset from the guess. Lower it where the offset is known.",
    )
    lower_edges: tuple[SemanticClass, ...] = internal(())
    estimate: tuple[str, ...] = internal(())
    every_image: bool = internal(False)

    def __post_init__(self) -> None:
        if 0.0 < self.object_bias_sigma_px < 0.001:
            raise ConfigError(
                f"object_bias_sigma_px: found {self.object_bias_sigma_px:g}, expected 0 or at least 0.001 px"
            )


EVERY_IMAGE_REACH = 0.6
"""Farthest image of a scan where every image is matched, in periods of the scans: half of one, and what
stamps vary by."""
DYNAMIC_REACH_M = 0.003
"""A dynamic object whose unknown motion between its scan and its image is this long keeps half of its weight;
one that moves a little farther keeps none [m]: a quarter of a pixel at 10 m with KITTI's camera."""

MOST_POINTS = 100_000
"""Most boundary points that are matched. Neighbours on an outline share its errors; 60 frames of KITTI have
21,000 to 58,000."""


@dataclass(frozen=True)
class PairMatches:
    """The matches of one scan and one image.

    Attributes:
        drive: number of the drive.
        pair: positions of scan and image.
        l_twist: the LiDAR's twist at the image's instant, or None without odometry.
        motion: the camera's, under the state that the matches were made at.
        matches: by class.
        tracks: for each class, the track (n,) of the object that each match lies on; empty where objects
            share their class's mask bias.
        scene: what assumptions may depend on.
        terms: for each class, derivative (n,) of each residual by the parameters that are estimated, by name.
        wTl: pose of the LiDAR in the world, where it is known.
    """

    drive: int
    pair: Pair
    l_twist: TwistSample | None
    motion: CameraTwist
    matches: Mapping[SemanticClass, SilhouetteMatches]
    tracks: Mapping[SemanticClass, NDArray[np.intp]] = field(default_factory=dict)
    scene: Scene | None = None
    terms: Mapping[SemanticClass, Mapping[str, FloatArray]] = field(default_factory=dict)
    wTl: gtsam.Pose3 | None = None

    def __len__(self) -> int:
        return sum(len(matches) for matches in self.matches.values())

    @cached_property
    def biased(self) -> Mapping[SemanticClass, tuple[list[int], NDArray[np.intp]]]:
        """By class of ``tracks``: the tracks that have a mask bias, and which of them (n,) each match has."""
        found = {}
        for c, tracks in self.tracks.items():
            names, groups = np.unique(tracks, return_inverse=True)
            found[c] = (names.tolist(), groups.reshape(-1))
        return found


@dataclass(frozen=True)
class DriveEdges:
    """The boundary points of a drive, group by group: what one scan shows of one class.

    Attributes:
        number: of the drive.
        drive: where they come from.
        motion: of its LiDAR and of its objects.
        config: which of them, and how they are matched.
        scans, classes: scan and class of each group, the scans rising.
        points, owners, bounds: as in :class:`~sst_graph.association.edge_matching.PairedEdges`.
        own_tracks: (n,) track of the object of each point, or None where objects have no biases.
        unknown_mps: (n,) speed of each point's object that is not known, or None where all are static.
        velocities: (n, 3) of each point's object over ground, in the LiDAR frame, or None where none is known
            to move [m/s].
    """

    number: int
    drive: Drive
    motion: DriveMotion
    config: GraphConfig
    scans: tuple[int, ...]
    classes: tuple[SemanticClass, ...]
    points: Boundaries
    owners: IntArray
    bounds: IntArray
    own_tracks: IntArray | None
    unknown_mps: FloatArray | None
    velocities: FloatArray | None

    @classmethod
    def of(cls, number: int, drive: Drive, motion: DriveMotion, config: GraphConfig) -> DriveEdges | None:
        """All of a drive; None where it has no boundary point."""
        groups = [
            (k, c, points)
            for k, scan in enumerate(drive.scans)
            for c, points in boundaries_of(scan, config.lower_edges).items()
            if len(points)
        ]
        if not groups:
            return None
        parts = [points for _, _, points in groups]
        objects, own = [points.objects for points in parts], None
        if (known := motion.objects) is not None:
            own = np.concatenate(
                [
                    of_each(numbers, {n: known[k, c, n] for n in numbers_in(numbers)})
                    for (k, c, _), numbers in zip(groups, objects, strict=True)
                ]
            )
        dynamic = [
            (motion.dynamic_objects(k), c, numbers)
            for (k, c, _), numbers in zip(groups, objects, strict=True)
        ]
        unknown_mps, velocities = _own_motion(dynamic)
        return cls(
            number,
            drive,
            motion,
            config,
            tuple(k for k, _, _ in groups),
            tuple(c for _, c, _ in groups),
            joined(parts),
            numbered_through(objects),
            np.cumsum([0, *map(len, parts)]),
            own,
            unknown_mps,
            velocities,
        )

    def __len__(self) -> int:
        return len(self.points)

    @cached_property
    def group_of(self) -> IntArray:
        """(n,) group of each point."""
        return np.repeat(np.arange(len(self.scans)), np.diff(self.bounds))

    def thinned(self, most: int) -> DriveEdges:
        """Every second (third, ...) point: at most so many."""
        return self.take(np.arange(0, len(self), step_for(len(self), most)))

    def take(self, index: IntArray) -> DriveEdges:
        """Some of the points, by position, rising."""
        return replace(
            self,
            points=self.points.take(index),
            owners=self.owners[index],
            bounds=np.searchsorted(index, self.bounds),
            own_tracks=None if self.own_tracks is None else self.own_tracks[index],
            unknown_mps=None if self.unknown_mps is None else self.unknown_mps[index],
            velocities=None if self.velocities is None else self.velocities[index],
        )

    def match(self, state: State, kernel: RobustKernel) -> DriveMatches | None:
        """Pair scans with images in true time under a state, and match their silhouettes; None without."""
        drive, calibration = self.drive, state.calibration(self.number)
        # 1. The points, and the images that they are compared with.
        at = self._at(state)
        if at is None:
            return None
        paired, group_pairs = at.paired, at.group_pairs
        # 2. Match them.
        deviation = None
        if any(state.nuisances.values()):
            scene = at.motions.scene(drive, paired.repeated(group_pairs))
            deviation = deviation_of(state.nuisances, scene)
        found = match_edges(paired, calibration, kernel, self.config, deviation)
        if len(found.index) == 0:
            return None
        if at.shares is not None and not (at.shares == 1.0).all():
            weights = at.shares[found.index] * found.alignment.weights
            found = replace(found, alignment=replace(found.alignment, weights=weights))
        return DriveMatches(
            self,
            at.pairs,
            at.motions,
            found,
            at.groups,
            np.array(group_pairs),
            at.index.take(found.index),
            calibration,
        )

    def paired(self, state: State) -> PairedEdges | None:
        """The points with their images in true time under a state, without those whose objects move in an
        unknown way; None without any."""
        at = self._at(state)
        return None if at is None else at.paired

    def _at(self, state: State) -> _PairedAtState | None:
        drive, time_offset_s = self.drive, state.time_offset_s(self.number)
        pairs = self.pairs(time_offset_s)
        # 1. The groups that have an image, and in it a contour of their class; once for each image.
        numbers: dict[int, list[int]] = {}
        for number, pair in enumerate(pairs):
            numbers.setdefault(pair.scan, []).append(number)
        groups = [
            (g, number)
            for g, (k, c) in enumerate(zip(self.scans, self.classes, strict=True))
            for number in numbers.get(k, ())
            if c in drive.images[pairs[number].image].contours
            and not (c == SemanticClass.OBJECT and drive.have_labels(k, pairs[number].image))
        ]
        if not groups:
            return None
        chosen, group_pairs = [g for g, _ in groups], [p for _, p in groups]
        # 2. Their points, without the objects whose weight is 0.
        spans = [(int(self.bounds[g]), int(self.bounds[g + 1])) for g in chosen]
        index = np.concatenate([np.arange(*span) for span in spans])
        bounds = np.cumsum([0, *(b - a for a, b in spans)])
        base_taus_s, shares = np.array([pairs[p].base_tau_s for p in group_pairs]), None
        if self.unknown_mps is not None:
            taus_s = time_offset_s + base_taus_s.repeat(np.diff(bounds))
            shares = dynamic_object_weights(self.unknown_mps.take(index), taus_s, DYNAMIC_REACH_M)
            kept = np.flatnonzero(shares)
            index, bounds, shares = index.take(kept), np.searchsorted(kept, bounds), shares.take(kept)
        points = self.points if np.array_equal(index, np.arange(len(self))) else self.points.take(index)
        # 3. The images that they are compared with, and the motion around these.
        motions, biases = _Motions.of(self, pairs, state), state.biases_of(self.number)
        classes = [self.classes[g] for g in chosen]
        paired = PairedEdges(
            drive.camera,
            points,
            self._owners(chosen, index, bounds),
            bounds,
            [drive.images[pairs[p].image].contours[c] for p, c in zip(group_pairs, classes, strict=True)],
            motions.of_images(group_pairs if len(set(group_pairs)) > 1 else group_pairs[0]),
            base_taus_s.repeat(np.diff(bounds)) - points.offsets_s,
            np.array([biases.get(c, 0.0) for c in classes]),
            self._velocities(index),
        )
        return _PairedAtState(pairs, chosen, group_pairs, motions, paired, index, shares)

    def pairs(self, time_offset_s: float) -> list[Pair]:
        """Scans and images that belong together in true time under an offset."""
        drive = self.drive
        stamps = drive.scan_stamps_ns, drive.image_stamps_ns
        if self.config.every_image and drive.has_dense_images:
            return pair_every_image(*stamps, time_offset_s, EVERY_IMAGE_REACH * drive.lidar_period_s)
        return pair_by_time(*stamps, time_offset_s, drive.image_period_s)

    def _owners(self, chosen: Sequence[int], index: IntArray, bounds: IntArray) -> IntArray:
        """(n,) numbers of the objects of some points; an object in two images counts as two."""
        owners, nth = self.owners.take(index), np.arange(len(chosen)) - np.searchsorted(chosen, chosen)
        if not nth.any():
            return owners
        return np.asarray(owners + nth.repeat(np.diff(bounds)) * (int(self.owners.max()) + 1))

    def _velocities(self, index: IntArray) -> FloatArray | None:
        """(n, 3) of the objects of some points; None where all are static."""
        velocities = None if self.velocities is None else self.velocities.take(index, axis=0)
        return None if velocities is None or not velocities.any() else velocities


@dataclass(frozen=True)
class _Motions:
    """The motion around the images of pairs.

    Attributes:
        c_twists, c_accelerations: (p, 6) the camera's [rad/s, m/s].
        l_twists: the LiDAR's, or None without odometry.
        measured: (p, 6) the LiDAR's as measured; zeros without odometry [rad/s, m/s].
        since_s: (p,) stamps of the images minus that of the drive's first [s].
    """

    c_twists: FloatArray
    c_accelerations: FloatArray
    l_twists: TwistSamples | None
    measured: FloatArray
    since_s: FloatArray

    @classmethod
    def of(cls, edges: DriveEdges, pairs: Sequence[Pair], state: State) -> _Motions:
        """Under a state."""
        drive, number = edges.drive, edges.number
        stamps = [drive.images[pair.image].stamp_ns for pair in pairs]
        shift_ns = round(state.time_offset_s(number) * 1e9)
        origin_ns = drive.images[0].stamp_ns if drive.origin_ns is None else drive.origin_ns
        since_s = np.array([stamp - origin_ns for stamp in stamps]) * 1e-9
        l_twists = edges.motion.at_all([stamp + shift_ns for stamp in stamps])
        if l_twists is None:
            rest = np.zeros((len(pairs), 6))
            return cls(rest, rest, None, rest, since_s)
        measured = l_twists.twists
        l_twists = moved_twists(
            l_twists, state.nuisances, Scene(drive.camera, measured, 0.0, drive.lidar_period_s)
        )
        Ad = np.asarray(state.cTl.AdjointMap())
        return cls(l_twists.twists @ Ad.T, l_twists.accelerations @ Ad.T, l_twists, measured, since_s)

    def of_images(self, pairs: int | Sequence[int]) -> CameraTwist:
        """The camera's around the image of one pair, or by rows (g, 6) around those of some."""
        return CameraTwist(self.c_twists[pairs], self.c_accelerations[pairs])

    def scene(self, drive: Drive, of: IntArray | int) -> Scene:
        """What assumptions depend on, of some of the pairs."""
        since_s = self.since_s[of]
        return Scene(drive.camera, self.measured[of], since_s, drive.lidar_period_s)


@dataclass(frozen=True)
class _PairedAtState:
    """A drive's points and the images that they are compared with under a state.

    Attributes:
        pairs: all pairs of scan and image.
        groups: the groups that have an image, and
        group_pairs: the pair of each.
        motions: around the images.
        paired: the points of these groups.
        index: (n,) which of the drive's points each is.
        shares: (n,) of the weight that its object's motion leaves each point, or None where all are static.
    """

    pairs: Sequence[Pair]
    groups: list[int]
    group_pairs: list[int]
    motions: _Motions
    paired: PairedEdges
    index: IntArray
    shares: FloatArray | None


@dataclass(frozen=True)
class DriveMatches:
    """All matches of a drive, pair by pair and class by class.

    Attributes:
        edges: of the drive.
        pairs: all pairs, also those without a match.
        motions: around their images.
        found: the matches, group by group.
        groups: which of the drive's groups each is, and
        group_pairs: its pair.
        points: (m,) which of the drive's points each match is.
        at: extrinsic and time offset that the matches were made at.
    """

    edges: DriveEdges
    pairs: Sequence[Pair]
    motions: _Motions
    found: EdgeMatches
    groups: Sequence[int]
    group_pairs: IntArray
    points: IntArray
    at: Calibration

    def __len__(self) -> int:
        return len(self.points)

    @property
    def alignment(self) -> Alignment:
        """The alignment of all matches."""
        return self.found.alignment

    @property
    def number(self) -> int:
        """Number of the drive."""
        return self.edges.number

    @cached_property
    def counts(self) -> IntArray:
        """(g,) matches of each group."""
        return np.diff(self.found.bounds)

    @cached_property
    def group_classes(self) -> list[SemanticClass]:
        """Class of each group."""
        return [self.edges.classes[g] for g in self.groups]

    @cached_property
    def places(self) -> IntArray:
        """(m,) which of the points of its scan and class each match is."""
        return self.points - self.edges.bounds[list(self.groups)].repeat(self.counts)

    @cached_property
    def pair_of(self) -> IntArray:
        """(m,) number of each match's pair."""
        return np.repeat(self.group_pairs, self.counts)

    @cached_property
    def paired(self) -> list[int]:
        """Numbers of the pairs that have matches."""
        return list(np.unique(self.pair_of).tolist())

    @property
    def c_twists(self) -> FloatArray:
        """(p, 6) of the camera at the image of each pair [rad/s, m/s]."""
        return self.motions.c_twists

    @cached_property
    def tracks(self) -> IntArray | None:
        """(m,) track whose mask bias each match has: its object's or the lower edges' of its class.

        None where objects share their class's.
        """
        own = self.edges.own_tracks
        if own is None:
            return None
        below = np.repeat([lower_edge_track(c) for c in self.group_classes], self.counts)
        return np.where(self.found.sides == BOTTOM, below, own[self.points])

    @property
    def classes(self) -> list[SemanticClass]:
        """Classes that have matches."""
        present = {c for c, count in zip(self.group_classes, self.counts.tolist(), strict=True) if count}
        return sorted(present)

    @property
    def tracked(self) -> set[tuple[int, SemanticClass, int]]:
        """(drive, class, track) of every object with a mask bias of its own."""
        if self.tracks is None:
            return set()
        tracks, first = np.unique(self.tracks, return_index=True)
        groups = np.searchsorted(self.found.bounds, first, side="right") - 1
        found = zip(groups.tolist(), tracks.tolist(), strict=True)
        return {(self.number, self.group_classes[g], track) for g, track in found}

    @cached_property
    def terms(self) -> dict[str, FloatArray]:
        """(m,) derivative of each residual by the parameters that are estimated, by name."""
        names = [name for name, _ in named_sigmas(self.edges.config.estimate)]
        if not names:
            return {}
        pair, offsets_s = self.pair_of, self.edges.points.offsets_s[self.points]
        at = self.at.cTl, self.at.time_offset_s, self.c_twists[pair].T
        scene = self.motions.scene(self.edges.drive, pair)
        return residual_columns(self.alignment, scene, offsets_s, at, names)

    def by_pair(self) -> list[PairMatches]:
        """The matches of each pair that has some."""
        groups: dict[int, dict[SemanticClass, tuple[slice, int]]] = {}
        spans = pairwise(self.found.bounds.tolist())
        for p, c, (a, b), seen in zip(
            self.group_pairs.tolist(), self.group_classes, spans, self.found.seen.tolist(), strict=True
        ):
            if b > a:
                groups.setdefault(p, {})[c] = slice(a, b), seen
        return [self._pair(p, own) for p, own in groups.items()]

    def _pair(self, p: int, groups: Mapping[SemanticClass, tuple[slice, int]]) -> PairMatches:
        points, motion = self.edges.points, self.motions.of_images(p)
        l_twists, tracks = self.motions.l_twists, self.tracks
        return PairMatches(
            self.number,
            self.pairs[p],
            None if l_twists is None else l_twists[p],
            motion,
            {
                c: SilhouetteMatches(
                    self._alignment_of(own, motion),
                    points.objects[self.points[own]],
                    self.found.sides[own],
                    self.places[own],
                    self.found.level_px[own],
                    points.offsets_s[self.points[own]],
                    seen,
                )
                for c, (own, seen) in groups.items()
            },
            {} if tracks is None else {c: tracks[own] for c, (own, _) in groups.items()},
            replace(self.motions.scene(self.edges.drive, p), image_s=float(self.motions.since_s[p])),
            {
                c: {name: column[own] for name, column in self.terms.items()}
                for c, (own, _) in groups.items()
                if self.terms
            },
            self.edges.motion.pose(self.pairs[p].scan),
        )

    def _alignment_of(self, own: slice, motion: CameraTwist) -> Alignment:
        """The alignment of one group."""
        alone = own == slice(0, len(self)) and self.alignment.c_acceleration.ndim == 1
        return self.alignment if alone else self.alignment.of_one_image(own, motion.c_acceleration)


def _own_motion(
    groups: Sequence[tuple[DynamicObjects, SemanticClass, IntArray]],
) -> tuple[FloatArray | None, FloatArray | None]:
    """Unknown speed of each point's object (n,) [m/s], and its velocity (n, 3) [m/s]; None where no object
    moves.

    Args:
        groups: the dynamic objects of each group's scan, its class, and the object of each of its points.
    """
    unknown = [np.zeros(len(objects)) for _, _, objects in groups]
    velocities = [np.zeros((len(objects), 3)) for _, _, objects in groups]
    for (dynamic, c, objects), slow, known in zip(groups, unknown, velocities, strict=True):
        for (other, n), one in dynamic.items():
            if other == c:
                own = objects == n
                slow[own] = one.unknown_mps
                if one.velocity is not None:
                    known[own] = one.velocity.l_velocity
    slow, known = np.concatenate(unknown), np.concatenate(velocities)
    return slow if slow.any() else None, known if known.any() else None


def edges_of(
    drives: Sequence[Drive], motions: Sequence[DriveMotion], config: GraphConfig
) -> list[DriveEdges]:
    """The boundary points of drives, to be matched again and again; drives without any are left out.

    Of more than :data:`MOST_POINTS` in all so many are left, so that memory and time do not grow without end
    with the drives.
    """
    found = [
        edges
        for number, (drive, motion) in enumerate(zip(drives, motions, strict=True))
        if (edges := DriveEdges.of(number, drive, motion, config)) is not None
    ]
    total = sum(map(len, found))
    if total <= MOST_POINTS:
        return found
    most = [max(1, MOST_POINTS * len(edges) // total) for edges in found]
    return [edges.take(spread_places(np.arange(len(edges)), n)) for edges, n in zip(found, most, strict=True)]


def match_all(edges: Sequence[DriveEdges], state: State, kernel: RobustKernel) -> list[DriveMatches]:
    """The matches of each drive under a state; drives without any are left out."""
    found = [own.match(state, kernel) for own in edges]
    return [matches for matches in found if matches is not None]


def associate(
    drives: Sequence[Drive],
    motions: Sequence[DriveMotion],
    state: State,
    kernel: RobustKernel,
    config: GraphConfig,
) -> list[PairMatches]:
    """Pair scans with images in true time under a state, and match their silhouettes."""
    found = match_all(edges_of(drives, motions, config), state, kernel)
    return [pair for matches in found for pair in matches.by_pair()]

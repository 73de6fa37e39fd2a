"""From a state to matches, and from matches to a factor graph on E, D, V(k) and B(class)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import gtsam
import numpy as np
from numpy.typing import NDArray

from factors import GroupedBias, LinearTerm, delay_prior, frame_factor, twist_transfer_factor, velocity_factor
from factors.robust import RobustKernel
from sst_graph.association.boundary import Boundaries
from sst_graph.association.pairing import Pair, pair_by_time
from sst_graph.association.silhouettes import (
    BOTTOM,
    MatchConfig,
    Motion,
    SilhouetteMatches,
    match_silhouettes,
)
from sst_graph.assumptions import ASSUMPTIONS, named_sigmas
from sst_graph.assumptions.model import Scene
from sst_graph.config import Settings, setting
from sst_graph.errors import ConfigError
from sst_graph.problem.drive import Drive, outlines
from sst_graph.problem.nuisances import deviation_of, moved_twist, residual_columns
from sst_graph.problem.objects import (
    Mover,
    ObjectId,
    moving_objects,
    numbers_in,
    of_each,
    standing_share,
    tracks_of_scans,
)
from sst_graph.problem.state import (
    EXTRINSIC,
    State,
    bias_key,
    delay_key,
    nuisance_key,
    object_bias_key,
    twist_key,
    underside_track,
)
from sst_graph.problem.trajectory import GrowingTrack, TwistSample, TwistTrack, camera_twist
from sst_graph.problem.velocity import velocities_of_points
from sst_graph.types import SemanticClass

FloatArray = NDArray[np.float64]
Movers = dict[tuple[SemanticClass, int], Mover]
"""The moving objects of one scan, by class and number within the scan."""
_Share = Callable[[SemanticClass, NDArray[np.intp]], FloatArray | None]


@dataclass(frozen=True)
class GraphConfig(Settings):
    """Priors and limits of the joint graph.

    Attributes:
        match: how boundary points meet contours.
        undersides: classes whose edges towards the ground are matched too. They sharpen roll and height where
            both sides label the underside alike; hand-drawn outlines often cover the gap above the ground.
        max_interval_periods: farthest pair in true time, in image periods.
        bias_sigma_px: prior deviation of a class's mask bias from 0 [px].
        object_bias_sigma_px: deviation of an object's mask bias from its class's [px]; 0 gives every object
            of a class the same bias.
        underside_bias_sigma_px: deviation of the mask bias that the undersides of a class share from the
            class's, where objects have biases of their own [px].
        delay_sigma_s: prior deviation of the time offset from the guess [s].
        rest_sigma_rad: prior deviation of the extrinsic's rotation from the guess [rad].
        rest_sigma_m: of its translation [m]; both so wide that they matter only where the data say nothing.
        mover_reach_m: an object that moves so far by itself between its scan and its image, in a way that is
            not known, keeps half of its weight, one that moves a little farther none [m].
        still_sigma: sigmas of the twist where nothing measures it [rad/s, m/s].
        estimate: assumptions whose parameters are variables: ``name=sigma`` with the deviation from 0.
    """

    match: MatchConfig = field(default_factory=MatchConfig)
    undersides: tuple[SemanticClass, ...] = ()
    max_interval_periods: float = setting(1.0, at_least=0.01, at_most=20.0)
    bias_sigma_px: float = setting(3.0, at_least=0.001, at_most=1000.0)
    object_bias_sigma_px: float = setting(0.5, at_least=0.0, at_most=1000.0)
    underside_bias_sigma_px: float = setting(2.0, at_least=0.001, at_most=1000.0)
    delay_sigma_s: float = setting(0.3, at_least=1e-6, at_most=100.0)
    rest_sigma_rad: float = setting(1.0, at_least=1e-5, at_most=100.0)
    rest_sigma_m: float = setting(0.5, at_least=1e-5, at_most=1000.0)
    mover_reach_m: float = setting(0.003, at_least=1e-6, at_most=100.0)
    still_sigma: tuple[float, float] = setting((0.05, 0.5), at_least=1e-6, at_most=100.0)
    estimate: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if 0.0 < self.object_bias_sigma_px < 0.001:
            raise ConfigError(
                f"object_bias_sigma_px: found {self.object_bias_sigma_px:g}, expected 0 or at least 0.001 px"
            )


@dataclass(frozen=True)
class PairMatches:
    """The matches of one scan and one image.

    Attributes:
        drive: number of the drive.
        pair: positions of scan and image.
        l_twist: the LiDAR's twist at the image's instant, or None where no odometry tells it.
        motion: the camera's, under the state that the matches were made at.
        matches: by class.
        tracks: for each class, the track (n,) of the object that each match lies on; empty where objects
            share their class's mask bias.
        scene: what assumptions may depend on.
        terms: for each class, derivative (n,) of each residual by the parameters that are estimated, by name.
    """

    drive: int
    pair: Pair
    l_twist: TwistSample | None
    motion: Motion
    matches: Mapping[SemanticClass, SilhouetteMatches]
    tracks: Mapping[SemanticClass, NDArray[np.intp]] = field(default_factory=dict)
    scene: Scene | None = None
    terms: Mapping[SemanticClass, Mapping[str, FloatArray]] = field(default_factory=dict)

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

    @property
    def moved(self) -> bool:
        """Whether the LiDAR is known to move at the image's instant."""
        return self.l_twist is not None and bool(self.l_twist.twist.any())


class Tracks:
    """Twist tracks of all drives, and tracks of their objects where those are given; made once."""

    def __init__(
        self,
        drives: Sequence[Drive],
        objects: Sequence[Mapping[ObjectId, int]] | None = None,
        growing: GrowingTrack | None = None,
    ) -> None:
        """growing: of a single drive whose motions grow."""
        self._tracks: list[TwistTrack | None] = [drive.lidar_track(growing) for drive in drives]
        self.objects: Sequence[Mapping[ObjectId, int]] | None = objects
        found = zip(drives, objects, strict=True) if objects is not None else ()
        self._movers = [_by_scan(moving_objects(drive, tracks)) for drive, tracks in found]

    def seeing(self, objects: Mapping[ObjectId, int], movers: Mapping[ObjectId, Mover]) -> Tracks:
        """The same twists of one drive, with other object tracks and moving objects."""
        other = Tracks([])
        other._tracks, other.objects, other._movers = self._tracks, [objects], [_by_scan(movers)]
        return other

    def part(self, drive: int, scans: Sequence[int]) -> Tracks:
        """Of :meth:`Drive.part <sst_graph.problem.drive.Drive.part>` of one drive, which becomes drive 0."""
        other, place = Tracks([]), {position: k for k, position in enumerate(scans)}
        other._tracks = [self._tracks[drive]]
        if self.objects is not None:
            other.objects = [tracks_of_scans(self.objects[drive], scans)]
            moving = self._movers[drive]
            other._movers = [{place[scan]: own for scan, own in moving.items() if scan in place}]
        return other

    def movers(self, drive: int, scan: int) -> Movers:
        """The moving objects of a scan."""
        return self._movers[drive].get(scan, {}) if self._movers else {}

    def at(self, drive: int, stamp_ns: int) -> TwistSample | None:
        """The LiDAR's twist at a stamp of its clock, or None where no odometry tells it."""
        track = self._tracks[drive]
        return None if track is None else track.at(stamp_ns)


def _by_scan(movers: Mapping[ObjectId, Mover]) -> dict[int, Movers]:
    found: dict[int, Movers] = {}
    for (scan, c, n), mover in movers.items():
        found.setdefault(scan, {})[c, n] = mover
    return found


def _shares(
    movers: Movers, c: SemanticClass, numbers: NDArray[np.intp], reach_m: float, tau_s: float
) -> FloatArray | None:
    """(n,) share of their weight that objects of a scan keep, for they may move in an interval.

    None where all keep all of it.
    """
    own = {n: mover for (other, n), mover in movers.items() if other == c}
    if not own:
        return None
    unknown = {n: own[n].unknown_mps if n in own else 0.0 for n in numbers_in(numbers)}
    return of_each(numbers, {n: standing_share(mps, tau_s, reach_m) for n, mps in unknown.items()})


def associate(
    drives: Sequence[Drive], tracks: Tracks, state: State, kernel: RobustKernel, config: GraphConfig
) -> list[PairMatches]:
    """Pair scans with images in true time under a state, and match their silhouettes."""
    found = []
    for number, drive in enumerate(drives):
        offset_s = state.offset_s(number)
        biases = state.biases_of(number)
        limit = config.max_interval_periods * drive.image_period_s
        for pair in pair_by_time(drive.scan_stamps_ns, drive.image_stamps_ns, offset_s, limit):
            image = drive.images[pair.image]
            l_twist = tracks.at(number, image.stamp_ns + round(offset_s * 1e9))
            scene = scene_of(drive, pair.image, l_twist)
            l_twist = moved_twist(l_twist, state.nuisances, scene)
            motion = _camera_motion(l_twist, state.cTl)
            movers, tau_s = tracks.movers(number, pair.scan), offset_s + pair.base_tau_s
            share = partial(_shares, movers, reach_m=config.mover_reach_m, tau_s=tau_s)
            boundaries = _told(outlines(drive.scans[pair.scan], config.undersides), share)
            known = {name: mover.velocity.l_velocity for name, mover in movers.items() if mover.velocity}
            matches = match_silhouettes(
                boundaries,
                image.contours,
                drive.camera,
                state.cTl,
                offset_s,
                pair.base_tau_s,
                motion,
                biases,
                kernel,
                config.match,
                velocities_of_points(known, boundaries),
                deviation_of(state.nuisances, scene),
            )
            matches = {c: _weighted(m, share(c, m.objects)) for c, m in matches.items()}
            if matches:
                on = _objects_of(
                    matches, pair.scan, None if tracks.objects is None else tracks.objects[number]
                )
                at = state.cTl, offset_s, motion.c_twist
                names = [name for name, _ in named_sigmas(config.estimate)]
                terms = {
                    c: residual_columns(m.alignment, scene, pair.base_tau_s, at, names)
                    for c, m in matches.items()
                    if names
                }
                found.append(PairMatches(number, pair, l_twist, motion, matches, on, scene, terms))
    return found


def scene_of(drive: Drive, image: int, l_twist: TwistSample | None) -> Scene:
    """What assumptions about an image of a drive may depend on, beside the points."""
    origin_ns = drive.images[0].stamp_ns if drive.origin_ns is None else drive.origin_ns
    since_s = (drive.images[image].stamp_ns - origin_ns) * 1e-9
    twist = np.zeros(6) if l_twist is None else l_twist.twist
    return Scene(drive.camera, twist, since_s, drive.scan_period_s)


def _told(boundaries: Mapping[SemanticClass, Boundaries], share: _Share) -> dict[SemanticClass, Boundaries]:
    """Boundaries without the objects that would keep nothing of their weight."""
    still = {}
    for c, points in boundaries.items():
        shares = share(c, points.objects)
        still[c] = points if shares is None or shares.all() else points.take(np.flatnonzero(shares))
    return {c: points for c, points in still.items() if len(points)}


def _weighted(matches: SilhouetteMatches, shares: FloatArray | None) -> SilhouetteMatches:
    if shares is None or (shares == 1.0).all():
        return matches
    alignment = replace(matches.alignment, weights=shares * matches.alignment.weights)
    return replace(matches, alignment=alignment)


def _objects_of(
    matches: Mapping[SemanticClass, SilhouetteMatches], scan: int, tracks: Mapping[ObjectId, int] | None
) -> dict[SemanticClass, NDArray[np.intp]]:
    """Track whose mask bias each match has, by class: its object's or the undersides'; may be empty."""
    if tracks is None:
        return {}
    found = {}
    for c, m in matches.items():
        own = of_each(m.objects, {name: tracks[scan, c, name] for name in numbers_in(m.objects)})
        found[c] = np.where(m.sides == BOTTOM, underside_track(c), own)
    return found


def _camera_motion(l_twist: TwistSample | None, cTl: gtsam.Pose3) -> Motion:
    if l_twist is None:
        return Motion(np.zeros(6), np.zeros(6))
    sample = camera_twist(l_twist, cTl)
    return Motion(sample.twist, sample.acceleration)


def joint_graph(
    pairs: Sequence[PairMatches], state: State, config: GraphConfig, guess: State | None = None
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """The whole problem at a state: silhouettes, motion, weak priors around the guess (or the state)."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    _add_calibration(graph, values, state, guess or state, config)
    _add_nuisances(graph, values, state, config)
    _add_biases(graph, values, pairs, state, config)
    for pair in pairs:
        E, D, V = EXTRINSIC, delay_key(state.clock(pair.drive)), twist_key(pair.drive, pair.pair.image)
        if not values.exists(V):
            values.insert(V, pair.motion.c_twist)
            graph.add(motion_factor(pair, E, D, V, state.cTl, state.offset_s(pair.drive), config))
        graph.add(silhouettes_factor(pair, E, D, V, partial(bias_key, pair.drive), state.nuisances))
    return graph, values


def silhouettes_factor(
    pair: PairMatches,
    E: int,
    D: int,
    V: int,
    bias_of: Callable[[SemanticClass], int],
    nuisances: Mapping[str, float] | None = None,
) -> gtsam.CustomFactor:
    """All silhouette matches of one pair as one condensed factor on extrinsic, offset, twist and mask biases.

    Args:
        bias_of: key of the mask bias that a class's objects share where they have none of their own.
        nuisances: values of the assumptions' parameters that the matches were made at.
    """
    biases: list[int | float | GroupedBias | None] = []
    for c in pair.matches:
        if c in pair.tracks:
            names, groups = pair.biased[c]
            biases.append(GroupedBias(tuple(object_bias_key(pair.drive, track) for track in names), groups))
        else:
            biases.append(bias_of(c))
    at = nuisances or {}
    terms = [
        [LinearTerm(nuisance_key(name), column, at.get(name, 0.0)) for name, column in own.items()]
        for own in (pair.terms.get(c, {}) for c in pair.matches)
    ]
    return frame_factor([m.alignment for m in pair.matches.values()], E, D, V, biases, terms=terms)


def motion_factor(
    pair: PairMatches, E: int, D: int, V: int, cTl: gtsam.Pose3, offset_s: float, config: GraphConfig
) -> gtsam.NonlinearFactor:
    """What the LiDAR's odometry, where there is one, says of the twist of a pair's image.

    Args:
        cTl, offset_s: that the matches were made at.
    """
    if pair.l_twist is None:
        sigmas = np.repeat(config.still_sigma, 3)
        return velocity_factor(V, np.zeros(6), np.diag(sigmas**2))
    covariance = camera_twist(pair.l_twist, cTl).covariance
    twist, acceleration = pair.l_twist.twist, pair.l_twist.acceleration
    return twist_transfer_factor(V, E, D, twist, acceleration, offset_s, covariance)


def bias_groups(pair: PairMatches, c: SemanticClass) -> list[tuple[int, NDArray[np.intp] | None]]:
    """Key of the mask bias, and the matches that share it (None for all): by object where it is tracked."""
    if c not in pair.tracks:
        return [(bias_key(pair.drive, c), None)]
    names, groups = pair.biased[c]
    return [
        (object_bias_key(pair.drive, track), np.flatnonzero(groups == k)) for k, track in enumerate(names)
    ]


def _add_calibration(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, state: State, guess: State, config: GraphConfig
) -> None:
    sigmas = np.repeat([config.rest_sigma_rad, config.rest_sigma_m], 3)
    graph.add(gtsam.PriorFactorPose3(EXTRINSIC, guess.cTl, gtsam.noiseModel.Diagonal.Sigmas(sigmas)))
    values.insert(EXTRINSIC, state.cTl)
    for clock, offset_s in enumerate(state.offsets_s):
        graph.add(delay_prior(delay_key(clock), guess.offset_s(clock), config.delay_sigma_s))
        values.insert(delay_key(clock), np.array([offset_s]))


def _add_nuisances(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, state: State, config: GraphConfig
) -> None:
    """The parameters that are estimated, with what is known of them beforehand."""
    for name, sigma in named_sigmas(config.estimate):
        noise = gtsam.noiseModel.Isotropic.Sigma(1, sigma)
        graph.add(gtsam.PriorFactorVector(nuisance_key(name), np.zeros(1), noise))
        values.insert(nuisance_key(name), np.array([state.nuisances.get(name, 0.0)]))


def _add_biases(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    pairs: Sequence[PairMatches],
    state: State,
    config: GraphConfig,
) -> None:
    noise = gtsam.noiseModel.Isotropic.Sigma(1, config.bias_sigma_px)
    for drive, c in sorted({(pair.drive, c) for pair in pairs for c in pair.matches}):
        graph.add(gtsam.PriorFactorVector(bias_key(drive, c), np.zeros(1), noise))
        values.insert(bias_key(drive, c), np.array([state.biases_px.get((drive, c), 0.0)]))
    if not (tracked := tracked_objects(pairs)):
        return
    for drive, c, track in tracked:
        key = object_bias_key(drive, track)
        sigma_px = (
            config.underside_bias_sigma_px if track == underside_track(c) else config.object_bias_sigma_px
        )
        noise = gtsam.noiseModel.Isotropic.Sigma(1, sigma_px)
        graph.add(gtsam.BetweenFactorVector(bias_key(drive, c), key, np.zeros(1), noise))
        values.insert(key, np.array([state.object_bias_px(drive, track, c)]))


def tracked_objects(pairs: Sequence[PairMatches]) -> list[tuple[int, SemanticClass, int]]:
    """(drive, class, track) of every object with a mask bias of its own."""
    return sorted(
        {(pair.drive, c, track) for pair in pairs for c, (names, _) in pair.biased.items() for track in names}
    )


def state_from(values: gtsam.Values, state: State, pairs: Sequence[PairMatches]) -> State:
    """The state in optimised values; biases of classes that had no match stay."""
    biases = dict(state.biases_px)
    for drive, c in {(pair.drive, c) for pair in pairs for c in pair.matches}:
        biases[drive, c] = float(values.atVector(bias_key(drive, c))[0])
    objects = dict(state.object_biases_px)
    for drive, _, track in tracked_objects(pairs):
        objects[drive, track] = float(values.atVector(object_bias_key(drive, track))[0])
    offsets = tuple(float(values.atVector(delay_key(i))[0]) for i in range(len(state.offsets_s)))
    keys = {name: nuisance_key(name) for name in ASSUMPTIONS}
    estimated = {name: float(values.atVector(key)[0]) for name, key in keys.items() if values.exists(key)}
    return State(values.atPose3(EXTRINSIC), offsets, biases, objects, {**state.nuisances, **estimated})

"""From a state to matches, and from matches to a factor graph on E, D, V(k) and B(class)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import gtsam
import numpy as np
from numpy.typing import NDArray

from factors import delay_prior, frame_factor, twist_transfer_factor, velocity_factor
from factors.robust import RobustKernel
from sst_graph.association.pairing import Pair, pair_by_time
from sst_graph.association.silhouettes import MatchConfig, Motion, SilhouetteMatches, match_silhouettes
from sst_graph.problem.drive import Drive
from sst_graph.problem.state import EXTRINSIC, State, bias_key, delay_key, twist_key
from sst_graph.problem.trajectory import TwistSample, TwistTrack, camera_twist
from sst_graph.types import SemanticClass

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class GraphConfig:
    """Priors and limits of the joint graph.

    Attributes:
        match: how boundary points meet contours.
        max_interval_periods: farthest pair in true time, in image periods.
        bias_sigma_px: prior deviation of a mask bias from 0 [px].
        delay_sigma_s: prior deviation of the time offset from 0 [s].
        rest_sigma_rad: prior deviation of the extrinsic's rotation from the start [rad].
        rest_sigma_m: of its translation [m]; both so wide that they only keep an unseen direction finite.
        still_sigma: sigmas of the twist where nothing measures it [rad/s, m/s].
    """

    match: MatchConfig = field(default_factory=MatchConfig)
    max_interval_periods: float = 1.0
    bias_sigma_px: float = 3.0
    delay_sigma_s: float = 1.0
    rest_sigma_rad: float = 1.0
    rest_sigma_m: float = 3.0
    still_sigma: tuple[float, float] = (0.05, 0.5)


@dataclass(frozen=True)
class PairMatches:
    """The matches of one scan and one image.

    Attributes:
        drive: number of the drive.
        pair: positions of scan and image.
        l_twist: the LiDAR's twist at the image's instant, or None where no odometry tells it.
        motion: the camera's, under the state that the matches were made at.
        matches: by class.
    """

    drive: int
    pair: Pair
    l_twist: TwistSample | None
    motion: Motion
    matches: Mapping[SemanticClass, SilhouetteMatches]

    def __len__(self) -> int:
        return sum(len(matches) for matches in self.matches.values())


class Tracks:
    """Twist tracks of all drives, made once."""

    def __init__(self, drives: Sequence[Drive]) -> None:
        self._tracks: list[TwistTrack | None] = [drive.lidar_track() for drive in drives]

    def at(self, drive: int, stamp_ns: int) -> TwistSample | None:
        """The LiDAR's twist at a stamp of its clock, or None where no odometry tells it."""
        track = self._tracks[drive]
        return None if track is None else track.at(stamp_ns)


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
            motion = _camera_motion(l_twist, state.cTl)
            matches = match_silhouettes(
                drive.scans[pair.scan].boundaries,
                image.contours,
                drive.camera,
                state.cTl,
                offset_s,
                pair.base_tau_s,
                motion,
                biases,
                kernel,
                config.match,
            )
            if matches:
                found.append(PairMatches(number, pair, l_twist, motion, matches))
    return found


def _camera_motion(l_twist: TwistSample | None, cTl: gtsam.Pose3) -> Motion:
    if l_twist is None:
        return Motion(np.zeros(6), np.zeros(6))
    sample = camera_twist(l_twist, cTl)
    return Motion(sample.twist, sample.acceleration)


def joint_graph(
    pairs: Sequence[PairMatches], state: State, config: GraphConfig
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """The whole problem at a state: silhouettes, motion, priors."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    _add_calibration(graph, values, state, config)
    _add_biases(graph, values, pairs, state, config)
    for pair in pairs:
        _add_motion(graph, values, pair, state, config)
        graph.add(silhouettes_of(pair, state))
    return graph, values


def silhouettes_of(pair: PairMatches, state: State) -> gtsam.CustomFactor:
    """All silhouette matches of one pair as one condensed factor on E, D, V(image), B(class)."""
    classes = list(pair.matches)
    return frame_factor(
        [pair.matches[c].alignment for c in classes],
        EXTRINSIC,
        delay_key(state.clock(pair.drive)),
        twist_key(pair.drive, pair.pair.image),
        [bias_key(pair.drive, c) for c in classes],
    )


def _add_calibration(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, state: State, config: GraphConfig
) -> None:
    sigmas = np.repeat([config.rest_sigma_rad, config.rest_sigma_m], 3)
    graph.add(gtsam.PriorFactorPose3(EXTRINSIC, state.cTl, gtsam.noiseModel.Diagonal.Sigmas(sigmas)))
    values.insert(EXTRINSIC, state.cTl)
    for clock, offset_s in enumerate(state.offsets_s):
        graph.add(delay_prior(delay_key(clock), offset_s, config.delay_sigma_s))
        values.insert(delay_key(clock), np.array([offset_s]))


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


def _add_motion(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    pair: PairMatches,
    state: State,
    config: GraphConfig,
) -> None:
    """The twist of the pair's image, tied to the LiDAR's odometry where there is one."""
    key = twist_key(pair.drive, pair.pair.image)
    if values.exists(key):
        return
    values.insert(key, pair.motion.c_twist)
    if pair.l_twist is None:
        sigmas = np.repeat(config.still_sigma, 3)
        graph.add(velocity_factor(key, np.zeros(6), np.diag(sigmas**2)))
        return
    covariance = camera_twist(pair.l_twist, state.cTl).covariance
    graph.add(
        twist_transfer_factor(
            key,
            EXTRINSIC,
            delay_key(state.clock(pair.drive)),
            pair.l_twist.twist,
            pair.l_twist.acceleration,
            state.offset_s(pair.drive),
            covariance,
        )
    )


def state_from(values: gtsam.Values, state: State, pairs: Sequence[PairMatches]) -> State:
    """The state in optimised values; biases of classes that had no match stay."""
    biases = dict(state.biases_px)
    for drive, c in {(pair.drive, c) for pair in pairs for c in pair.matches}:
        biases[drive, c] = float(values.atVector(bias_key(drive, c))[0])
    offsets = tuple(float(values.atVector(delay_key(i))[0]) for i in range(len(state.offsets_s)))
    return State(values.atPose3(EXTRINSIC), offsets, biases)

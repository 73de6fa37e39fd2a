"""The graph of :mod:`sst_graph.experiments.slam`: a pose graph, and what the camera adds to it."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import gtsam
import numpy as np

from sst_graph.association.edge_matching import MatchConfig
from sst_graph.config import Settings, setting
from sst_graph.drive.preparation import Drive
from sst_graph.factors import (
    CameraMotion,
    GroupedBias,
    camera_motion_factor,
    pose_alignment_factor,
    time_offset_prior,
)
from sst_graph.objects.tracks import ObjectId, object_tracks
from sst_graph.odometry import LoopClosure, metric_motions
from sst_graph.slam.alignment_keys import AlignmentKeys, Trajectory
from sst_graph.slam.alignment_term import AlignmentTerm, TermConfig, TermMatches, TermPlace
from sst_graph.types import Calibration, FloatArray, RelativeMotion, SemanticClass

EXTRINSIC, TIME_OFFSET, BIAS = (int(gtsam.symbol(letter, 0)) for letter in "EDB")
"""Keys of the extrinsic, the time offset and the vehicles' common mask bias."""
VEHICLE = SemanticClass.VEHICLE


@dataclass(frozen=True)
class CameraGraphConfig(Settings):
    """What the camera adds to a pose graph.

    Attributes:
        kernel_px: scales of the silhouettes' robust kernel, one for each renewal of the matches [px].
        match: how boundary points meet contours.
        bias_sigma_px: prior deviation of the mask bias from 0 [px].
        object_bias_sigma_px: deviation of an object's mask bias from the common one [px].
        nominal_rad, nominal_m: prior deviation of the extrinsic from the nominal one [rad], [m].
        time_offset_sigma_s: prior deviation of the time offset from 0 [s].
        between_rad, between_m: how far the body's motion is from one twist between two poses [rad], [m];
            added to the sigmas of visual odometry.
        silhouettes, visual_odometry: which of the camera's factors there are.
    """

    kernel_px: tuple[float, ...] = setting(
        (5.0, 4.0, 3.0, 3.0, 3.0), at_least=0.1, at_most=1000.0, length=(1, 100)
    )
    match: MatchConfig = field(default_factory=MatchConfig)
    bias_sigma_px: float = setting(3.0, at_least=0.001, at_most=1000.0)
    object_bias_sigma_px: float = setting(0.5, at_least=0.001, at_most=1000.0)
    nominal_rad: float = setting(0.2, at_least=1e-5, at_most=100.0)
    nominal_m: float = setting(0.5, at_least=1e-5, at_most=1000.0)
    time_offset_sigma_s: float = setting(1.0, at_least=1e-6, at_most=100.0)
    between_rad: float = setting(3.5e-4, at_least=0.0, at_most=10.0)
    between_m: float = setting(4e-3, at_least=0.0, at_most=100.0)
    silhouettes: bool = True
    visual_odometry: bool = True


def pose_key(scan: int) -> int:
    """Key of wTl at a scan."""
    return int(gtsam.symbol("X", scan))


def pose_graph(
    motions: Sequence[RelativeMotion], closures: Sequence[LoopClosure] = ()
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Odometry and loop closures on the LiDAR's poses, the first held at the origin; the odometry's poses."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    held = gtsam.noiseModel.Isotropic.Sigma(6, 1e-4)
    graph.add(gtsam.PriorFactorPose3(pose_key(0), gtsam.Pose3(), held))
    values.insert(pose_key(0), gtsam.Pose3())
    for k, motion in enumerate(motions):
        noise = gtsam.noiseModel.Gaussian.Covariance(motion.covariance)
        graph.add(gtsam.BetweenFactorPose3(pose_key(k), pose_key(k + 1), motion.aTb, noise))
        values.insert(pose_key(k + 1), values.atPose3(pose_key(k)) * motion.aTb)
    huber = gtsam.noiseModel.mEstimator.Huber.Create(1.5)
    for closure in closures:
        noise = gtsam.noiseModel.Gaussian.Covariance(closure.motion.covariance)
        robust = gtsam.noiseModel.Robust.Create(huber, noise)
        ends = pose_key(closure.first), pose_key(closure.second)
        graph.add(gtsam.BetweenFactorPose3(*ends, closure.motion.aTb, robust))
    return graph, values


def with_camera(
    graph: gtsam.NonlinearFactorGraph,
    poses: gtsam.Values,
    drive: Drive,
    start: Calibration,
    nominal: gtsam.Pose3,
    config: CameraGraphConfig,
) -> gtsam.Values:
    """Poses, extrinsic and time offset together: match, optimise, match again under a narrower kernel.

    Args:
        graph, poses: :func:`pose_graph`, and where its poses are.
        drive: of the same scans; poses and scans correspond one to one.
        start: calibration where the first matches are made.
        nominal: what the weak prior on the extrinsic is centred on.
        config: settings.
    """
    tracks = object_tracks(drive)
    values = gtsam.Values(poses)
    values.insert(EXTRINSIC, start.cTl)
    values.insert(TIME_OFFSET, np.array([start.time_offset_s]))
    values.insert(BIAS, np.zeros(1))
    stamps = drive.scan_stamps_ns
    trajectory = Trajectory([pose_key(k) for k in range(len(stamps))], stamps)
    keys = AlignmentKeys(trajectory, EXTRINSIC, TIME_OFFSET, {VEHICLE: BIAS})
    settings = TermConfig(match=config.match, min_matches=1)
    terms = [AlignmentTerm(drive.scans, image, drive.camera, keys, settings) for image in drive.images]
    for kernel_px in config.kernel_px:
        whole = gtsam.NonlinearFactorGraph(graph)
        _add_priors(whole, nominal, config)
        if config.silhouettes:
            matches = [term.matched(values, kernel_px) for term in terms]
            values = _add_silhouettes(whole, values, matches, tracks, config)
        if config.visual_odometry:
            _add_visual_odometry(whole, values, drive, terms, config)
        values = gtsam.LevenbergMarquardtOptimizer(whole, values).optimize()
    return values


def _add_priors(graph: gtsam.NonlinearFactorGraph, nominal: gtsam.Pose3, config: CameraGraphConfig) -> None:
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.repeat([config.nominal_rad, config.nominal_m], 3))
    graph.add(gtsam.PriorFactorPose3(EXTRINSIC, nominal, noise))
    graph.add(time_offset_prior(TIME_OFFSET, 0.0, config.time_offset_sigma_s))
    graph.add(time_offset_prior(BIAS, 0.0, config.bias_sigma_px))


def _add_silhouettes(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    matches: Sequence[TermMatches],
    tracks: Mapping[ObjectId, int],
    config: CameraGraphConfig,
) -> gtsam.Values:
    """The matches of every image, with a mask bias for each object; the values then."""
    seen = set[int]()
    for each in matches:
        if each.place is None or not len(each):
            continue
        numbers = np.concatenate(each.found.objects)
        of_match = [_object_key(tracks[each.place.scan, VEHICLE, int(number)]) for number in numbers]
        keys, groups = np.unique(np.array(of_match, dtype=np.uint64), return_inverse=True)
        objects = [int(key) for key in keys]
        seen.update(objects)
        biases = GroupedBias(tuple(objects), groups)
        between = each.place.between
        graph.add(pose_alignment_factor(each.found.alignments, between, EXTRINSIC, TIME_OFFSET, biases))
    return _with_object_biases(graph, values, seen, config)


def _with_object_biases(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, seen: set[int], config: CameraGraphConfig
) -> gtsam.Values:
    """Tie every object's bias to the common one; values of the objects that are seen, and of no other."""
    kept = gtsam.Values(values)
    letter = gtsam.Symbol(_object_key(0)).chr()
    for key in values.keys():  # noqa: SIM118  (gtsam, no dict)
        if gtsam.Symbol(key).chr() == letter and key not in seen:
            kept.erase(key)
    noise = gtsam.noiseModel.Isotropic.Sigma(1, config.object_bias_sigma_px)
    for key in sorted(seen):
        graph.add(gtsam.BetweenFactorVector(BIAS, key, np.zeros(1), noise))
        if not kept.exists(key):
            kept.insert(key, values.atVector(BIAS))
    return kept


def _object_key(track: int) -> int:
    return int(gtsam.symbol("o", track))


def _add_visual_odometry(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    drive: Drive,
    terms: Sequence[AlignmentTerm],
    config: CameraGraphConfig,
) -> None:
    """Motions of the camera, metric by the depth that the calibration in the values gives to its features."""
    places = [term.place(values) for term in terms]
    keys = terms[0].keys

    def depth(position: int) -> FloatArray:
        place = places[position]
        if not isinstance(place, TermPlace):
            return np.zeros((0, 3))
        twist = keys.trajectory.twist(values, place.position)
        assert twist is not None  # both poses are there
        tau = place.between.image_after_a_s + keys.offset(values)
        aTs = values.atPose3(place.between.X_a).between(values.atPose3(place.between.X_s))
        cTs = keys.extrinsic(values) * gtsam.Pose3.Expmap(-tau * twist) * aTs
        return np.asarray(cTs.transformFrom(drive.scans[place.scan].depth_lPs.astype(np.float64).T)).T

    motions = metric_motions(drive.image_pairs, drive.camera, depth)
    between = np.diag(np.repeat([config.between_rad, config.between_m], 3) ** 2)
    for (first, second), motion in zip(itertools.pairwise(places), motions, strict=True):
        if motion.ok and isinstance(first, TermPlace) and isinstance(second, TermPlace):
            camera_motion = CameraMotion(motion.aTb, motion.covariance + between)
            ends = first.between, second.between
            graph.add(camera_motion_factor(*ends, EXTRINSIC, TIME_OFFSET, camera_motion))

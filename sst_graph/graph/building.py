"""From matches to a factor graph on E, D, V(k) and B(class)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import gtsam
import numpy as np

from sst_graph.assumptions import ASSUMPTIONS, named_sigmas
from sst_graph.drive.twists import camera_twist
from sst_graph.factors import (
    GroupedBias,
    LidarTwist,
    LinearTerm,
    frame_factor,
    time_offset_prior,
    twist_transfer_factor,
    velocity_factor,
)
from sst_graph.graph.matching import GraphConfig, PairMatches
from sst_graph.graph.state import (
    EXTRINSIC,
    State,
    bias_key,
    lower_edge_track,
    nuisance_key,
    object_bias_key,
    time_offset_key,
    twist_key,
)
from sst_graph.types import SemanticClass

LOWER_EDGE_BIAS_SIGMA_PX = 2.0
"""Deviation of the mask bias that the lower edges of a class share from the class's, where objects have
biases of their own [px]: labels end an object at its body, its wheels or its shadow."""
PRIOR_ROTATION_SIGMA_RAD, PRIOR_TRANSLATION_SIGMA_M = 1.0, 0.5
"""Prior deviations of the extrinsic from the guess: so wide that they matter only where the data say
nothing."""
UNKNOWN_TWIST_SIGMAS = np.repeat([0.05, 0.5], 3)
"""(6,) deviations of the camera's twist from 0 where no odometry measures it [rad/s, m/s]: a vehicle that
stands, or moves so slowly that the scan's motion is smaller than other errors."""


def joint_graph(
    pairs: Sequence[PairMatches], state: State, config: GraphConfig, guess: State | None = None
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """The whole problem at a state: silhouettes, motion, weak priors around the guess (or the state)."""
    classes = sorted({(pair.drive, c) for pair in pairs for c in pair.matches})
    graph, values = prior_graph(classes, tracked_objects(pairs), state, config, guess)
    for pair in pairs:
        E, D, V = EXTRINSIC, time_offset_key(state.clock(pair.drive)), twist_key(pair.drive, pair.pair.image)
        if not values.exists(V):
            values.insert(V, pair.motion.c_twist)
            graph.add(motion_factor(pair, E, D, V, state.cTl, state.time_offset_s(pair.drive)))
        graph.add(silhouettes_factor(pair, E, D, V, partial(bias_key, pair.drive), state.nuisances))
    return graph, values


def prior_graph(
    classes: Sequence[tuple[int, SemanticClass]],
    objects: Sequence[tuple[int, SemanticClass, int]],
    state: State,
    config: GraphConfig,
    guess: State | None = None,
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Priors of all unknowns but the twists, and the values of these unknowns at a state.

    Args:
        classes: (drive, class) of every class that has matches.
        objects: (drive, class, track) of every object with a mask bias of its own.
        guess: what the weak priors are centred on; by default the state.
    """
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    _add_calibration(graph, values, state, guess or state, config)
    _add_nuisances(graph, values, state, config)
    _add_biases(graph, values, classes, objects, state, config)
    return graph, values


def silhouettes_factor(
    pair: PairMatches,
    E: int,
    D: int,
    V: int,
    bias_of: Callable[[SemanticClass], int],
    nuisances: Mapping[str, float] | None,
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
    pair: PairMatches, E: int, D: int, V: int, cTl: gtsam.Pose3, time_offset_s: float
) -> gtsam.NonlinearFactor:
    """The LiDAR odometry's measurement of the twist at a pair's image; without odometry a wide prior.

    Args:
        cTl, time_offset_s: that the matches were made at.
    """
    if pair.l_twist is None:
        return velocity_factor(V, np.zeros(6), np.diag(UNKNOWN_TWIST_SIGMAS**2))
    covariance = camera_twist(pair.l_twist, cTl).covariance
    lidar_twist = LidarTwist(pair.l_twist.twist, pair.l_twist.acceleration, time_offset_s)
    return twist_transfer_factor(V, E, D, lidar_twist, covariance)


def _add_calibration(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, state: State, guess: State, config: GraphConfig
) -> None:
    sigmas = np.repeat([PRIOR_ROTATION_SIGMA_RAD, PRIOR_TRANSLATION_SIGMA_M], 3)
    graph.add(gtsam.PriorFactorPose3(EXTRINSIC, guess.cTl, gtsam.noiseModel.Diagonal.Sigmas(sigmas)))
    values.insert(EXTRINSIC, state.cTl)
    for clock, time_offset_s in enumerate(state.time_offsets_s):
        graph.add(
            time_offset_prior(time_offset_key(clock), guess.time_offset_s(clock), config.time_offset_sigma_s)
        )
        values.insert(time_offset_key(clock), np.array([time_offset_s]))


def _add_nuisances(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, state: State, config: GraphConfig
) -> None:
    """The assumptions' parameters that are estimated, with their priors."""
    for name, sigma in named_sigmas(config.estimate):
        noise = gtsam.noiseModel.Isotropic.Sigma(1, sigma)
        graph.add(gtsam.PriorFactorVector(nuisance_key(name), np.zeros(1), noise))
        values.insert(nuisance_key(name), np.array([state.nuisances.get(name, 0.0)]))


def _add_biases(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    classes: Sequence[tuple[int, SemanticClass]],
    objects: Sequence[tuple[int, SemanticClass, int]],
    state: State,
    config: GraphConfig,
) -> None:
    noise = gtsam.noiseModel.Isotropic.Sigma(1, config.mask_bias_sigma_px)
    for drive, c in classes:
        graph.add(gtsam.PriorFactorVector(bias_key(drive, c), np.zeros(1), noise))
        values.insert(bias_key(drive, c), np.array([state.biases_px.get((drive, c), 0.0)]))
    if not objects:
        return
    lower, own = LOWER_EDGE_BIAS_SIGMA_PX, config.object_bias_sigma_px
    lower_noise, own_noise = (gtsam.noiseModel.Isotropic.Sigma(1, sigma_px) for sigma_px in (lower, own))
    for drive, c, track in objects:
        key, noise = object_bias_key(drive, track), lower_noise if track == lower_edge_track(c) else own_noise
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
    offsets = tuple(float(values.atVector(time_offset_key(i))[0]) for i in range(len(state.time_offsets_s)))
    keys = {name: nuisance_key(name) for name in ASSUMPTIONS}
    estimated = {name: float(values.atVector(key)[0]) for name, key in keys.items() if values.exists(key)}
    return State(values.atPose3(EXTRINSIC), offsets, biases, objects, {**state.nuisances, **estimated})

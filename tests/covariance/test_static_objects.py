"""The covariance by static objects alone."""

from __future__ import annotations

import dataclasses

import gtsam
import numpy as np
from linear_systems import system_of
from streets import prepared_street, standing_street

from sst_graph.batch import CalibrationConfig
from sst_graph.batch.method_estimate import MethodEstimate, result_of
from sst_graph.covariance.cluster_robust import RobustCovariance, robust_covariance
from sst_graph.covariance.static_objects import static_covariance
from sst_graph.factors import RobustKernel
from sst_graph.graph.building import joint_graph
from sst_graph.graph.drive_motion import motions_of
from sst_graph.graph.matching import GraphConfig, PairMatches, associate
from sst_graph.graph.state import State
from sst_graph.objects.tracks import ObjectId, object_tracks
from sst_graph.types import Guess, SemanticClass

CONFIG = GraphConfig()
VEHICLE = SemanticClass.VEHICLE


def matched() -> tuple[State, list[PairMatches], dict[ObjectId, int]]:
    drive = prepared_street()
    tracks, state = object_tracks(drive), State(standing_street().truth.cTl)
    kernel = RobustKernel("geman_mcclure", 3.0)
    return state, associate([drive], motions_of([drive], [tracks]), state, kernel, CONFIG), tracks


def robust_of(pairs: list[PairMatches], state: State, tracks: dict[ObjectId, int]) -> RobustCovariance:
    graph, values = joint_graph(pairs, state, CONFIG)
    return robust_covariance(system_of(graph, values), values, pairs, state, [tracks])


def of_track(pair: PairMatches, track: int) -> np.ndarray:
    """(m,) whether matches are of an object."""
    return np.asarray(pair.tracks[VEHICLE] == track)


def moving(pair: PairMatches, track: int) -> PairMatches:
    """An object of the pair has a velocity, too small to matter."""
    matches = pair.matches[VEHICLE]
    velocities = np.where(of_track(pair, track)[:, None], 1e-12, np.zeros((len(matches), 3)))
    alignment = dataclasses.replace(matches.alignment, l_velocities=velocities)
    return dataclasses.replace(pair, matches={VEHICLE: dataclasses.replace(matches, alignment=alignment)})


def without(pair: PairMatches, track: int) -> PairMatches:
    kept, matches = np.flatnonzero(~of_track(pair, track)), pair.matches[VEHICLE]
    part = {name: getattr(matches, name)[kept] for name in ("objects", "sides", "index", "level_px")}
    fewer = dataclasses.replace(matches, alignment=matches.alignment.take(kept), **part)
    return dataclasses.replace(pair, matches={VEHICLE: fewer}, tracks={VEHICLE: pair.tracks[VEHICLE][kept]})


def test_it_is_the_covariance_without_the_others() -> None:
    state, pairs, tracks = matched()
    seen, counts = np.unique(np.concatenate([p.tracks[VEHICLE] for p in pairs]), return_counts=True)
    track = int(seen[counts.argmax()])
    given = [moving(pair, track) for pair in pairs]
    robust = robust_of(given, state, tracks)
    alone = static_covariance(robust, given)[:7, :7]
    expected = robust_of([without(pair, track) for pair in pairs], state, tracks).matrix[:7, :7]
    ratios = np.sqrt(np.diag(alone) / np.diag(expected))
    assert (np.abs(ratios[:6] - 1.0) < 0.15).all()
    assert np.sqrt(np.diag(alone) / np.diag(robust.matrix[:7, :7])).max() > 1.2


def test_where_nothing_moves_it_is_the_whole_one() -> None:
    state, pairs, tracks = matched()
    robust = robust_of(pairs, state, tracks)
    assert static_covariance(robust, pairs) is robust.matrix


def test_what_only_dynamic_objects_determine_is_unobservable() -> None:
    good = np.diag(np.array([1e-3] * 3 + [0.01] * 3 + [0.0005]) ** 2)
    step = np.array([0.0, 0.0, 0.0, 0.06, 0.0, 0.0, 0.0075])
    for by_static_objects, status in (
        (None, "ok"),
        (good, "ok"),
        (good + np.outer(step, step), "unobservable"),
    ):
        answer = MethodEstimate(
            standing_street().truth.cTl, 0.1, good, (), by_static_objects=by_static_objects
        )
        result = result_of(answer, [prepared_street()], Guess(gtsam.Pose3()), CalibrationConfig())
        assert result.status == status
    assert "by static objects alone" in result.reasons[0] and len(result.weak_directions) == 1

"""Keys of the joint graph, and the graph of a small simulated drive."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from streets import prepared_street, standing_street

from sst_graph.factors import RobustKernel
from sst_graph.graph.building import PRIOR_ROTATION_SIGMA_RAD, joint_graph, state_from, tracked_objects
from sst_graph.graph.drive_motion import motions_of
from sst_graph.graph.matching import (
    MOST_POINTS,
    GraphConfig,
    PairMatches,
    associate,
    edges_of,
    match_all,
)
from sst_graph.graph.state import EXTRINSIC, State, bias_key, object_bias_key, time_offset_key, twist_key
from sst_graph.objects.tracks import object_tracks
from sst_graph.types import SemanticClass

VEHICLE = SemanticClass.VEHICLE
CONFIG = GraphConfig()


def matched(by_object: bool) -> tuple[State, list[PairMatches]]:
    source, drive = standing_street(0.0), prepared_street(0.0)
    motions = motions_of([drive], [object_tracks(drive)] if by_object else None)
    state = State(source.truth.cTl)
    return state, associate([drive], motions, state, RobustKernel("geman_mcclure", 3.0), CONFIG)


def test_keys_are_distinct() -> None:
    keys = [EXTRINSIC, *(time_offset_key(clock) for clock in range(3))]
    keys += [twist_key(d, k) for d in range(3) for k in (0, 1, 9_999_999)]
    keys += [bias_key(d, c) for d in range(3) for c in SemanticClass]
    keys += [object_bias_key(d, k) for d in range(3) for k in (0, 1, 9_999_999)]
    assert len(set(keys)) == len(keys)


def test_clocks_and_biases_of_a_state() -> None:
    shared = State(gtsam.Pose3(), (0.1,), {(0, VEHICLE): 0.5, (1, VEHICLE): -0.5}, {(0, 7): 0.8})
    assert [shared.clock(d) for d in (0, 1)] == [0, 0] and shared.time_offset_s(1) == 0.1
    own = State(gtsam.Pose3(), (0.1, 0.2))
    assert [own.time_offset_s(d) for d in (0, 1)] == [0.1, 0.2]
    assert shared.biases_of(1) == {VEHICLE: -0.5}
    # An object's bias is its class's until it has its own.
    assert [shared.object_bias_px(0, t, VEHICLE) for t in (7, 8)] == [0.8, 0.5]
    assert shared.object_bias_px(2, 7, VEHICLE) == 0.0


def test_part_of_the_way_to_another_state() -> None:
    turn = np.array([0.1, -0.2, 0.3, 1.0, 2.0, -1.0])
    here = State(gtsam.Pose3(), (0.0, 1.0), {(0, VEHICLE): 1.0}, {(0, 7): 1.0})
    there = State(gtsam.Pose3.Expmap(turn), (1.0, 1.0), {(0, VEHICLE): 3.0}, {(0, 7): 2.0, (0, 8): 5.0})
    way = here.towards(there, 0.25)
    np.testing.assert_allclose(gtsam.Pose3.Logmap(way.cTl), 0.25 * turn, atol=1e-12)
    assert way.time_offsets_s == (0.25, 1.0) and way.biases_px == {(0, VEHICLE): 1.5}
    # A bias that was not known before is taken over.
    assert way.object_biases_px == {(0, 7): 1.25, (0, 8): 5.0}
    assert here.towards(there, 1.0) is there


def test_matches_know_their_boundary_points_beside_objects_of_unknown_speed() -> None:
    source, drive = standing_street(0.0), prepared_street(0.0)
    edges = edges_of([drive], motions_of([drive]), CONFIG)
    fast = np.where(np.isin(edges[0].owners, np.unique(edges[0].owners)[::2]), 30.0, 0.0)
    away = State(source.truth.cTl, (0.01,))
    (matches,) = match_all([replace(edges[0], unknown_mps=fast)], away, RobustKernel("geman_mcclure", 3.0))
    assert not fast[matches.points].any() and (matches.places < matches.points).any()
    for pair in matches.by_pair():
        for c, found in pair.matches.items():
            points = drive.scans[pair.pair.scan].boundaries[c]
            np.testing.assert_array_equal(points.lPs[found.index], found.alignment.lPs)


def test_of_long_drives_so_many_points_are_matched_spread_over_all_scans() -> None:
    drive = prepared_street(0.0)
    (one,) = edges_of([drive], motions_of([drive]), CONFIG)
    copies = 2 * MOST_POINTS // len(one)
    many = edges_of([drive] * copies, motions_of([drive]) * copies, CONFIG)
    assert 0.99 * MOST_POINTS < sum(map(len, many)) <= MOST_POINTS
    for edges in (many[0], many[-1]):
        kept = np.diff(edges.bounds) / np.diff(one.bounds)
        assert edges.scans == one.scans and kept.min() > 0.4 and kept.max() < 0.6
        assert set(np.flatnonzero(np.bincount(one.owners) > 3)) <= set(edges.owners.tolist())


@pytest.mark.parametrize("by_object", [False, True])
def test_the_factors_of_a_joint_graph(by_object: bool) -> None:
    state, pairs = matched(by_object)
    assert [(p.pair.scan, p.pair.image) for p in pairs] == [(0, 0), (1, 1), (2, 2)]
    assert min(len(p) for p in pairs) > 20
    graph, values = joint_graph(pairs, state, CONFIG)
    objects = tracked_objects(pairs)
    assert bool(objects) == by_object
    twists = [twist_key(0, k) for k in range(3)]
    biases = [object_bias_key(0, track) for _, _, track in objects]
    expected = {EXTRINSIC, time_offset_key(), bias_key(0, VEHICLE), *twists, *biases}
    assert set(values.keys()) == expected
    # Priors on E, D and B; a tie of every object's bias; a twist and the silhouettes of every image.
    assert graph.size() == 3 + len(objects) + 2 * 3
    ties = [set(graph.at(i).keys()) for i in range(graph.size())]
    for key in twists:
        assert {key, EXTRINSIC, time_offset_key()} in ties
        assert any({key, EXTRINSIC, time_offset_key()} < tie for tie in ties)
    for key in biases:
        assert {key, bias_key(0, VEHICLE)} in ties
    assert np.isfinite(graph.error(values))


def test_the_optimum_is_near_the_truth_and_becomes_the_state() -> None:
    state, pairs = matched(True)
    graph, values = joint_graph(pairs, state, CONFIG)
    optimum = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    assert graph.error(optimum) <= graph.error(values)
    found = state_from(optimum, state, pairs)
    assert np.degrees(np.linalg.norm(gtsam.Rot3.Logmap(found.cTl.between(state.cTl).rotation()))) < 0.5
    assert found.biases_px[0, VEHICLE] == optimum.atVector(bias_key(0, VEHICLE))[0]
    assert set(found.object_biases_px) == {(0, track) for _, _, track in tracked_objects(pairs)}
    assert found.time_offsets_s == (optimum.atVector(time_offset_key())[0],)


def test_a_guess_is_what_the_priors_hold() -> None:
    state, pairs = matched(False)
    guess = State(state.cTl.retract(np.array([0.5, 0.0, 0.0, 0.0, 0.0, 0.0])), (0.25,))
    at_guess, values = joint_graph(pairs, state, CONFIG, guess)
    at_state, _ = joint_graph(pairs, state, CONFIG)
    excess = at_guess.error(values) - at_state.error(values)
    off = np.array([0.5 / PRIOR_ROTATION_SIGMA_RAD, 0.25 / CONFIG.time_offset_sigma_s])
    assert excess == pytest.approx(0.5 * off @ off, rel=1e-6)

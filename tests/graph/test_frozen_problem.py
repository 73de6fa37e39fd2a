"""The frozen problem, worked out for all images at once, against the gtsam graph of the same matches."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import gtsam
import numpy as np
import pytest
from linear_systems import system_of
from streets import prepared_street, standing_street

from sst_graph.covariance.cluster_robust import robust_covariance
from sst_graph.drive.preparation import Drive, ScanFeatures
from sst_graph.factors import RobustKernel
from sst_graph.graph.building import joint_graph, state_from
from sst_graph.graph.drive_motion import DriveMotion, motions_of
from sst_graph.graph.frozen_problem import FrozenProblem, NormalEquations
from sst_graph.graph.known import KnownCalibration
from sst_graph.graph.matching import DriveMatches, GraphConfig, associate, edges_of, match_all
from sst_graph.graph.state import EXTRINSIC, State, difference, time_offset_key
from sst_graph.objects.dynamic_objects import DynamicObject
from sst_graph.objects.tracks import ObjectId, object_tracks
from sst_graph.objects.velocity import ObjectVelocity
from sst_graph.types import SemanticClass

VEHICLE = SemanticClass.VEHICLE
KERNEL = RobustKernel("geman_mcclure", 5.0)
L_TWIST = np.array([0.02, -0.03, 0.2, 5.0, 0.3, -0.1])
PLAIN = GraphConfig(lower_edges=(VEHICLE,))
FREE = replace(PLAIN, estimate=("focal", "range_scale", "skew=0.001"))


@cache
def moving(rolling: bool) -> Drive:
    """The standing street as if the LiDAR had turned and driven, and with times of its points."""
    drive = prepared_street()
    turn = np.array([1.0, 1.2])[: len(drive.lidar_motions)]
    motions = [
        replace(motion, aTb=gtsam.Pose3.Expmap(motion.seconds * scale * L_TWIST))
        for motion, scale in zip(drive.lidar_motions, turn, strict=True)
    ]

    def timed(scan: ScanFeatures) -> ScanFeatures:
        both = [
            {c: replace(b, offsets_s=0.05 * np.arctan2(b.lPs[:, 1], b.lPs[:, 0])) for c, b in own.items()}
            for own in (scan.boundaries, scan.lower_edges)
        ]
        return replace(scan, boundaries=both[0], lower_edges=both[1])

    scans = tuple(timed(scan) for scan in drive.scans) if rolling else drive.scans
    return replace(drive, scans=scans, lidar_motions=tuple(motions))


def matched(drives: list[Drive], state: State, config: GraphConfig, by_object: bool) -> list[DriveMatches]:
    motions = motions_of(drives, [object_tracks(drive) for drive in drives] if by_object else None)
    return match_all(edges_of(drives, motions, config), state, KERNEL)


def whole(system: NormalEquations) -> tuple[np.ndarray, np.ndarray]:
    """H and g of all unknowns, the twists last."""
    n, f = len(system.g), len(system.g_twists)
    H = np.zeros((n + 6 * f, n + 6 * f))
    H[:n, :n] = system.H
    H[n:, :n] = system.H_mixed.reshape(-1, n)
    H[:n, n:] = H[n:, :n].T
    for k, block in enumerate(system.H_twists):
        H[n + 6 * k : n + 6 * k + 6, n + 6 * k : n + 6 * k + 6] = block
    return H, np.concatenate([system.g, system.g_twists.reshape(-1)])


@pytest.mark.parametrize(
    ("rolling", "by_object", "config"),
    [
        (False, False, PLAIN),
        (False, True, PLAIN),
        (True, True, PLAIN),
        (True, False, FREE),
        (False, True, FREE),
    ],
)
def test_normal_equations_are_the_graphs(rolling: bool, by_object: bool, config: GraphConfig) -> None:
    drive = moving(rolling)
    drives = [drive, replace(drive, scans=drive.scans[1:], lidar_motions=drive.lidar_motions[1:])]
    cTl = standing_street().truth.cTl.retract(np.array([0.003, -0.002, 0.001, 0.02, -0.03, 0.01]))
    known = {"focal": 0.002, "range_scale": -0.001} if config.estimate else {}
    state = State(cTl, (0.012, -0.02), {(0, VEHICLE): 0.4, (1, VEHICLE): -0.2}, {(0, 1): 0.7}, known)
    guess = State(cTl.retract(np.full(6, 0.01)), (0.0, 0.0))
    matches = matched(drives, state, config, by_object)
    pairs = [pair for own in matches for pair in own.by_pair()]
    assert len(pairs) == 5 and sum(map(len, pairs)) == sum(map(len, matches)) > 300
    graph, values = joint_graph(pairs, state, config, guess)
    problem = FrozenProblem(matches, state, config, guess)
    # At the matches, and a step away from them, where the robust weights and the rates are others.
    system = problem.linearized(problem.start)
    away = problem.moved(problem.start, *(0.1 * each for each in system.step(1e-6)))
    assert set(problem.values_at(problem.start).keys()) == set(values.keys())
    for point in (problem.start, away):
        values = problem.values_at(point)
        linear, system = graph.linearize(values), problem.linearized(point)
        assert system.cost == pytest.approx(graph.error(values), rel=1e-12)
        H, g = whole(system)
        expected, b = linear.hessian(problem.ordering)
        scale = 1.0 / np.sqrt(np.diag(expected))
        np.testing.assert_allclose(H * np.outer(scale, scale), expected * np.outer(scale, scale), atol=1e-12)
        size = np.abs(scale * b).max()
        np.testing.assert_allclose(scale * g / size, -scale * b / size, atol=1e-12)
        # Its covariance is the inverse's block, its step the solution.
        inverse = np.linalg.inv(expected * np.outer(scale, scale)) * np.outer(scale, scale)
        n = len(system.g)
        sigmas = np.sqrt(np.diag(inverse)[:n])
        np.testing.assert_allclose(
            system.covariance() / np.outer(sigmas, sigmas),
            inverse[:n, :n] / np.outer(sigmas, sigmas),
            atol=1e-7,
        )
        x, twists = system.step(0.0)
        step = np.concatenate([x, twists.reshape(-1)])
        np.testing.assert_allclose(scale * (expected @ step) / size, scale * b / size, atol=1e-7)


def dense() -> Drive:
    """The moving street with three images for each scan: two more, 34 ms before and after its own."""
    drive = moving(False)
    images = [
        replace(image, index=3 * k + n, stamp_ns=image.stamp_ns + (n - 1) * 34_000_000)
        for k, image in enumerate(drive.images)
        for n in range(3)
    ]
    return replace(drive, images=tuple(images))


def test_several_images_of_a_scan_are_matched_each_by_itself() -> None:
    drive, config = dense(), replace(PLAIN, every_image=True)
    assert drive.has_dense_images and drive.part([0, 2]).has_dense_images
    state = State(standing_street().truth.cTl, (0.0,), {(0, VEHICLE): 0.4}, {})
    objects = object_tracks(drive)
    motions = motions_of([drive], [objects])
    together = associate([drive], motions, state, KERNEL, config)
    assert [(pair.pair.scan, pair.pair.image) for pair in together] == [(k // 3, k) for k in range(9)]
    for pair in together:
        (alone,) = (
            one
            for one in associate(
                [replace(drive, images=drive.images[pair.pair.image : pair.pair.image + 1])],
                motions,
                state,
                KERNEL,
                PLAIN,
            )
            if one.pair.scan == pair.pair.scan
        )
        both, own = pair.matches[VEHICLE], alone.matches[VEHICLE]
        assert both.seen == own.seen
        assert pair.pair.base_tau_s == pytest.approx(alone.pair.base_tau_s, abs=1e-12)
        np.testing.assert_array_equal(both.index, own.index)
        for name in ("pixels", "normals", "sigmas_px", "weights"):
            one, other = getattr(both.alignment, name), getattr(own.alignment, name)
            np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-12)
    # The normal equations are the graph's, and what the images show of a scan is one frame of the covariance.
    (matches,) = matched([drive], state, config, True)
    graph, values = joint_graph(together, state, config)
    problem = FrozenProblem([matches], state, config)
    H, _ = whole(problem.linearized(problem.start))
    expected, _ = graph.linearize(values).hessian(problem.ordering)
    np.testing.assert_allclose(H, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())
    robust = robust_covariance(system_of(graph, values), values, together, state, [objects])
    assert sorted(set(robust.table.frames.tolist())) == [0, 1, 2]
    # Without the setting, or at equal rates, a scan has its nearest image alone.
    nearest = associate([drive], motions, state, KERNEL, PLAIN)
    assert [(pair.pair.scan, pair.pair.image) for pair in nearest] == [(k, 3 * k + 1) for k in range(3)]
    plain = [associate([moving(False)], motions, state, KERNEL, one) for one in (PLAIN, config)]
    assert [p.pair for p in plain[0]] == [p.pair for p in plain[1]] and len(plain[0]) == 3


@pytest.mark.parametrize("rolling", [False, True])
@pytest.mark.parametrize("time_offset_s", [0.012, -0.12])
def test_all_scans_are_matched_as_each_by_itself(rolling: bool, time_offset_s: float) -> None:
    drive = moving(rolling)
    values = {"range_scale": -0.001, "k1": 0.01, "skew": 1e-3}
    state = State(standing_street().truth.cTl, (time_offset_s,), {(0, VEHICLE): 0.4}, {}, values)
    objects = object_tracks(drive)
    motions = motions_of([drive], [objects])
    together = {pair.pair.scan: pair for pair in associate([drive], motions, state, KERNEL, FREE)}
    assert len(together) >= 2
    for scan in range(len(drive.scans)):
        alone = associate([drive.part([scan])], [motions[0].part([scan])], state, KERNEL, FREE)
        assert len(alone) == (scan in together)
        for pair in alone:
            both, own = together[scan].matches[VEHICLE], pair.matches[VEHICLE]
            for name in ("index", "objects", "sides"):
                np.testing.assert_array_equal(getattr(both, name), getattr(own, name))
            for name in ("lPs", "base_taus_s", "pixels", "normals", "sigmas_px", "weights"):
                one, other = getattr(both.alignment, name), getattr(own.alignment, name)
                np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-12)
            assert both.seen == own.seen
            assert [*pair.tracks[VEHICLE]] == [*together[scan].tracks[VEHICLE]]
            assert {t for t in pair.tracks[VEHICLE] if t < 1000} <= set(objects.values())
            for name, column in pair.terms[VEHICLE].items():
                np.testing.assert_allclose(together[scan].terms[VEHICLE][name], column, rtol=1e-9, atol=1e-9)


def test_the_optimum_is_the_graphs() -> None:
    drive, state = moving(True), State(standing_street().truth.cTl, (0.01,))
    matches = matched([drive], state, PLAIN, True)
    pairs = [pair for own in matches for pair in own.by_pair()]
    problem = FrozenProblem(matches, state, PLAIN)
    point, system = problem.optimum(30)
    graph, values = joint_graph(pairs, state, PLAIN)
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(1e-12)
    params.setAbsoluteErrorTol(1e-12)
    optimum = gtsam.LevenbergMarquardtOptimizer(graph, values, params).optimize()
    assert system.cost == pytest.approx(graph.error(optimum), rel=1e-6)
    assert system.cost < problem.linearized(problem.start).cost
    found, expected = problem.state_at(point), state_from(optimum, state, pairs)
    sigmas = np.sqrt(np.diag(system.covariance())[:7])
    assert np.abs(difference(expected, found) / sigmas).max() < 0.01
    assert found.object_biases_px.keys() == expected.object_biases_px.keys()
    # The length of the step in deviations, by gtsam's own covariance.
    marginals = gtsam.Marginals(graph, problem.values_at(point))
    joint = marginals.jointMarginalCovariance([EXTRINSIC, time_offset_key()])
    step = difference(state, found)
    length = float(np.sqrt(step @ np.linalg.solve(joint.fullMatrix(), step)))
    assert problem.step_sigmas(point, system) == pytest.approx(length, rel=1e-4)


def test_a_prior_holds_the_extrinsic() -> None:
    drive, state = moving(False), State(standing_street().truth.cTl, (0.0,))
    there = state.cTl.retract(np.array([0.0, 0.0, 0.0, 0.5, 0.0, 0.0]))
    prior = KnownCalibration(State(there, (0.0,)), np.diag([1e-12] * 6 + [1.0]))
    point, _ = FrozenProblem(matched([drive], state, PLAIN, True), state, PLAIN, prior=prior).optimum(20)
    np.testing.assert_allclose(point.cTl.matrix(), there.matrix(), atol=1e-4)


def test_moving_objects_are_matched_where_they_are() -> None:
    """An object that drives along beside the LiDAR has the gradient of its own velocity in the offset."""
    drive, state = moving(False), State(standing_street().truth.cTl, (0.03,))
    tracks = object_tracks(drive)
    fast = {
        name: DynamicObject(8.0, ObjectVelocity(np.array([4.0, 1.0, 0.0]), 0.03))
        for name in list(tracks)[::2]
    }
    slow: dict[ObjectId, DynamicObject] = {name: DynamicObject(0.06) for name in list(tracks)[1::2]}
    motion = DriveMotion.of(drive).with_objects(tracks, fast | slow)
    matches = match_all(edges_of([drive], [motion], PLAIN), state, KERNEL)
    pairs = [pair for own in matches for pair in own.by_pair()]
    assert any(m.alignment.l_velocities is not None for pair in pairs for m in pair.matches.values())
    graph, values = joint_graph(pairs, state, PLAIN)
    problem = FrozenProblem(matches, state, PLAIN)
    system, H = problem.linearized(problem.start), graph.linearize(values).hessian(problem.ordering)[0]
    assert system.H[6, 6] == pytest.approx(H[6, 6], rel=1e-12)
    assert system.cost == pytest.approx(graph.error(values), rel=1e-12)

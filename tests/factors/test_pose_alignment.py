"""Alignment on the poses of a trajectory: sign, derivatives, an independent oracle, solvers."""

from __future__ import annotations

import itertools
from dataclasses import replace

import gtsam
import numpy as np
import pytest

from sst_graph.factors import (
    Alignment,
    Between,
    FactorError,
    PinholeCamera,
    RobustKernel,
    check_gradient,
    check_jacobians,
    frame_factor,
    pose_alignment_factor,
    stacked,
)

E, D, B = gtsam.symbol("e", 0), gtsam.symbol("d", 0), gtsam.symbol("b", 0)
X = [gtsam.symbol("x", k) for k in range(3)]
BTL = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.1, -0.2, 0.3), np.array([0.8, -0.3, 1.7]))
SECONDS = 0.12


def trajectory(seed, cTl, time_offset_s, bTl, bias=0.3):
    """Values: three poses of the body, about 1 m and 2 deg apart, and the calibration."""
    rng = np.random.default_rng(seed)
    values = gtsam.Values()
    pose = gtsam.Pose3.Expmap(rng.normal(0.0, 1.0, 6))
    for key in X:
        values.insert(key, pose)
        pose = pose * gtsam.Pose3.Expmap(rng.normal(0.0, 1.0, 6) * [0.03, 0.03, 0.03, 0.3, 0.3, 0.3])
        pose = pose * bTl * gtsam.Pose3(gtsam.Rot3(), np.array([0.8, 0.0, 0.0])) * bTl.inverse()
    values.insert(E, cTl.retract(rng.normal(0.0, 0.01, 6)))
    values.insert(D, np.array([time_offset_s + rng.normal(0.0, 0.01)]))
    values.insert(B, np.array([bias]))
    return values


def c_twist(values, a, b, bTl, seconds=SECONDS):
    """The camera's twist, through its poses: wTc = wTb bTl lTc."""
    lTc = values.atPose3(E).inverse()
    ends = [values.atPose3(key) * bTl * lTc for key in (a, b)]
    return gtsam.Pose3.Logmap(ends[0].between(ends[1])) / seconds


def test_sign_by_hand():
    # 2 m forward in 0.2 s; the image 0.05 + 0.05 s after the scan sees a point 10 m ahead at 9 m
    camera = PinholeCamera(100.0, 100.0, 50.0, 50.0, 101, 101)
    alignment = Alignment(camera, np.array([[0.9, 0.45, 10.0]]), 0.05, np.array([[58.0, 56.0]]), 1.0)
    values = gtsam.Values()
    values.insert(X[0], gtsam.Pose3(gtsam.Rot3(), np.array([0.0, 0.0, 5.0])))
    values.insert(X[1], gtsam.Pose3(gtsam.Rot3(), np.array([0.0, 0.0, 7.0])))
    values.insert(D, np.array([0.05]))
    factor = stacked(pose_alignment_factor([alignment], Between(X[0], X[1], 0.2, 0.05), gtsam.Pose3(), D))
    np.testing.assert_allclose(factor.unwhitenedError(values), [2.0, -1.0, 0.0], atol=1e-9)


def test_sign_of_a_scan_at_another_pose_by_hand():
    # the scan was taken 1 m behind X_a, 0.5 s ago: the point at 10 m is then seen at 8 m
    camera = PinholeCamera(100.0, 100.0, 50.0, 50.0, 101, 101)
    alignment = Alignment(camera, np.array([[0.8, 0.4, 10.0]]), 0.05, np.array([[58.0, 56.0]]), 1.0)
    values = gtsam.Values()
    for key, z in zip(X, (5.0, 7.0, 4.0), strict=True):
        values.insert(key, gtsam.Pose3(gtsam.Rot3(), np.array([0.0, 0.0, z])))
    values.insert(D, np.array([0.05]))
    between = Between(X[0], X[1], 0.2, 0.05, X_scan=X[2])
    factor = stacked(pose_alignment_factor([alignment], between, gtsam.Pose3(), D))
    np.testing.assert_allclose(factor.unwhitenedError(values), [2.0, -1.0, 0.0], atol=1e-9)


@pytest.mark.parametrize("normals", [False, True])
def test_jacobians_at_100_states(make_scene, normals):
    for seed in range(100):
        alignment, cTl, time_offset_s, _ = make_scene(seed, 4, per_point=bool(seed % 2), normals=normals)
        bTl = BTL if seed % 3 else gtsam.Pose3()
        if seed % 5 == 0:
            alignment = replace(alignment, c_acceleration=np.zeros(6))
        X_scan = [None, X[2], X[1], X[0]][seed % 4]
        between = Between(X[0], X[1], SECONDS, 0.5 * SECONDS - 0.03, X_scan=X_scan, bTl=bTl)
        factor = pose_alignment_factor([alignment], between, E, D, B if normals else None)
        check_jacobians(stacked(factor), trajectory(seed, cTl, time_offset_s, bTl), 1e-6)


@pytest.mark.parametrize("kind", ["none", "geman_mcclure"])
def test_condensed_gradient_is_that_of_the_robust_cost(make_scene, kind):
    for seed in range(6):
        alignment, cTl, time_offset_s, _ = make_scene(
            seed, 25, normals=True, per_point=bool(seed % 2), kernel=RobustKernel(kind, 4.0)
        )
        X_scan = X[2] if seed % 3 else None
        between = Between(X[0], X[1], SECONDS, 0.5 * SECONDS + 0.02, X_scan=X_scan, bTl=BTL)
        factor = pose_alignment_factor([alignment], between, E, D, B)
        # a kernel's second derivative jumps: a short step there
        step = 1e-3 if kind == "none" else 1e-6
        check_gradient(factor, trajectory(seed, cTl, time_offset_s, BTL), 1e-5, step=step)


@pytest.mark.parametrize("elsewhere", [False, True])
def test_a_gtsam_camera_at_the_interpolated_pose_says_the_same(make_scene, elsewhere):
    alignment, cTl, time_offset_s, _ = make_scene(4, 12)
    alignment = replace(alignment, c_acceleration=np.zeros(6), sigmas_px=1.0)
    camera = alignment.camera
    K = gtsam.Cal3_S2(camera.fx, camera.fy, 0.0, camera.cx, camera.cy)
    values = trajectory(7, cTl, time_offset_s, BTL)
    tau = float(values.atVector(D)[0]) + float(alignment.base_taus_s[0])
    between = values.atPose3(X[0]).between(values.atPose3(X[1]))
    wTb = values.atPose3(X[0]) * gtsam.Pose3.Expmap(tau / SECONDS * gtsam.Pose3.Logmap(between))
    wTc = wTb * BTL * values.atPose3(E).inverse()
    wTs = values.atPose3(X[2] if elsewhere else X[0]) * BTL
    pinhole = gtsam.PinholeCameraCal3_S2(wTc, K)
    uvs = np.array([pinhole.project(wTs.transformFrom(lP)) for lP in alignment.lPs])
    late_s = float(alignment.base_taus_s[0])
    between = Between(X[0], X[1], SECONDS, late_s, X_scan=X[2] if elsewhere else None, bTl=BTL)
    factor = stacked(pose_alignment_factor([alignment], between, E, D))
    expected = np.append((uvs - alignment.pixels).T.reshape(-1), 0.0)
    np.testing.assert_allclose(factor.unwhitenedError(values), expected, atol=1e-6)


def test_the_twist_is_that_of_the_frame_factor(make_scene):
    # same cost as the factor on a twist variable, with the mean twist carried to the image's instant
    alignment, cTl, time_offset_s, _ = make_scene(5, 20, normals=True)
    values = trajectory(5, cTl, time_offset_s, BTL)
    between = Between(X[0], X[1], SECONDS, 0.5 * SECONDS - 0.04, bTl=BTL)
    factor = pose_alignment_factor([alignment], between, E, D, B)
    late = float(values.atVector(D)[0]) - 0.04
    twist = c_twist(values, X[0], X[1], BTL) + late * alignment.c_acceleration
    other = frame_factor([alignment], E, D, twist, B)
    assert factor.error(values) == pytest.approx(other.error(values), rel=1e-9)


def test_constants_stand_in_for_the_calibration(make_scene):
    alignment, cTl, time_offset_s, _ = make_scene(6, 10)
    values = trajectory(6, cTl, time_offset_s, BTL)
    pose, offset = values.atPose3(E), float(values.atVector(D)[0])
    between = Between(X[0], X[1], SECONDS, 0.03, bTl=BTL)
    full = pose_alignment_factor([alignment], between, E, D)
    fixed = pose_alignment_factor([alignment], between, pose, offset)
    assert tuple(full.keys()) == (X[0], X[1], E, D) and tuple(fixed.keys()) == (X[0], X[1])
    assert fixed.error(values) == pytest.approx(full.error(values), rel=1e-12)
    whole, part = full.linearize(values).information(), fixed.linearize(values).information()
    np.testing.assert_allclose(part, whole[:12, :12], atol=1e-9 * np.abs(whole).max())


def street(make_scene, frames=6):
    """A graph with odometry, and alignments that fit the true calibration exactly; the truth."""
    base, cTl, time_offset_s, _ = make_scene(20, 60, noise_px=0.0)
    base = replace(base, c_acceleration=np.zeros(6), sigmas_px=1.0)
    rng = np.random.default_rng(1)
    truth = gtsam.Values()
    truth.insert(E, cTl)
    truth.insert(D, np.array([time_offset_s]))
    poses = [gtsam.Pose3()]
    for _ in range(frames):
        poses.append(poses[-1] * gtsam.Pose3.Expmap(rng.normal(0.0, 1.0, 6) * [0.05, 0.05, 0.1, 1, 0.1, 0.1]))
    keys = [gtsam.symbol("x", k) for k in range(frames + 1)]
    for key, pose in zip(keys, poses, strict=True):
        truth.insert(key, pose)
    factors = []
    for a, b in itertools.pairwise(keys):
        seen = replace(base, pixels=np.zeros((len(base), 2)))
        between = Between(a, b, SECONDS, float(base.base_taus_s[0]))
        blank = stacked(pose_alignment_factor([seen], between, E, D))
        pixels = blank.unwhitenedError(truth)[:-1].reshape(2, -1).T
        factors.append((a, b, pose_alignment_factor([replace(seen, pixels=pixels)], between, E, D)))
    return factors, truth


def start(truth):
    values = gtsam.Values(truth)
    values.update(E, truth.atPose3(E).retract([0.02, -0.02, 0.02, 0.05, -0.05, 0.05]))
    values.update(D, truth.atVector(D) + 0.02)
    return values


def odometry(truth, a, b):
    noise = gtsam.noiseModel.Isotropic.Sigma(6, 0.01)
    return gtsam.BetweenFactorPose3(a, b, truth.atPose3(a).between(truth.atPose3(b)), noise)


def check_found(estimate, truth):
    assert np.abs(truth.atPose3(E).localCoordinates(estimate.atPose3(E))).max() < 1e-5
    assert abs(estimate.atVector(D)[0] - truth.atVector(D)[0]) < 1e-5


def test_calibration_in_a_pose_graph_by_lm(make_scene):
    factors, truth = street(make_scene)
    graph = gtsam.NonlinearFactorGraph()
    graph.add(gtsam.PriorFactorPose3(X[0], gtsam.Pose3(), gtsam.noiseModel.Isotropic.Sigma(6, 1e-3)))
    for a, b, factor in factors:
        graph.add(odometry(truth, a, b))
        graph.add(factor)
    check_found(gtsam.LevenbergMarquardtOptimizer(graph, start(truth)).optimize(), truth)


@pytest.mark.parametrize("smoother", ["isam2", "fixed_lag"])
def test_calibration_in_a_pose_graph_frame_by_frame(make_scene, smoother):
    factors, truth = street(make_scene, frames=12)
    guess = start(truth)
    params = gtsam.ISAM2Params()
    params.setRelinearizeThreshold(1e-4)
    params.relinearizeSkip = 1
    make = {
        "isam2": lambda: gtsam.ISAM2(params),
        "fixed_lag": lambda: gtsam.IncrementalFixedLagSmoother(5.0, params),
    }
    solver = make[smoother]()
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(gtsam.PriorFactorPose3(X[0], gtsam.Pose3(), gtsam.noiseModel.Isotropic.Sigma(6, 1e-3)))
    wide = gtsam.noiseModel.Isotropic.Sigma(6, 10.0)
    graph.add(gtsam.PriorFactorPose3(E, guess.atPose3(E), wide))
    graph.add(gtsam.PriorFactorVector(D, guess.atVector(D), gtsam.noiseModel.Isotropic.Sigma(1, 10.0)))
    values.insert(X[0], truth.atPose3(X[0]))
    values.insert(E, guess.atPose3(E))
    values.insert(D, guess.atVector(D))
    for k, (a, b, factor) in enumerate(factors):
        graph.add(odometry(truth, a, b))
        graph.add(factor)
        values.insert(b, truth.atPose3(b))
        if smoother == "isam2":
            solver.update(graph, values)
        else:
            stamps = {E: float(k), D: float(k), b: float(k)} | ({a: float(k)} if k == 0 else {})
            solver.update(graph, values, stamps)
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for _ in range(3):
        if smoother == "isam2":
            solver.update()
    estimate = solver.calculateEstimate()
    assert np.abs(truth.atPose3(E).localCoordinates(estimate.atPose3(E))).max() < 1e-3
    assert abs(estimate.atVector(D)[0] - truth.atVector(D)[0]) < 1e-3
    if smoother == "fixed_lag":
        assert not estimate.exists(X[0]) and estimate.exists(E)


def test_refuses_what_makes_no_factor(make_scene):
    alignment, *_ = make_scene(1)
    with pytest.raises(FactorError, match="distinct keys"):
        Between(X[0], X[0], SECONDS, 0.03)
    with pytest.raises(FactorError, match="seconds"):
        Between(X[0], X[1], 0.0, 0.03)
    between = Between(X[0], X[1], SECONDS, 0.03)
    with pytest.raises(FactorError, match="x1 for X_b and cTl"):
        pose_alignment_factor([alignment], between, X[1], D)
    other = replace(alignment, c_acceleration=np.ones(6))
    with pytest.raises(FactorError, match="one for all"):
        pose_alignment_factor([alignment, other], between, E, D)


def test_a_factor_is_condensed_and_stacked_has_the_rows_of_its_matches(make_scene):
    points = make_scene(1)[0]
    factor = pose_alignment_factor([points], Between(X[0], X[1], SECONDS, 0.03), E, D)
    assert factor.noiseModel().dim() == 6 + 6 + 6 + 1 + 2
    assert stacked(factor).noiseModel().dim() == 2 * len(points) + 1

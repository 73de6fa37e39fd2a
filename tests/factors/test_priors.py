"""Priors and random walks of offset and extrinsic; the regularizer beta, its cost in closed form."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from sst_graph.factors import (
    FactorError,
    beta_regularizer,
    check_jacobians,
    extrinsic_drift,
    time_offset_drift,
    time_offset_prior,
)

D = [gtsam.symbol("d", k) for k in range(11)]
E = [gtsam.symbol("e", k) for k in range(2)]
STATIC = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.3, -0.2, 1.1), np.array([0.1, -0.2, 0.3]))


def test_prior_by_hand():
    values = gtsam.Values()
    values.insert(D[0], np.array([0.13]))
    factor = time_offset_prior(D[0], 0.10, 0.01)
    np.testing.assert_allclose(factor.unwhitenedError(values), [0.03], atol=1e-15)
    assert factor.error(values) == pytest.approx(0.5 * 3.0**2)


def test_later_less_earlier():
    values = gtsam.Values()
    values.insert(D[0], np.array([0.10]))
    values.insert(D[1], np.array([0.13]))
    # 4 s of 0.005 s / sqrt(s): sigma 0.01 s
    np.testing.assert_allclose(time_offset_drift(D[0], D[1], 4.0, 0.005).whitenedError(values), [3.0])


def test_a_walk_of_many_steps_is_a_walk_of_one():
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(time_offset_prior(D[0], 0.1, 0.02))
    for k, key in enumerate(D):
        values.insert(key, np.array([0.1]))
        if k:
            graph.add(time_offset_drift(D[k - 1], key, 0.3, 0.005))
    variance = gtsam.Marginals(graph, values).marginalCovariance(D[-1])[0, 0]
    assert variance == pytest.approx(0.02**2 + 10 * 0.3 * 0.005**2, rel=1e-9)


def test_extrinsic_drift_by_hand():
    values, start = gtsam.Values(), gtsam.Pose3(gtsam.Rot3.Ry(0.4), np.array([1.0, 2.0, 3.0]))
    step = np.array([0.01, 0.0, 0.0, 0.0, 0.02, 0.0])
    values.insert(E[0], start)
    values.insert(E[1], start * gtsam.Pose3.Expmap(step))
    factor = extrinsic_drift(E[0], E[1], 4.0, 0.005, 0.01)
    np.testing.assert_allclose(factor.whitenedError(values), [1.0, 0, 0, 0, 1.0, 0], atol=1e-9)


def test_jacobians_at_100_states():
    rng = np.random.default_rng(0)
    for _ in range(100):
        values = gtsam.Values()
        for k in range(2):
            values.insert(D[k], rng.normal(0.0, 0.2, 1))
            values.insert(E[k], gtsam.Pose3.Expmap(rng.normal(0.0, 0.7, 6)))
        check_jacobians(time_offset_prior(D[0], 0.1, 0.01), values, 1e-6)
        check_jacobians(time_offset_drift(D[0], D[1], 0.1, 0.01), values, 1e-6)
        check_jacobians(extrinsic_drift(E[0], E[1], 0.1, 0.01, 0.02), values, 1e-6)


def test_they_serialize():
    graph = gtsam.NonlinearFactorGraph()
    graph.add(time_offset_prior(D[0], 0.1, 0.01))
    graph.add(time_offset_drift(D[0], D[1], 0.1, 0.01))
    graph.add(extrinsic_drift(E[0], E[1], 0.1, 0.01, 0.02))
    copy = gtsam.NonlinearFactorGraph()
    copy.deserialize(graph.serialize())
    assert copy.equals(graph, 1e-12)


@pytest.mark.parametrize("seconds", [0.0, -1.0, np.inf])
def test_time_must_pass(seconds):
    with pytest.raises(FactorError, match="seconds"):
        time_offset_drift(D[0], D[1], seconds, 0.01)
    with pytest.raises(FactorError, match="seconds"):
        extrinsic_drift(E[0], E[1], seconds, 0.01, 0.01)


def at(pose):
    values = gtsam.Values()
    values.insert(E[0], pose)
    return values


def test_regularizer_free_less_static_in_the_camera_frame():
    turn = gtsam.Rot3.Rz(0.01)
    pose = gtsam.Pose3(turn * STATIC.rotation(), STATIC.translation() + np.array([0.0, 0.0, 0.02]))
    error = beta_regularizer(E[0], STATIC, 1.0, 1.0).unwhitenedError(at(pose))
    np.testing.assert_allclose(error, [0.0, 0.0, 0.01, 0.0, 0.0, 0.02], atol=1e-12)


def test_weights_of_the_paper():
    pose = gtsam.Pose3(
        gtsam.Rot3.Rx(0.002) * STATIC.rotation(), STATIC.translation() + np.array([0.003, 0.0, 0.0])
    )
    expected = 0.5 * (1e6 * 0.003**2 + 1e9 * 0.002**2)
    assert beta_regularizer(E[0], STATIC, 1e6, 1e9).error(at(pose)) == pytest.approx(expected, rel=1e-9)


def test_regularizer_jacobians_at_100_poses():
    rng = np.random.default_rng(0)
    for _ in range(100):
        pose = STATIC.retract(rng.normal(0.0, 0.5, 6))
        check_jacobians(beta_regularizer(E[0], STATIC, 1e6, 1e9), at(pose), 1e-6)


def test_the_angle_is_gtsams_distance_of_rotations():
    rng = np.random.default_rng(1)
    for _ in range(20):
        pose = STATIC.retract(rng.normal(0.0, 0.5, 6))
        error = beta_regularizer(E[0], STATIC, 1.0, 1.0).unwhitenedError(at(pose))
        _, angle = pose.rotation().between(STATIC.rotation()).axisAngle()
        assert np.linalg.norm(error[:3]) == pytest.approx(angle, rel=1e-9)
        assert np.linalg.norm(error[3:]) == pytest.approx(
            np.linalg.norm(pose.translation() - STATIC.translation())
        )


def test_refuses_a_weight_that_is_none():
    with pytest.raises(FactorError, match="lambda_t"):
        beta_regularizer(E[0], STATIC, 0.0, 1.0)

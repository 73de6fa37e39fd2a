"""The regularizer beta: by hand, derivatives, and its cost in closed form."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from sst_graph.factors import FactorError, beta_regularizer, check_jacobians

E = gtsam.symbol("e", 0)
STATIC = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.3, -0.2, 1.1), np.array([0.1, -0.2, 0.3]))


def at(pose):
    values = gtsam.Values()
    values.insert(E, pose)
    return values


def test_free_less_static_in_the_camera_frame():
    turn = gtsam.Rot3.Rz(0.01)
    pose = gtsam.Pose3(turn * STATIC.rotation(), STATIC.translation() + np.array([0.0, 0.0, 0.02]))
    error = beta_regularizer(E, STATIC, 1.0, 1.0).unwhitenedError(at(pose))
    np.testing.assert_allclose(error, [0.0, 0.0, 0.01, 0.0, 0.0, 0.02], atol=1e-12)


def test_weights_of_the_paper():
    pose = gtsam.Pose3(
        gtsam.Rot3.Rx(0.002) * STATIC.rotation(), STATIC.translation() + np.array([0.003, 0.0, 0.0])
    )
    expected = 0.5 * (1e6 * 0.003**2 + 1e9 * 0.002**2)
    assert beta_regularizer(E, STATIC, 1e6, 1e9).error(at(pose)) == pytest.approx(expected, rel=1e-9)


def test_jacobians_at_100_poses():
    rng = np.random.default_rng(0)
    for _ in range(100):
        pose = STATIC.retract(rng.normal(0.0, 0.5, 6))
        check_jacobians(beta_regularizer(E, STATIC, 1e6, 1e9), at(pose), 1e-6)


def test_the_angle_is_gtsams_distance_of_rotations():
    rng = np.random.default_rng(1)
    for _ in range(20):
        pose = STATIC.retract(rng.normal(0.0, 0.5, 6))
        error = beta_regularizer(E, STATIC, 1.0, 1.0).unwhitenedError(at(pose))
        _, angle = pose.rotation().between(STATIC.rotation()).axisAngle()
        assert np.linalg.norm(error[:3]) == pytest.approx(angle, rel=1e-9)
        assert np.linalg.norm(error[3:]) == pytest.approx(
            np.linalg.norm(pose.translation() - STATIC.translation())
        )


def test_refuses_a_weight_that_is_none():
    with pytest.raises(FactorError, match="lambda_t"):
        beta_regularizer(E, STATIC, 0.0, 1.0)

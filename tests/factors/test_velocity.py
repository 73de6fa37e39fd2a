"""Factors on twists: signs by hand, derivatives, closed forms and gtsam as oracles."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from sst_graph.factors import (
    DirectionSigmas,
    FactorError,
    check_jacobians,
    mean_velocity_factor,
    twist_jerk_factor,
    twist_smoothness_factor,
    velocity_direction_factor,
    velocity_factor,
)

V = [gtsam.symbol("v", k) for k in range(3)]
COVARIANCE = np.diag([1e-4, 2e-4, 3e-4, 0.01, 0.02, 0.04]) + 1e-5


def at(*twists):
    values = gtsam.Values()
    for key, twist in zip(V, twists, strict=False):
        values.insert(key, np.asarray(twist, dtype=float))
    return values


def direction_factor(**changes):
    measured = {
        "omega": [0.0, 0.1, 0.0],
        "direction": [0.0, 0.0, 2.0],
        "speed_mps": 10.0,
        "sigmas": DirectionSigmas(0.01, 0.02, 0.3),
    }
    return velocity_direction_factor(V[0], **(measured | changes))


def test_velocity_less_measured_and_its_covariance():
    factor = velocity_factor(V[0], [0, 0, 0, 0, 0, 10.0], COVARIANCE)
    difference = np.array([0.01, 0, 0, 0, 0, 1.0])
    values = at([0.01, 0, 0, 0, 0, 11.0])
    np.testing.assert_allclose(factor.unwhitenedError(values), difference, atol=1e-12)
    assert factor.error(values) == pytest.approx(0.5 * difference @ np.linalg.solve(COVARIANCE, difference))


def test_direction_by_hand():
    # 0.05 rad aside of the measured direction, 1 m/s too fast, turning 0.02 rad/s too fast
    speed = 11.0
    v = speed * np.array([np.sin(0.05), 0.0, np.cos(0.05)])
    error = direction_factor(low_speed_mps=1e-6).unwhitenedError(at([0.0, 0.12, 0.0, *v]))
    np.testing.assert_allclose(error[:3], [0.0, 0.02, 0.0], atol=1e-12)
    assert np.linalg.norm(error[3:5]) == pytest.approx(np.sin(0.05), rel=1e-6)
    assert error[5] == pytest.approx(speed * np.cos(0.05) - 10.0)


def test_direction_says_little_at_low_speed_and_nothing_breaks_at_rest():
    factor = direction_factor(speed_mps=0.0)
    for speed, expected in ((20.0, 0.02), (0.5, 0.02 * np.sqrt(2.0)), (0.05, 0.02 * np.sqrt(101.0))):
        # angular sigma that the direction has at a speed
        A, _ = factor.linearize(at([0, 0, 0, 0, 0, speed])).jacobian()
        across = np.linalg.norm(A[3:5, 3]) * speed  # by a sideways angle
        assert 1.0 / across == pytest.approx(expected, rel=1e-3)
    information = factor.linearize(at(np.zeros(6))).information()
    sigmas = np.sqrt(np.diag(np.linalg.inv(information)))
    np.testing.assert_allclose(sigmas, [0.01, 0.01, 0.01, 0.02 * 0.5, 0.02 * 0.5, 0.3], rtol=1e-6)


def test_backward_motion_is_told_from_forward():
    forward = direction_factor().error(at([0, 0.1, 0, 0, 0, 10.0]))
    backward = direction_factor().error(at([0, 0.1, 0, 0, 0, -10.0]))
    assert forward == pytest.approx(0.0, abs=1e-12)
    assert backward == pytest.approx(0.5 * (20.0 / 0.3) ** 2)


def test_direction_is_gtsams_unit_direction_at_speed():
    rng = np.random.default_rng(2)
    for _ in range(20):
        d = gtsam.Unit3(rng.normal(size=3))
        v = 10.0 * np.asarray(d.retract(rng.normal(0.0, 0.01, 2)).point3())
        factor = direction_factor(direction=d.point3(), low_speed_mps=1e-6)
        error = factor.unwhitenedError(at([0, 0.1, 0, *v]))
        np.testing.assert_allclose(error[3:5], d.errorVector(gtsam.Unit3(v)), atol=1e-6)


def test_mean_by_hand():
    factor = mean_velocity_factor(V[0], V[1], [0, 0, 0, 0, 0, 10.0], COVARIANCE)
    values = at([0, 0, 0, 0, 0, 10.0], [0, 0, 0, 0, 0, 14.0])
    np.testing.assert_allclose(factor.unwhitenedError(values), [0, 0, 0, 0, 0, 2.0])


def test_mean_of_two_known_velocities_has_half_their_covariance():
    # oracle: x + y over 2 with independent covariances
    graph = gtsam.NonlinearFactorGraph()
    graph.add(mean_velocity_factor(V[0], V[1], np.zeros(6), COVARIANCE))
    graph.add(velocity_factor(V[0], np.zeros(6), 4.0 * COVARIANCE))
    found = gtsam.Marginals(graph, at(np.zeros(6), np.zeros(6)))
    np.testing.assert_allclose(found.marginalCovariance(V[1]), 8.0 * COVARIANCE, rtol=1e-9)


def test_smoothness_by_hand():
    factor = twist_smoothness_factor(V[0], V[1], 0.1, 0.5, 2.0)
    values = at(np.zeros(6), [0.1, 0, 0, 0, 0, 0.6])
    # 1 rad/s^2 against 0.5, and 6 m/s^2 against 2
    np.testing.assert_allclose(factor.whitenedError(values), [2.0, 0, 0, 0, 0, 3.0], atol=1e-12)


def test_jerk_is_blind_to_constant_acceleration_and_sees_a_parabola():
    factor = twist_jerk_factor(V[0], V[1], V[2], (0.1, 0.3), 1.0, 1.0)
    times = np.array([0.0, 0.1, 0.4])
    base, acceleration, jerk = np.random.default_rng(3).normal(size=(3, 6))
    steady = [base + acceleration * t for t in times]
    np.testing.assert_allclose(factor.unwhitenedError(at(*steady)), np.zeros(6), atol=1e-12)
    changing = [base + acceleration * t + 0.5 * jerk * t**2 for t in times]
    np.testing.assert_allclose(factor.unwhitenedError(at(*changing)), jerk, atol=1e-12)


FACTORS = {
    "velocity": lambda: velocity_factor(V[0], np.ones(6), COVARIANCE),
    "direction": direction_factor,
    "direction_low": lambda: direction_factor(low_speed_mps=5.0, direction=[1.0, 2.0, 3.0]),
    "mean": lambda: mean_velocity_factor(V[0], V[1], np.ones(6), COVARIANCE),
    "smoothness": lambda: twist_smoothness_factor(V[0], V[1], 0.1, 0.5, 2.0),
    "jerk": lambda: twist_jerk_factor(V[0], V[1], V[2], (0.1, 0.3), 1.0, 2.0),
}


@pytest.mark.parametrize("name", FACTORS)
def test_jacobians_at_100_twists(name):
    rng, factor = np.random.default_rng(5), FACTORS[name]()
    for _ in range(100):
        check_jacobians(factor, at(*rng.normal(0.0, 3.0, (3, 6))), 1e-6)


@pytest.mark.parametrize(
    "build",
    [
        lambda: velocity_factor(V[0], np.ones(5), COVARIANCE),
        lambda: velocity_factor(V[0], np.ones(6), -COVARIANCE),
        lambda: velocity_factor(V[0], np.ones(6), np.diag([1.0, 1, 1, 1, 1, 0])),
        lambda: velocity_factor(V[0], np.ones(6), np.triu(np.ones((6, 6)))),
        lambda: direction_factor(direction=[0.0, 0.0, 0.0]),
        lambda: direction_factor(low_speed_mps=0.0),
        lambda: DirectionSigmas(0.0, 0.02, 0.3),
        lambda: DirectionSigmas(0.01, -0.02, 0.3),
        lambda: DirectionSigmas(0.01, 0.02, np.nan),
        lambda: direction_factor(speed_mps=np.nan),
        lambda: twist_smoothness_factor(V[0], V[1], -0.1, 0.5, 2.0),
        lambda: twist_jerk_factor(V[0], V[1], V[2], (0.1, 0.0), 1.0, 2.0),
        lambda: twist_jerk_factor(V[0], V[1], V[2], 0.1, 1.0, 2.0),
    ],
)
def test_bad_measurements_raise(build):
    with pytest.raises(FactorError, match="expected"):
        build()

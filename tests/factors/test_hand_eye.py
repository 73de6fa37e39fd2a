"""Motion-based factors: signs, derivatives, a simulated drive as the oracle."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from sst_graph.factors import (
    CameraMotion,
    FactorError,
    LidarMotion,
    check_jacobians,
    hand_eye_factor,
    rotation_hand_eye,
)

E, D = gtsam.symbol("e", 0), gtsam.symbol("d", 0)
TRUE = gtsam.Pose3(
    gtsam.Rot3(np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])), np.array([0.1, -0.2, -0.3])
).retract(np.array([0.02, -0.03, 0.01, 0.0, 0.0, 0.0]))
COVARIANCE = np.diag([1e-6] * 3 + [1e-4] * 3)


def wTl(t):
    """A weaving, rolling drive of the LiDAR, smooth in t [s]."""
    rotation = gtsam.Rot3.RzRyRx(0.1 * np.sin(1.3 * t), 0.15 * np.sin(0.9 * t), 0.6 * np.sin(0.8 * t))
    return gtsam.Pose3(rotation, np.array([8.0 * t, 2.0 * np.sin(0.7 * t), 0.3 * np.sin(1.1 * t)]))


def l_twist(t, h=1e-5):
    return gtsam.Pose3.Logmap(wTl(t - h).between(wTl(t + h))) / (2.0 * h)


def pair(t1, t2, offset_true, time_offset_0_s):
    """Camera motion over its stamps, LiDAR motion over the interval that time_offset_0_s takes for it."""
    c1Tc2 = TRUE * wTl(t1 + offset_true).between(wTl(t2 + offset_true)) * TRUE.inverse()
    a, b = t1 + time_offset_0_s, t2 + time_offset_0_s
    return c1Tc2, LidarMotion(wTl(a).between(wTl(b)), l_twist(a), l_twist(b), time_offset_0_s)


def at(pose, offset=None):
    values = gtsam.Values()
    values.insert(E, pose)
    if offset is not None:
        values.insert(D, np.array([offset]))
    return values


def test_by_hand():
    # the LiDAR drives 1 m along its x (forward), a camera that looks forward sees z; measured 0.9 m
    cRl = gtsam.Rot3(np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]))
    step = gtsam.Pose3(gtsam.Rot3(), np.array([1.0, 0.0, 0.0]))
    seen = gtsam.Pose3(gtsam.Rot3(), np.array([0.0, 0.0, 0.9]))
    still = np.zeros(6)
    factor = hand_eye_factor(E, None, CameraMotion(seen, COVARIANCE), LidarMotion(step, still, still, 0.0))
    error = factor.unwhitenedError(at(gtsam.Pose3(cRl, np.zeros(3))))
    np.testing.assert_allclose(error, [0, 0, 0, 0, 0, 0.1], atol=1e-12)


def test_a_later_offset_takes_later_motion():
    # speeding up from 10 to 12 m/s over the pair: 0.1 s later the LiDAR covers 0.2 m more
    step = gtsam.Pose3(gtsam.Rot3(), np.array([0.0, 0.0, 11.0]))
    twists = np.array([0, 0, 0, 0, 0, 10.0]), np.array([0, 0, 0, 0, 0, 12.0])
    factor = hand_eye_factor(E, D, CameraMotion(step, COVARIANCE), LidarMotion(step, *twists, 0.05))
    error = factor.unwhitenedError(at(gtsam.Pose3(), 0.15))
    np.testing.assert_allclose(error, [0, 0, 0, 0, 0, 0.2], atol=1e-12)


@pytest.mark.parametrize("kind", ["full", "direction", "rotation"])
@pytest.mark.parametrize("with_offset", [True, False])
def test_jacobians_at_100_states(kind, with_offset):
    rng = np.random.default_rng(4)
    for _ in range(100):
        c1Tc2, lidar = pair(*np.sort(rng.uniform(0.0, 5.0, 2)), 0.1, 0.05)
        key, offset = (D, 0.13) if with_offset else (None, None)
        if kind == "rotation":
            factor = rotation_hand_eye(E, key, c1Tc2.rotation(), lidar, COVARIANCE[:3, :3])
        else:
            camera = CameraMotion(c1Tc2, COVARIANCE, scale_known=kind == "full")
            factor = hand_eye_factor(E, key, camera, lidar)
        check_jacobians(factor, at(TRUE.retract(rng.normal(0.0, 0.1, 6)), offset), 1e-6)


@pytest.mark.parametrize("kind", ["full", "direction"])
def test_a_weaving_drive_gives_extrinsic_and_delay_back(kind):
    offset_true, time_offset_0_s, pose = 0.08, 0.0, TRUE.retract(np.array([0.1, -0.1, 0.05, 0.2, -0.1, 0.1]))
    values = at(pose, time_offset_0_s)
    for _ in range(3):  # outer loop: the LiDAR's motion is taken again over the interval found
        graph, time_offset_0_s = gtsam.NonlinearFactorGraph(), float(values.atVector(D)[0])
        for t1 in np.arange(0.0, 12.0, 0.5):
            c1Tc2, lidar = pair(t1, t1 + 0.5, offset_true, time_offset_0_s)
            if kind == "direction":
                t = c1Tc2.translation()
                c1Tc2 = gtsam.Pose3(c1Tc2.rotation(), t / np.linalg.norm(t))
            camera = CameraMotion(c1Tc2, COVARIANCE, scale_known=kind == "full")
            graph.add(hand_eye_factor(E, D, camera, lidar))
        values = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    assert values.atVector(D)[0] == pytest.approx(offset_true, abs=1e-4)
    error = TRUE.localCoordinates(values.atPose3(E))
    assert np.abs(error[:3]).max() < 2e-4
    assert np.abs(error[3:]).max() < (1e-3 if kind == "full" else 0.05)


def test_rotation_only_gives_rotation_and_delay_back():
    values, time_offset_0_s = at(TRUE.retract(np.array([0.1, -0.1, 0.05, 0.0, 0.0, 0.0])), 0.0), 0.0
    for _ in range(3):
        graph, time_offset_0_s = gtsam.NonlinearFactorGraph(), float(values.atVector(D)[0])
        graph.add(
            gtsam.PriorFactorPose3(E, TRUE, gtsam.noiseModel.Diagonal.Sigmas(np.repeat([10.0, 0.1], 3)))
        )
        for t1 in np.arange(0.0, 12.0, 0.5):
            c1Tc2, lidar = pair(t1, t1 + 0.5, 0.08, time_offset_0_s)
            graph.add(rotation_hand_eye(E, D, c1Tc2.rotation(), lidar, COVARIANCE[:3, :3]))
        values = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    assert values.atVector(D)[0] == pytest.approx(0.08, abs=1e-4)
    assert np.abs(TRUE.localCoordinates(values.atPose3(E))[:3]).max() < 1e-4


def test_a_turn_is_the_rotation_of_a_motion():
    c1Tc2, lidar = pair(1.0, 1.5, 0.08, 0.02)
    turn = LidarMotion.of_turn(lidar.l1Tl2.rotation(), lidar.l_twist_1[:3], lidar.l_twist_2[:3], 0.02)
    values = at(TRUE.retract(np.full(6, 0.05)), 0.05)
    factors = [
        rotation_hand_eye(E, D, c1Tc2.rotation(), motion, COVARIANCE[:3, :3]) for motion in (lidar, turn)
    ]
    errors = [factor.unwhitenedError(values) for factor in factors]
    assert np.abs(errors[0]).max() > 1e-3
    np.testing.assert_allclose(errors[1], errors[0], rtol=1e-12)


def test_length_of_a_scaleless_motion_does_not_matter():
    c1Tc2, lidar = pair(1.0, 1.5, 0.08, 0.02)
    errors = []
    for scale in (0.1, 1.0, 7.0):
        scaled = gtsam.Pose3(c1Tc2.rotation(), scale * c1Tc2.translation())
        carried = np.diag([1e-6] * 3 + [1e-4 * scale**2] * 3)
        factor = hand_eye_factor(E, D, CameraMotion(scaled, carried, scale_known=False), lidar)
        errors.append(factor.error(at(TRUE.retract(np.full(6, 0.05)), 0.05)))
    np.testing.assert_allclose(errors, errors[0], rtol=1e-9)


def test_nothing_breaks_at_rest():
    rest, still = gtsam.Pose3(), np.zeros(6)
    seen = gtsam.Pose3(gtsam.Rot3(), np.array([0.0, 0.0, 1.0]))
    camera = CameraMotion(seen, COVARIANCE, scale_known=False)
    factor = hand_eye_factor(E, D, camera, LidarMotion(rest, still, still, 0.0))
    assert np.isfinite(factor.linearize(at(TRUE, 0.1)).augmentedInformation()).all()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: CameraMotion(gtsam.Pose3(), COVARIANCE, scale_known=False), "c1Tc2: found zero.*direction"),
        (lambda: CameraMotion(np.eye(4), COVARIANCE), "c1Tc2 of CameraMotion: found an array.*Pose3"),
        (lambda: CameraMotion(TRUE, -COVARIANCE), "covariance of CameraMotion"),
        (lambda: LidarMotion(TRUE.rotation(), np.zeros(6), np.zeros(6), 0.0), "l1Tl2 of LidarMotion"),
        (lambda: LidarMotion(TRUE, np.zeros(6), np.zeros(3), 0.0), "l_twist_2 of LidarMotion"),
        (lambda: LidarMotion(TRUE, np.zeros(6), np.zeros(6), np.nan), "time_offset_0_s of LidarMotion"),
        (lambda: LidarMotion.of_turn(TRUE, np.zeros(3), np.zeros(3), 0.0), "l1Rl2 of LidarMotion.*Rot3"),
        (lambda: LidarMotion.of_turn(TRUE.rotation(), np.zeros(6), np.zeros(3), 0.0), "l_omega"),
    ],
)
def test_what_is_no_motion_is_refused(make, message):
    with pytest.raises(FactorError, match=message):
        make()

"""Visual odometry on the poses of a trajectory: sign, derivatives, an independent oracle, a solver."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from sst_graph.factors import (
    Between,
    CameraMotion,
    FactorError,
    LidarMotion,
    camera_motion_factor,
    check_jacobians,
    hand_eye_factor,
)

E, D = gtsam.symbol("e", 0), gtsam.symbol("d", 0)
X = [gtsam.symbol("x", k) for k in range(8)]
BTL = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.1, -0.2, 0.3), np.array([0.8, -0.3, 1.7]))
OPTICAL = gtsam.Rot3(np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]))
CTL = gtsam.Pose3(OPTICAL, np.array([0.1, -0.2, -0.3])).retract(np.full(6, 0.03))
COVARIANCE = np.diag([1e-6] * 3 + [1e-4] * 3)
PERIOD_S = 0.1


def values_of(poses, cTl=None, time_offset_s=None):
    values = gtsam.Values()
    for key, pose in zip(X, poses, strict=False):
        values.insert(key, pose)
    if cTl is not None:
        values.insert(E, cTl)
    if time_offset_s is not None:
        values.insert(D, np.array([time_offset_s]))
    return values


def wandering(seed, number=4):
    rng = np.random.default_rng(seed)
    poses = [gtsam.Pose3.Expmap(rng.normal(0.0, 1.0, 6))]
    while len(poses) < number:
        poses.append(poses[-1] * gtsam.Pose3.Expmap(rng.normal(0.0, 1.0, 6) * [0.1, 0.1, 0.2, 1.0, 0.3, 0.3]))
    return poses


def test_by_hand():
    # 1 m, then 2 m forward, 0.1 s each; images 0.05 s after X0 and X1, so 0.5 + 1 m apart. Measured 1.4 m.
    # The LiDAR's x is the camera's z.
    poses = [gtsam.Pose3(gtsam.Rot3(), np.array([x, 0.0, 0.0])) for x in (0.0, 1.0, 3.0)]
    seen = gtsam.Pose3(gtsam.Rot3(), np.array([0.0, 0.0, 1.4]))
    first, second = Between(X[0], X[1], 0.1, 0.02), Between(X[1], X[2], 0.1, 0.02)
    cTl = gtsam.Pose3(OPTICAL, np.zeros(3))
    factor = camera_motion_factor(first, second, cTl, D, CameraMotion(seen, COVARIANCE))
    error = factor.unwhitenedError(values_of(poses, time_offset_s=0.03))
    np.testing.assert_allclose(error, [0, 0, 0, 0, 0, 0.1], atol=1e-12)


@pytest.mark.parametrize("scale_known", [True, False])
def test_jacobians_at_100_states(scale_known):
    for seed in range(100):
        rng = np.random.default_rng(seed)
        poses = wandering(seed)
        measured = gtsam.Pose3.Expmap(rng.normal(0.0, 1.0, 6) * [0.1, 0.1, 0.1, 0.5, 0.3, 1.0])
        second = [(1, 2), (2, 3), (0, 1), (1, 0)][seed % 4]
        bTl = BTL if seed % 3 else None
        factor = camera_motion_factor(
            Between(X[0], X[1], 0.12, rng.uniform(-0.05, 0.15), bTl=bTl),
            Between(X[second[0]], X[second[1]], 0.1, rng.uniform(-0.05, 0.15), bTl=bTl),
            CTL if seed % 5 == 0 else E,
            0.03 if seed % 7 == 0 else D,
            CameraMotion(measured, COVARIANCE, scale_known=scale_known),
        )
        values = values_of(poses, CTL.retract(rng.normal(0.0, 0.3, 6)), 0.02)
        # the direction of a short translation turns fast: a short step there
        check_jacobians(factor, values, 1e-6, step=1e-3 if scale_known else 2e-4)


def test_camera_poses_worked_out_one_by_one_say_the_same():
    poses, time_offset_s = wandering(3), 0.04
    measured = gtsam.Pose3.Expmap(np.array([0.02, -0.1, 0.05, 0.1, 0.2, 0.9]))
    places = Between(X[0], X[1], 0.12, 0.01, bTl=BTL), Between(X[2], X[3], 0.1, 0.05, bTl=BTL)
    factor = camera_motion_factor(*places, E, D, CameraMotion(measured, COVARIANCE))
    cameras = []
    for (a, b), place in zip(((0, 1), (2, 3)), places, strict=True):
        s = (place.image_after_a_s + time_offset_s) / place.seconds
        wTb = poses[a] * gtsam.Pose3.Expmap(s * gtsam.Pose3.Logmap(poses[a].between(poses[b])))
        cameras.append(wTb * BTL * CTL.inverse())
    graph = gtsam.NonlinearFactorGraph()
    noise = gtsam.noiseModel.Gaussian.Covariance(COVARIANCE)
    graph.add(gtsam.BetweenFactorPose3(1, 2, measured, noise))
    expected = gtsam.Values()
    expected.insert(1, cameras[0])
    expected.insert(2, cameras[1])
    assert factor.error(values_of(poses, CTL, time_offset_s)) == pytest.approx(
        graph.error(expected), rel=1e-9
    )


def test_is_the_hand_eye_factor_where_the_trajectory_is_known():
    # one twist throughout: carried by the delay at both ends, or interpolated, is the same
    twist = np.array([0.1, -0.05, 0.4, 8.0, 0.3, 0.1])
    poses = [gtsam.Pose3.Expmap(k * PERIOD_S * twist) for k in range(4)]
    measured = CTL * gtsam.Pose3.Expmap(1.03 * PERIOD_S * twist) * CTL.inverse()
    seen = CameraMotion(measured, COVARIANCE)
    places = Between(X[0], X[1], PERIOD_S, 0.0), Between(X[1], X[2], PERIOD_S, 0.0)
    ours = camera_motion_factor(*places, E, D, seen)
    known = hand_eye_factor(E, D, seen, LidarMotion(poses[0].between(poses[1]), twist, twist, 0.0))
    for time_offset_s in (0.0, 0.03, -0.06):
        values = values_of(poses, CTL.retract(np.full(6, 0.01)), time_offset_s)
        assert ours.error(values) == pytest.approx(known.error(values), rel=1e-9)
        np.testing.assert_allclose(
            ours.linearize(values).jacobian()[0][:, -7:],
            known.linearize(values).jacobian()[0],
            atol=1e-6 * np.abs(known.linearize(values).jacobian()[0]).max(),
        )


def weaving(count, period_s=PERIOD_S):
    """Poses of a drive, piecewise of one twist, that turns and changes its speed."""
    poses = [gtsam.Pose3()]
    for k in range(count - 1):
        t = k * period_s
        twist = np.array(
            [0.2 * np.sin(3 * t), 0.3 * np.cos(4 * t), 0.6 * np.sin(5 * t), 5 + 3 * np.sin(4 * t)]
        )
        poses.append(poses[-1] * gtsam.Pose3.Expmap(period_s * np.append(twist, [0.2, 0.1])))
    return poses


def slam(lidar_sigmas, offset):
    """Poses by LiDAR odometry alone and with visual odometry of 0.5 cm, 0.03 deg; rms errors [m] and D [s].

    ``offset``: a key, or held at a value; the truth is 0.04 s.
    """
    count, time_offset_s, rng = 40, 0.04, np.random.default_rng(0)
    poses, keys = weaving(count), [gtsam.symbol("p", k) for k in range(count)]
    rough = np.repeat(lidar_sigmas, 3)
    fine = np.repeat([np.radians(0.03), 0.005], 3)
    graph, alone = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(gtsam.PriorFactorPose3(keys[0], poses[0], gtsam.noiseModel.Isotropic.Sigma(6, 1e-4)))
    alone.insert(keys[0], poses[0])
    noise = gtsam.noiseModel.Diagonal.Sigmas(rough)
    for k in range(count - 1):
        step = poses[k].between(poses[k + 1]).retract(rng.normal(0.0, rough))
        graph.add(gtsam.BetweenFactorPose3(keys[k], keys[k + 1], step, noise))
        alone.insert(keys[k + 1], alone.atPose3(keys[k]) * step)

    def camera(k):
        xi = gtsam.Pose3.Logmap(poses[k].between(poses[k + 1]))
        return poses[k] * gtsam.Pose3.Expmap(time_offset_s / PERIOD_S * xi) * CTL.inverse()

    for k in range(count - 2):
        measured = camera(k).between(camera(k + 1)).retract(rng.normal(0.0, fine))
        places = [Between(keys[i], keys[i + 1], PERIOD_S, 0.0) for i in (k, k + 1)]
        graph.add(camera_motion_factor(*places, E, offset, CameraMotion(measured, np.diag(fine**2))))
    about = CTL.retract(np.repeat([0.001, -0.01], 3))
    known = gtsam.noiseModel.Diagonal.Sigmas(np.repeat([0.002, 0.02], 3))
    graph.add(gtsam.PriorFactorPose3(E, about, known))
    start = gtsam.Values(alone)
    start.insert(E, about)
    if offset == D:
        start.insert(D, np.zeros(1))
    found = gtsam.LevenbergMarquardtOptimizer(graph, start).optimize()

    def drift(values):
        ends = [
            values.atPose3(key).translation() - p.translation() for key, p in zip(keys, poses, strict=True)
        ]
        return float(np.sqrt(np.mean(np.square(ends))))

    return drift(alone), drift(found), found.atVector(D)[0] if offset == D else offset


def test_improves_a_rough_trajectory_through_a_calibration_that_is_roughly_known():
    alone, both, _ = slam([np.radians(0.3), 0.05], 0.043)
    assert both < 0.3 * alone


def test_finds_the_delay_by_a_good_trajectory():
    alone, both, time_offset_s = slam([np.radians(0.01), 0.001], D)
    assert abs(time_offset_s - 0.04) < 0.001 and both < 1.1 * alone


def test_refuses_what_makes_no_factor():
    with pytest.raises(FactorError, match="x0 for X_a and X_b"):
        Between(X[0], X[0], 0.1, 0.0)
    with pytest.raises(FactorError, match="seconds"):
        Between(X[0], X[1], 0.0, 0.0)
    places = Between(X[0], X[1], 0.1, 0.0), Between(X[1], X[2], 0.1, 0.0)
    seen = CameraMotion(gtsam.Pose3(), COVARIANCE)
    with pytest.raises(FactorError, match="x0 for X_a of the first and cTl"):
        camera_motion_factor(*places, X[0], D, seen)
    elsewhere = Between(X[1], X[2], 0.1, 0.0, bTl=BTL)
    with pytest.raises(FactorError, match="bTl of camera_motion_factor: found one at the first image"):
        camera_motion_factor(places[0], elsewhere, E, D, seen)

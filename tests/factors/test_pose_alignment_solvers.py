"""The factors on poses beside odometry, IMU preintegration and GPS, under LM, iSAM2 and fixed-lag smoothers.

One graph, in which only the camera's factors determine the calibration: every solver comes to the
truth from a start that is off in everything.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import gtsam
import numpy as np
import pytest

from sst_graph.factors import Between, CameraMotion, camera_motion_factor, pose_alignment_factor, stacked

E, D, IMU_BIAS = gtsam.symbol("E", 0), gtsam.symbol("D", 0), gtsam.symbol("b", 0)
BTL = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.1, -0.2, 0.3), np.array([0.8, -0.3, 1.7]))
TRUE_BIAS = gtsam.imuBias.ConstantBias(np.array([0.03, -0.02, 0.04]), np.array([0.004, -0.003, 0.002]))
PERIOD_S, IMU_STEPS = 0.1, 20
FRAMES = 14


def X(k):
    return gtsam.symbol("X", k)


def V(k):
    return gtsam.symbol("V", k)


def imu_params(combined):
    kind = gtsam.PreintegrationCombinedParams if combined else gtsam.PreintegrationParams
    params = kind.MakeSharedU(9.81)
    params.setAccelerometerCovariance(np.eye(3) * 1e-4)
    params.setGyroscopeCovariance(np.eye(3) * 1e-6)
    params.setIntegrationCovariance(np.eye(3) * 1e-6)
    if combined:
        params.setBiasAccCovariance(np.eye(3) * 1e-5)
        params.setBiasOmegaCovariance(np.eye(3) * 1e-6)
    return params


def imu_readings(k):
    """Accelerations and rates over an interval, as a biased IMU reads them on a weaving, braking drive."""
    t = (k + (np.arange(IMU_STEPS) + 0.5) / IMU_STEPS) * PERIOD_S
    rates = np.stack([0.3 * np.sin(4 * t), 0.3 * np.cos(5 * t), 0.9 * np.sin(3 * t)], axis=1)
    forces = np.stack([4 * np.cos(3 * t), 3 * np.sin(4 * t), 9.81 + np.sin(6 * t)], axis=1)
    return forces + TRUE_BIAS.accelerometer(), rates + TRUE_BIAS.gyroscope()


def preintegrated(k, combined, bias):
    kind = gtsam.PreintegratedCombinedMeasurements if combined else gtsam.PreintegratedImuMeasurements
    measured = kind(imu_params(combined), bias)
    for force, rate in zip(*imu_readings(k), strict=True):
        measured.integrateMeasurement(force, rate, PERIOD_S / IMU_STEPS)
    return measured


@dataclass(frozen=True)
class Drive:
    """True states, and the camera's factors of each image, by the frame whose arrival completes them."""

    truth: gtsam.Values
    camera: list[list[gtsam.NonlinearFactor]]


@pytest.fixture
def drive(make_scene):
    base, cTl, time_offset_s, _ = make_scene(20, 60, noise_px=0.0)
    time_offset_s = 0.06
    base = replace(base, c_acceleration=np.zeros(6), sigmas_px=1.0)
    truth = gtsam.Values()
    truth.insert(E, cTl)
    truth.insert(D, np.array([time_offset_s]))
    state = gtsam.NavState(
        gtsam.Pose3(gtsam.Rot3.RzRyRx(0.02, 0.01, 0.3), np.zeros(3)), np.array([8.0, 2, 0])
    )
    for k in range(FRAMES):
        truth.insert(X(k), state.pose())
        truth.insert(V(k), state.velocity())
        state = preintegrated(k, False, TRUE_BIAS).predict(state, TRUE_BIAS)
    camera = [[] for _ in range(FRAMES)]
    for k in range(FRAMES - 1):
        camera[k + 1].append(_seen(base, k, truth))
    places = [Between(X(k), X(k + 1), PERIOD_S, -0.02, bTl=BTL) for k in range(FRAMES - 1)]
    for k in range(FRAMES - 2):
        camera[k + 2].append(_moved(places[k], places[k + 1], k, truth))
    return Drive(truth, camera)


def _seen(base, k, truth):
    """The alignment factor of image k, its pixels those of the truth."""
    blank = replace(base, pixels=np.zeros((len(base), 2)))
    args = Between(X(k), X(k + 1), PERIOD_S, 0.0, bTl=BTL), E, D
    error = stacked(pose_alignment_factor([blank], *args)).unwhitenedError(truth)
    pixels = error[:-1].reshape(2, -1).T
    return pose_alignment_factor([replace(blank, pixels=pixels)], *args)


def _moved(first, second, k, truth):
    """The camera's true motion between images k and k + 1, by the poses at their instants."""
    s = (first.image_after_a_s + truth.atVector(D)[0]) / PERIOD_S
    cameras = []
    for a in (k, k + 1):
        step = gtsam.Pose3.Logmap(truth.atPose3(X(a)).between(truth.atPose3(X(a + 1))))
        wTl = truth.atPose3(X(a)) * gtsam.Pose3.Expmap(s * step) * BTL
        cameras.append(wTl * truth.atPose3(E).inverse())
    covariance = np.diag(np.repeat([1e-3, 1e-2], 3) ** 2)
    measured = CameraMotion(cameras[0].between(cameras[1]), covariance)
    return camera_motion_factor(first, second, E, D, measured)


def bias_key(k, combined):
    """One bias for all frames, or, where it wanders, one for each."""
    return gtsam.symbol("b", k) if combined else IMU_BIAS


def new_at(k, drive, combined):
    """Factors and starts that come with frame k; every start is off."""
    graph, values, truth = gtsam.NonlinearFactorGraph(), gtsam.Values(), drive.truth
    rng = np.random.default_rng(k)
    off = np.repeat([0.01, 0.1], 3) * rng.standard_normal(6)
    values.insert(X(k), truth.atPose3(X(k)).retract(off))
    values.insert(V(k), truth.atVector(V(k)) + 0.2 * rng.standard_normal(3))
    if k == 0 or combined:
        values.insert(bias_key(k, combined), gtsam.imuBias.ConstantBias())
    if k == 0:
        values.insert(E, truth.atPose3(E).retract(np.array([0.02, -0.02, 0.02, 0.05, -0.05, 0.05])))
        values.insert(D, truth.atVector(D) + 0.02)
        tight = gtsam.noiseModel.Isotropic.Sigma(6, 1e-3)
        graph.add(gtsam.PriorFactorPose3(X(0), truth.atPose3(X(0)), tight))
        graph.add(
            gtsam.PriorFactorVector(V(0), values.atVector(V(0)), gtsam.noiseModel.Isotropic.Sigma(3, 5.0))
        )
        graph.add(
            gtsam.PriorFactorConstantBias(
                bias_key(0, combined), gtsam.imuBias.ConstantBias(), gtsam.noiseModel.Isotropic.Sigma(6, 0.5)
            )
        )
        rough = gtsam.noiseModel.Isotropic.Sigma(6, 1.0)
        graph.add(gtsam.PriorFactorPose3(E, values.atPose3(E), rough))
        graph.add(gtsam.PriorFactorVector(D, values.atVector(D), gtsam.noiseModel.Isotropic.Sigma(1, 1.0)))
        return graph, values
    a, b = k - 1, k
    measured = preintegrated(a, combined, gtsam.imuBias.ConstantBias())
    keys = X(a), V(a), X(b), V(b), bias_key(a, combined)
    if combined:
        graph.add(gtsam.CombinedImuFactor(*keys, bias_key(b, combined), measured))
    else:
        graph.add(gtsam.ImuFactor(*keys, measured))
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.repeat([0.005, 0.02], 3))
    step = truth.atPose3(X(a)).between(truth.atPose3(X(b)))
    graph.add(gtsam.BetweenFactorPose3(X(a), X(b), step, noise))
    graph.add(
        gtsam.GPSFactor(X(b), truth.atPose3(X(b)).translation(), gtsam.noiseModel.Isotropic.Sigma(3, 0.05))
    )
    for factor in drive.camera[k]:
        graph.add(factor)
    return graph, values


def check(estimate, drive, combined, last_pose_only=False):
    truth = drive.truth
    assert np.abs(truth.atPose3(E).localCoordinates(estimate.atPose3(E))).max() < 2e-4
    assert abs(estimate.atVector(D)[0] - truth.atVector(D)[0]) < 1e-4
    for k in [FRAMES - 1] if last_pose_only else range(FRAMES):
        off = truth.atPose3(X(k)).localCoordinates(estimate.atPose3(X(k)))
        assert np.abs(off).max() < 1e-3
        assert np.abs(estimate.atVector(V(k)) - truth.atVector(V(k))).max() < 2e-3
    found = estimate.atConstantBias(bias_key(FRAMES - 1, combined))
    assert np.abs(found.vector() - TRUE_BIAS.vector()).max() < 5e-3


@pytest.mark.parametrize("combined", [False, True])
def test_levenberg_marquardt(drive, combined):
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k in range(FRAMES):
        factors, starts = new_at(k, drive, combined)
        graph.push_back(factors)
        values.insert(starts)
    found = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    check(found, drive, combined)
    sigmas = np.sqrt(np.diag(gtsam.Marginals(graph, found).marginalCovariance(E)))
    assert (sigmas < 0.05).all()  # of priors of 1 rad and 1 m


def isam2_params():
    params = gtsam.ISAM2Params()
    params.setRelinearizeThreshold(1e-5)
    params.relinearizeSkip = 1
    return params


@pytest.mark.parametrize("combined", [False, True])
def test_isam2_frame_by_frame(drive, combined):
    solver = gtsam.ISAM2(isam2_params())
    for k in range(FRAMES):
        solver.update(*new_at(k, drive, combined))
    for _ in range(5):
        solver.update()
    check(solver.calculateEstimate(), drive, combined)


@pytest.mark.parametrize("kind", ["incremental", "batch"])
@pytest.mark.parametrize("combined", [False, True])
def test_fixed_lag_smoothers(drive, kind, combined):
    lag_s = 6.5 * PERIOD_S
    if kind == "incremental":
        solver = gtsam.IncrementalFixedLagSmoother(lag_s, isam2_params())
    else:
        solver = gtsam.BatchFixedLagSmoother(lag_s)
    for k in range(FRAMES):
        graph, values = new_at(k, drive, combined)
        # extrinsic, offset and the one bias are stamped again each time, or they would leave with the lag
        lasting = [E, D] if combined else [E, D, IMU_BIAS]
        stamps = dict.fromkeys([*values.keys(), *lasting], k * PERIOD_S)
        solver.update(graph, values, stamps)
    for _ in range(3):
        solver.update(gtsam.NonlinearFactorGraph(), gtsam.Values(), {})
    estimate = solver.calculateEstimate()
    assert not estimate.exists(X(0)) and estimate.exists(E) and estimate.exists(X(FRAMES - 1))
    check(estimate, drive, combined, last_pose_only=True)

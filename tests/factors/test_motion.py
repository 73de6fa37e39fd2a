"""Motion over the interval: signs by hand, gtsam as the oracle, derivatives."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from sst_graph.factors import CameraTwist, move_points
from sst_graph.factors.motion import (
    cross_rows,
    exponential_coefficients,
    group_poses,
    move_groups,
    se3_left_jacobian,
    transformed,
)

STILL = np.zeros(6)


def moved(cTl, lPs, taus, twist, acceleration=STILL, model="se3"):
    motion = CameraTwist(np.asarray(twist), acceleration)
    return move_points(cTl, np.asarray(lPs, dtype=float).T, taus, motion, model).cPs.T


@pytest.mark.parametrize("model", ["se3", "translation"])
@pytest.mark.parametrize("taus", [0.1, np.array([0.1])])
def test_driving_forward_brings_points_nearer(model, taus):
    cPs = moved(gtsam.Pose3(), [[1.0, 0.0, 20.0]], taus, [0, 0, 0, 0, 0, 10.0], model=model)
    np.testing.assert_allclose(cPs, [[1.0, 0.0, 19.0]], atol=1e-12)


@pytest.mark.parametrize("taus", [0.1, np.array([0.1])])
def test_turning_right_moves_points_to_the_left(taus):
    # y points down, so a turn to the right is a positive rotation about y
    cPs = moved(gtsam.Pose3(), [[0.0, 0.0, 10.0]], taus, [0, np.pi, 0, 0, 0, 0])
    np.testing.assert_allclose(
        cPs, [[-10.0 * np.sin(0.1 * np.pi), 0.0, 10.0 * np.cos(0.1 * np.pi)]], atol=1e-12
    )


def test_acceleration_by_hand():
    # 10 m/s at the image, braking at 4 m/s^2: in the 0.5 s before, 10 * 0.5 + 4 / 2 * 0.25 = 5.5 m
    braking = np.array([0, 0, 0, 0, 0, -4.0])
    for taus in (0.5, np.array([0.5])):
        cPs = moved(gtsam.Pose3(), [[0.0, 0.0, 20.0]], taus, [0, 0, 0, 0, 0, 10.0], braking)
        np.testing.assert_allclose(cPs, [[0.0, 0.0, 14.5]], atol=1e-12)


@pytest.mark.parametrize("speed", [1e-7, 1.0, 12.0])
def test_points_move_as_gtsam_moves_them(speed):
    rng = np.random.default_rng(3)
    cTl = gtsam.Pose3.Expmap(rng.normal(size=6))
    lPs, taus = rng.normal(0.0, 10.0, (100, 3)), rng.uniform(-0.5, 0.5, 100)
    twist, acceleration = speed * rng.normal(size=6), speed * rng.normal(size=6)
    expected = [
        (gtsam.Pose3.Expmap(-tau * (twist - 0.5 * tau * acceleration)) * cTl).transformFrom(lP)
        for tau, lP in zip(taus, lPs, strict=True)
    ]
    np.testing.assert_allclose(moved(cTl, lPs, taus, twist, acceleration), expected, rtol=1e-9, atol=1e-9)
    same = [
        moved(cTl, lP[None], float(tau), twist, acceleration)[0] for tau, lP in zip(taus, lPs, strict=True)
    ]
    np.testing.assert_allclose(same, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 0.1, 0.999999, 1.000001, 2.0, 3.1, 9.0])
def test_left_jacobian_is_the_power_series(angle):
    rng = np.random.default_rng(7)
    xi = rng.normal(size=6)
    xi[:3] *= angle / np.linalg.norm(xi[:3])
    ad = gtsam.Pose3.adjointMap(xi)
    expected, term = np.eye(6), np.eye(6)
    for k in range(1, 80):
        term = term @ ad / (k + 1)
        expected = expected + term
    np.testing.assert_allclose(se3_left_jacobian(xi), expected, rtol=1e-10, atol=1e-10)


def test_coefficients_of_many_angles_are_those_of_each():
    x = np.array([0.0, 1e-6, 0.5, 0.99, 1.01, 4.0, 9.0])
    each = [exponential_coefficients(np.array(value)) for value in x]
    np.testing.assert_allclose(exponential_coefficients(x), np.transpose(each), rtol=1e-12)


def test_coefficients_by_hand_and_their_derivatives():
    theta = np.pi / 2.0
    b, c, *_ = exponential_coefficients(np.array(theta**2))
    assert b == pytest.approx(1.0 / theta**2)
    assert c == pytest.approx((theta - 1.0) / theta**3)
    for x in (1e-8, 0.3, 0.9, 1.1, 5.0):
        h = 1e-4 * max(x, 1.0) if x > 1e-3 else 1e-9
        up, down = exponential_coefficients(np.array([[x + h], [x - h]]))[:2].transpose(1, 0, 2)
        numerical = (up - down)[:, 0] / (2.0 * h)
        tolerance = 1e-6 if x > 1e-3 else 1e-5  # differences of 1e-9
        np.testing.assert_allclose(exponential_coefficients(np.array(x))[2:], numerical, rtol=tolerance)


def test_an_object_that_drives_along_stays_where_it_is():
    """Camera and object go forward at 10 m/s: LiDAR x is camera z, and the point stays where it is."""
    cTl = gtsam.Pose3(gtsam.Rot3(np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])), np.zeros(3))
    lPs, velocity = np.array([[20.0], [3.0], [1.0]]), np.array([[10.0], [0.0], [0.0]])
    forward = CameraTwist(np.array([0, 0, 0, 0, 0, 10.0]), STILL)
    for taus in (0.3, np.array([0.3])):
        point = move_points(cTl, lPs, taus, forward, l_velocities=velocity)
        np.testing.assert_allclose(point.cPs.T, [[-3.0, -1.0, 20.0]], atol=1e-12)
        parked = move_points(cTl, lPs, taus, forward)
        np.testing.assert_allclose(parked.cPs.T, [[-3.0, -1.0, 17.0]], atol=1e-12)


@pytest.mark.parametrize("model", ["se3", "translation"])
@pytest.mark.parametrize("rigid", [True, False])
@pytest.mark.parametrize("speed", [0.01, 1.0, 10.0])
@pytest.mark.parametrize("objects", [False, True])
def test_derivatives_at_100_points(model, rigid, speed, objects):
    rng = np.random.default_rng(11)
    cTl, twist = gtsam.Pose3.Expmap(rng.normal(size=6)), speed * rng.normal(size=6)
    acceleration, time_offset_s = speed * rng.normal(size=6), 0.13
    lPs = rng.normal(0.0, 10.0, (3, 100))
    base = -0.04 if rigid else rng.uniform(-0.2, 0.2, 100)
    velocities = rng.normal(0.0, 10.0, (3, 100)) if objects else None

    def cPs(x):
        motion = CameraTwist(twist + x[7:], acceleration)
        taus_s = time_offset_s + x[6] + base
        return move_points(cTl.retract(x[:6]), lPs, taus_s, motion, model, velocities).cPs

    motion = CameraTwist(twist, acceleration)
    point = move_points(cTl, lPs, time_offset_s + base, motion, model, velocities)
    g = np.broadcast_to(np.eye(3)[:, :, None], (3, 3, 100)).copy()
    rows = np.empty((point.lift.shape[1] if rigid else 13, 3, 100))
    point.write_rows(g, rows)
    J = np.tensordot(point.lift, rows, axes=1) if rigid else rows
    for column in range(13):
        step = 1e-4 * np.eye(13)[column]
        coarse, fine = (cPs(step) - cPs(-step)) / 2e-4, (cPs(step / 2) - cPs(-step / 2)) / 1e-4
        numerical = (4.0 * fine - coarse) / 3.0
        scale = max(np.abs(numerical).max(), 1e-3)
        np.testing.assert_allclose(J[column] / scale, numerical / scale, atol=1e-6)


@pytest.mark.parametrize("objects", [False, True])
def test_groups_move_as_their_points_do_each_with_its_own_tau_and_image(objects: bool):
    rng = np.random.default_rng(13)
    bounds, cTl = np.array([0, 4, 4, 9]), gtsam.Pose3.Expmap(rng.normal(size=6))  # the second has none
    counts, taus_s = np.diff(bounds), np.array([0.13, -0.2, 0.05])
    twists, accelerations = rng.normal(size=(2, 3, 6))
    lPs, g = rng.normal(0.0, 10.0, (3, 9)), rng.normal(size=(3, 2, 9))
    groups = CameraTwist(twists, accelerations)
    each = CameraTwist(*(np.repeat(rows, counts, axis=0).T for rows in (twists, accelerations)))
    velocities = rng.normal(0.0, 10.0, (3, 9)) if objects else None
    single = move_points(cTl, lPs, np.repeat(taus_s, counts), each, l_velocities=velocities)
    moved = move_groups(cTl, lPs, bounds, taus_s, groups, velocities)
    np.testing.assert_allclose(moved.cPs, single.cPs, rtol=1e-12, atol=1e-12)
    if not objects:
        by_pose = transformed(group_poses(cTl, taus_s, groups), lPs, bounds)
        np.testing.assert_allclose(by_pose, single.cPs, rtol=1e-12, atol=1e-12)
    expected, rows = np.empty((13, 2, 9)), np.empty((moved.lift.shape[2], 2, 9))
    single.write_rows(g, expected)
    moved.write_rows(g, rows)
    lifts = np.repeat(moved.lift, counts, axis=0)
    np.testing.assert_allclose(np.einsum("nij,jkn->ikn", lifts, rows), expected, rtol=1e-10, atol=1e-10)


def test_cross_products_of_rows() -> None:
    a, b = np.random.default_rng(3).normal(size=(2, 7, 3))
    np.testing.assert_allclose(cross_rows(a, b), np.cross(a, b), rtol=1e-12)
    np.testing.assert_allclose(cross_rows(a[0], b), np.cross(a[0], b), rtol=1e-12)

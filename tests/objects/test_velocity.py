"""Velocities over ground of objects: a moving box, one cut off by the field of view, what is forgotten."""

from __future__ import annotations

import dataclasses

import gtsam
import numpy as np
import pytest
from numpy.typing import NDArray

from sst_graph.drive.preparation import ScanFeatures
from sst_graph.features.lidar_edges import Boundaries, Edge
from sst_graph.objects.velocity import ObjectVelocities, ObjectVelocity, near_end_velocity
from sst_graph.types import SemanticClass

FloatArray = NDArray[np.float64]
VEHICLE = SemanticClass.VEHICLE
NAME = (VEHICLE, 0)
PERIOD_NS = 100_000_000
HEIGHTS = np.arange(-1.0, 0.6, 0.1)


def _scan(stamp_ns: int, wTl: gtsam.Pose3, corners: FloatArray) -> ScanFeatures:
    """A scan of one object: edges that stand at corners (n, 2) in the world, and a roof that says nothing."""
    wPs = np.array([[x, y, z] for x, y in corners for z in HEIGHTS])
    roof = np.column_stack([np.tile(corners.mean(axis=0), (40, 1)), np.full(40, 0.7)]) + 3.0
    lPs = np.stack([wTl.transformTo(wP) for wP in np.vstack([wPs, roof])])
    n = len(lPs)
    edges = np.full(n, Edge.SIDE, np.uint8)
    edges[len(wPs) :] = Edge.TOP
    found = {
        VEHICLE: Boundaries(lPs, lPs.copy(), np.ones(n, np.intp), np.zeros(n), edges, np.zeros(n, np.intp))
    }
    none = np.zeros((0, 3))
    return ScanFeatures(0, stamp_ns, found, none, np.zeros(0, np.uint8), none[:, 0], none, none[:, 0])


def _seen_corners(centre: FloatArray, place: FloatArray) -> FloatArray:
    """The two corners (2, 2) of a box of 4.4 by 1.8 m along x that bound it as seen from a place."""
    corners = centre + np.array([[2.2, 0.9], [2.2, -0.9], [-2.2, -0.9], [-2.2, 0.9]])
    angles = np.arctan2(*(corners - place).T[::-1])
    return corners[[angles.argmin(), angles.argmax()]]


def _followed(
    speed_mps: float,
    ego_mps: float,
    scans: int = 12,
    left_m: float = 3.0,
    start_m: float = 30.0,
    period_ns: int = PERIOD_NS,
) -> ObjectVelocities:
    """A box that drives along x, seen from a LiDAR that drives along x and looks to the left; period_ns:
    between two stamps."""
    velocities = ObjectVelocities()
    for k in range(scans):
        t = 0.1 * k
        wTl = gtsam.Pose3(gtsam.Rot3.Yaw(0.3), np.array([ego_mps * t, 0.0, 0.0]))
        corners = _seen_corners(np.array([start_m + speed_mps * t, left_m]), np.array([ego_mps * t, 0.0]))
        velocities.add(k, _scan(k * period_ns, wTl, corners), {NAME: 7}, wTl)
    return velocities


def _in_world(found: ObjectVelocity | None) -> FloatArray:
    assert found is not None
    return np.asarray(gtsam.Rot3.Yaw(0.3).rotate(found.l_velocity))


@pytest.mark.parametrize(("speed", "ego"), [(-9.0, 8.0), (9.0, 8.0), (6.0, 0.0), (-12.0, 0.0)])
def test_a_moving_box(speed: float, ego: float) -> None:
    """Oncoming or ahead: exact, though its visible corners change; surest in the middle of its detections."""
    velocities = _followed(speed, ego)
    for k in range(12):
        np.testing.assert_allclose(_in_world(velocities.of(k, NAME)), [speed, 0.0, 0.0], atol=1e-6)
    early = velocities.of(2, NAME), velocities.of(11, NAME)
    assert early[0] is not None and early[1] is not None and early[1].sigma_mps > 0.15
    velocities.update_all()
    sigmas = [found.sigma_mps for k in range(12) if (found := velocities.of(k, NAME)) is not None]
    assert sigmas[5] == pytest.approx(0.03) and sigmas[0] > 0.15 and sigmas[-1] > 0.15


def test_the_claimed_noise() -> None:
    """The spread of the velocities found is their claimed deviation."""
    rng = np.random.default_rng(0)
    times, errors, sigmas = 0.1 * np.arange(-3, 4), [], []
    for _ in range(300):
        outlines = [
            np.array([[30.0 - 8.0 * t, 3.0], [34.0 - 8.0 * t, 3.0]]) + 0.05 * rng.standard_normal(2)
            for t in times
        ]
        found = near_end_velocity(times, outlines, [np.zeros(2)] * 7, np.array([-7.0, 1.0]))
        assert found is not None
        errors.append(found[0] - [-8.0, 0.0])
        sigmas.append(found[1])
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(np.sqrt(np.mean(np.square(sigmas))), rel=0.1)


def test_objects_without_a_velocity() -> None:
    """Standing, passing alongside, seen too seldom, or leaping: none."""
    assert _followed(0.0, 8.0).of(6, NAME) is None
    assert _followed(-8.0, 8.0, start_m=9.0).of(6, NAME) is None
    assert _followed(-9.0, 8.0, scans=3).of(1, NAME) is None
    assert _followed(-9.0, 8.0).of(5, (VEHICLE, 1)) is None
    velocities = ObjectVelocities()
    rng = np.random.default_rng(1)
    for k in range(8):
        corners = np.array([[30.0 - 0.9 * k, 3.0], [34.0 - 0.9 * k, 3.0]]) + rng.normal(0.0, 1.0, 2)
        velocities.add(k, _scan(k * PERIOD_NS, gtsam.Pose3(), corners), {NAME: 7}, gtsam.Pose3())
    assert velocities.of(4, NAME) is None


@pytest.mark.parametrize("period_ns", [100, 60_000])
def test_stamps_of_a_clock_that_hardly_runs(period_ns: int) -> None:
    """Milliseconds divided by a million: scans within a millisecond of each other show no velocity."""
    velocities = _followed(-9.0, 8.0, period_ns=period_ns)
    velocities.update_all()
    assert all(velocities.of(k, NAME) is None for k in range(12))


def test_an_end_that_the_field_of_view_cuts_off_is_no_motion() -> None:
    """A parked row beside the road: its near end is where the labels end, and drives along with the LiDAR."""
    velocities = ObjectVelocities()
    for k in range(10):
        x = 0.8 * k
        wTl = gtsam.Pose3(gtsam.Rot3.Yaw(0.3), np.array([x, 0.0, 0.0]))
        kept = np.array([[x + 4.0, 3.0], [12.0, 2.9], [12.0, 4.6], [11.0, 3.0], [11.5, 4.6]])
        velocities.add(k, _scan(k * PERIOD_NS, wTl, kept), {NAME: 7}, wTl)
    assert velocities.of(5, NAME) is None
    # Without a look at the rest of the outline it would be.
    seen = [velocities._scans[k] for k in range(2, 9)]
    outlines, places = [one.outlines[NAME] for one in seen], [one.place for one in seen]
    found = near_end_velocity(0.1 * np.arange(-3, 4), outlines, places, np.array([1.6, 0.0]))
    assert found is not None and found[0][0] > 5.0


def test_what_is_known_grows_with_the_scans_around_and_is_forgotten() -> None:
    velocities, whole = ObjectVelocities(), []
    for k in range(12):
        wTl = gtsam.Pose3(gtsam.Rot3.Yaw(0.3), np.array([0.8 * k, 0.0, 0.0]))
        corners = _seen_corners(np.array([30.0 - 0.9 * k, 3.0]), np.array([0.8 * k, 0.0]))
        whole.append(velocities.add(k, _scan(k * PERIOD_NS, wTl, corners), {NAME: 7}, wTl))
        if k == 6:
            early = velocities.of(6, NAME)
    # The first velocity is applied to all scans before; then those around which all has been seen.
    assert whole[2] == set() and whole[3] == {0, 1, 2} and whole[11] == {7}
    late = velocities.of(6, NAME)
    assert early is not None and late is not None and late.sigma_mps < 0.3 * early.sigma_mps
    assert velocities.of(6, NAME) is late
    velocities.forget(8)
    assert velocities.of(6, NAME) is None and min(velocities._scans) == 8
    assert 6 not in velocities.found[7]
    velocities.found[7][9] = late
    assert velocities.of(9, NAME) is late and velocities.speeds(10)[NAME] == pytest.approx(9 / 1.0)
    velocities.forget(12)
    assert not (velocities._scans or velocities.found)


def test_a_scan_whose_objects_show_no_side() -> None:
    """Roofs alone, as where all sides are hidden or too far from the next beam."""
    scan = _scan(0, gtsam.Pose3(), _seen_corners(np.array([20.0, 3.0]), np.zeros(2)))
    roofs = scan.boundaries[VEHICLE].take(np.flatnonzero(scan.boundaries[VEHICLE].edges == Edge.TOP))
    velocities = ObjectVelocities()
    velocities.add(0, dataclasses.replace(scan, boundaries={VEHICLE: roofs}), {NAME: 7}, gtsam.Pose3())
    assert velocities.of(0, NAME) is None and velocities.speeds(0) == {}


@pytest.mark.parametrize("pitch_deg", [0.0, 25.0])
def test_a_box_on_the_ground_seen_by_a_lidar_that_is_mounted_aslant(pitch_deg: float) -> None:
    """The world's axes are those of the first scan, aslant too: the velocity has a part along their z."""
    velocities, level_R_world = ObjectVelocities(), gtsam.Rot3.Pitch(np.radians(pitch_deg))
    rng = np.random.default_rng(0)
    ground = np.column_stack([rng.uniform(-5.0, 40.0, (3000, 2)), rng.normal(-1.7, 0.02, 3000)])
    for k in range(12):
        t = 0.1 * k
        level_T_lidar = gtsam.Pose3(level_R_world, np.array([2.0 * t, 0.0, 0.0]))
        corners = _seen_corners(np.array([15.0 + 10.0 * t, 3.0]), np.array([2.0 * t, 0.0]))
        scan = _scan(k * PERIOD_NS, level_T_lidar, corners)
        lPs = (ground - level_T_lidar.translation()) @ level_R_world.matrix()
        scan = dataclasses.replace(scan, lPs=lPs, classes=np.ones(3000, np.uint8))
        velocities.insert(
            k, scan, {NAME: 7}, gtsam.Pose3(level_R_world, np.zeros(3)).inverse() * level_T_lidar
        )
    velocities.update_all()
    found = velocities.of(6, NAME)
    assert found is not None
    np.testing.assert_allclose(level_R_world.rotate(found.l_velocity), [10.0, 0.0, 0.0], atol=0.05)

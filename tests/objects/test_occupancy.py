"""Objects that are where they were a little before or after, and those that are not."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from scipy.spatial.distance import cdist

from sst_graph.drive.preparation import ScanFeatures
from sst_graph.features.lidar_edges import Boundaries
from sst_graph.objects.occupancy import OccupancyTest, _Outlines
from sst_graph.types import SemanticClass

VEHICLE, BUILDING = SemanticClass.VEHICLE, SemanticClass.BUILDING
STEP = gtsam.Pose3(gtsam.Rot3.Yaw(0.02), np.array([0.7, 0.1, 0.0]))
"""The LiDAR's own motion in 0.1 s."""
ROOF = np.stack(np.meshgrid(np.arange(0.0, 4.2, 0.2), [0.0, 1.6], [0.0]), -1).reshape(-1, 3)


def scan(k: int, period_s: float, corners: list[np.ndarray], c: SemanticClass = VEHICLE) -> ScanFeatures:
    """Roofs (their edges are the boundary) with these corners in the world, seen at the k-th pose."""
    wTl = pose(k, period_s)
    wPs = np.concatenate([np.zeros((0, 3)), *(ROOF + corner for corner in corners)])
    lPs = (wPs - wTl.translation()) @ wTl.rotation().matrix()
    numbers = np.repeat(np.arange(len(corners)), len(ROOF))
    n, small = len(lPs), np.zeros((0, 3), np.float32)
    found = Boundaries(lPs, lPs, np.ones(n, np.intp), np.zeros(n), np.zeros(n, np.uint8), numbers)
    stamp_ns = round(k * period_s * 1e9)
    by_class = {c: found} if n else {}
    ground = np.array([[5.0, 0.0, -1.7]]), np.full(1, SemanticClass.GROUND, np.uint8), np.zeros(1)
    return ScanFeatures(k, stamp_ns, by_class, *ground, small, small[:, 0])


def pose(k: int, period_s: float) -> gtsam.Pose3:
    return gtsam.Pose3.Expmap(gtsam.Pose3.Logmap(STEP) * (k * period_s / 0.1))


def seen(
    scans: int, *velocities: float, period_s: float = 0.1, c: SemanticClass = VEHICLE
) -> list[dict[int, float]]:
    """Speeds that roofs of these velocities along x are assumed to have [m/s], scan by scan."""
    test = OccupancyTest()
    for k in range(scans):
        corners = [np.array([15.0 + v * k * period_s, 6.0 * i - 9.0, 0.5]) for i, v in enumerate(velocities)]
        test.add(k, scan(k, period_s, corners, c), pose(k, period_s))
    return [{n: speed for (_, n), speed in test.speeds(k).items()} for k in range(scans)]


@pytest.mark.parametrize("period_s", [0.05, 0.1, 0.15, 0.5])
def test_what_drives_away_is_not_found_again(period_s: float) -> None:
    """A roof of 4 m: at 12 m/s it has left its place after 0.3 s; a parked one has not, though we drive."""
    speeds = seen(12, 0.0, 12.0, period_s=period_s)
    assert all(set(found) == {1} for found in speeds)
    assert min(found[1] for found in speeds) > 5.0


def test_slower_objects_overlap_with_themselves() -> None:
    """Half a metre in 0.3 s takes a roof's edge from its place, but little of its sides."""
    assert all(not found for found in seen(8, 0.0, 1.5))


def test_coming_into_view_and_leaving_is_not_motion() -> None:
    test = OccupancyTest()
    for k in range(14):
        corner = [np.array([15.0, -4.0, 0.5])] if 4 <= k <= 8 else []
        test.add(k, scan(k, 0.1, corner), pose(k, 0.1))
    # Each is found again on the side on which it was seen; the middle one nowhere 0.3 s away.
    assert [bool(test.speeds(k)) for k in range(4, 9)] == [False, False, True, False, False]


@pytest.mark.parametrize(("speed", "changed"), [(0.0, {4}), (12.0, set())])
def test_later_scans_change_the_decision(speed: float, changed: set[int]) -> None:
    """What is new in scan 4 is found dynamic; 0.3 s later not, if it is static."""
    test = OccupancyTest()
    for k in range(7):
        corners = [np.array([15.0 + 0.1 * k * speed, -4.0, 0.5])] if k >= 4 else []
        assert test.add(k, scan(k, 0.1, corners), pose(k, 0.1)) == set()
    assert test.speeds(4)
    after = scan(7, 0.1, [np.array([15.0 + 0.7 * speed, -4.0, 0.5])])
    assert test.add(7, after, pose(7, 0.1)) == changed
    assert bool(test.speeds(4)) == (speed > 0.0)


def test_a_few_scans_are_not_enough() -> None:
    assert seen(3, 12.0) == [{}] * 3


def test_labels_that_go_do_not_take_the_object_along() -> None:
    """The roof is there still, as a building; the ground below a vehicle that left does not count."""
    for c, found in ((BUILDING, False), (SemanticClass.GROUND, True)):
        test = OccupancyTest()
        for k in range(8):
            whole = scan(k, 0.1, [np.array([15.0, -4.0, 0.5])])
            if k % 2:
                lPs = whole.boundaries[VEHICLE].lPs
                whole = replace(whole, boundaries={}, lPs=lPs, classes=np.full(len(lPs), c, np.uint8))
            test.add(k, whole, pose(k, 0.1))
        assert bool(test.speeds(4)) == found


def test_scans_without_labels_between_take_nothing_from_its_place() -> None:
    """Labels in every third scan: what drives away is found from one labelled scan to another."""
    test = OccupancyTest()
    for k in range(13):
        corners = [np.array([15.0, -4.0, 0.5]), np.array([15.0 + 1.2 * k, 4.0, 0.5])]
        whole = scan(k, 0.1, corners)
        if k % 3:
            nothing = np.zeros((0, 3)), np.zeros(0, np.uint8), np.zeros(0)
            whole = replace(whole, boundaries={}, lPs=nothing[0], classes=nothing[1], offsets_s=nothing[2])
        test.add(k, whole, pose(k, 0.1))
    assert [set(test.speeds(k)) for k in (3, 6, 9)] == [{(VEHICLE, 1)}] * 3
    assert not test.speeds(4)


def test_what_cannot_move_is_left_alone() -> None:
    assert all(not found for found in seen(6, 12.0, c=BUILDING))
    # Scans two seconds apart tell nothing of an object either.
    assert all(not found for found in seen(4, 12.0, period_s=2.0))


def test_speeds_rise_as_less_is_found() -> None:
    test = OccupancyTest()
    shares = np.linspace(0.0, 1.0, 101)
    speeds = []
    for k, share in enumerate(shares):
        test.shares[k] = {(VEHICLE, 0): np.array([1.0, share])}
        speeds.append(test.speeds(k).get((VEHICLE, 0), 0.0))
    assert (np.diff(speeds) <= 0.0).all()
    assert speeds[20] == 30.0 and speeds[45] == pytest.approx(0.6) and speeds[60] == 0.0


def test_nothing_is_kept_of_scans_long_gone() -> None:
    test = OccupancyTest()
    for k in range(40):
        test.forget(k - 10)
        test.add(k, scan(k, 0.1, [np.array([15.0, -4.0, 0.5])]), pose(k, 0.1))
    assert sorted(test.shares) == list(range(29, 40))
    assert len(test._places) <= 6


def test_points_within_reach_are_found_among_many() -> None:
    rng = np.random.default_rng(1)
    wPs, reaches_m = rng.uniform(-5.0, 5.0, (40, 3)), rng.uniform(0.2, 1.0, 40)
    many = rng.uniform(-20.0, 20.0, (20_000, 3))
    outlines = _Outlines(wPs, reaches_m, np.zeros(40, np.intp))
    expected = (cdist(wPs, many) <= reaches_m[:, None]).any(axis=1)
    assert 5 < np.count_nonzero(expected) < 35
    np.testing.assert_array_equal(outlines.near_some(many), expected)
    assert not outlines.near_some(many[:0]).any()

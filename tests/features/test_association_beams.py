"""Rings, their order and their cones, from a scan of eight lasers that sit off the origin."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from sst_graph.features.lidar_beams import arrange_beams, common_height, recover_rings, rings_belong

ELEVATIONS = np.radians([-14.0, -11.5, -9.0, -7.0, -5.0, -3.0, -1.5, 0.5])
HEIGHTS = np.array([0.21, 0.18, 0.2, 0.15, 0.12, 0.14, 0.1, 0.11])
STEP = np.radians(0.2)
NAMES = np.array([5, 2, 7, 0, 1, 6, 3, 4])
"""The lasers' names, by elevation: no order at all."""


def eight_rings(
    noise_m: float = 0.01, low_m: float = 5.0, high_m: float = 40.0
) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) in a random order and the rank of each point's laser."""
    rng = np.random.default_rng(4)
    azimuth = np.tile(np.arange(-np.pi + 0.5 * STEP, np.pi, STEP), 8)
    rank = np.repeat(np.arange(8), len(azimuth) // 8)
    rho = rng.uniform(low_m, high_m, len(azimuth))
    z = HEIGHTS[rank] + np.tan(ELEVATIONS[rank]) * rho + rng.normal(0.0, noise_m, len(rho))
    points = np.stack([rho * np.cos(azimuth), rho * np.sin(azimuth), z], axis=1)
    shuffled = rng.permutation(len(points))
    return points[shuffled], rank[shuffled]


def test_ranks_heights_and_step() -> None:
    points, rank = eight_rings()
    beams = arrange_beams(points, NAMES[rank].astype(np.uint16))
    np.testing.assert_array_equal(beams.ring, rank)
    np.testing.assert_allclose(beams.height, HEIGHTS, atol=0.005)
    assert beams.step == pytest.approx(STEP, rel=1e-9)
    assert (np.diff(beams.elevation) > 0.0).all()
    np.testing.assert_allclose(beams.rho, np.hypot(points[:, 0], points[:, 1]))


def test_sorted_by_ring_then_azimuth() -> None:
    points, rank = eight_rings()
    beams = arrange_beams(points, NAMES[rank].astype(np.uint16))
    assert sorted(beams.order) == list(range(len(points)))
    assert (np.diff(beams.ring[beams.order]) >= 0).all()
    same = np.diff(beams.ring[beams.order]) == 0
    assert (np.diff(beams.azimuth[beams.order])[same] > 0.0).all()


def test_outliers_do_not_move_the_cones() -> None:
    points, rank = eight_rings()
    rng = np.random.default_rng(1)
    points[rng.permutation(len(points))[: len(points) // 20], 2] += 1.0
    beams = arrange_beams(points, NAMES[rank].astype(np.uint16))
    np.testing.assert_allclose(beams.height, HEIGHTS, atol=0.01)


def test_no_height_from_a_ring_at_one_range() -> None:
    points, rank = eight_rings(low_m=20.0, high_m=25.0)
    assert not arrange_beams(points, rank).height.any()


@pytest.mark.parametrize("turn_deg", [0.0, 90.0])
def test_numbers_that_do_not_belong_to_the_points_are_not_believed(turn_deg: float) -> None:
    """In any axes; lasers may be numbered in any order."""
    points, rank = eight_rings(low_m=15.0)
    numbers, mixed = NAMES[rank], np.random.default_rng(5).permutation(NAMES[rank])
    turned = points @ gtsam.Rot3.Rx(np.radians(turn_deg)).matrix().T
    assert rings_belong(turned, numbers) and not rings_belong(turned, mixed)
    found, recovered = arrange_beams(points, mixed), arrange_beams(points, None)
    np.testing.assert_array_equal(found.ring, recovered.ring)
    assert rings_belong(points[:10], mixed[:10])  # too few to tell
    # Returns that were lost, at the origin; a scan of one laser.
    lost = np.where(np.arange(len(points))[:, None] % 5 > 1, 0.0, turned)
    assert rings_belong(lost, numbers) and not rings_belong(lost, mixed)
    assert rings_belong(turned[rank == 3], numbers[rank == 3])
    # Column after column: every eighth point is of the same laser.
    many = np.arange(80_000)
    azimuths, lasers = 2.0 * np.pi * (many // 8) / 10_000, many % 8
    level = np.cos(ELEVATIONS[lasers])
    seen = np.stack([level * np.cos(azimuths), level * np.sin(azimuths), np.sin(ELEVATIONS[lasers])], axis=1)
    assert rings_belong(20.0 * seen, lasers)


def test_rings_without_numbers() -> None:
    points, rank = eight_rings(low_m=15.0, high_m=60.0)
    rho = np.hypot(points[:, 0], points[:, 1])
    found = recover_rings(np.arctan2(points[:, 2], rho), rho)
    # Every ring's points carry one number, and numbers rise with the elevation.
    share = [np.bincount(found[rank == k]).max() / np.count_nonzero(rank == k) for k in range(8)]
    assert min(share) > 0.99
    mode = [int(np.bincount(found[rank == k]).argmax()) for k in range(8)]
    assert mode == sorted(set(mode))


def test_rings_without_numbers_of_lasers_far_above_the_origin() -> None:
    """64 rings 0.4 deg apart whose cones have their tips 0.2 m above the origin, as of an HDL-64E:
    near points are up to seven rings higher, as seen from the origin."""
    rng = np.random.default_rng(8)
    rank = rng.integers(0, 64, 60_000)
    azimuth, rho = rng.uniform(-0.7, 0.7, len(rank)), rng.uniform(4.0, 40.0, len(rank))
    z = 0.2 + np.tan(np.radians(-24.0 + 0.41 * rank)) * rho + rng.normal(0.0, 0.005, len(rank))
    points = np.stack([rho * np.cos(azimuth), rho * np.sin(azimuth), z], axis=1)
    assert common_height(z, rho) == pytest.approx(0.2, abs=0.011)
    found = arrange_beams(points, None).ring
    assert sum(np.bincount(found[rank == k]).max() for k in range(64)) > 0.97 * len(rank)
    assert sum(np.bincount(rank[found == k]).max() for k in np.unique(found)) > 0.97 * len(rank)


def test_rings_that_meet_the_ground_before_any_far_point() -> None:
    """From 1.8 m all below -13 deg do; the others see walls of all distances."""
    rank = np.tile(np.arange(24), 500)
    rng = np.random.default_rng(3)
    elevation = np.radians(np.linspace(-25.0, 2.0, 24)[rank] + rng.normal(0.0, 0.02, len(rank)))
    walls = rng.uniform(10.0, 50.0, len(rank))
    rho = np.where(elevation < np.radians(-2.0), 1.8 / np.tan(np.maximum(-elevation, 0.01)), walls)
    found = recover_rings(elevation, rho)
    assert sum(np.bincount(found[rank == k]).max() for k in range(24)) > 0.99 * len(rank)
    assert sum(np.bincount(rank[found == k]).max() for k in np.unique(found)) > 0.99 * len(rank)


def test_a_sensor_without_rings_gets_strips() -> None:
    elevation = np.random.default_rng(0).uniform(-0.2, 0.2, 20_000)
    found = recover_rings(elevation, np.full(len(elevation), 20.0))
    for k in np.unique(found):
        assert np.ptp(elevation[found == k]) <= np.radians(0.4) + 1e-9
    assert len(np.unique(found)) == pytest.approx(0.4 / np.radians(0.4), abs=1.0)


def test_nothing() -> None:
    assert len(recover_rings(np.zeros(0), np.zeros(0))) == 0
    assert common_height(np.zeros(0), np.zeros(0)) == 0.0
    beams = arrange_beams(np.zeros((0, 3)), None)
    assert len(beams.order) == 0 and beams.step == 0.0


def test_rings_of_few_points_among_rings_of_many() -> None:
    points, rank = eight_rings(noise_m=0.002)
    rng = np.random.default_rng(2)
    kept = (rank % 2 == 0) | (
        rng.random(len(rank)) < 0.05
    )  # every other ring has fewer than its cone may use
    counts = np.bincount(rank[kept])
    assert counts[1::2].max() < 150 and counts[::2].min() > 1000
    beams = arrange_beams(points[kept], NAMES[rank[kept]].astype(np.uint16))
    np.testing.assert_array_equal(beams.ring, rank[kept])
    np.testing.assert_allclose(beams.height, HEIGHTS, atol=0.005)
    medians = [
        np.median(np.arctan2(p[:, 2], np.hypot(p[:, 0], p[:, 1])))
        for p in (points[kept & (rank == r)] for r in range(8))
    ]
    np.testing.assert_allclose(beams.elevation, medians, atol=1e-3)


def test_more_numbers_than_lasers_are_those_of_something_else() -> None:
    """Of a number that one point or two have, nothing is left of the variance, whatever it stands for."""
    points, _ = eight_rings(low_m=15.0)
    points = np.tile(points, (1 + 20_000 // len(points), 1))
    rng = np.random.default_rng(6)
    for most in (500, 65_536):
        numbers = rng.integers(0, most, len(points)).astype(np.uint16)
        assert not rings_belong(points, numbers)
        recovered = arrange_beams(points, None)
        np.testing.assert_array_equal(arrange_beams(points, numbers).ring, recovered.ring)

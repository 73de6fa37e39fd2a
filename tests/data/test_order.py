"""Rings and point times from the order of a spinning scanner's points."""

from __future__ import annotations

import numpy as np
import pytest

from sst_graph.data.scan_order import rings_from_order
from sst_graph.sweep_timing import SweepTiming

BEAMS = 32


def spin(
    *, start_deg: float = 0.0, clockwise: bool = False, crop_deg: float = 180.0, kept: float = 0.85
) -> tuple[np.ndarray, np.ndarray]:
    """Points of a scanner over uneven ground, beam after beam, and the true beam of each."""
    rng = np.random.default_rng(11)
    points, beams = [], []
    for beam, elevation in enumerate(np.radians(np.linspace(2.0, -24.0, BEAMS))):
        azimuth = np.arange(0.0, 360.0, 0.5) + start_deg + rng.normal(0.0, 0.1)
        azimuth = np.mod(azimuth[::-1] if clockwise else azimuth, 360.0)
        azimuth = azimuth[(np.abs(np.mod(azimuth + 180.0, 360.0) - 180.0) < crop_deg)]
        azimuth = np.radians(azimuth[rng.random(len(azimuth)) < kept])
        reach = rng.uniform(4.0, 60.0, len(azimuth))
        tilt = elevation + rng.normal(0.0, 0.002, len(azimuth))
        directions = [np.cos(tilt) * np.cos(azimuth), np.cos(tilt) * np.sin(azimuth), np.sin(tilt)]
        points.append(reach[:, None] * np.stack(directions, 1))
        beams.append(np.full(len(azimuth), beam))
    return np.concatenate(points).astype(np.float32), np.concatenate(beams)


@pytest.mark.parametrize("start_deg", [0.0, 180.0, 90.0])
@pytest.mark.parametrize("clockwise", [False, True])
def test_beams_of_a_full_turn_are_found(start_deg: float, clockwise: bool) -> None:
    points, beams = spin(start_deg=start_deg, clockwise=clockwise)
    rings = rings_from_order(points)
    assert rings is not None
    assert rings.dtype == np.uint16
    assert np.mean(rings != beams) < 0.002


@pytest.mark.parametrize("crop_deg", [50.0, 60.0, 120.0])
def test_beams_of_a_cropped_cloud_are_found(crop_deg: float) -> None:
    """As on disk: each beam runs 0..+crop, then -crop..0."""
    points, beams = spin(crop_deg=crop_deg)
    rings = rings_from_order(points)
    assert rings is not None
    assert np.mean(rings != beams) < 0.005


@pytest.mark.parametrize("clockwise", [False, True])
def test_beams_of_points_that_are_there_twice_are_found(clockwise: bool) -> None:
    """Two returns a firing, side by side."""
    points, beams = spin(clockwise=clockwise)
    rings = rings_from_order(np.repeat(points, 2, axis=0))
    assert rings is not None and np.mean(rings != np.repeat(beams, 2)) < 0.002


def test_other_orders_give_none() -> None:
    points, beams = spin()
    rng = np.random.default_rng(0)
    assert rings_from_order(points[rng.permutation(len(points))]) is None
    columns = np.lexsort((beams, np.round(np.arctan2(points[:, 1], points[:, 0]), 2)))
    assert rings_from_order(points[columns]) is None
    assert rings_from_order(points[beams == 7]) is None
    noise = rng.normal(0.0, 10.0, (3000, 3)).astype(np.float32)
    assert rings_from_order(noise) is None


def fired(*, speed_mps: float, upwards: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """A street of blocks of many distances, measured firing after firing on the way and moved to where the
    LiDAR is when it faces forward; a fifth of the returns is missing. Points and the true beam of each."""
    rng = np.random.default_rng(5)
    elevations = np.radians(np.linspace(2.0, -24.0, BEAMS))
    reaches = rng.uniform(5.0, 40.0, 80)
    points, beams = [], []
    for azimuth in np.radians(np.arange(-180.0, 180.0, 0.4)):
        forward = speed_mps * azimuth / (2.0 * np.pi) * 0.1
        to_ground = 1.8 / np.maximum(np.tan(-elevations), 1e-3)
        reach = np.minimum(to_ground, reaches[int((azimuth + np.pi) / (2.0 * np.pi) * 80)])
        directions = [np.full(BEAMS, np.cos(azimuth)), np.full(BEAMS, np.sin(azimuth)), np.tan(elevations)]
        own = reach[:, None] * np.stack(directions, 1) + [forward, 0.0, 0.0]
        seen = np.flatnonzero(rng.random(BEAMS) < rng.choice([0.8, 1.0]))[:: -1 if upwards else 1]
        points.append(own[seen])
        beams.append(seen)
    return np.concatenate(points).astype(np.float32), np.concatenate(beams)


@pytest.mark.parametrize(("speed_mps", "upwards"), [(0.0, False), (8.0, True), (20.0, False)])
def test_beams_of_a_cloud_stored_firing_after_firing_are_found(speed_mps: float, upwards: bool) -> None:
    """At 20 m/s the lower rings move by three times their distance during the turn."""
    points, beams = fired(speed_mps=speed_mps, upwards=upwards)
    rings = rings_from_order(points)
    assert rings is not None and rings.dtype == np.uint16
    assert np.mean(rings != (BEAMS - 1 - beams if upwards else beams)) < 0.01


@pytest.mark.parametrize("count", [0, 1, 2, 9])
def test_tiny_clouds_give_none(count: int) -> None:
    assert rings_from_order(spin()[0][:count]) is None
    assert rings_from_order(np.zeros((count, 3), np.float32)) is None


def test_sweep_runs_from_left_to_right_and_is_stamped_ahead() -> None:
    ahead, left, right = [10.0, 0, 0], [0, 5.0, 1], [0, -5.0, 1]
    offsets = SweepTiming(-1.0, np.pi, 0.1).offsets_s(np.array([ahead, left, right], np.float32))
    np.testing.assert_allclose(offsets, [0.0, -0.025, 0.025], atol=1e-9)
    assert offsets.dtype == np.float32

"""Boundary points of a plate before a wall, seen by lasers in the origin."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sst_graph.features.lidar_edges import MAX_RANGE_M, Boundaries, Edge, find_boundaries, split_objects
from sst_graph.types import Scan, SemanticClass

VEHICLE, OTHER = SemanticClass.VEHICLE, SemanticClass.OTHER
STEP_DEG, RING_DEG = 0.2, 0.4
ELEVATIONS = np.radians(np.arange(-4.0, 4.01, RING_DEG))
AZIMUTHS = np.radians(np.arange(-20.0, 20.01, STEP_DEG) + 0.03)


def scene(
    plate_m: float | np.ndarray = 10.0,
    wall_m: float | np.ndarray = 20.0,
    half_width_deg: float = 5.0,
    top_deg: float = 1.0,
    offsets: bool = False,
) -> Scan:
    """A plate on the cylinder ``rho = plate_m`` (by azimuth) before a wall; it stands on the lowest ring."""
    azimuth, elevation = (a.ravel() for a in np.meshgrid(AZIMUTHS, ELEVATIONS))
    ring = np.repeat(np.arange(len(ELEVATIONS)), len(AZIMUTHS))
    on_plate = (np.abs(azimuth) < np.radians(half_width_deg)) & (elevation < np.radians(top_deg))
    tiled = (np.tile(np.broadcast_to(r, AZIMUTHS.shape), len(ELEVATIONS)) for r in (plate_m, wall_m))
    rho = np.where(on_plate, *tiled)
    points = np.stack([rho * np.cos(azimuth), rho * np.sin(azimuth), rho * np.tan(elevation)], axis=1)
    return Scan(
        0,
        points.astype(np.float32),
        np.where(on_plate, VEHICLE, OTHER).astype(np.uint8),
        offsets_s=(0.01 * azimuth).astype(np.float32) if offsets else None,
        rings=ring.astype(np.uint16),
    )


def found_in(scan: Scan, max_range_m: float = MAX_RANGE_M, with_lower_edges: bool = True) -> Boundaries:
    return find_boundaries(scan, [VEHICLE], max_range_m, with_lower_edges)[VEHICLE]


def polar_deg(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Azimuth, elevation [deg] and rho [m]."""
    rho = np.hypot(points[:, 0], points[:, 1])
    return np.degrees(np.arctan2(points[:, 1], points[:, 0])), np.degrees(np.arctan2(points[:, 2], rho)), rho


def test_sides_half_a_step_outside_the_last_return() -> None:
    found = found_in(scene())
    sides = found.take(np.flatnonzero(found.edges == Edge.SIDE))
    azimuth, _, rho = polar_deg(sides.lPs)
    on_plate = np.degrees(AZIMUTHS)[np.abs(AZIMUTHS) < np.radians(5.0)]
    rings = np.count_nonzero(np.degrees(ELEVATIONS) < 1.0 - 1e-6)
    expected = [on_plate[0] - 0.5 * STEP_DEG] * rings + [on_plate[-1] + 0.5 * STEP_DEG] * rings
    np.testing.assert_allclose(np.sort(azimuth), expected, atol=1e-4)
    np.testing.assert_allclose(rho, 10.0, atol=1e-4)
    assert np.array_equal(np.unique(sides.rings, return_counts=True)[1], [2] * rings)
    # The point across the edge: farther out on either side, by a step.
    across, _, _ = polar_deg(sides.outward)
    np.testing.assert_allclose(across - azimuth, np.sign(azimuth) * STEP_DEG, atol=1e-4)


def test_top_half_way_to_the_ring_above_at_the_objects_range() -> None:
    found = found_in(scene())
    top = found.take(np.flatnonzero(found.edges == Edge.TOP))
    _, _, rho = polar_deg(top.lPs)
    columns = np.count_nonzero(np.abs(AZIMUTHS) < np.radians(5.0))
    assert len(top) == columns
    last, above = ELEVATIONS[np.radians(1.0) - 1e-9 > ELEVATIONS][-1], np.radians(1.2)
    between = 0.5 * (np.tan(last) + np.tan(above)) * 10.0
    assert np.degrees(last) == pytest.approx(0.8) and len(ELEVATIONS) == 21
    np.testing.assert_allclose(rho, 10.0, atol=1e-4)
    np.testing.assert_allclose(top.lPs[:, 2], between, atol=1e-4)
    np.testing.assert_array_less(top.lPs[:, 2], top.outward[:, 2])


@pytest.mark.parametrize("ground_m", [6.0, 9.5, 14.0])
def test_bottom_half_way_to_the_ring_that_meets_the_ground(ground_m: float) -> None:
    """The plate ends above the ground, which the rings below meet before or behind it."""
    scan, low = scene(), np.radians(-1.0)
    azimuth, elevation, _ = (np.radians(a) for a in polar_deg(scan.points))
    below = (scan.classes == VEHICLE) & (elevation < low)
    rho = np.where(below, ground_m, np.hypot(scan.points[:, 0], scan.points[:, 1]))
    points = np.stack([rho * np.cos(azimuth), rho * np.sin(azimuth), rho * np.tan(elevation)], axis=1)
    classes = np.where(below, OTHER, scan.classes).astype(np.uint8)
    cut = replace(scan, points=points.astype(np.float32), classes=classes)
    found = found_in(cut)
    bottom = found.take(np.flatnonzero(found.edges == Edge.BOTTOM))
    assert len(bottom) == np.count_nonzero(np.abs(AZIMUTHS) < np.radians(5.0))
    last = ELEVATIONS[low - 1e-9 < ELEVATIONS][0]
    between = 0.5 * (np.tan(last) + np.tan(last - np.radians(RING_DEG))) * 10.0
    np.testing.assert_allclose(bottom.lPs[:, 2], between, atol=2e-4)
    np.testing.assert_array_less(bottom.outward[:, 2], bottom.lPs[:, 2])
    assert Edge.BOTTOM not in found_in(cut, with_lower_edges=False).edges


def test_nothing_where_the_neighbour_is_nearer_or_as_far() -> None:
    nearer_on_the_left = np.where(AZIMUTHS > 0.0, 5.0, 20.0)
    azimuth, _, _ = polar_deg(found_in(scene(wall_m=nearer_on_the_left)).lPs)
    found = found_in(scene(wall_m=nearer_on_the_left))
    assert (azimuth[found.edges == Edge.SIDE] < -4.0).all() and (found.edges == Edge.SIDE).any()
    assert (azimuth[found.edges == Edge.TOP] < 0.1).all() and (found.edges == Edge.TOP).any()
    assert not find_boundaries(scene(wall_m=10.4), [VEHICLE])
    assert find_boundaries(scene(wall_m=10.6), [VEHICLE])


def test_the_range_is_carried_on() -> None:
    # A side that recedes by 0.3 m a step towards the left, as a car's flank does.
    recedes = 8.0 + 0.3 * np.arange(len(AZIMUTHS)) * (-np.inf < AZIMUTHS)
    recedes = recedes - recedes[np.argmin(np.abs(AZIMUTHS))] + 12.0
    found = found_in(scene(plate_m=recedes, wall_m=60.0), max_range_m=100.0)
    sides = found.take(np.flatnonzero(found.edges == Edge.SIDE))
    azimuth, _, rho = polar_deg(sides.lPs)
    members = np.flatnonzero(np.abs(AZIMUTHS) < np.radians(5.0))
    np.testing.assert_allclose(rho[azimuth > 0.0], recedes[members[-1]] + 0.15, atol=1e-3)
    np.testing.assert_allclose(rho[azimuth < 0.0], recedes[members[0]] - 0.15, atol=1e-3)


ROOF_RADIUS_M, ROOF_TOP_M, ROOF_AT_M = 3.0, -0.3, 9.0


def roof(phase_deg: float, label: SemanticClass) -> Scan:
    """A cylinder across the view, its highest line 0.3 m below the LiDAR and 9 m away, before a wall."""
    azimuth, elevation = (a.ravel() for a in np.meshgrid(AZIMUTHS, ELEVATIONS + np.radians(phase_deg)))
    ring = np.repeat(np.arange(len(ELEVATIONS)), len(AZIMUTHS))
    height = np.tan(elevation)
    # The nearer intersection of z = height * rho with the circle.
    middle = ROOF_TOP_M - ROOF_RADIUS_M
    a, b = 1.0 + height**2, ROOF_AT_M + height * middle
    root = b**2 - a * (ROOF_AT_M**2 + middle**2 - ROOF_RADIUS_M**2)
    rho = np.where(root >= 0.0, (b - np.sqrt(np.maximum(root, 0.0))) / a, 40.0)
    points = np.stack([rho * np.cos(azimuth), rho * np.sin(azimuth), rho * height], axis=1)
    classes = np.where(rho < 11.0, label, OTHER).astype(np.uint8)
    return Scan(0, points.astype(np.float32), classes, rings=ring.astype(np.uint16))


def tangent_slope(eye_m: float) -> float:
    """Slope of the ray that touches the roof from ``eye_m`` above the LiDAR."""
    down = ROOF_TOP_M - ROOF_RADIUS_M - eye_m
    angle = np.arctan2(down, ROOF_AT_M) + np.arcsin(ROOF_RADIUS_M / np.hypot(ROOF_AT_M, down))
    return float(np.tan(angle))


@pytest.mark.parametrize("lower_m", [0.08, 0.25])
def test_a_roof_seen_from_above_ends_behind_its_last_return(lower_m: float) -> None:
    """In the mean over where the rings fall, a camera below the LiDAR sees the edge where the roof ends."""
    errors = dict[SemanticClass, float]()
    for label in (VEHICLE, SemanticClass.BUILDING):
        slopes = []
        for phase in np.arange(0.01, RING_DEG, 0.02):
            top = find_boundaries(roof(phase, label), [label])[label]
            top = top.take(np.flatnonzero(top.edges == Edge.TOP))
            assert len(top) == len(AZIMUTHS)
            slopes.append(np.mean((top.lPs[:, 2] + lower_m) / np.hypot(top.lPs[:, 0], top.lPs[:, 1])))
        errors[label] = 721.0 * abs(float(np.mean(slopes)) - tangent_slope(-lower_m))
    assert errors[VEHICLE] < 0.1  # px
    assert 4.0 * errors[VEHICLE] < errors[SemanticClass.BUILDING]


def test_rays_leave_the_tip_of_their_ring() -> None:
    """Of lasers that leave the axis 0.15 m above the origin, edges carried on stay on the ring's cone."""
    azimuth, elevation = (a.ravel() for a in np.meshgrid(AZIMUTHS, ELEVATIONS))
    on_plate = (np.abs(azimuth) < np.radians(5.0)) & (elevation < np.radians(1.0))
    step = 0.4
    rho = np.where(on_plate, 10.0 + step / np.radians(STEP_DEG) * (azimuth + np.radians(5.0)), 60.0)
    z = 0.15 + rho * np.tan(elevation)
    points = np.stack([rho * np.cos(azimuth), rho * np.sin(azimuth), z], axis=1)
    classes = np.where(on_plate, VEHICLE, OTHER).astype(np.uint8)
    ring = np.repeat(np.arange(len(ELEVATIONS)), len(AZIMUTHS)).astype(np.uint16)
    found = found_in(Scan(0, points.astype(np.float32), classes, rings=ring))
    sides = found.take(np.flatnonzero((found.edges == Edge.SIDE) & (found.lPs[:, 1] < 0.0)))
    _, _, reached = polar_deg(sides.lPs)
    np.testing.assert_allclose(reached, rho[on_plate].min() - 0.5 * step, atol=1e-3)
    slopes = np.sort((sides.lPs[:, 2] - 0.15) / reached)
    np.testing.assert_allclose(slopes, np.tan(ELEVATIONS[np.radians(1.0) > ELEVATIONS]), atol=1e-4)


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("height_m", [-2.0, 3.0])
def test_points_on_the_axis_of_rotation_are_left_out(height_m: float) -> None:
    scan = scene()
    points, plain = scan.points.copy(), found_in(scan)
    some = np.flatnonzero(scan.classes == VEHICLE)[[3, 40, 41]]
    points[some] = 0.0, 0.0, height_m
    found = found_in(replace(scan, points=points))
    assert 0.8 * len(plain) < len(found) and np.hypot(*found.lPs[:, :2].T).min() > 9.0


def test_no_edge_across_a_gap_in_the_scan() -> None:
    scan = scene()
    azimuth, _, _ = polar_deg(scan.points)
    kept = (azimuth < 5.0) | (azimuth > 5.9)
    holed = Scan(0, scan.points[kept], scan.classes[kept], rings=scan.rings[kept])
    found = found_in(holed)
    sides, _, _ = polar_deg(found.lPs[found.edges == Edge.SIDE])
    assert len(sides) and (sides < 0.0).all()


def test_times_ranges_and_sizes() -> None:
    found = found_in(scene(offsets=True))
    azimuth, _, _ = polar_deg(found.lPs)
    np.testing.assert_allclose(found.offsets_s, 0.01 * np.radians(azimuth), atol=0.011 * np.radians(STEP_DEG))
    assert (found_in(scene()).offsets_s == 0.0).all()
    assert not find_boundaries(scene(), [VEHICLE], max_range_m=9.0)
    assert not find_boundaries(scene(), [SemanticClass.POLE])


def test_an_object_of_few_returns_is_left_out() -> None:
    scan = scene()
    members = np.flatnonzero(scan.classes == VEHICLE)
    for kept, found in ((14, False), (15, True)):
        classes = scan.classes.copy()
        classes[members[kept:]] = SemanticClass.OTHER
        assert (VEHICLE in find_boundaries(replace(scan, classes=classes), [VEHICLE])) == found


def test_objects_by_instance_and_by_place() -> None:
    rng = np.random.default_rng(0)
    centres = np.array([[5.0, 0.0, 0.0], [5.0, 4.0, 0.0], [9.0, 0.0, 0.0]])
    points = np.repeat(centres, [60, 60, 8], axis=0) + rng.uniform(-0.4, 0.4, (128, 3))
    mask = np.ones(128, dtype=bool)
    by_place = split_objects(points, mask, None, 15)
    # Two objects 4 m apart, and one of too few points.
    assert len(set(by_place[:60])) == 1 and len(set(by_place[60:120])) == 1
    assert by_place[0] != by_place[60] and by_place[0] >= 0 and (by_place[120:] == -1).all()
    names = np.repeat([7, 7, 9], [60, 60, 8]).astype(np.uint16)
    assert split_objects(points, mask, names, 15).tolist() == [7] * 120 + [-1] * 8
    names[3] = 0
    np.testing.assert_array_equal(split_objects(points, mask, names, 15), by_place)
    mask[:60] = False
    assert (split_objects(points, mask, None, 15)[:60] == -1).all()

"""Which way is up, for a LiDAR that is mounted level, aslant or upside down."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sst_graph.features.compact_objects import find_compact_objects
from sst_graph.features.lidar_edges import Edge, find_boundaries
from sst_graph.features.up import LEVEL, levelled, up_direction
from sst_graph.types import Scan, SemanticClass

HEIGHT_M = 1.7
MOUNTS = [(0, 0, 0), (15, 0, 0), (0, -25, 40), (30, 10, 0), (180, 0, 0), (195, 8, 70)]
"""Roll, pitch and yaw [deg]."""


def rotation(mount: tuple[float, float, float]) -> np.ndarray:
    """(3, 3) from level axes to the LiDAR's."""
    return np.asarray(Rotation.from_euler("xyz", mount, degrees=True).inv().as_matrix())


def street(mount: tuple[float, float, float], slope: float = 0.0) -> np.ndarray:
    """Points (n, 3) of a road between two facades with boxes and bushes on it, from a LiDAR above it."""
    rng = np.random.default_rng(3)
    x, y = rng.uniform(-30.0, 30.0, (2, 6000))
    road = np.stack([x, 0.25 * y, np.full_like(x, -HEIGHT_M)], axis=1)
    walls = np.stack([x[:3000], 8.0 * np.sign(y[:3000]), rng.uniform(-HEIGHT_M, 6.0, 3000)], axis=1)
    boxes = np.array([[9.0, 3.0], [-12.0, -4.0], [18.0, -3.0]]) + rng.uniform(-1.0, 1.0, (300, 3, 2))
    boxes = np.concatenate([boxes, rng.uniform(-HEIGHT_M, -0.2, (300, 3, 1))], axis=2).reshape(-1, 3)
    points = np.concatenate([road, walls, boxes]) + rng.normal(0.0, 0.02, (9900, 3))
    points[:, 2] += slope * points[:, 0]
    return points @ rotation(mount).T


@pytest.mark.parametrize("mount", MOUNTS)
def test_the_ground_is_found_under_any_mount(mount: tuple[float, float, float]) -> None:
    up = up_direction(street(mount))
    assert np.degrees(np.arccos(np.clip(up @ rotation(mount)[:, 2], -1.0, 1.0))) < 1.0
    assert (up is LEVEL) == (mount == (0, 0, 0))


def test_a_slope_is_level_enough() -> None:
    assert up_direction(street((0, 0, 0), slope=0.1)) is LEVEL


def test_a_ceiling_is_no_ground() -> None:
    """A garage, the sensor nearer to its ceiling, of which it sees more."""
    points = street((0, 0, 0))
    ceiling = points[np.abs(points[:, 2] + HEIGHT_M) < 0.1] * [1.2, 1.2, 0.0] + [0.0, 0.0, 0.6]
    floor = points[points[:, 2] < 0.4]
    assert up_direction(np.concatenate([floor, ceiling])) is LEVEL


@pytest.mark.parametrize("points", [np.zeros((0, 3)), np.zeros((50, 3)), np.ones((1, 3))])
def test_without_ground_the_axis_is_up(points: np.ndarray) -> None:
    assert up_direction(points) is LEVEL


@pytest.mark.parametrize("mount", MOUNTS)
def test_levelled_points_have_the_ground_below(mount: tuple[float, float, float]) -> None:
    points = street(mount)
    turned = levelled(points, up_direction(points))
    road = turned[:6000]
    assert np.abs(road[:, 2] + HEIGHT_M).max() < 0.4
    np.testing.assert_allclose(np.linalg.norm(turned, axis=1), np.linalg.norm(points, axis=1))


@pytest.mark.parametrize("mount", MOUNTS)
def test_heights_do_not_depend_on_the_mount(mount: tuple[float, float, float]) -> None:
    expected, found = (find_compact_objects(street(each), None).heights_m for each in ((0, 0, 0), mount))
    assert np.quantile(np.abs(found - expected), 0.99) < 0.25
    assert np.median(np.abs(found - expected)) < 0.05


def vehicle_scan(upside_down: bool) -> Scan:
    """A box on the road, in rings; seen by a LiDAR that stands on its head, if so."""
    azimuth, elevation = np.meshgrid(
        np.radians(np.arange(-60.0, 60.0, 0.4)), np.radians(np.arange(-24.0, 3.0, 0.5))
    )
    rays = np.stack([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)], axis=-1).reshape(-1, 3)
    rings = np.repeat(np.arange(len(elevation)), azimuth.shape[1])
    reach = np.where(rays[:, 2] < 0.0, -HEIGHT_M / np.minimum(rays[:, 2], -1e-9), 40.0)
    on_box = (np.abs(8.0 * rays[:, 1] / rays[:, 0]) < 1.0) & (
        np.abs(8.0 / rays[:, 0] * rays[:, 2] + 1.0) < 0.7
    )
    on_box &= rays[:, 0] > 0.0
    reach = np.minimum(np.where(on_box, 8.0 / np.maximum(rays[:, 0], 1e-9), reach), 40.0)
    classes = np.where(on_box, SemanticClass.VEHICLE, SemanticClass.OTHER).astype(np.uint8)
    points = (rays * reach[:, None]).astype(np.float32)
    scan = Scan(0, points, classes, rings=rings.astype(np.uint16))
    return replace(scan, points=scan.points * np.float32([1, -1, -1])) if upside_down else scan


def test_edges_of_a_lidar_on_its_head_are_the_same_edges() -> None:
    upright, turned = (
        find_boundaries(vehicle_scan(upside_down), [SemanticClass.VEHICLE])[SemanticClass.VEHICLE]
        for upside_down in (False, True)
    )
    assert {Edge.SIDE, Edge.TOP, Edge.BOTTOM} <= set(upright.edges)
    np.testing.assert_array_equal(turned.edges, upright.edges)
    np.testing.assert_allclose(turned.lPs * [1, -1, -1], upright.lPs, atol=1e-6)
    np.testing.assert_allclose(turned.outward * [1, -1, -1], upright.outward, atol=1e-6)

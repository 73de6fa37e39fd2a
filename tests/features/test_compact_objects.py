"""Ground and compact objects of scans without labels."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from streets import standing_street

from sst_graph import open_source
from sst_graph.features.compact_objects import ObjectShape, find_compact_objects
from sst_graph.features.ground import heights_above_ground
from sst_graph.types import SemanticClass

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
HEIGHT_M = 1.7


def ring_scan(slope: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Points and rings of a scanner 1.7 m above sloping ground, with a box 10 m ahead and a pole beside
    it."""
    azimuths = np.radians(np.arange(-40.0, 40.0, 0.2))
    points, rings = [], []
    for ring, elevation in enumerate(np.radians(np.arange(-20.0, 4.0, 0.5))):
        for azimuth in azimuths:
            ray = np.array([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)])
            reaches = []
            if ray[2] - slope * ray[0] < -1e-6:
                reaches.append(-HEIGHT_M / (ray[2] - slope * ray[0]))
            for x, y, half, top in ((10.0, 0.0, 0.9, 1.5), (12.0, 4.0, 0.1, 3.0)):
                reach = x / ray[0]
                floor = -HEIGHT_M + slope * x
                hit = ray * reach
                if abs(hit[1] - y) < half and floor < hit[2] < floor + top:
                    reaches.append(reach)
            if reaches and min(reaches) < 60.0:
                points.append(ray * min(reaches))
                rings.append(ring)
    return np.array(points), np.array(rings, np.uint16)


@pytest.mark.parametrize("slope", [0.0, 0.06])
def test_a_box_and_a_pole_on_sloping_ground(slope: float) -> None:
    points, rings = ring_scan(slope)
    heights = points[:, 2] + HEIGHT_M - slope * points[:, 0]
    np.testing.assert_allclose(heights_above_ground(points), heights, atol=0.06)
    found = find_compact_objects(points, rings)
    box = (np.abs(points[:, 0] - 10.0) < 1e-6) & (heights > 0.3)
    pole = (np.abs(points[:, 0] - 12.0) < 1e-6) & (heights > 0.3)
    assert len(set(found.numbers[box])) == len(set(found.numbers[pole])) == 1
    assert (found.kinds[found.numbers][box] == ObjectShape.VEHICLE_LIKE).all()
    assert (found.kinds[found.numbers][pole] == ObjectShape.POLE_LIKE).all()
    assert (found.kinds[found.numbers][heights < 0.1] == ObjectShape.GROUND).all()


def test_returns_from_below_the_road_do_not_lower_it() -> None:
    """Returns by way of puddles."""
    points, _ = ring_scan()
    mirrored = points[points[:, 0] > 14.0][:40] - [0.0, 0.0, 6.0]
    heights = heights_above_ground(np.concatenate([points, mirrored]))[: len(points)]
    np.testing.assert_allclose(heights, points[:, 2] + HEIGHT_M, atol=0.1)


def test_nothing_in_a_scan_without_points() -> None:
    found = find_compact_objects(np.zeros((0, 3)), None)
    assert len(found.numbers) == 0 and len(found.kinds) == 1


def recall(points: np.ndarray, rings: np.ndarray | None, vehicles: np.ndarray) -> tuple[int, int]:
    """Points of vehicles within 45 m that are of compact objects, and all of them."""
    found = find_compact_objects(points.astype(np.float64), rings)
    kinds = found.kinds[found.numbers]
    near = vehicles & (np.linalg.norm(points, axis=1) < 45.0)
    compact = (kinds == ObjectShape.VEHICLE_LIKE) | (kinds == ObjectShape.POLE_LIKE)
    return int(np.count_nonzero(compact & near)), int(np.count_nonzero(near))


def test_vehicles_of_a_street_are_compact_objects() -> None:
    scan = standing_street(0.0)[0].scan
    assert scan is not None
    found, of = recall(scan.points, scan.rings, scan.classes == SemanticClass.VEHICLE)
    # What is lower than 0.2 m counts as ground: more of a simulated vehicle, whose labels reach down to it.
    assert of > 500 and found > 0.85 * of


@pytest.mark.drives
@pytest.mark.skipif(not DATA.is_dir(), reason="no ../shared")
@pytest.mark.parametrize("name", ["stop", "parked"])
def test_vehicles_of_real_drives_are_compact_objects(name: str) -> None:
    drive = open_source(DATA / f"kitti_2011_09_26_{name}")
    counts = np.zeros(2, int)
    for k in range(0, len(drive), 4):
        scan = drive[k].scan
        assert scan is not None
        counts += recall(scan.points, scan.rings, scan.classes == SemanticClass.VEHICLE)
    assert counts[0] >= 0.95 * counts[1]

"""Hills, trucks and LiDARs that see no ground are not taken for wrong labels or units."""

from __future__ import annotations

import numpy as np
import pytest
from stored import simulated

from sst_graph import CalibrationConfig
from sst_graph.batch.calibrate import prepare_drives
from sst_graph.data.kept_drive import KeptDrive
from sst_graph.diagnosis.labels import ground_points
from sst_graph.diagnosis.units import clouds
from sst_graph.drive.input_statistics import InputStatistics, scan_statistics
from sst_graph.drive.preparation import Drive
from sst_graph.simulator import SimulationConfig
from sst_graph.types import Scan, SemanticClass

FEET = 1.0 / 0.3048
RNG = np.random.default_rng(5)


def ground(slope: float, height_m: float) -> np.ndarray:
    """(n, 3) rings of points on hills that are so steep at most, 100 m from top to top."""
    radius, azimuth = np.meshgrid(np.geomspace(3.0, 45.0, 25), np.linspace(-np.pi, np.pi, 120, False))
    x, y = (radius * np.cos(azimuth)).ravel(), (radius * np.sin(azimuth)).ravel()
    wave = 2.0 * np.pi / 100.0
    z = slope / wave * (1.0 - np.cos(wave * x)) - height_m
    return np.stack([x, y, z + RNG.normal(0.0, 0.02, len(x))], axis=1)


def boxes(height_m: float, lidar_m: float) -> np.ndarray:
    """(n, 3) the sides of eight vehicles of a height on flat ground, 120 points each."""
    z = np.tile(np.linspace(0.1, height_m, 12), 10) - lidar_m
    y = np.repeat(np.linspace(-1.0, 1.0, 10), 12)
    return np.concatenate(
        [np.stack([np.full(120, 8.0 + 4.0 * k), 6.0 * (-1) ** k + y, z], axis=1) for k in range(8)]
    )


def drive(parts: dict[SemanticClass, np.ndarray], scale: float = 1.0) -> Drive:
    """A drive whose scans have these points of each class; the rest of it is a street's."""
    street = SimulationConfig(seed=31, frames=2, width=621, height=188, azimuth_step_deg=0.35)
    (plain,) = prepare_drives([KeptDrive.of(simulated(street))], CalibrationConfig(decide_sweep=False))
    points = scale * np.concatenate([*parts.values()])
    classes = np.concatenate([np.full(len(own), int(c), np.uint8) for c, own in parts.items()])
    scan = Scan(0, points.astype(np.float32), classes)
    made = InputStatistics((scan_statistics(0, scan),), ())
    return Drive(**{**vars(plain), "statistics": made})


def test_hills_are_ground() -> None:
    steep = drive({SemanticClass.GROUND: ground(0.2, 1.7)})
    assert steep.statistics is not None and steep.statistics.scans[0].ground is not None
    assert steep.statistics.scans[0].ground.share < 0.75
    assert ground_points(steep) is None


def test_rocks_beside_a_road_are_terrain() -> None:
    road = ground(0.1, 1.7)
    road = road[np.abs(road[:, 1]) < 5.0]
    rocks = np.concatenate([boxes(3.0, 1.7) + np.array([0.0, 5.0 * k, 0.0]) for k in (1, 2, 3)])
    assert ground_points(drive({SemanticClass.GROUND: road, SemanticClass.TERRAIN: rocks})) is None
    assert ground_points(drive({SemanticClass.TERRAIN: rocks})) is not None


def test_vehicles_are_no_ground() -> None:
    found = ground_points(drive({SemanticClass.GROUND: boxes(1.5, 1.7)}))
    assert found is not None and "class numbers of the points are mixed up" in found.cause


@pytest.mark.parametrize(("height_m", "lidar_m"), [(1.5, 1.7), (3.7, 1.8), (4.1, 3.5), (1.3, 0.4)])
def test_units_are_told_among_cars_and_trucks(height_m: float, lidar_m: float) -> None:
    parts = {
        SemanticClass.GROUND: ground(0.0, lidar_m),
        SemanticClass.VEHICLE: boxes(height_m, lidar_m),
    }
    assert clouds(drive(parts)) is None
    for unit, factor in (("millimetres", 1000.0), ("centimetres", 100.0)):
        found = clouds(drive(parts, factor))
        assert found is not None and unit in found.cause


@pytest.mark.parametrize("lidar_m", [0.6, 1.7])
def test_feet_are_told_by_cars(lidar_m: float) -> None:
    parts = {SemanticClass.GROUND: ground(0.0, lidar_m), SemanticClass.VEHICLE: boxes(1.5, lidar_m)}
    found = clouds(drive(parts, FEET))
    assert found is not None and found.cause == "the clouds are in feet, not metres"


def test_vehicles_seen_in_part_have_their_unit_where_no_ground_is_seen() -> None:
    """A LiDAR that hangs upside down sees the roofs alone."""
    roofs = boxes(1.5, 1.7)
    roofs = roofs[roofs[:, 2] > -0.55]
    assert clouds(drive({SemanticClass.VEHICLE: roofs})) is None

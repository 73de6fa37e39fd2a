"""Clouds without structure: a result that is not ok, no exception, and no line of a library on stderr."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from stored import simulated

from sst_graph import CalibrationConfig, calibrate
from sst_graph.data.kept_drive import KeptDrive
from sst_graph.simulator import SimulationConfig
from sst_graph.types import Scan, SemanticClass

Rng = np.random.Generator


@cache
def _street() -> KeptDrive:
    config = SimulationConfig(seed=3, frames=10, width=160, height=64, azimuth_step_deg=2.0)
    return KeptDrive.of(simulated(config), sweep="auto")


def _vehicles(points: np.ndarray[Any, Any], stamp_ns: int) -> Scan:
    classes = np.full(len(points), SemanticClass.VEHICLE, np.uint8)
    return Scan(stamp_ns, points.astype(np.float32), classes)


def _sphere(scan: Scan, rng: Rng) -> Scan:
    directions = rng.normal(size=(3000, 3))
    return _vehicles(10.0 * directions / np.linalg.norm(directions, axis=1)[:, None], scan.stamp_ns)


def _one_place(scan: Scan, rng: Rng) -> Scan:
    return _vehicles(np.full((3000, 3), 5.0), scan.stamp_ns)


def _first(count: int) -> Callable[[Scan, Rng], Scan]:
    return lambda scan, rng: Scan(scan.stamp_ns, scan.points[:count], scan.classes[:count])


def _one_ring(scan: Scan, rng: Rng) -> Scan:
    return replace(scan, rings=np.zeros(len(scan.points), np.uint16))


@pytest.mark.parametrize(
    "cloud",
    [
        *(_one_place, _first(1), _first(10)),
        *(pytest.param(cloud, marks=pytest.mark.slow) for cloud in (_sphere, _one_ring)),
    ],
)
@pytest.mark.parametrize("method", ["joint", "edges"])
def test_clouds_without_structure(
    cloud: Callable[[Scan, Rng], Scan], method: Any, capfd: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(0)
    drive = _street().with_scans(lambda scan: cloud(scan, rng))
    config = CalibrationConfig(method=method, find_causes=False)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        result = calibrate(drive, drive.nominal, config)
    assert result.status != "ok" and result.reasons
    assert said == [] and capfd.readouterr().err == ""

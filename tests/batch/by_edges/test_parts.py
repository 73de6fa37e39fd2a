"""Drives with some of their boundary points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from streets import standing_street

from sst_graph.batch import CalibrationConfig
from sst_graph.batch.by_edges.parts import thinned_together
from sst_graph.drive.preparation import Drive, prepare_drive
from sst_graph.graph import matching
from sst_graph.graph.drive_motion import motions_of
from sst_graph.graph.matching import edges_of
from sst_graph.types import SemanticClass


@pytest.fixture(scope="module")
def drive() -> Drive:
    config = replace(CalibrationConfig().prepare, use_visual_odometry=False)
    return prepare_drive(standing_street(), (SemanticClass.OBJECT,), config, depth=False)


def points_of(drive: Drive) -> int:
    return sum(len(points) for scan in drive.scans for points in scan.boundaries.values())


def test_drives_with_few_points_stay_as_they_are(drive: Drive) -> None:
    (same,) = thinned_together([drive], points_of(drive))
    assert same is drive


def test_the_points_are_those_that_would_be_matched(drive: Drive, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of several drives with more points than are matched, those that the graph would choose."""
    drives, most = [drive, drive.part([0])], points_of(drive) // 3
    some = thinned_together(drives, most)
    found = edges_of(some, motions_of(some), CalibrationConfig().noise)
    monkeypatch.setattr(matching, "MOST_POINTS", most)
    expected = edges_of(drives, motions_of(drives), CalibrationConfig().noise)
    assert 0.9 * most < sum(map(points_of, some)) <= most
    for one, other in zip(found, expected, strict=True):
        assert one.scans == other.scans
        np.testing.assert_array_equal(one.points.lPs, other.points.lPs)
        np.testing.assert_array_equal(one.points.objects, other.points.objects)
        np.testing.assert_array_equal(one.bounds, other.bounds)

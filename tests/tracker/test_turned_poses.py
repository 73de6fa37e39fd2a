"""A turn of the camera beyond the reach of the kernel, by the costs of new frames at turned poses."""

from __future__ import annotations

from collections.abc import Callable

import gtsam
import numpy as np
import pytest

from sst_graph.tracker.monitor.turned_poses import TurnedPoses, turned
from sst_graph.tracker.window.gaussian import Point

POINT = Point(gtsam.Pose3(gtsam.Rot3.RzRyRx(-1.5, 0.1, -1.6), np.array([0.1, -0.2, 0.3])), 0.05, np.zeros(2))


def cost_around(pose: Point, noise: np.random.Generator) -> Callable[[Point], float]:
    """Of frames whose edges are met within 0.35 degrees of a pose, and by chance elsewhere."""
    chance = 0.02 * noise.standard_normal()

    def cost(point: Point) -> float:
        off = np.degrees(np.linalg.norm(gtsam.Rot3.Logmap(pose.cTl.rotation().between(point.cTl.rotation()))))
        return float(1.0 + chance - 0.4 * np.exp(-((off / 0.35) ** 2)) + 0.01 * noise.standard_normal())

    return cost


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("degrees", [-1.0, 0.5, 0.9])
def test_a_turn_is_found_where_it_leads(axis: int, degrees: float) -> None:
    noise, poses = np.random.default_rng(3), TurnedPoses()
    for _ in range(30):
        poses.add(cost_around(POINT, noise), POINT)
        assert poses.better(POINT) is None and not poses.contradicted
    new = turned(POINT, np.radians(degrees) * np.eye(3)[axis])
    found = []
    for _ in range(8):
        found.append(poses.better(POINT))
        poses.add(cost_around(new, noise), POINT)
    better = poses.better(POINT)
    assert poses.contradicted
    assert found == [None] * 8 and better is not None and better.time_offset_s == POINT.time_offset_s
    left = gtsam.Rot3.Logmap(better.cTl.rotation().between(new.cTl.rotation()))
    assert np.degrees(np.linalg.norm(left)) < 0.3


def test_pictures_that_match_nothing_are_no_turn() -> None:
    """Neither from the start nor after a while: by chance no pose is better for long and by much."""
    noise, poses = np.random.default_rng(4), TurnedPoses()
    nowhere = turned(POINT, np.radians([10.0, 0.0, 0.0]))
    for _ in range(100):
        poses.add(cost_around(nowhere, noise), POINT)
        assert poses.better(POINT) is None
    poses.restart()
    for k in range(100):
        poses.add(cost_around(POINT if k < 20 else nowhere, noise), POINT)
        assert poses.better(POINT) is None


def test_frames_without_anything_in_view_do_not_count() -> None:
    poses = TurnedPoses()
    poses.add(lambda point: None, POINT)
    assert not poses.gains

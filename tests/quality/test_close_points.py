"""Share of close points, and what a perfect calibration would give."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from sst_graph.fit import CLOSE_PX
from sst_graph.quality.close_points import SIDES_OF_STRETCH, attainable_share, close_share

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]


def _labels(frames: int, seed: int) -> tuple[FloatArray, FloatArray, IntArray, IntArray]:
    """Residuals of labels that err by side and by point, derivatives by the rotation, frames, sides.

    30 sides a frame, 20 points a side.
    """
    rng = np.random.default_rng(seed)
    count = 30 * frames
    sides = np.repeat(np.arange(count), 20)
    angles = rng.uniform(0.0, 2.0 * np.pi, count)
    normals = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    uvs = rng.uniform([-600.0, -100.0], [600.0, 100.0], (count, 2))
    # A turn about x moves by f down, about y by f to the side, about z across the radius.
    by_turn = np.stack(
        [normals[:, 1] * 720.0, normals[:, 0] * 720.0, (normals * uvs[:, ::-1] * [-1, 1]).sum(1)], 1
    )
    r = rng.normal(0.0, 0.5, count)[sides] + rng.normal(0.0, 1.2, len(sides))
    return r, by_turn[sides], np.repeat(np.arange(frames), 600), sides


def test_share_counts_what_is_nearer_than_the_limit() -> None:
    assert close_share(np.array([0.0, -0.99 * CLOSE_PX, 1.01 * CLOSE_PX, -9.0])) == 0.5
    assert close_share(np.zeros(0)) == 0.0


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("turn_deg", [(0, 0, 0), (0.3, 0, 0), (0, -0.3, 0), (0, 0, 0.3)])
def test_attainable_share_does_not_depend_on_the_calibration(
    turn_deg: tuple[float, float, float], seed: int
) -> None:
    """What labels allow is found at the truth and 0.3 deg from it, to two percentage points."""
    r, by_turn, frames, sides = _labels(8, seed)
    truth = close_share(r)
    found = attainable_share(r + by_turn @ np.radians(turn_deg), by_turn, frames, sides)
    assert found == pytest.approx(truth, abs=0.02)


def test_a_mount_that_moved_half_way_does_not_lower_what_labels_allow() -> None:
    r, by_turn, frames, sides = _labels(8, 7)
    moved = r + np.where(frames < 4, 0.3, -0.3) * np.radians(1.0) * by_turn[:, 0]
    assert close_share(moved) < 0.8 * close_share(r)
    assert attainable_share(moved, by_turn, frames, sides) == pytest.approx(close_share(r), abs=0.02)


def test_too_few_sides_to_turn_leave_the_residuals_as_they_are() -> None:
    r = np.array([0.1, 2.0, 3.0, -0.2])
    found = attainable_share(r, np.ones((4, 3)), np.zeros(4, np.intp), np.array([0, 0, 1, 2]))
    assert found == close_share(r)


def test_few_sides_are_made_up_for() -> None:
    """A single stretch of few sides: the three angles take scatter away, which is given back."""
    found, truth = [], []
    for seed in range(60):
        r, by_turn, frames, sides = _labels(1, seed)
        few = sides < SIDES_OF_STRETCH
        found.append(attainable_share(r[few], by_turn[few], frames[few], sides[few]))
        truth.append(close_share(r[few]))
    assert np.mean(found) == pytest.approx(np.mean(truth), abs=0.015)


def test_a_single_vehicle_leaves_what_labels_allow_at_what_they_show() -> None:
    """Left, right and lower edge of one vehicle in all frames, each drawn 0.8 px too far out: three angles
    take as many independent residuals as there are."""
    sides = np.tile(np.repeat(np.arange(3), 20), 12)
    normals = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0]])[sides]
    uvs = np.array([[40.0, 0.0], [-40.0, 0.0], [0.0, 20.0]])[sides]
    r = 0.8 + np.random.default_rng(0).normal(0.0, 0.2, len(sides))
    by_turn = np.stack(
        [normals[:, 1] * 720.0, normals[:, 0] * 720.0, (normals * uvs[:, ::-1] * [-1, 1]).sum(1)], 1
    )
    frames = np.repeat(np.arange(12), 60)
    assert close_share(r) > 0.99
    assert attainable_share(r, by_turn, frames, sides) > 0.99
    two = sides < 2
    assert attainable_share(r[two], by_turn[two], frames[two], sides[two]) > 0.99

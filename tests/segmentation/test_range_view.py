"""Range images: where points lie in them, and which labels the points get back."""

from __future__ import annotations

import math

import numpy as np
import pytest
from tiny_networks import scan_of

from sst_graph.segmentation.range_view import Neighbours, RangeImage, RangeView

VIEW = RangeView(32, 8, 10.0, -30.0, (1.0, 2.0, 3.0, 4.0, 0.5), (2.0, 2.0, 2.0, 2.0, 0.25))


def test_a_point_lies_where_the_papers_equation_puts_it() -> None:
    """u = (1 - atan2(y, x) / pi) / 2 W and v = (1 - (asin(z / r) + |fov_down|) / fov) H, worked by hand."""
    ahead_left = np.array([[10.0, 10.0, 0.0]])  # azimuth 45 deg: u = 0.375 * 32 = 12; level: v = 0.25 * 8 = 2
    image = VIEW.project(scan_of(ahead_left, np.array([0.75], np.float32)))
    assert (image.rows[0], image.columns[0]) == (2, 12)
    assert image.point[2, 12] == 0
    r = math.hypot(10.0, 10.0)
    assert image.values[0, :, 2, 12] == pytest.approx([(r - 1) / 2, 4.0, 3.5, -2.0, 1.0], rel=1e-6)
    assert np.count_nonzero(image.values) == 5


def test_the_nearest_of_several_points_has_the_pixel() -> None:
    image = VIEW.project(scan_of(np.array([[20.0, 0, 0], [5.0, 0, 0], [9.0, 0, 0]])))
    assert image.point[image.rows[0], image.columns[0]] == 1
    assert (image.rows == image.rows[0]).all()


def test_what_the_data_lack_is_the_mean() -> None:
    image = VIEW.project(scan_of(np.array([[20.0, 0, 0]])))
    assert image.values[0, 4].max() == image.values[0, 4].min() == 0.0


def test_points_beyond_the_field_of_view_and_at_the_origin_have_a_pixel_of_the_border() -> None:
    image = VIEW.project(scan_of(np.array([[1.0, 0, 9.0], [1.0, 0, -9.0], [0.0, 0, 0], [-5.0, -1e-9, 0]])))
    assert image.rows[:2].tolist() == [0, 7]
    assert image.columns.max() <= 31
    assert np.isfinite(image.values).all()


def by_loops(image: RangeImage, numbers: np.ndarray, by: Neighbours, unlabelled: np.ndarray) -> list[int]:
    """KNN.py of lidar-bonnetal in plain loops, without the two differences that the module names."""
    height, width = numbers.shape
    half, found = by.window // 2, []
    bell = {
        (i, j): math.exp(-(i * i + j * j) / (2 * by.sigma_px**2))
        for i in range(-half, half + 1)
        for j in range(-half, half + 1)
    }
    total = sum(bell.values())
    for k, (row, column) in enumerate(zip(image.rows, image.columns, strict=True)):
        candidates = []
        for (i, j), weight in bell.items():
            r, c = row + i, column + j
            if not (0 <= r < height and 0 <= c < width):
                continue
            if i == 0 and j == 0:
                distance = 0.0
            elif image.point[r, c] >= 0:
                distance = abs(float(image.ranges[image.point[r, c]] - image.ranges[k])) * (
                    1 - weight / total
                )
            else:
                continue
            candidates.append((distance, int(numbers[r, c])))
        votes = [0] * len(unlabelled)
        for distance, number in sorted(candidates)[: by.count]:
            if not unlabelled[number] and (by.cutoff_m == 0 or distance <= by.cutoff_m):
                votes[number] += 1
        found.append(votes.index(max(votes)) if any(votes) else -1)
    return found


@pytest.mark.parametrize(
    "by", [Neighbours(), Neighbours(7, 7, 1.5, 2.0), Neighbours(3, 3, 1.0, 0.0), Neighbours(1, 1, 1.0, 1.0)]
)
def test_labels_of_points_are_those_of_the_published_vote(by: Neighbours) -> None:
    rng = np.random.default_rng(4)
    azimuth, ranges = rng.uniform(-np.pi, np.pi, 400), rng.uniform(3.0, 9.0, 400)
    points = np.column_stack([ranges * np.cos(azimuth), ranges * np.sin(azimuth), rng.uniform(-3, 1, 400)])
    image = VIEW.project(scan_of(points))
    numbers = rng.integers(0, 4, image.point.shape)
    unlabelled = np.array([True, False, False, False])
    found = image.of_points(numbers, by, unlabelled)
    assert found.tolist() == by_loops(image, numbers, by, unlabelled)
    assert len(set(found.tolist())) >= 4 - (by.count > 3)


def test_without_neighbours_a_point_has_the_label_of_its_pixel() -> None:
    image = VIEW.project(scan_of(np.array([[20.0, 0, 0], [5.0, 0, 0]])))
    numbers = np.arange(8 * 32).reshape(8, 32) % 3
    own = numbers[image.rows[0], image.columns[0]]
    assert image.of_points(numbers, None, np.zeros(3, bool)).tolist() == [own, own]


def test_a_far_point_behind_a_near_one_takes_the_label_of_its_own_neighbours() -> None:
    """What range images get wrong at the borders of objects, and what the vote is for."""
    wall = [[20.0, y, 0.0] for y in np.linspace(-12, 12, 13)]
    points = np.array([*wall, [5.0, 0.0, 0.0]])  # the last hides the middle of the wall
    image = VIEW.project(scan_of(points))
    numbers = np.ones((8, 32), np.int64)
    numbers[image.rows[-1], image.columns[-1]] = 2
    found = image.of_points(numbers, Neighbours(), np.zeros(3, bool))
    assert found[-1] == 2
    assert found[6] == 1
    assert image.of_points(numbers, None, np.zeros(3, bool))[6] == 2

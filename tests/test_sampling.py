"""Some of many items, chosen evenly."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from sst_graph.sampling import evenly_spread, spread_places, step_for


@pytest.mark.parametrize(
    ("count", "most", "expected"),
    [(9, 3, [0, 4, 8]), (4, 9, [0, 1, 2, 3]), (7, 1, [0]), (0, 5, []), (5, 0, [])],
)
def test_items_are_evenly_spread(count: int, most: int, expected: list[int]) -> None:
    assert evenly_spread(range(count), most) == expected


@pytest.mark.parametrize("count", [2, 5, 11, 100])
@pytest.mark.parametrize("most", [2, 3, 4, 7, 11])
def test_no_item_comes_twice_and_gaps_differ_by_one_at_most(count: int, most: int) -> None:
    found = evenly_spread(range(count), most)
    gaps = {b - a for a, b in itertools.pairwise(found)}
    assert len(found) == min(count, most) and found[0] == 0 and found[-1] == count - 1
    assert min(gaps) >= 1 and max(gaps) - min(gaps) <= 1


@pytest.mark.parametrize(("count", "kept"), [(0, 0), (1, 1), (4, 4), (5, 3), (8, 4), (9, 3)])
def test_every_kth_item_is_kept_and_at_most_so_many(count: int, kept: int) -> None:
    assert len(range(count)[:: step_for(count, 4)]) == kept


def test_places_are_spread_from_the_first_to_the_last() -> None:
    places = np.array([2, 3, 5, 7, 11, 13, 17])
    np.testing.assert_array_equal(spread_places(places, 3), [2, 7, 17])
    np.testing.assert_array_equal(spread_places(places, 4), [2, 5, 11, 17])
    np.testing.assert_array_equal(spread_places(places, 7), places)
    assert len(spread_places(places[:0], 7)) == 0

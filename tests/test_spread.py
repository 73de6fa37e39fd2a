"""How far values spread, whatever a few of them are."""

from __future__ import annotations

import numpy as np

from sst_graph.spread import robust_spread


def test_the_spread_is_that_of_most_values() -> None:
    values = 7.0 + 0.2 * np.random.default_rng(0).standard_normal(4001)
    assert abs(robust_spread(values) - 0.2) < 0.01
    values[:400] = 1e6
    assert abs(robust_spread(values) - 0.2) < 0.05
    assert robust_spread(np.full(3, 5.0)) == 0.0

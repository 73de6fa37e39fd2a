"""Speed of a frame of the nearest-pixel methods: re-match and linearize 5,000 points and 1,500 pixels.

Run with ``pytest benchmarks --benchmark-enable``; absolute times belong to a machine (the aim: 10 ms on
one core), so what is asserted is the ratio to the same work with one factor per match.
"""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from benchmarks.workloads import C_TWIST, POSE, TIME_OFFSET_S, D, E, best_seconds, class_view
from sst_graph.association.nearest import ClassView, match_nearest
from sst_graph.factors import Alignment, frame_factor

POINTS, PIXELS = 5000, 1500


@pytest.fixture(scope="module")
def view() -> ClassView:
    """Five vehicles in the mask, and points around them."""
    return class_view(POINTS, PIXELS)


@pytest.fixture
def values() -> gtsam.Values:
    result = gtsam.Values()
    result.insert(E, POSE)
    result.insert(D, np.array([TIME_OFFSET_S]))
    return result


def alignments(view: ClassView) -> list[Alignment]:
    found = match_nearest(view, POSE, TIME_OFFSET_S, C_TWIST, 5.0)
    assert found is not None
    return found.alignments


def together(view: ClassView, values: gtsam.Values) -> gtsam.GaussianFactor:
    """Fresh matches in one factor, linearized."""
    return frame_factor(alignments(view), E, D, C_TWIST).linearize(values)


def one_by_one(view: ClassView, values: gtsam.Values) -> gtsam.GaussianFactorGraph:
    """The same with a factor for each match."""
    graph = gtsam.NonlinearFactorGraph()
    for a in alignments(view):
        for i in range(len(a)):
            match = Alignment(
                a.camera,
                a.lPs[i : i + 1],
                a.base_taus_s[i : i + 1],
                a.pixels[i : i + 1],
                a.sigmas_px[i : i + 1],
                motion_model=a.motion_model,
                weights=np.asarray(a.weights)[i : i + 1],
            )
            graph.add(frame_factor([match], E, D, C_TWIST))
    return graph.linearize(values)


def test_rematch(benchmark, view):
    benchmark(alignments, view)


def test_rematch_and_linearize(benchmark, view, values):
    found = benchmark(together, view, values).information()
    hessian, _ = one_by_one(view, values).hessian()
    order = [*range(6, 7), *range(0, 6)]  # a graph sorts its keys: d, e
    np.testing.assert_allclose(found[np.ix_(order, order)], hessian, atol=1e-9 * np.abs(hessian).max())
    slow = best_seconds({"": lambda: one_by_one(view, values)}, 2)[""]
    ratio = slow / best_seconds({"": lambda: together(view, values)}, 9)[""]
    benchmark.extra_info["one_factor_per_match_over_one_factor"] = ratio
    benchmark.extra_info["matches"] = sum(len(a) for a in alignments(view))
    assert ratio > 50.0

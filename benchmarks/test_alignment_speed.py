"""Speed of a frame's alignment factor: 5,000 points and 1,500 pixels, one core.

Run with ``pytest benchmarks --benchmark-enable``; absolute times belong to a machine, so what is
asserted is the ratio to one factor per match.
"""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from benchmarks.workloads import CAMERA, D, E, V, best_seconds, frame_matches, frame_values
from sst_graph.factors import Alignment, custom_factor, frame_factor, stacked
from sst_graph.factors.motion import se3_left_jacobian

POINTS, PIXELS = 5000, 1500


@pytest.fixture
def values() -> gtsam.Values:
    return frame_values()


@pytest.mark.parametrize("per_point", [False, True], ids=["one_time", "time_per_point"])
@pytest.mark.parametrize("condensed", [True, False], ids=["condensed", "stacked"])
def test_linearize_5000_points(benchmark, values, per_point, condensed):
    factor = frame_factor([frame_matches(0, POINTS, per_point)], E, D, V)
    factor = factor if condensed else stacked(factor)
    benchmark(factor.linearize, values)


def test_linearize_a_frame_of_points_and_pixels(benchmark, values):
    factor = frame_factor([frame_matches(0, POINTS), frame_matches(1, PIXELS)], E, D, V)
    benchmark(factor.linearize, values)


def test_cost_of_5000_points(benchmark, values):
    factor = frame_factor([frame_matches(0, POINTS)], E, D, V)
    benchmark(factor.error, values)


def single_match_factor(alignment: Alignment, i: int) -> gtsam.CustomFactor:
    """One match as a lean factor of its own: gtsam's operations, no vectorisation."""
    lP, q = alignment.lPs[i], alignment.pixels[i]
    sigma, kernel_scale = float(alignment.sigmas_px[i]), alignment.kernel.scale
    zero = np.zeros((2, 3))

    def function(cTl, time_offset_s, twist, *, jacobians):
        xi = -time_offset_s[0] * twist
        moved = gtsam.Pose3.Expmap(xi) * cTl
        X, Y, Z = cP = moved.transformFrom(lP)
        r = np.array([CAMERA.fx * X / Z + CAMERA.cx - q[0], CAMERA.fy * Y / Z + CAMERA.cy - q[1]]) / sigma
        root_w = 1.0 / (1.0 + (r @ r) / kernel_scale**2)
        if not jacobians:
            return root_w**0.5 * r, None
        uv_H_cP = np.array([[CAMERA.fx, 0.0, -CAMERA.fx * X / Z], [0.0, CAMERA.fy, -CAMERA.fy * Y / Z]])
        uv_H_cP *= root_w / (Z * sigma)
        by_left = np.hstack([zero, uv_H_cP])
        by_left[:, :3] = np.cross(cP, uv_H_cP)
        by_xi = by_left @ se3_left_jacobian(xi)
        H = [by_left @ moved.AdjointMap(), -(by_xi @ twist)[:, None], -time_offset_s[0] * by_xi]
        return root_w * r, H

    return custom_factor(gtsam.noiseModel.Unit.Create(2), [E, D, V], function, [6, 1, 6], 2)


def test_condensed_against_one_factor_per_match(benchmark, values):
    """The same frame as one condensed factor and as 6,500 factors of one match."""
    frame = [frame_matches(0, POINTS), frame_matches(1, PIXELS)]
    graph = gtsam.NonlinearFactorGraph()
    for alignment in frame:
        for i in range(len(alignment)):
            graph.add(single_match_factor(alignment, i))
    condensed = frame_factor(frame, E, D, V)
    expected, _ = graph.linearize(values).hessian()
    found = condensed.linearize(values).information()
    order = [*range(6, 7), *range(0, 6), *range(7, 13)]  # a graph sorts its keys: d, e, v
    np.testing.assert_allclose(found[np.ix_(order, order)], expected, atol=1e-9 * np.abs(expected).max())
    assert condensed.error(values) == pytest.approx(graph.error(values), rel=1e-9)

    benchmark(condensed.linearize, values)
    slow = best_seconds({"": lambda: graph.linearize(values)}, 2)[""]
    ratio = slow / best_seconds({"": lambda: condensed.linearize(values)}, 7)[""]
    benchmark.extra_info["one_factor_per_match_over_condensed"] = ratio
    assert ratio > 50.0

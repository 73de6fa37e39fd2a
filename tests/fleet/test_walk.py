"""A vehicle's calibration over its drives, against one graph of all of them."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from fleet.vehicle_drives import RIG, SIGMAS, WEEK, vehicle

from sst_graph.errors import ConfigError
from sst_graph.export import EXTRINSIC, TIME_OFFSET, fuse_marginals, marginal_of_graph
from sst_graph.factors import extrinsic_drift, rekeyed, time_offset_drift
from sst_graph.fleet.vehicles.walk import DriveEstimate, Smoothed, WalkConfig, passes, smoothed, walked
from sst_graph.marginal import CalibrationMarginal
from studies.marginal_disagreement import drive

DAY_S = 86400.0


def apart_in_sigmas(
    found: gtsam.Pose3, time_offset_s: float, joint: gtsam.Values, k: int, H: np.ndarray
) -> float:
    d = np.append(
        found.localCoordinates(joint.atPose3(EXTRINSIC + k)),
        joint.atVector(TIME_OFFSET + k)[0] - time_offset_s,
    )
    return float(np.sqrt(d @ H @ d))


def assert_same(one: Smoothed, other: Smoothed, sigmas: float) -> None:
    """Two estimates and their covariances, in sigmas of the second; curvature leaves thousandths of one."""
    d = other.local_coordinates(one)
    assert np.sqrt(d @ np.linalg.solve(other.covariance, d)) < sigmas
    scale = 1.0 / np.sqrt(np.diag(other.covariance))
    np.testing.assert_allclose(
        one.covariance * np.outer(scale, scale), other.covariance * np.outer(scale, scale), atol=2.0 * sigmas
    )


def test_the_walk_of_marginals_is_one_graph_of_all_drives() -> None:
    """Marginals at the joint optimum, one linearization for both: the same estimate within 1e-3 sigma."""
    days, config = [0.0, 3.0, 10.0], WalkConfig(rotation_deg=0.02, translation_m=0.001, time_offset_s=1e-3)
    joint, start, graphs = gtsam.NonlinearFactorGraph(), gtsam.Values(), []
    for k, day in enumerate(days):
        graph, values = drive(k + 1, RIG.retract(np.array([0.001, 0.0, -0.001, 0.0, 0.002, 0.0]) * k), 0.1)
        keys = {EXTRINSIC: EXTRINSIC + k, TIME_OFFSET: TIME_OFFSET + k}
        for i in range(graph.size()):
            joint.add(rekeyed(graph.at(i), keys))
        for key in values.keys():  # noqa: SIM118  (gtsam, no dict)
            single = gtsam.Values()
            if key == EXTRINSIC:
                single.insert(keys[key], values.atPose3(key))
            else:
                single.insert(keys.get(key, key), values.atVector(key))
            start.insert(single)
        if k:
            seconds = (day - days[k - 1]) * DAY_S
            rates = np.array([np.radians(0.02), 0.001, 1e-3]) / np.sqrt(DAY_S)
            joint.add(extrinsic_drift(EXTRINSIC + k - 1, EXTRINSIC + k, seconds, rates[0], rates[1]))
            joint.add(time_offset_drift(TIME_OFFSET + k - 1, TIME_OFFSET + k, seconds, rates[2]))
        graphs.append((graph, values))
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(1e-14)
    best = gtsam.LevenbergMarquardtOptimizer(joint, start, params).optimize()
    marginals = gtsam.Marginals(joint, best)

    drives = []
    for k, (graph, values) in enumerate(graphs):
        at = best.atPose3(EXTRINSIC + k), float(best.atVector(TIME_OFFSET + k)[0])
        drives.append(DriveEstimate(str(k), days[k], marginal_of_graph(graph, values, at=at)))
    found = smoothed(drives, (), config)
    for k, one in enumerate(found):
        expected = marginals.jointMarginalCovariance([EXTRINSIC + k, TIME_OFFSET + k]).fullMatrix()
        H = np.linalg.inv(expected)
        assert apart_in_sigmas(one.cTl, one.time_offset_s, best, k, H) < 1e-3
        scale = np.sqrt(np.diag(expected))
        np.testing.assert_allclose(
            one.covariance / np.outer(scale, scale), expected / np.outer(scale, scale), atol=5e-3
        )
    # and the graphs at the other drives' optima do not: the test above is about something
    alone = smoothed([replace(one, day=1e4 * k) for k, one in enumerate(drives)], (), config)
    assert max(apart_in_sigmas(one.cTl, one.time_offset_s, best, k, H) for k, one in enumerate(alone)) > 0.1


def test_without_a_walk_it_is_the_fusion_of_marginals() -> None:
    drives = vehicle(np.random.default_rng(1), {}, count=5)
    still = WalkConfig(rotation_deg=1e-4, translation_m=1e-5, time_offset_s=1e-6)
    fused = fuse_marginals([one.marginal for one in drives], significance=0.0)
    for one in smoothed(drives, (), still):
        d = fused.at.local_coordinates(one)
        assert np.sqrt(d @ fused.information @ d) < 0.02
        np.testing.assert_allclose(np.diag(one.covariance), np.diag(fused.covariance()), rtol=0.02)


def test_a_walk_adds_its_variance() -> None:
    marginal = CalibrationMarginal(RIG, 0.02, np.diag(SIGMAS**-2), np.zeros(7))
    config = WalkConfig(rotation_deg=0.1, translation_m=0.02, time_offset_s=0.003)
    rates = np.array([np.radians(0.1)] * 3 + [0.02] * 3 + [0.003])
    expected = SIGMAS**2 + 9.0 * rates**2
    np.testing.assert_allclose(np.diag(walked(marginal, 9.0, config).covariance()), expected, rtol=1e-6)


def test_a_step_separates_its_sides() -> None:
    drives = vehicle(np.random.default_rng(2), {}, count=6)
    split = smoothed(drives, (4,), WalkConfig())
    first, last = smoothed(drives[:4], (), WalkConfig()), smoothed(drives[4:], (), WalkConfig())
    for one, other in zip(split, [*first, *last], strict=True):
        assert_same(one, other, 1e-3)


def test_elimination_in_turn_is_one_graph() -> None:
    """The oracle: gtsam's own optimizer and marginals on the graph of all drives' factors and ties."""
    drives, config = vehicle(np.random.default_rng(3), {}, count=6), WalkConfig(rotation_deg=0.05)
    steps, seconds = (2,), WEEK * DAY_S
    rates = np.array([np.radians(0.05), 0.0005, 0.0001]) / np.sqrt(DAY_S)
    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k, one in enumerate(drives):
        graph.add(one.marginal.factor(EXTRINSIC + k, TIME_OFFSET + k))
        start.insert(one.marginal.point(EXTRINSIC + k, TIME_OFFSET + k))
        if k and k not in steps:
            graph.add(extrinsic_drift(EXTRINSIC + k - 1, EXTRINSIC + k, seconds, rates[0], rates[1]))
            graph.add(time_offset_drift(TIME_OFFSET + k - 1, TIME_OFFSET + k, seconds, rates[2]))
    best = gtsam.LevenbergMarquardtOptimizer(graph, start).optimize()
    marginals = gtsam.Marginals(graph, best)
    for k, found in enumerate(smoothed(drives, steps, config)):
        covariance = marginals.jointMarginalCovariance([EXTRINSIC + k, TIME_OFFSET + k]).fullMatrix()
        time_offset_s = float(best.atVector(TIME_OFFSET + k)[0])
        assert_same(found, Smoothed(best.atPose3(EXTRINSIC + k), time_offset_s, covariance=covariance), 0.01)


def test_the_ends_of_a_stretch_have_one_side() -> None:
    ways = passes(vehicle(np.random.default_rng(3), {}, count=6), (2,), WalkConfig())
    assert [k for k, before in enumerate(ways.before) if before is None] == [0, 2]
    assert [k for k, after in enumerate(ways.after) if after is None] == [1, 5]


def test_next_to_no_walk_between_drives_that_hardly_know() -> None:
    """An offset that no drive knows, tied by the steadiest walk: large sigmas, not a fault of arithmetic."""
    hardly = np.diag(np.array([1.0] * 3 + [2.0] * 3 + [1.0]) ** -2)
    drives = [
        DriveEstimate(str(k), 0.0, CalibrationMarginal(RIG, 0.0, hardly, np.zeros(7))) for k in range(9)
    ]
    steady = WalkConfig(rotation_deg=1e-4, translation_m=1e-5, time_offset_s=1e-6)
    expected = np.array([1.0] * 3 + [2.0] * 3 + [1.0]) / 3.0
    for one in smoothed(drives, (), steady):
        np.testing.assert_allclose(np.sqrt(np.diag(one.covariance)), expected, rtol=0.01)


@pytest.mark.parametrize(
    "values", [{"rotation_deg": 0.0}, {"false_alarm_rate": 1.0}, {"translation_m": -1.0}]
)
def test_refuses_rates_that_are_none(values: dict[str, float]) -> None:
    with pytest.raises(ConfigError):
        WalkConfig(**values)

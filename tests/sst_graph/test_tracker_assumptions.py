"""What is taken for granted, in the tracker: considered, tested, estimated."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray

from sst_graph import Tracker, TrackerConfig
from sst_graph.assumptions import ASSUMPTIONS
from sst_graph.config import with_overrides
from sst_graph.data.simulator import SimulationConfig, simulate
from sst_graph.problem.graph import joint_graph
from sst_graph.problem.state import State
from sst_graph.uncertainty.assumptions import consider
from sst_graph.uncertainty.covariance import robust_covariance

FloatArray = NDArray[np.float64]

STREET = SimulationConfig(
    seed=5,
    frames=24,
    width=621,
    height=188,
    azimuth_limit_deg=50.0,
    azimuth_step_deg=0.3,
    vehicle_density=0.3,
    time_offset_s=0.04,
    speed_mps=6.0,
)


def _config(*settings: str) -> TrackerConfig:
    """Settings of a tracker that trusts its guess."""
    return with_overrides(TrackerConfig(), ["calibration.start.enabled=false", "start_scans=10", *settings])


@pytest.fixture(scope="module")
def settled() -> Tracker:
    """A street's tracker at its end, with all frames in the window."""
    street = simulate(STREET)
    tracker = Tracker(street.camera, _config(), street.truth.cTl, 0.04)
    for frame in street:
        tracker.add(frame)
    tracker.settle()
    return tracker


def test_what_the_tracker_considers_is_what_the_batch_does(settled: Tracker) -> None:
    """The batch's function on the window's own matches, at the tracker's state."""
    assert settled.smoother is not None
    config = settled.config.calibration
    entries = dict(sorted(settled.smoother.entries.items()))
    assert list(entries) == list(range(len(entries))) and not settled.smoother.sums.recent
    points = [entry.score.belief.point for entry in entries.values()]
    pairs = [entry.pair for entry in entries.values()]
    at = points[0]
    assert all(point.cTl.equals(at.cTl, 0.0) for point in points)  # settling matches all at one point
    seen = [(point.tracks, point.object_biases_px) for point in points]
    biases = {(0, t): float(b) for own in seen for t, b in zip(*own, strict=True)}
    state = at.state(settled.classes)
    state = dataclasses.replace(state, object_biases_px={**state.object_biases_px, **biases})
    guess = State(settled.guess.cTl, (settled.guess.offset_s,))
    graph, values = joint_graph(pairs, state, settled.matcher.graph, guess)
    tracks, _ = settled.window.objects_of(list(entries))
    robust = robust_covariance(graph, values, pairs, state, [tracks])
    expected = consider(robust, pairs, values, state, config.assumptions)
    found = settled.considered()
    assert dict(found.sigmas) == dict(expected.sigmas) and set(found.sigmas) == set(ASSUMPTIONS)
    for name, step in expected.sensitivities.items():
        scale = np.sqrt(np.diag(settled.covariance)[:7])
        size = np.linalg.norm(step / scale)
        np.testing.assert_allclose(found.sensitivities[name] / scale, step / scale, atol=1e-3 * size)
    np.testing.assert_allclose(
        np.sqrt(np.diag(found.covariance(7))), np.sqrt(np.diag(expected.covariance(7))), rtol=1e-3
    )
    total = settled.covariance[:7, :7] + expected.covariance(7)
    np.testing.assert_allclose(np.diag(settled.reported()), np.diag(total), rtol=1e-3)

"""On a calibration that stays, the tracker ends where the batch does."""

from __future__ import annotations

import dataclasses

import gtsam
import numpy as np
import pytest

from sst_graph import Tracker, TrackerConfig
from sst_graph.data.simulator import SimulationConfig, simulate
from sst_graph.estimators.joint import solve_joint
from sst_graph.problem.drive import prepare_drive
from sst_graph.problem.state import State


def test_the_tracker_ends_where_the_batch_does() -> None:
    """With one mask bias a class on both sides: the tracker has no biases of single objects."""
    street = simulate(
        SimulationConfig(
            seed=5,
            frames=30,
            width=621,
            height=188,
            azimuth_limit_deg=50.0,
            azimuth_step_deg=0.3,
            vehicle_density=0.3,
            time_offset_s=0.02,
            speed_mps=6.0,
            moving_fraction=0.0,
        )
    )
    frames = [street[i] for i in range(len(street))]
    default = TrackerConfig(start_scans=10)
    start = dataclasses.replace(default.calibration.start, enabled=False)
    joint = default.calibration.joint
    graph = dataclasses.replace(joint.graph, object_bias_sigma_px=0.0)
    joint = dataclasses.replace(joint, graph=graph)
    calibration = dataclasses.replace(default.calibration, start=start, joint=joint)
    tracker = Tracker(
        street.camera, dataclasses.replace(default, calibration=calibration), street.truth.cTl, 0.02
    )
    for frame in frames:
        tracker.add(frame)
    tracker.settle()
    # The batch from the same start, run until it rests.
    drive = prepare_drive(street, calibration.classes, calibration.prepare)
    joint = dataclasses.replace(calibration.joint, step_sigmas=0.02, max_outer=80)
    state = solve_joint([drive], State(street.truth.cTl, (0.02,)), joint).state
    turn = gtsam.Pose3.Logmap(tracker.point.cTl.between(state.cTl))
    step = np.append(turn, state.offset_s(0) - tracker.point.offset_s)
    sigmas = np.sqrt(np.diag(tracker.covariance)[:7])
    assert np.abs(step / sigmas).max() == pytest.approx(0.0, abs=0.3), np.round(step / sigmas, 2)

"""The tracker's start: none in one basin while another explains the labels better."""

from __future__ import annotations

import dataclasses
from contextlib import nullcontext
from pathlib import Path

import gtsam
import numpy as np
import pytest
from stored import simulated
from streets import TRACKED_STREET

from sst_graph import Tracker
from sst_graph.data import open_source
from sst_graph.errors import EstimationError
from sst_graph.tracker.start import solution
from sst_graph.tracker.window.gaussian import Point

PARKED = Path(__file__).resolve().parents[3] / "shared" / "data" / "kitti_2011_09_26_parked"


def _solved(turn_deg: float, cost: float) -> solution._Solved:
    pose = gtsam.Pose3(gtsam.Rot3.Rz(np.radians(turn_deg)), np.zeros(3))
    return solution._Solved(cost, Point(pose, 0.0, np.zeros(2)))


@pytest.mark.parametrize(
    ("turn_deg", "cost", "refused"), [(8.0, 2.5, True), (8.0, 2.9, False), (0.5, 2.5, False)]
)
def test_a_better_pose_that_has_not_converged_prevents_a_start(
    turn_deg: float, cost: float, refused: bool
) -> None:
    """It must be clearly better, and of another basin: else it is the same solution before convergence."""
    reached = solution._NotConverged("still moved", _solved(turn_deg, cost))
    where = r"cost 2\.500 against 3\.000 a point\), but has not converged"
    with pytest.raises(EstimationError, match=where) if refused else nullcontext():
        solution._check_not_converged(_solved(0.0, 3.0), [EstimationError("no match"), reached])


@pytest.mark.slow
@pytest.mark.skipif(not PARKED.exists(), reason="no real drives here")
def test_a_real_drive_three_images_off_starts_in_the_right_basin() -> None:
    """At 11 m/s, the guessed time offset 310 ms off: from 12 frames alone it would be 6 degrees off."""
    source = open_source(str(PARKED), image_shift=3)
    assert source.truth is not None and source.truth.cTl is not None
    truth = source.truth
    rough = truth.cTl.retract(np.array([0.02, -0.02, 0.02, 0.05, 0.05, -0.05]))
    tracker = Tracker(source.camera, None, rough)
    for frame in source:
        tracker.add(frame)
    assert tracker.estimate.exists

    def turn() -> np.ndarray:
        return np.asarray(gtsam.Rot3.Logmap(tracker.estimate.point.cTl.between(truth.cTl).rotation()))

    late = tracker.estimate.point.time_offset_s - (truth.time_offset_s or 0.0)
    assert abs(late) < 3.0 * np.sqrt(tracker.estimate.covariance[6, 6])
    assert (
        turn() @ np.linalg.solve(tracker.estimate.covariance[:3, :3], turn()) < 16.3
    )  # 99.9 % of chi-squared, 3
    tracker.optimize()
    assert np.degrees(np.linalg.norm(turn())) < 0.15


def test_scans_at_half_the_rate_get_twice_the_work_for_a_start() -> None:
    street = simulated(TRACKED_STREET)
    for period_ns, factor in ((50_000_000, 1), (104_000_000, 1), (200_000_000, 2), (900_000_000, 2)):
        tracker = Tracker(street.camera)
        each = tracker.initializer.work_per_frame
        for k in range(2):
            scan = street[k].scan
            assert scan is not None
            tracker.add_scan(dataclasses.replace(scan, stamp_ns=k * period_ns))
        assert each is not None and tracker.initializer.work_for(tracker.inputs.window) == factor * each

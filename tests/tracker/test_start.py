"""The tracker's start: none in one basin while another explains the labels better."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import gtsam
import numpy as np
import pytest

from sst_graph import Tracker, TrackerConfig
from sst_graph.data import open_source
from sst_graph.drive.preparation import Drive
from sst_graph.errors import EstimationError
from sst_graph.graph.state import State
from sst_graph.stepwise import Stepwise, run_to_end
from sst_graph.tracker.start import solution as tracker_start
from sst_graph.tracker.start.solution import Guess, first_estimate_steps
from sst_graph.tracker.window.gaussian import Point

PARKED = Path(__file__).resolve().parents[3] / "shared" / "data" / "kitti_2011_09_26_parked"


def _solved(turn_deg: float, cost: float) -> tracker_start._Solved:
    pose = gtsam.Pose3(gtsam.Rot3.Rz(np.radians(turn_deg)), np.zeros(3))
    return tracker_start._Solved(cost, Point(pose, 0.0, np.zeros(2)))


@pytest.mark.parametrize(
    ("turn_deg", "cost", "refused"), [(8.0, 2.5, True), (8.0, 2.9, False), (0.5, 2.5, False)]
)
def test_a_better_pose_that_has_not_converged_prevents_a_start(
    monkeypatch: pytest.MonkeyPatch, turn_deg: float, cost: float, refused: bool
) -> None:
    """It must be clearly better, and of another basin: else it is the same solution before convergence."""
    drive = Drive("none", None, (), (), (), ())  # type: ignore[arg-type]

    def starts(drive: Drive, guess: Guess, config: TrackerConfig, reach_s: float) -> Stepwise[list[State]]:
        yield 1
        return [State(gtsam.Pose3(), (reach_s,))]

    def solution(
        drive: Drive, start: State, kernels_px: Sequence[float], config: TrackerConfig
    ) -> Stepwise[tracker_start._Solved]:
        yield 1
        if start.time_offset_s(0) > 0.0:
            raise tracker_start._NotConverged("still moved", _solved(turn_deg, cost))
        return _solved(0.0, 3.0)

    monkeypatch.setattr(tracker_start, "_starts", starts)
    monkeypatch.setattr(tracker_start, "_solution", solution)
    if refused:
        with pytest.raises(
            EstimationError, match=r"cost 2\.500 against 3\.000 a point\), but has not converged"
        ):
            run_to_end(first_estimate_steps(drive, Guess(None, 0.0), TrackerConfig()))
    else:
        assert run_to_end(first_estimate_steps(drive, Guess(None, 0.0), TrackerConfig())).cTl.equals(
            gtsam.Pose3(), 1e-9
        )


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

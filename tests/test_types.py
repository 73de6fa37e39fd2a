"""Types of the whole package: equality by value."""

from __future__ import annotations

import pickle

import gtsam
import numpy as np
import pytest

from sst_graph import Calibration
from sst_graph.factors import FactorError

POSE = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.1, -0.2, 0.3), np.array([1.0, 2.0, 3.0]))


def test_a_calibration_compares_and_hashes_by_value() -> None:
    one, same = Calibration(POSE, 0.05), Calibration(gtsam.Pose3(POSE.matrix()), 0.05)
    assert one == same and hash(one) == hash(same)
    assert one != Calibration(POSE, 0.06) and one != Calibration(POSE.inverse(), 0.05)
    assert pickle.loads(pickle.dumps(one)) == one
    assert Calibration(POSE).time_offset_s == 0.0 and one != 0.05
    cTl, time_offset_s = one
    assert cTl is one.cTl and time_offset_s == 0.05


def test_the_step_between_calibrations_is_the_right_perturbation() -> None:
    step = np.array([0.02, -0.01, 0.03, 0.1, -0.2, 0.3, 0.004])
    other = Calibration(POSE * gtsam.Pose3.Expmap(step[:6]), 0.05 + step[6])
    np.testing.assert_allclose(Calibration(POSE, 0.05).local_coordinates(other), step, atol=1e-12)
    assert Calibration(POSE, 0.05).retract(step) == other


@pytest.mark.parametrize(
    ("values", "named"),
    [
        ((np.eye(4), 0.0), "cTl"),
        ((None, 0.0), "cTl"),
        ((POSE, "soon"), "time_offset_s"),
        ((POSE, np.nan), "nan"),
    ],
)
def test_a_calibration_is_a_pose_and_a_number(values: tuple[object, object], named: str) -> None:
    with pytest.raises(FactorError, match=named):
        Calibration(*values)  # type: ignore[arg-type]

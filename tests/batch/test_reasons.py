"""The order of a result's reasons."""

from __future__ import annotations

import gtsam
import numpy as np
from streets import prepared_street

from sst_graph.batch import CalibrationConfig
from sst_graph.batch.method_estimate import MethodEstimate, result_of
from sst_graph.types import Guess


def test_what_decides_the_status_is_said_before_what_does_not() -> None:
    vague = np.diag([*[1e-8] * 6, 0.1])
    config = CalibrationConfig()
    estimate = MethodEstimate(gtsam.Pose3(), 0.0, vague, (), remarks=("the pictures shift",))
    result = result_of(estimate, [prepared_street()], Guess(None), config)
    assert result.status == "unobservable"
    assert "time offset" in result.reasons[0] and result.reasons[1:] == ("the pictures shift",)
    wrong = MethodEstimate(gtsam.Pose3(), 0.0, vague, (), ("wrong",), ("the pictures shift",))
    assert result_of(wrong, [prepared_street()], Guess(None), config).reasons[::2] == (
        "wrong",
        "the pictures shift",
    )

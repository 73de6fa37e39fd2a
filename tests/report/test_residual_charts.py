"""Charts of the residuals."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from sst_graph.factors.camera import PinholeCamera
from sst_graph.fit import Fit, FitQuality, MatchedFrame, PointResiduals
from sst_graph.report.residual_charts import _azimuths_deg, broad_charts
from sst_graph.result import CalibrationResult
from sst_graph.types import SemanticClass

CAMERA = PinholeCamera(700.0, 700.0, 600.0, 180.0, 1200, 360)
OPTICAL = gtsam.Rot3(np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]))
COUNT = 20


def _fit(lPs: np.ndarray) -> Fit:
    """A vehicle at each of some places (n, 3)."""
    n = COUNT * len(lPs)
    tracks = np.repeat(np.arange(len(lPs)), COUNT)
    points = PointResiduals(
        np.zeros(n, np.intp),
        np.full(n, SemanticClass.VEHICLE, np.uint8),
        tracks,
        np.zeros(n, np.intp),
        lPs[tracks],
        np.zeros(n),
        np.zeros((n, 3)),
        np.full((n, 2), 100.0),
        np.tile([1.0, 0.0], (n, 1)),
        0.1 * tracks,
        np.ones(n),
        np.ones(n),
        np.zeros((n, 7)),
    )
    frame = MatchedFrame("a", 0, 0, 0.0, np.zeros(6), np.zeros(6))
    return Fit((frame,), points, FitQuality(n, 1.0, None, 1.0))


@pytest.mark.parametrize("yaw_deg", [0.0, 90.0, -120.0])
def test_where_an_object_is_does_not_depend_on_how_the_lidar_is_turned(yaw_deg: float) -> None:
    """As a car's driver says it: a LiDAR whose y axis is forward, as nuScenes has it, or that looks back."""
    R = gtsam.Rot3.Rz(np.radians(yaw_deg))
    cTl = gtsam.Pose3(OPTICAL.compose(R), np.zeros(3))
    vTs = np.array([[12.0, 0.0, 0.0], [10.0, 10.0, 0.0], [10.0, -10.0, 0.0]])
    result = CalibrationResult(cTl, 0.0, 1e-6 * np.eye(7), "ok", CAMERA)
    listed, _ = broad_charts(_fit(vTs @ R.matrix()), result)
    places = ("vehicle at 12 m, ahead", "vehicle at 14 m, 45° left", "vehicle at 14 m, 45° right")
    assert all(f"<li>{place}, {COUNT} points in 1 frame" in listed for place in places)


@pytest.mark.parametrize("middle_deg", [0.0, 90.0, 180.0])
def test_azimuths_have_no_step_where_a_camera_looks_back(middle_deg: float) -> None:
    expected = middle_deg + np.linspace(-40.0, 40.0, 9)
    across = np.radians(expected)
    lPs = 15.0 * np.stack([np.cos(across), np.sin(across), np.zeros(9)], axis=1)
    np.testing.assert_allclose(_azimuths_deg(lPs) % 360.0, expected % 360.0, atol=1e-9)
    np.testing.assert_allclose(np.diff(_azimuths_deg(lPs)), 10.0)

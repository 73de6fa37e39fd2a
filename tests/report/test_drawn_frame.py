"""Where points land in the report's pictures."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np

from sst_graph.cameras.estimated_camera import EstimatedCamera
from sst_graph.factors import PinholeCamera
from sst_graph.fit import MatchedFrame
from sst_graph.report.drawn_frame import DrawnFrame
from sst_graph.types import CameraImage, Scan

CAMERA = PinholeCamera(60.0, 60.0, 40.0, 30.0, 80, 60)
LENS = EstimatedCamera(61.0, 61.0, 40.0, 30.0, 80, 60, k1=0.1, estimated=("focal", "k1"))


def test_points_land_where_the_lens_of_the_result_puts_them() -> None:
    points = np.random.default_rng(4).uniform([-0.5, -0.5, 1.0], [0.5, 0.5, 1.2], (20, 3))
    scan = Scan(0, points.astype(np.float32), np.zeros(20, np.uint8))
    image = CameraImage(0, np.zeros((60, 80), np.uint8), np.zeros((60, 80, 3), np.uint8))
    drawn = DrawnFrame(MatchedFrame("d", 0, 0, 0.0, np.zeros(6), np.zeros(6)), scan, image, CAMERA)
    given, _ = drawn.projected(gtsam.Pose3(), 0.0)
    np.testing.assert_allclose(given, CAMERA.project(scan.points.astype(np.float64)), atol=1e-9)
    seen, _ = drawn.through(LENS).projected(gtsam.Pose3(), 0.0)
    np.testing.assert_allclose(seen, LENS.project(scan.points.astype(np.float64)), atol=1e-9)
    assert np.abs(seen - given).max() > 0.5
    # A result of other pictures says nothing of these.
    assert drawn.through(replace(LENS, width=160)) is drawn

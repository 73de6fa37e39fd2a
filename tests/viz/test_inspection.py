"""Plots of an inspection."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from sst_graph.factors.camera import PinholeCamera
from sst_graph.inspect.frame_information import KEY, FrameInformation, to_document
from sst_graph.inspect.inspection import inspect_result
from sst_graph.result import CalibrationResult, DriveOffset, FrameId
from sst_graph.viz.inspection import draw_sigma_over_frames
from sst_graph.viz.matplotlib_figure import figure_class

CTL = gtsam.Pose3(gtsam.Rot3(np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])), np.array([0.0, -0.1, -0.3]))


def _frame(drive: str, number: int, so_far: float) -> FrameInformation:
    ratios = np.full(7, so_far)
    return FrameInformation(
        FrameId(drive, number), 1.0, ratios, ratios, np.eye(6), np.zeros(6), 90, 4, 6.5, 0.4
    )


def test_the_time_offset_of_each_drive_ends_at_its_own_sigma() -> None:
    frames = [_frame("a", 0, 2.0), _frame("a", 1, 1.0), _frame("b", 0, 1.5), _frame("b", 1, 1.0)]
    result = CalibrationResult(
        CTL,
        0.05,
        np.diag([1e-3] * 3 + [0.01] * 3 + [0.001]) ** 2,
        "ok",
        PinholeCamera(700.0, 700.0, 600.0, 180.0, 1200, 360),
        frames_used=tuple(frame.frame for frame in frames),
        diagnostics={KEY: to_document(frames)},
    )

    def drawn_ms(one: CalibrationResult) -> list[float]:
        figure = draw_sigma_over_frames(figure_class()(), inspect_result(one))
        return list(figure.axes[2].lines[0].get_ydata())

    assert drawn_ms(result) == pytest.approx([2.0, 1.0, 1.5, 1.0])
    offsets = (DriveOffset("a", 0.05, 0.001), DriveOffset("b", 0.02, 0.010))
    assert drawn_ms(replace(result, drive_offsets=offsets)) == pytest.approx([2.0, 1.0, 15.0, 10.0])

"""The result in words."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from sst_graph.factors.camera import PinholeCamera
from sst_graph.inspect.report import ReferenceErrors, error_lines, markdown_report, summary
from sst_graph.metrics import FORWARD_R_OPTICAL, calibration_errors, euler_angles_deg
from sst_graph.result import CalibrationResult, DriveOffset, FrameId, WeakDirection
from sst_graph.types import GroundTruth

POSE = gtsam.Pose3(
    FORWARD_R_OPTICAL.inverse().compose(gtsam.Rot3.RzRyRx(*np.radians([2.0, -1.0, 3.0]))), [0.1, -0.2, -0.3]
)
RESULT = CalibrationResult(
    POSE,
    0.1036,
    np.diag([np.radians(0.02), np.radians(0.03), np.radians(0.04), 0.01, 0.02, 0.03, 0.004]) ** 2,
    "unobservable",
    PinholeCamera(700.0, 700.0, 4.0, 3.0, 8, 6),
    "image_2",
    reasons=("Only one speed was seen.",),
    weak_directions=(WeakDirection(np.eye(7)[6], 90.0, "1 m ahead equals 118 ms.", "Record a stop."),),
    frames_used=(FrameId("a/00", 1), FrameId("a/00", 2), FrameId("b/00", 1)),
    initial=POSE * gtsam.Pose3(gtsam.Rot3.Rz(np.radians(5.0)), [0.0, 0.0, 0.0]),
    initial_time_offset_s=0.1,
)


@pytest.mark.parametrize(
    "rpy_deg", [[2.0, -1.0, 3.0], [90.0, 0.0, 0.0], [5.0, 35.0, -60.0], [175.0, 20.0, 90.0]]
)
def test_sigmas_of_roll_pitch_and_yaw_are_those_of_the_angles(rpy_deg: list[float]) -> None:
    """By differences of the angles themselves, of a LiDAR mounted any way."""
    R = FORWARD_R_OPTICAL.inverse().compose(gtsam.Rot3.RzRyRx(*np.radians(rpy_deg)))
    root = (
        np.random.default_rng(0).normal(size=(7, 7))
        * np.array([1e-3, 3e-3, 5e-3, 0.01, 0.01, 0.01, 1e-3])[:, None]
    )
    result = replace(RESULT, T_camera_lidar=gtsam.Pose3(R, POSE.translation()), covariance=root @ root.T)
    steps = 1e-6 * np.eye(3)
    angles_H_turns = [
        (euler_angles_deg(R.retract(step)) - euler_angles_deg(R.retract(-step))) / 2e-6 for step in steps
    ]
    expected = np.sqrt(np.diag(np.transpose(angles_H_turns) @ result.covariance[:3, :3] @ angles_H_turns))
    rows = [line.split(" | ") for line in markdown_report(result, None, []).splitlines()]
    said = {row[0]: row[2] for row in rows if len(row) == 3}
    for name, sigma in zip(("roll", "pitch", "yaw"), expected, strict=True):
        assert float(said[f"| {name}"].split()[0]) == pytest.approx(sigma, rel=0.05)


def test_summary_carries_every_number_with_its_sigma() -> None:
    text = summary(RESULT)
    assert "unobservable" in text and "3 frames of 2 drives (a/00, b/00)" in text
    assert "0.020 0.030 0.040 deg" in text and "1.0 2.0 3.0 cm" in text
    assert "+103.60 ms +- 4.0 ms   (t_lidar = t_camera_stamp + offset)" in text
    assert "by 5.00 deg" in text and "+3.6 ms" in text
    assert "Only one speed was seen" in text
    assert "1 m ahead equals 118 ms." in text and "Record a stop." in text


def test_of_many_reasons_the_summary_has_the_first() -> None:
    reasons = tuple(f"this is wrong {k}" for k in range(8))
    text = summary(replace(RESULT, status="not_converged", reasons=reasons))
    assert all(reason in text for reason in reasons[:5]) and "wrong 5" not in text
    assert "and 3 more: reasons in the result's file" in text
    text = summary(replace(RESULT, status="not_converged", reasons=reasons[:5]))
    assert reasons[4] in text and " more" not in text


def test_summary_names_each_drives_offset() -> None:
    text = summary(replace(RESULT, drive_offsets=(DriveOffset("a/00", -0.05, 0.001),)))
    assert "a/00: -50.00 ms +- 1.0 ms" in text
    offsets = DriveOffset("a/00", -0.05, 0.001), DriveOffset("b/00", 0.02, 0.012)
    text = markdown_report(replace(RESULT, drive_offsets=offsets), None, [])
    assert "| time offset of a/00 | -50.00 ms | 1.0 ms |" in text
    assert "| time offset of b/00 | +20.00 ms | 12 ms |" in text and "| time offset |" not in text


def test_errors_against_the_truth() -> None:
    errors = calibration_errors(POSE, 0.1036, GroundTruth(POSE, 0.1), RESULT.covariance)
    text = summary(RESULT, ReferenceErrors(errors, "the truth"))
    assert "against the truth" in text and "+3.60 ms" in text
    assert "0.8 of 7" in text


def test_errors_without_an_offset_or_a_covariance() -> None:
    lines = error_lines(calibration_errors(POSE, 0.1, GroundTruth(POSE, None)))
    assert not any("ms" in line or "NEES" in line for line in lines)
    six = error_lines(calibration_errors(POSE, 0.1, GroundTruth(POSE, None), RESULT.covariance))
    assert any("of 6" in line for line in six)


def test_report_shows_angles_on_vehicle_axes_and_pictures() -> None:
    text = markdown_report(RESULT, None, ["overlay_1.png"], "Points by depth.")
    assert "Above the start, below the result. Points by depth.\n" in text and "mask" not in text
    for row in (
        "| roll | 2.0000 deg | 0.020 deg |",
        "| pitch | -1.0000 deg | 0.030 deg |",
        "| yaw | 3.0000 deg | 0.040 deg |",
        "| x | 10.00 cm |",
    ):
        assert row in text
    assert "![overlay_1.png](overlay_1.png)" in text


def test_translation_sigmas_are_turned_into_the_cameras_axes() -> None:
    # The LiDAR's x (sigma 1 cm) is the camera's z, its y (2 cm) the camera's -x, its z (3 cm) its -y.
    level = gtsam.Pose3(FORWARD_R_OPTICAL.inverse(), [0.1, -0.2, -0.3])
    text = markdown_report(replace(RESULT, T_camera_lidar=level), None, [])
    assert "| x | 10.00 cm | 2.0 cm |" in text
    assert "| y | -20.00 cm | 3.0 cm |" in text
    assert "| z | -30.00 cm | 1.0 cm |" in text


@pytest.mark.parametrize("sigma_s", [0.0, 1e-9, 12.0, 1e6])
def test_any_sigma_can_be_written(sigma_s: float) -> None:
    covariance = RESULT.covariance.copy()
    covariance[6, 6] = sigma_s**2
    assert "time offset" in summary(replace(RESULT, covariance=covariance))

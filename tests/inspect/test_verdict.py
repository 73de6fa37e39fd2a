"""The verdict, and reasons in one line."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from sst_graph.factors.camera import PinholeCamera
from sst_graph.fit import FitQuality
from sst_graph.inspect.reasons import MOST_LETTERS, as_sentence, capitalized, short_reason, short_reasons
from sst_graph.inspect.report import ReferenceErrors, summary
from sst_graph.inspect.verdict import fit_line, is_start, largest_sigmas, quality_line, verdict
from sst_graph.metrics import CalibrationErrors
from sst_graph.odometry.sweep import REMEDY
from sst_graph.report import ReportInputs, report_html
from sst_graph.result import CalibrationResult, DriveOffset, FrameId, WeakDirection

CAMERA = PinholeCamera(700.0, 700.0, 620.0, 187.0, 1241, 375)
OPTICAL = gtsam.Pose3(gtsam.Rot3(np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])), np.zeros(3))
DEG = np.radians(1.0)


def _result(sigmas: list[float], **values: object) -> CalibrationResult:
    given = {"status": "ok", "camera": CAMERA, **values}
    return CalibrationResult(OPTICAL, 0.1, np.diag(np.square(sigmas)), **given)  # type: ignore[arg-type]


def test_the_worst_of_the_time_offsets_of_several_drives_is_told() -> None:
    offsets = (DriveOffset("a", 0.05, 0.001), DriveOffset("b", 0.02, 0.009))
    result = _result([1e-3] * 3 + [0.01] * 3 + [0.001], drive_offsets=offsets)
    assert largest_sigmas(result)[2] == pytest.approx(9.0)
    assert "The time offsets are known to 9.0 ms or better." in verdict(result)
    assert "The time offset is known to 1.0 ms." in verdict(replace(result, drive_offsets=()))
    # The covariance is that of the first drive: it does not say that nothing is past its limit.
    weak = WeakDirection(
        np.eye(7)[6], 20.0, "drive 'b': the time offset is known to 20.0 ms only", "record a stop"
    )
    past = replace(
        result,
        status="unobservable",
        reasons=(weak.reason,),
        weak_directions=(weak,),
        frames_used=(FrameId("a", 0),),
    )
    nothing = "No direction is past its limit."
    assert nothing in report_html(ReportInputs(result, [])) and nothing not in report_html(
        ReportInputs(past, [])
    )


def test_largest_sigmas_are_those_of_the_worst_direction() -> None:
    degrees, cm, ms = largest_sigmas(_result([0.1 * DEG, 0.2 * DEG, 0.1 * DEG, 0.01, 0.03, 0.02, 0.002]))
    assert (degrees, cm, ms) == pytest.approx((0.2, 3.0, 2.0))


def test_verdicts_of_the_three_statuses() -> None:
    sigmas = [0.05 * DEG] * 3 + [0.004] * 3 + [0.0008]
    # 0.05 deg and 0.4 cm at 30 m of 700 px: 0.62 px; at the border 1 + (620 / 700)^2 times as much, and x y.
    assert verdict(_result(sigmas)) == (
        "Good to 0.050° and 0.40 cm (one sigma): at 30 m the cloud may be 0.62 px off in the middle of the "
        "picture; in the corners, 1.1 px. The time offset is known to 0.80 ms."
    )
    open_ = verdict(
        _result(sigmas, status="unobservable", reasons=("the shift (1 cm) is open: record a stop",))
    )
    assert open_.startswith("Not finished: the shift is open: record a stop. As it is: 0.050°")
    bad = verdict(_result(sigmas, status="not_converged", reasons=("stamps are late: check the clock",)))
    assert bad == "Do not use this calibration: stamps are late: check the clock."


def test_a_start_that_stands_for_an_estimate_is_none() -> None:
    """Its errors against a published calibration, which is the start, would be 0."""
    reasons = ("no frame shows the classes: label some",)
    start = _result([1.0] * 3 + [2.0] * 3 + [1.0], status="unobservable", initial=OPTICAL, reasons=reasons)
    assert is_start(start)
    said = "No estimate: no frame shows the classes: label some. What stands in this result is the start."
    assert verdict(start) == said
    comparison = ReferenceErrors(CalibrationErrors(0.0, 0.0, 0.0, 0.0, None), "the truth")
    lines = summary(start, comparison).splitlines()
    assert "moved           not: no estimate could be made, and this is the start" in lines
    assert "start against the truth" in lines
    page = report_html(ReportInputs(start, [], comparison))
    assert "Errors of the start against the truth:" in page and "driving at" not in page
    moved = replace(start, T_camera_lidar=OPTICAL * gtsam.Pose3(gtsam.Rot3(), np.array([0.1, 0.0, 0.0])))
    assert not is_start(moved) and not is_start(replace(start, frames_used=(FrameId("a", 0),)))
    assert verdict(moved).startswith("Not finished: ")


def test_names_keep_their_letters() -> None:
    assert capitalized("rig2/00: the scans show nothing") == "rig2/00: the scans show nothing"
    assert capitalized("the time offset: x") == "The time offset: x"


@pytest.mark.parametrize(
    ("reason", "short"),
    [
        (
            "the LiDAR shifted forward cannot be distinguished from the image taken later: 1 m equals 91 ms "
            "of time offset (one sigma: 13.9 cm, 12.7 ms): record a stop, a change of speed or a turn",
            "the LiDAR shifted forward cannot be distinguished from the image taken later: 1 m equals 91 ms "
            "of time offset: record a stop, a change of speed or a turn",
        ),
        (
            "the pictures lie beside the principal point cx: cx = 1.74 ± 0.46 px; check that the camera "
            "matrix belongs to this image size and crop",
            "the pictures lie beside the principal point cx: cx = 1.74 ± 0.46 px; check that the camera "
            "matrix belongs to this image size and crop",
        ),
        (
            "a/00: frames 0 to 29 and those from 30 on contradict each other: the later ones differ in "
            "translation by 3.1 cm ± 0.4 cm backward; check whether the mount was moved, and calibrate the "
            "frames before and after apart",
            "a/00: frames 0 to 29 and those from 30 on contradict each other: check whether the mount was "
            "moved, and calibrate the frames before and after apart",
        ),
        (
            "only 15 % of the boundary points in view meet a contour (expected 20 % or more): the pose "
            "may be "
            "wrong altogether",
            "only 15 % of the boundary points in view meet a contour: the pose may be wrong altogether",
        ),
        (
            "a/00: the clock jumps by 0.2 s at frame 12: calibrate the frames before it and those after "
            "it apart",
            "a/00: the clock jumps by 0.2 s at frame 12: calibrate the frames before it and those after "
            "it apart",
        ),
        ("the outer loop still moved after 40 iterations", "the outer loop still moved after 40 iterations"),
        ("Only one speed was seen.", "Only one speed was seen"),
    ],
)
def test_a_reason_is_what_and_remedy(reason: str, short: str) -> None:
    assert short_reason(reason) == short


def test_long_reasons_are_cut_at_a_word() -> None:
    short = short_reason("word " * 100 + ": do this " + "and that " * 50)
    assert len(short) <= MOST_LETTERS and short.endswith("…") and "word…: do this and that" in short


def test_the_remedy_of_an_undecided_sweep_is_whole() -> None:
    found = "the scans do not show whether they are compensated (a, b), and it matters: 1 deg, 2 cm"
    short = short_reason(f"a_drive_with_a_long_name/2011_09_26_0011: {found}; {REMEDY}")
    assert short.endswith(f": {REMEDY}") and len(short) <= MOST_LETTERS
    assert as_sentence(short) == short + "." and as_sentence("cut…") == "cut…"


def test_reasons_that_shorten_alike_are_one() -> None:
    result = _result([1.0] * 7, status="not_converged", reasons=("a (1 cm): b", "a (2 cm): b", "c"))
    assert short_reasons(result) == ("a: b", "c")


def test_quality_in_one_line() -> None:
    assert quality_line(FitQuality(3412, 0.842, 0.03, 0.851)) == (
        "84 % of 3412 boundary points within 1.5 px of the contour (at the start 3 %); labels like "
        "these allow 85 %"
    )
    assert "start" not in quality_line(FitQuality(3412, 0.842, None, 0.851))
    assert quality_line(FitQuality(16582, 0.38, 0.19, 0.38, 0.209)) == (
        "38 % of 16582 boundary points within 1.5 px of the strongest edge nearby (at the start 19 %, at "
        "random rotations 21 %)"
    )


def test_what_labels_allow_is_not_said_of_a_calibration_that_contradicts_them() -> None:
    stored = {"fit_quality": FitQuality(1338, 0.23, None, 0.24).to_dict()}
    assert fit_line(_result([0.01] * 7, diagnostics=stored)).endswith("labels like these allow 24 %")
    wrong = fit_line(_result([0.01] * 7, status="not_converged", diagnostics=stored))
    assert wrong == "23 % of 1338 boundary points within 1.5 px of the contour"


def test_without_labels_the_fit_is_how_far_the_edges_stand_out() -> None:
    contrast = {"score": 120.0, "sigmas": 18.95, "ratio": 7.0, "other": 0.0}
    expected = {"least_sigmas": 6.0, "least_over_other": 1.08}
    alone = _result([0.01] * 7, diagnostics={"contrast": contrast | expected})
    line = "the score of the edges is 19 standard deviations above those of random rotations"
    line += " (6 or more expected)"
    assert fit_line(alone) == line
    other = _result([0.01] * 7, diagnostics={"contrast": contrast | expected | {"other": 100.0}})
    assert fit_line(other) == line + ", 1.20 times that of the best other optimum (1.08 or more expected)"
    quality = FitQuality(900, 0.4, None, 0.41, 0.2)
    both = {"contrast": contrast | expected, "fit_quality": quality.to_dict()}
    assert (
        fit_line(_result([0.01] * 7, diagnostics=both))
        == f"{line}; no measure by itself: {quality_line(quality)}"
    )
    check = fit_line(_result([0.01] * 7, method="motion", diagnostics={"fit_quality": quality.to_dict()}))
    assert check.endswith("at random rotations 20 %): 2.0 times chance, right calibrations have 1.3 to 2")
    for stored in (None, {}, contrast, contrast | expected | {"sigmas": "many"}):
        assert fit_line(_result([0.01] * 7, diagnostics={"contrast": stored})) == ""

"""Sigmas, correlations and sentences of an inspection, worked by hand."""

from __future__ import annotations

import copy
import json
import re
from dataclasses import replace

import gtsam
import numpy as np
import pytest

from sst_graph.covariance.observability import ObservabilityConfig
from sst_graph.factors.camera import PinholeCamera
from sst_graph.inspect.frame_information import KEY, FrameInformation, to_document
from sst_graph.inspect.inspection import (
    camera_sigmas,
    correlation_matrix,
    inspect_result,
    pixel_sigma,
    redundant_frames,
    strong_correlations,
    telling_frames,
    to_dict,
    weakest_direction,
)
from sst_graph.inspect.inspection_text import (
    advice_sentences,
    correlation_sentence,
    frame_list,
    inspection_text,
    short,
)
from sst_graph.result import CalibrationResult, DriveOffset, FrameId

CTL = gtsam.Pose3(gtsam.Rot3(np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])), np.array([0.0, -0.1, -0.3]))
"""The camera looks along the LiDAR's x axis: its x, y, z are the LiDAR's -y, -z, x."""
CAMERA = PinholeCamera(700.0, 700.0, 600.0, 180.0, 1200, 360)
SIGMAS = np.array([*np.radians([0.1, 0.2, 0.3]), 0.01, 0.02, 0.03, 0.001])


def frame(number: int, without: list[float], speed: float = 0.0, drive: str = "a/00") -> FrameInformation:
    view = np.diag(1.0 / (np.array([*np.radians([0.3] * 3), 0.05, 0.05, 0.05]) ** 2))
    twist = np.array([0.0, 0.0, 0.0, speed, 0.0, 0.0])
    ratios = np.array(without)
    return FrameInformation(
        FrameId(drive, number), 0.1 * number, ratios, 2.0 * ratios, view, twist, 90, 4, 6.5, 0.4
    )


def result_of(covariance: np.ndarray, frames: list[FrameInformation] | None = None) -> CalibrationResult:
    return CalibrationResult(
        CTL,
        0.05,
        covariance,
        "ok",
        CAMERA,
        frames_used=tuple(f.frame for f in frames or ()),
        diagnostics={}
        if frames is None
        else {KEY: to_document(frames), "mask_bias_px": {"a/00:vehicle": 0.3}},
    )


FRAMES = [frame(3, [1.2, 1, 1, 1, 1, 1, 1]), frame(4, [1.005] * 7), frame(5, [1, 1, 1, 1.3, 1, 1, 1.1], 6.0)]


def test_camera_axes() -> None:
    sigmas = camera_sigmas(result_of(np.diag(SIGMAS**2)))
    assert sigmas.rotation_deg == pytest.approx((0.2, 0.3, 0.1))
    assert sigmas.translation_cm == pytest.approx((2.0, 3.0, 1.0))
    assert sigmas.time_offset_ms == pytest.approx(1.0)


def test_pixels_by_drawing() -> None:
    rng = np.random.default_rng(0)
    root = rng.normal(size=(7, 7)) * SIGMAS[:, None] * 0.2
    result = result_of(root @ root.T)
    lP = CTL.transformTo(np.array([0.0, 0.0, 20.0]))
    draws = root @ rng.normal(size=(7, 4000))
    uvs = CAMERA.project(np.stack([CTL.retract(d[:6]).transformFrom(lP) for d in draws.T]))
    found = pixel_sigma(result, 20.0)
    assert (found.across_px, found.down_px) == pytest.approx(tuple(uvs.std(axis=0)), rel=0.05)


def test_pixels_by_hand() -> None:
    # 0.1 deg of pitch (camera x, the LiDAR's y) at 700 px: 1.22 px down, at any range but for the lever.
    covariance = np.zeros((7, 7))
    covariance[1, 1] = np.radians(0.1) ** 2
    found = pixel_sigma(result_of(covariance), 1000.0)
    assert found.down_px == pytest.approx(700 * np.radians(0.1), rel=1e-3)
    assert found.across_px == pytest.approx(0.0, abs=1e-9)


def test_correlations() -> None:
    covariance = np.diag(SIGMAS**2)
    covariance[3, 6] = covariance[6, 3] = 0.8 * SIGMAS[3] * SIGMAS[6]
    covariance[2, 4] = covariance[4, 2] = -0.9 * SIGMAS[2] * SIGMAS[4]
    assert correlation_matrix(covariance)[2, 4] == pytest.approx(-0.9)
    first, second = strong_correlations(covariance, 0.6)
    assert (first.first, first.second, second.first, second.second) == (2, 4, 3, 6)
    assert second.slope == pytest.approx(0.08) and second.first_alone == pytest.approx(0.006)
    words = correlation_sentence(second)
    assert words.startswith("x and time offset (+0.800): +1 cm goes with +0.80 ms")
    assert "x would be known to 0.60 cm if time offset were known, time offset to 0.60 ms if x were" in words
    assert "+0.1 deg goes with -0.60 cm" in correlation_sentence(first)
    assert strong_correlations(covariance, 0.95) == ()


def test_an_unknown_without_variance_is_correlated_with_nothing() -> None:
    covariance = np.diag([0.0, *SIGMAS[1:] ** 2])
    np.testing.assert_array_equal(correlation_matrix(covariance), np.eye(7))
    text = inspection_text(inspect_result(result_of(covariance)))
    assert "nan" not in text


def test_the_weakest_direction_within_the_limits_too() -> None:
    weak = weakest_direction(result_of(np.diag(SIGMAS**2)), ObservabilityConfig())
    # Over their limits: 0.3 of 0.5 deg, 3 of 5 cm, 1 of 5 ms, and the rest less.
    assert int(np.abs(weak.vector).argmax()) in (2, 5)
    tight = weakest_direction(result_of(np.diag(SIGMAS**2)), ObservabilityConfig(time_offset_s=1e-4))
    assert tight.vector[6] == pytest.approx(1.0)


def test_frames_that_matter_and_frames_that_do_not() -> None:
    assert telling_frames(FRAMES, 0) == [0, 1] and telling_frames(FRAMES, 3) == [2, 1]
    assert redundant_frames(FRAMES, 0.01) == (1,)
    assert redundant_frames(FRAMES, 0.25) == (0, 1)


def test_inspections_are_compared_by_value() -> None:
    covariance = np.diag(np.arange(1.0, 8.0) ** 2 * 1e-6)
    one = inspect_result(result_of(covariance, FRAMES))
    again = copy.deepcopy(one)
    assert again == one and hash(again) == hash(one)
    assert inspect_result(result_of(2.0 * covariance, FRAMES)) != one


def test_lists_of_frames() -> None:
    one = [frame(k, [1.0] * 7) for k in (2, 3, 4, 9)]
    assert frame_list(one, (0, 1, 2)) == "2-4" and frame_list(one, (3, 0)) == "2, 9"
    assert frame_list(one, ()) == "none"
    two = [*one, frame(0, [1.0] * 7, drive="b/00"), frame(1, [1.0] * 7, drive="b/00")]
    assert frame_list(two, (0, 3, 4, 5)) == "a/00: 2, 9; b/00: 0-1"


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.0, "0"), (0.01234, "0.012"), (1.26, "1.3"), (12.6, "13"), (300.0, "300"), (2e7, "2e+07")],
)
def test_two_digits(value: float, text: str) -> None:
    assert short(value) == text


def test_the_text_of_a_result_with_frames() -> None:
    covariance = np.diag(SIGMAS**2)
    text = inspection_text(inspect_result(result_of(covariance, FRAMES), next_frames=7))
    lines = text.splitlines()
    (lidar,) = [line for line in lines if line.startswith("rotation about the LiDAR")]
    (camera,) = [line for line in lines if line.startswith("rotation about the camera")]
    assert lidar.split()[-4:] == ["deg", "0.10", "0.20", "0.30"]
    assert camera.split()[-4:] == ["deg", "0.20", "0.30", "0.10"]
    assert "- matters most for rotation x (sigma without it): 3 (+20.0 %), 4 (+0.5 %)" in lines
    assert "- matters most for y (sigma without it): 4 (+0.5 %)" in lines
    assert "predicted for 7 more frames" in text and "record 7 frames" in text
    assert "(1 of 3: no sigma grows by more than 1 % without it): 4" in text
    assert "weak directions: none past the limits" in text


def test_changes_that_are_the_same_after_rounding_are_left_out() -> None:
    inspection = inspect_result(result_of(np.diag(SIGMAS**2), FRAMES), next_frames=7)
    plan = inspection.plan
    assert plan is not None
    nearly = replace(plan.best, sigmas=plan.best.sigmas * 1.0001)
    twice = replace(plan.best, sigmas=plan.best.sigmas * 2.0)
    first, *_, last = plan.views
    same = replace(plan, nearer=nearly, views=(first, replace(last, prediction=first.prediction)))
    other = replace(plan, views=(first, replace(last, prediction=twice)))
    every, fewer = (" ".join(advice_sentences(inspection, one)) for one in (other, same))
    assert "half as far: " in every and "what is in view" in every
    assert "half as far" not in fewer and "what is in view" not in fewer and "record 7 frames" in fewer
    for before, after in re.findall(r"([\d.]+) -> ([\d.]+)", every):
        assert before != after


def test_the_text_without_frames_says_so() -> None:
    result = replace(
        result_of(np.diag(SIGMAS**2)),
        status="not_converged",
        reasons=("it moved on",),
        drive_offsets=(DriveOffset("a/00", 0.05, 0.001), DriveOffset("b/00", -0.02, 0.002)),
    )
    text = inspection_text(inspect_result(result))
    assert "what each frame brought is not known" in text
    assert "reason       it moved on" in text and "b/00: -20.00 ms, sigma 2.0 ms" in text


def test_nothing_is_predicted_from_an_estimate_that_is_not_to_be_trusted() -> None:
    trusted = result_of(np.diag(SIGMAS**2), FRAMES)
    inspection = inspect_result(replace(trusted, status="not_converged", reasons=("it moved on",)))
    text = inspection_text(inspection)
    assert inspection.plan is None and to_dict(inspection)["plan"] is None
    assert "what to record next: not predicted" in text and "more frame" not in text
    assert text.count("matters most for") == 7


def test_the_text_of_a_result_that_used_no_frame() -> None:
    """Sigmas of priors alone, no weak direction named: neither within the limits, nor another method's."""
    result = replace(result_of(100.0 * np.diag(SIGMAS**2)), frames_used=(), status="unobservable")
    text = inspection_text(inspect_result(result))
    assert "weak directions: none named by this result, whose sigmas are past the limits" in text
    assert "none past the limits" not in text and "--method joint only" not in text
    assert "method joint: no frame was used" in text


def test_many_frames_are_cut_unless_asked_for() -> None:
    frames = [frame(k, [1.02] * 7, 3.0) for k in range(30)]
    inspection = inspect_result(result_of(np.diag(SIGMAS**2), frames))
    few, all_of_them = inspection_text(inspection), inspection_text(inspection, all_frames=True)
    assert "18 more with --all-frames" in few and "--all-frames" not in all_of_them
    assert len(all_of_them.splitlines()) - len(few.splitlines()) == 18


def test_json() -> None:
    document = json.loads(
        json.dumps(to_dict(inspect_result(result_of(np.diag(SIGMAS**2), FRAMES))), allow_nan=False)
    )
    assert document["sigmas"]["camera_axes"]["rotation_deg"] == pytest.approx([0.2, 0.3, 0.1])
    assert [f["redundant"] for f in document["frames"]] == [False, True, False]
    assert document["frames"][2]["speed_mps"] == pytest.approx(6.0)
    assert document["plan"]["count"] == 10 and len(document["plan"]["motions"]) == 6
    assert to_dict(inspect_result(result_of(np.eye(7))))["plan"] is None

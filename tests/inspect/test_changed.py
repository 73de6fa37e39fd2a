"""A result whose calibration is another than the one that its figures are of."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
import pytest

from sst_graph.factors.camera import PinholeCamera
from sst_graph.fit import FitQuality, MeasuredFit
from sst_graph.inspect.changed import change_of
from sst_graph.inspect.inspection import inspect_result, to_dict
from sst_graph.inspect.inspection_text import inspection_text
from sst_graph.inspect.verdict import fit_line, quality_line, verdict
from sst_graph.result import CalibrationResult

QUALITY = FitQuality(5181, 0.57, 0.33, 0.59)


def _at(pose: gtsam.Pose3, time_offset_s: float) -> dict[str, Any]:
    return {"T_camera_lidar": pose.matrix().tolist(), "time_offset_s": time_offset_s}


def _result(at: object = None) -> CalibrationResult:
    pose = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.3, -0.2, 0.1), np.array([0.1, 0.2, -0.3]))
    place = _at(pose, 0.1) if at is None else at
    return CalibrationResult(
        pose,
        0.1,
        1e-6 * np.eye(7),
        "ok",
        PinholeCamera(700.0, 700.0, 620.0, 187.0, 1241, 375),
        diagnostics={"fit_quality": {**QUALITY.to_dict(), "at": place}},
    )


def _turned() -> CalibrationResult:
    result = _result()
    step = gtsam.Pose3.Expmap(np.radians([0.0, 0.3, 0.0, 0.0, 0.0, 0.0]))
    return replace(result, T_camera_lidar=result.T_camera_lidar.compose(step), time_offset_s=0.095)


def test_an_estimate_is_not_changed_by_rounding() -> None:
    result = CalibrationResult.from_json(_result().to_json())
    assert change_of(result) is None and verdict(result).startswith("Good to")
    for wXi in np.random.default_rng(3).normal(size=(50, 6)):
        cTl = gtsam.Pose3.Expmap(wXi)
        rounded = gtsam.Pose3(np.round(cTl.matrix(), 4))
        edited = replace(_result(_at(cTl, 0.1)), T_camera_lidar=rounded, time_offset_s=0.1 + 4e-5)
        assert change_of(CalibrationResult.from_json(edited.to_json())) is None


def test_a_changed_calibration_is_named() -> None:
    change = change_of(CalibrationResult.from_json(_turned().to_json()))
    assert change is not None
    found = change.rotation_deg, change.translation_cm, change.time_offset_ms
    assert found == pytest.approx((0.3, 0.0, -5.0), abs=1e-6)
    said = "This is not the calibration that was estimated (0.30°, 0.0 cm and -5.0 ms from it)."
    assert verdict(_turned()).startswith(f"{said} The estimate itself: Good to")
    assert fit_line(_turned()) == (
        "of the estimate, not of this calibration (sst-graph inspect RESULT DATA measures it): "
        + quality_line(QUALITY)
    )


@pytest.mark.parametrize(
    "at", [3, {}, {"T_camera_lidar": "x", "time_offset_s": 0.0}, _at(gtsam.Pose3(), np.inf)]
)
def test_a_file_that_does_not_say_where_is_taken_as_it_is(at: object) -> None:
    assert change_of(_result(at)) is None and fit_line(_result(at)) == quality_line(QUALITY)


def test_json_has_the_verdict_and_the_fit() -> None:
    document = to_dict(inspect_result(_result()))
    assert document["verdict"] == verdict(_result())
    assert document["fit"]["labels"]["share"] == 0.57 and document["fit"]["labels"]["attainable"] == 0.59
    assert document["fit"]["edges"] is None and document["fit"]["changed_since"] is None
    assert document["fit"]["sentence"] == fit_line(_result())
    assert to_dict(inspect_result(_turned()))["fit"]["changed_since"]["time_offset_ms"] == pytest.approx(-5.0)
    assert to_dict(inspect_result(replace(_result(), diagnostics={})))["fit"] is None


def test_shares_of_edges_have_their_own_entry() -> None:
    edges = replace(QUALITY, by_chance=0.2).to_dict()
    alone = to_dict(inspect_result(replace(_result(), diagnostics={"fit_quality": edges})))["fit"]
    assert alone["labels"] is None and alone["edges"]["by_chance"] == 0.2
    both = {"fit_quality": QUALITY.to_dict(), "fit_quality_of_edges": edges}
    found = to_dict(inspect_result(replace(_result(), diagnostics=both)))["fit"]
    assert found["labels"]["by_chance"] is None and found["edges"]["by_chance"] == 0.2


def test_the_text_begins_with_the_verdict_and_has_what_was_measured() -> None:
    lines = inspection_text(inspect_result(_result())).splitlines()
    assert lines[0].startswith("verdict      Good to")
    assert not any(line.startswith("fit now") for line in lines)
    low = MeasuredFit("a/00", replace(QUALITY, share=0.38), None)
    lines = inspection_text(inspect_result(_result()), measured=low).splitlines()
    place = lines.index("fit now      measured with this calibration on a/00:")
    assert lines[place + 1].strip() == (
        "labels: 38 % of 5181 boundary points within 1.5 px of the contour (at the start 33 %); labels like "
        "these allow 59 %, 21 points more: wrong by a few tenths of a degree or more, or the mount moved"
    )

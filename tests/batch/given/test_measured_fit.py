"""How a given calibration fits a drive, on a simulated street."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import cv2
import gtsam
import numpy as np
import pytest
from stored import stored
from streets import CROWDED_STREET, crowded_street

from sst_graph import CalibrationConfig, calibrate
from sst_graph.batch.given.measured_fit import measure_fit, settings_of
from sst_graph.config import with_overrides
from sst_graph.data.kept_drive import KeptDrive
from sst_graph.errors import DataError
from sst_graph.fit import FitQuality, MeasuredFit
from sst_graph.inspect.verdict import measured_lines
from sst_graph.result import CalibrationResult
from sst_graph.types import SemanticClass


def _true_result() -> CalibrationResult:
    street = crowded_street()
    truth = street.truth
    assert truth is not None and truth.time_offset_s is not None
    return CalibrationResult(truth.cTl, truth.time_offset_s, 1e-6 * np.eye(7), "ok", street.camera)


@cache
def _measured(turn_deg: float) -> MeasuredFit:
    """At the truth, turned about the LiDAR's z axis."""
    true = _true_result()
    turn = gtsam.Pose3.Expmap(np.radians([0.0, 0.0, turn_deg, 0.0, 0.0, 0.0]))
    turned = replace(true, T_camera_lidar=true.T_camera_lidar.compose(turn))
    return stored((CROWDED_STREET, "measured", turn_deg), lambda: measure_fit(turned, crowded_street()))


@pytest.mark.slow
def test_three_tenths_of_a_degree_show_by_labels_and_by_edges() -> None:
    right, wrong = _measured(0.0), _measured(0.3)
    assert right.drive == crowded_street().name
    assert right.labels is not None and wrong.labels is not None
    assert right.labels.share > right.labels.attainable - 0.03
    assert wrong.labels.share < wrong.labels.attainable - 0.08
    assert right.edges is not None and wrong.edges is not None and right.edges.by_chance is not None
    assert wrong.edges.share < right.edges.share - 0.03 and right.edges.share > 1.3 * right.edges.by_chance
    assert "points more: wrong by a few tenths" in measured_lines(wrong)[0]
    assert "points more" not in measured_lines(right)[0]


@pytest.mark.slow
@pytest.mark.parametrize("method", ["joint", "edges"])
def test_what_a_calibration_stored_is_measured_again(method: str) -> None:
    street = crowded_street()
    settings = with_overrides(CalibrationConfig(method=method), ["search.enabled=false", "use_motion=never"])
    result = calibrate(street, street.nominal, settings)
    kept = FitQuality.from_diagnostics(result.diagnostics)
    measured = measure_fit(result, crowded_street())
    again = measured.labels if method == "joint" else measured.edges
    assert kept is not None and again is not None
    assert again.share == pytest.approx(kept.share, abs=1e-9 if method == "joint" else 0.003)


@pytest.mark.slow
def test_masks_drawn_too_wide_are_not_taken_for_a_wrong_pose() -> None:
    frames = []
    for frame in crowded_street():
        image = frame.image
        assert image is not None
        wide = cv2.dilate((image.mask == SemanticClass.VEHICLE).astype(np.uint8), np.ones((5, 5)))
        mask = np.where(wide > 0, SemanticClass.VEHICLE, image.mask).astype(image.mask.dtype)
        frames.append(replace(frame, image=replace(image, mask=mask)))
    drive = replace(KeptDrive.of(crowded_street()), frames=tuple(frames), name="wide")
    measured = measure_fit(_true_result(), drive)
    assert measured.labels is not None
    assert measured.bias_px["vehicle"] == pytest.approx(_measured(0.0).bias_px["vehicle"] + 2.0, abs=1.0)
    assert measured.labels.share > measured.labels.attainable - 0.04
    (line, *_) = measured_lines(measured)
    assert "outlines of vehicle +" in line and "points more" not in line


@pytest.mark.slow
def test_of_unlabelled_pictures_and_scans_nothing_is_measured() -> None:
    street = crowded_street()[:2]
    blind = []
    for frame in street:
        scan, image = frame.scan, frame.image
        assert scan is not None and image is not None
        unlabelled, unmasked = (np.full_like(a, SemanticClass.IGNORE) for a in (scan.classes, image.mask))
        nothing_seen = replace(image, mask=unmasked, pixels=np.zeros((0, 0, 3), np.uint8))
        scan = replace(scan, classes=unlabelled, instances=None)
        blind.append(replace(frame, scan=scan, image=nothing_seen))

    class Blind:
        camera, nominal, name, truth = street.camera, None, "blind", None

        def __len__(self) -> int:
            return len(blind)

        def __getitem__(self, position: int) -> object:
            return blind[position]

    measured = measure_fit(_true_result(), Blind())  # type: ignore[arg-type]
    assert measured == MeasuredFit("blind", None, None)
    assert measured_lines(measured) == ["no boundary point has a contour or an edge of the picture nearby"]


@pytest.mark.slow
def test_the_settings_are_those_of_the_result(caplog: pytest.LogCaptureFixture) -> None:
    result = _true_result()
    chosen = {"classes": ["pole"], "max_range_m": 30.0}
    for config in (chosen, {"calibration": chosen, "window": 3}):
        settings = settings_of(replace(result, config=config))
        assert settings.classes == (SemanticClass.POLE,) and settings.max_range_m == 30.0
    assert settings_of(replace(result, config={"of_another_version": 1})).classes == (SemanticClass.VEHICLE,)
    assert "default settings" in caplog.text


def test_what_is_no_result_is_refused() -> None:
    with pytest.raises(DataError, match="expected a CalibrationResult"):
        measure_fit("calibration.json", crowded_street())  # type: ignore[arg-type]

"""Close points of one frame, as captions have them."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from streets import crowded_street

from sst_graph.cameras.estimated_camera import EstimatedCamera
from sst_graph.cli.pictures import close_words
from sst_graph.factors.camera import PinholeCamera
from sst_graph.features.mask_contour import ContourMap
from sst_graph.quality.frame_share import ClosePoints, close_points
from sst_graph.types import Calibration, Frame, SemanticClass


def _street() -> tuple[Frame, Calibration]:
    """A frame at a standstill, and the true calibration."""
    street = crowded_street()
    truth = street.truth
    assert truth is not None
    return street[0], Calibration(truth.cTl, truth.time_offset_s or 0.0)


def _turned(at: Calibration, axis: int) -> Calibration:
    step = np.zeros(6)
    step[axis] = np.radians(-0.3)
    return replace(at, cTl=at.cTl.compose(gtsam.Pose3.Expmap(step)))


def _close(
    frame: Frame, camera: PinholeCamera, at: Calibration, c_twist: None, bias_px: float = 0.0
) -> ClosePoints | None:
    contour = None if frame.image is None else ContourMap.in_image(frame.image, SemanticClass.VEHICLE)
    return close_points(frame, contour, camera, at, c_twist, bias_px)


@pytest.mark.parametrize("axis", [1, 2])
def test_three_tenths_of_a_degree_show(axis: int) -> None:
    """At half the usual size, where they are 1.9 px."""
    frame, true = _street()
    camera = crowded_street().camera
    right, wrong = (_close(frame, camera, at, None) for at in (true, _turned(true, axis)))
    assert right is not None and wrong is not None and right.points > 50
    assert wrong.close / wrong.points < 0.75 * right.close / right.points


def test_masks_that_are_drawn_too_large_count_with_their_bias() -> None:
    """A bias that is given moves the residuals by as much."""
    frame, true = _street()
    camera = crowded_street().camera
    right, off = (_close(frame, camera, true, None, bias) for bias in (0.0, 4.0))
    assert right is not None and off is not None
    assert off.close / off.points < 0.5 * right.close / right.points


def test_an_estimated_lens_is_that_of_the_picture() -> None:
    frame, true = _street()
    camera = crowded_street().camera
    plain = EstimatedCamera(camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)
    bent = replace(plain, k1=0.1)
    found = [_close(frame, one, true, None) for one in (camera, plain, bent)]
    assert found[0] == found[1] and found[1] is not None and found[2] is not None
    assert found[2].close / found[2].points < 0.9 * found[1].close / found[1].points


def test_without_labels_there_is_no_share() -> None:
    frame, true = _street()
    scan, image = frame.scan, frame.image
    assert scan is not None and image is not None
    camera = crowded_street().camera
    unlabelled = replace(scan, classes=np.full_like(scan.classes, SemanticClass.IGNORE))
    unmasked = replace(image, mask=np.full_like(image.mask, SemanticClass.IGNORE))
    empty = replace(image, mask=np.full_like(image.mask, SemanticClass.GROUND))
    for other in (replace(frame, scan=unlabelled), replace(frame, image=unmasked), replace(frame, scan=None)):
        assert _close(other, camera, true, None) is None
    assert _close(replace(frame, image=empty), camera, true, None) == ClosePoints(0, 0)


def test_words() -> None:
    after, before = ClosePoints(57, 96) + ClosePoints(0, 4), ClosePoints(39, 100)
    assert after.words == "57 % of 100 boundary points of vehicles within 1.5 px of the contour"
    assert ClosePoints(0, 0).words == "no vehicle's boundary near a contour"
    assert close_words(after, before) == f"; {after.words} (before: 39 %)"
    assert close_words(after, None) == close_words(after, ClosePoints(0, 0)) == f"; {after.words}"
    assert close_words(None, None) == ""

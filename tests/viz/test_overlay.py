"""Overlays: what is drawn where."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from sst_graph.errors import DataError
from sst_graph.factors.camera import PinholeCamera
from sst_graph.types import CameraImage, Frame, Scan, SemanticClass
from sst_graph.viz import draw_overlay
from sst_graph.viz.overlay import CONTOUR, IN_MASK, MIN_WIDTH_PX, NOT_MATCHED, OUT_OF_MASK, _strip, legend_of

CAMERA = PinholeCamera(500.0, 500.0, 400.0, 100.0, 800, 200)
WHERE = gtsam.Pose3()
"""The scan is given in the camera's own axes here."""


def _frame(points: list[list[float]], classes: list[int], **scan: object) -> Frame:
    mask = np.zeros((200, 800), np.uint8)
    mask[80:121, 380:421] = SemanticClass.VEHICLE
    mask[:, 700:] = SemanticClass.IGNORE
    picture = np.full((200, 800, 3), 120, np.uint8)
    values = {"stamp_ns": 10**9, **scan}
    return Frame(
        7,
        Scan(points=np.array(points, np.float32), classes=np.array(classes, np.uint8), **values),  # type: ignore[arg-type]
        CameraImage(10**9, mask, picture),
    )


def _pixels_of(picture: np.ndarray, colour: tuple[int, int, int]) -> set[tuple[int, int]]:
    """(u, v) of the pixels of this colour in the image below the strip."""
    image = picture[len(picture) - 200 :]
    return {(int(u), int(v)) for v, u in np.argwhere((image == colour).all(axis=2))}


def test_vehicle_points_are_green_inside_and_red_outside_the_mask() -> None:
    frame = _frame([[0, 0, 10], [2, 0, 10], [0, 1, 10]], [SemanticClass.VEHICLE] * 2 + [SemanticClass.GROUND])
    picture = draw_overlay(frame, CAMERA, WHERE, 0.0)
    assert _pixels_of(picture, IN_MASK) == {(400, 100), (401, 100), (400, 101), (401, 101)}
    assert _pixels_of(picture, OUT_OF_MASK) == {(500, 100), (501, 100), (500, 101), (501, 101)}


def test_points_without_labels_are_drawn_by_depth() -> None:
    """Red near and blue far: at 4 and at 50 m."""
    frame = _frame([[0, 0, 4], [10, 0, 50]], [SemanticClass.IGNORE] * 2)
    image = draw_overlay(frame, CAMERA, WHERE, 0.0)[-200:]
    near, far = image[100, 400].astype(int), image[100, 500].astype(int)
    assert near[2] > near[0] + 100 and far[0] > far[2] + 100  # BGR
    # One point with a label, and the legend is that of the classes again.
    labelled = replace(frame, scan=replace(frame.scan, classes=np.array([SemanticClass.GROUND, 0], np.uint8)))
    assert not np.array_equal(draw_overlay(labelled, CAMERA, WHERE, 0.0)[-200:][100, 400], image[100, 400])


def test_the_legend_names_what_is_drawn() -> None:
    labelled = _frame([[0, 0, 10]], [SemanticClass.VEHICLE])
    masked = _frame([[0, 0, 10]], [SemanticClass.IGNORE])
    assert masked.image is not None
    nothing = replace(masked.image, mask=np.full((200, 800), SemanticClass.IGNORE, np.uint8))
    plain = replace(masked, image=nothing)
    assert legend_of([plain]) == "Points by depth, red near, blue far."
    assert legend_of([masked]) == f"{legend_of([plain])} The contour is that of the vehicle mask."
    assert "green inside" in legend_of([labelled]) and "depth" not in legend_of([labelled])
    assert "by their class. Scans without labels: points by depth" in legend_of([labelled, plain])


def test_the_contour_follows_the_picture_and_is_dark_where_it_shows_nothing() -> None:
    """The object is drawn two pixels inside its mask's left side, and has no lower side to be seen."""
    frame = _frame([[0, 0, 10]], [SemanticClass.VEHICLE])
    assert frame.image is not None
    pixels = frame.image.pixels.copy()
    pixels[80:, 382:421] = 220
    picture = draw_overlay(replace(frame, image=replace(frame.image, pixels=pixels)), CAMERA, WHERE, 0.0)
    found, dark = _pixels_of(picture, CONTOUR), _pixels_of(picture, NOT_MATCHED)
    assert {u for u, v in found if v == 100} == {382, 420}
    assert {u for u, v in dark if v == 120} >= set(range(390, 410)) and not any(v < 110 for _, v in dark)


def test_points_behind_or_beside_the_image_are_left_out() -> None:
    frame = _frame([[0, 0, -10], [20, 0, 10], [np.float32(6.4), 0, 10]], [SemanticClass.VEHICLE] * 3)
    picture = draw_overlay(frame, CAMERA, WHERE, 0.0)
    assert _pixels_of(picture, IN_MASK) == set()
    # The third falls where the mask says nothing: neither right nor wrong.
    assert _pixels_of(picture, OUT_OF_MASK) == set()


def test_a_camera_driving_forward_sees_points_nearer() -> None:
    # tau = offset = 0.2 s at 10 m/s: the point at 10 m is seen at 8 m, u = 400 + 500 * 0.16 / 8 = 410.
    frame = _frame([[0.16, 0, 10]], [SemanticClass.VEHICLE])
    c_twist = np.array([0, 0, 0, 0, 0, 10.0])
    assert (410, 100) in _pixels_of(draw_overlay(frame, CAMERA, WHERE, 0.2, c_twist), IN_MASK)
    assert (408, 100) in _pixels_of(draw_overlay(frame, CAMERA, WHERE, 0.2), IN_MASK)


def test_points_are_moved_from_their_own_times() -> None:
    # Offsets of -0.1 and +0.1 s within the sweep: tau = 0.2 and 0 s.
    frame = _frame(
        [[0.16, 0, 10], [-0.16, 0, 10]],
        [SemanticClass.VEHICLE] * 2,
        offsets_s=np.array([-0.1, 0.1], np.float32),
    )
    c_twist = np.array([0, 0, 0, 0, 0, 10.0])
    drawn = _pixels_of(draw_overlay(frame, CAMERA, WHERE, 0.1, c_twist), IN_MASK)
    assert {(410, 100), (392, 100)} <= drawn and (390, 100) not in drawn


def test_the_image_stamp_counts() -> None:
    frame = _frame([[0.16, 0, 10]], [SemanticClass.VEHICLE])
    assert frame.image is not None
    later = replace(frame, image=replace(frame.image, stamp_ns=10**9 + 2 * 10**8))
    picture = draw_overlay(later, CAMERA, WHERE, 0.0, np.array([0, 0, 0, 0, 0, 10.0]))
    assert (410, 100) in _pixels_of(picture, IN_MASK)


def test_small_pictures_are_enlarged() -> None:
    camera = PinholeCamera(7.0, 7.0, 4.0, 3.0, 8, 6)
    image = CameraImage(0, np.zeros((6, 8), np.uint8), np.zeros((6, 8, 3), np.uint8))
    frame = Frame(0, Scan(0, np.zeros((0, 3), np.float32), np.zeros(0, np.uint8)), image)
    assert draw_overlay(frame, camera, WHERE, 0.0).shape[1] >= MIN_WIDTH_PX


@pytest.mark.parametrize("missing", ["scan", "image"])
def test_half_a_frame_cannot_be_drawn(missing: str) -> None:
    frame = replace(_frame([[0, 0, 10]], [SemanticClass.VEHICLE]), **{missing: None})
    with pytest.raises(DataError, match=f"frame 7: found no {missing}"):
        draw_overlay(frame, CAMERA, WHERE, 0.0)


def test_an_image_of_another_size_is_refused() -> None:
    frame = _frame([[0, 0, 10]], [SemanticClass.VEHICLE])
    with pytest.raises(DataError, match="found an image of 800x200, expected 640x200"):
        draw_overlay(frame, replace(CAMERA, width=640), WHERE, 0.0)


@pytest.mark.parametrize("width", [720, 1000, 1242])
@pytest.mark.parametrize("count", [1, 4, 12, 30])
def test_words_over_the_picture_fit(width: int, count: int) -> None:
    """The last word ends inside of the strip, however many there are."""
    legend = [(f"vehicle points {k}", (255, 255, 255)) for k in range(count - 1)] + [("end", IN_MASK)]
    strip = _strip(width, legend)
    _, columns = np.nonzero(strip[..., 1].astype(int) - strip[..., 2] > 40)
    assert strip.shape[1] == width and columns.size and columns.max() < width - 4

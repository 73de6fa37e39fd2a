"""Information of a frame: the offset from the view and the twist, and the columns in the file."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
import pytest

from sst_graph.errors import DataError
from sst_graph.factors.camera import PinholeCamera
from sst_graph.inspect.frame_information import (
    KEY,
    FrameInformation,
    frames_of,
    from_document,
    positive_part,
    to_document,
    with_offset,
)
from sst_graph.result import CalibrationResult, FrameId


def some_frames(count: int = 4, seed: int = 0) -> tuple[FrameInformation, ...]:
    """Frames with random views of the usual size, each faster than the one before."""
    rng = np.random.default_rng(seed)
    found = []
    for k in range(count):
        root = rng.normal(size=(9, 6)) / np.array([0.005] * 3 + [0.05] * 3)
        found.append(
            FrameInformation(
                FrameId("street/00", 10 + k),
                float(rng.uniform(0.0, 0.5)),
                1.0 + rng.uniform(0.0, 0.1, 7),
                np.geomspace(5.0, 1.0, count)[k] * np.ones(7),
                root.T @ root,
                np.array([0.0, 0.0, 0.01, 2.0 * k, 0.0, 0.0]),
                100 + k,
                3,
                7.5,
                0.25,
            )
        )
    return tuple(found)


def result_with(diagnostics: dict[str, Any]) -> CalibrationResult:
    camera = PinholeCamera(700.0, 700.0, 600.0, 180.0, 1200, 360)
    return CalibrationResult(gtsam.Pose3(), 0.0, np.eye(7), "ok", camera, diagnostics=diagnostics)


def test_the_offset_of_a_point_by_hand() -> None:
    # One equation on x alone; at 3 m/s forward a second later is 3 m less.
    view = np.zeros((6, 6))
    view[3, 3] = 4.0
    L = with_offset(view, np.array([0.0, 0.0, 0.0, 3.0, 0.0, 0.0]))
    assert (L[3, 3], L[3, 6], L[6, 6]) == (4.0, -12.0, 36.0)
    # Sliding 1 m forward equals 1/3 s: nothing is known along that line.
    assert np.array([0, 0, 0, 1.0, 0, 0, 1 / 3]) @ L @ np.array([0, 0, 0, 1.0, 0, 0, 1 / 3]) == pytest.approx(
        0
    )


def test_at_rest_a_view_says_nothing_of_the_offset() -> None:
    view = some_frames(1)[0].view
    L = with_offset(view, np.zeros(6))
    np.testing.assert_array_equal(L[:6, :6], view)
    assert not L[6].any()


def test_the_file_gives_back_what_was_written() -> None:
    frames = some_frames()
    text = json.dumps(to_document(frames), allow_nan=False)
    back = frames_of(result_with({KEY: json.loads(text)}))
    assert len(back) == len(frames)
    for a, b in zip(frames, back, strict=True):
        assert (a.frame, a.matches, a.objects) == (b.frame, b.matches, b.objects)
        for name in ("bits", "without", "so_far", "l_twist", "nearest_m", "left"):
            np.testing.assert_allclose(getattr(b, name), getattr(a, name), rtol=6e-4)
        scale = np.sqrt(np.outer(np.diag(a.view), np.diag(a.view)))
        np.testing.assert_allclose(b.view / scale, a.view / scale, atol=6e-4)
        assert (
            np.linalg.eigvalsh(b.information / np.outer(*[np.sqrt(np.diag(b.information) + 1)] * 2))[0]
            > -1e-9
        )
    assert len(text) / len(frames) < 600


def test_a_result_without_it() -> None:
    assert frames_of(result_with({})) == ()


@pytest.mark.parametrize(
    ("change", "place"),
    [
        (lambda d: d.pop("view"), "view"),
        (lambda d: d.update(bits=[1.0]), "bits"),
        (lambda d: d.update(without=[[1.0] * 6] * 4), "without"),
        (lambda d: d.update(l_twist=[["x"] * 6] * 4), "l_twist"),
        (lambda d: d.update(so_far=[[None] * 7] * 4), "so_far"),
        (lambda d: d.update(drive=["a"]), "'drive' and 'frame'"),
        (lambda d: d.update(frame=3), "'drive' and 'frame'"),
    ],
)
def test_malformed_columns_are_refused(change: Any, place: str) -> None:
    document = to_document(some_frames())
    change(document)
    with pytest.raises(DataError, match=place):
        from_document(document)


def test_columns_must_be_an_object() -> None:
    with pytest.raises(DataError, match="an object of columns"):
        from_document([1, 2])


def first_view_is(*upper: float) -> Any:
    """A change of the document: the first entries of the first view's upper triangle, zeros after them."""
    return lambda document: document["view"].__setitem__(0, [*upper, *[0.0] * (21 - len(upper))])


@pytest.mark.parametrize(
    "change",
    [
        first_view_is(0.0, 1.0),  # nothing on the diagonal, and something beside it
        first_view_is(0.0, 1e18),
        first_view_is(4.0, 1e3),
        first_view_is(-1.0),
        # three unknowns that are each the opposite of both others
        first_view_is(1.0, -0.9, -0.9, 0.0, 0.0, 0.0, 1.0, -0.9, 0.0, 0.0, 0.0, 1.0),
    ],
)
def test_a_view_that_is_no_information_is_refused(change: Any) -> None:
    document = to_document(some_frames())
    change(document)
    with pytest.raises(DataError, match=r"frame_information\.view.*semi-definite"):
        from_document(document)


def test_rounding_of_views_that_tell_little_is_read() -> None:
    # One equation on six unknowns, rounded: the five eigenvalues of zero are off to both sides.
    rng = np.random.default_rng(3)
    for frame in some_frames(200):
        row = rng.normal(size=6) * 10.0 ** rng.uniform(-6.0, 6.0, 6) * (rng.random(6) < 0.7)
        (back,) = from_document(to_document([replace(frame, view=np.outer(row, row))]))
        scale = np.where(row == 0.0, 1.0, np.abs(row))
        np.testing.assert_allclose(
            back.view / np.outer(scale, scale), np.outer(row, row) / np.outer(scale, scale), atol=6e-3
        )


def test_positive_part() -> None:
    A = np.array([[4.0, 2.0], [2.0, 3.0]])
    np.testing.assert_allclose(positive_part(A), A)
    # A correlation is at most 1 ...
    np.testing.assert_allclose(positive_part(np.array([[4.0, 2.4], [2.4, 1.0]])), [[4.0, 2.0], [2.0, 1.0]])
    # ... three of -0.9 are cut down to -0.5 of their diagonal, ...
    cut = positive_part(1.9 * np.eye(3) - 0.9)
    np.testing.assert_allclose(cut / cut[0, 0], 1.5 * np.eye(3) - 0.5, atol=1e-12)
    # ... and beside nothing, or less than nothing by rounding, stands nothing.
    for nothing in (0.0, -1e-17, 5e-324):
        part = positive_part(np.array([[nothing, 1e-12], [1e-12, 3.0]]))
        np.testing.assert_allclose(part, np.diag([0.0, 3.0]), atol=1e-150)

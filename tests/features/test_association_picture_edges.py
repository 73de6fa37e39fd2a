"""Contours that follow the picture: drawn objects whose edges are known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from sst_graph.features.image_edges import PictureEdges
from sst_graph.features.mask_contour import ContourMap
from sst_graph.types import SemanticClass

VEHICLE = SemanticClass.VEHICLE
HEIGHT, WIDTH = 160, 240
LEFT, RIGHT, TOP, BOTTOM = 60, 180, 40, 120
"""Columns and rows of the object in the picture, the last ones not included."""
SIDES = {
    "left": ([LEFT - 0.5, 80.0], [-1.0, 0.0]),
    "right": ([RIGHT - 0.5, 80.0], [1.0, 0.0]),
    "top": ([120.0, TOP - 0.5], [0.0, -1.0]),
    "bottom": ([120.0, BOTTOM - 0.5], [0.0, 1.0]),
}


def picture(bright: int = 160, dark: int = 60, noise: float = 4.0, seed: int = 0) -> np.ndarray:
    """A bright object on dark ground, with the camera's noise."""
    grey = np.full((HEIGHT, WIDTH, 3), float(dark))
    grey[TOP:BOTTOM, LEFT:RIGHT] = bright
    grey += np.random.default_rng(seed).normal(0.0, noise, grey.shape)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


def mask(left: float = 0.0, right: float = 0.0, top: float = 0.0, bottom: float = 0.0) -> np.ndarray:
    """The object's mask, each side that much too far outside [px]."""
    found = np.zeros((HEIGHT, WIDTH), np.uint8)
    found[round(TOP - top) : round(BOTTOM + bottom), round(LEFT - left) : round(RIGHT + right)] = VEHICLE
    return found


def field(labels: np.ndarray, pixels: np.ndarray | None = None) -> ContourMap:
    found = ContourMap.of(labels, VEHICLE, pixels)
    assert found is not None
    return found


def distance_at_the_edge(found: ContourMap, side: str) -> float:
    """Signed distance that the field has where the object ends [px]."""
    return float(found.look_up(np.array([SIDES[side][0]])).distances[0])


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("off", [-2, -1, 0, 1, 2])
def test_a_side_drawn_beside_the_edge(side: str, off: int) -> None:
    labels = mask(**{side: off})
    assert distance_at_the_edge(field(labels), side) == pytest.approx(-off, abs=0.05)
    followed = field(labels, picture())
    for name in SIDES:
        assert distance_at_the_edge(followed, name) == pytest.approx(0.0, abs=0.12), name
    uvs = np.array([SIDES[side][0]]) + np.outer(np.arange(-6.0, 7.0), SIDES[side][1])
    feet = followed.look_up(uvs)
    assert feet.valid.all() and (feet.normals @ SIDES[side][1]).min() > 0.99
    np.testing.assert_allclose(
        feet.feet @ np.abs(SIDES[side][1]), SIDES[side][0] @ np.abs(SIDES[side][1]), atol=0.2
    )


@pytest.mark.parametrize("part", [0.2, 0.5, 0.8])
def test_an_edge_within_a_pixel(part: float) -> None:
    """A column of mixed colour: the edge lies ``part`` of a pixel farther out."""
    pixels = picture(noise=0.0)
    pixels[TOP:BOTTOM, LEFT - 1] = round(60 + part * 100)
    for grown in (0, 1):
        found = distance_at_the_edge(field(mask(left=grown), pixels), "left")
        assert found == pytest.approx(-part, abs=0.12)


def test_a_mirrored_picture_is_followed_alike() -> None:
    """Neither direction is preferred, and it does not matter where a contour begins."""
    pixels, labels = picture(noise=12.0), mask(left=2, top=-1, right=1)
    plain = field(labels, pixels)
    for axis in (0, 1):
        mirrored = field(np.flip(labels, axis), np.flip(pixels, axis))
        difference = np.flip(mirrored.distance, axis) - plain.distance
        near = np.abs(plain.distance) < 6.0
        # Every second pixel is evaluated, not the same ones.
        assert np.abs(difference[near]).mean() < 0.05 and abs(difference[near].mean()) < 0.01


def test_what_is_not_seen_is_not_matched() -> None:
    """The lower half of the object is as dark as the ground beside it."""
    pixels = picture()
    pixels[90:BOTTOM, LEFT:RIGHT] = picture(60, 60, seed=1)[90:BOTTOM, LEFT:RIGHT]
    followed = field(mask(left=2), pixels)
    rows = np.arange(TOP + 8.0, BOTTOM - 8.0)
    for column in (LEFT - 4.0, LEFT + 4.0):
        feet = followed.look_up(np.stack([np.full(len(rows), column), rows], axis=1))
        assert feet.valid[rows < 80].all() and not feet.valid[rows > 100].any()
    assert not followed.look_up(np.array([SIDES["bottom"][0]])).valid[0]
    assert field(mask(left=2)).look_up(np.array([[LEFT - 4.0, 105.0]])).valid[0]


@pytest.mark.parametrize("noise", [0.0, 25.0])
def test_a_picture_that_shows_nothing_changes_nothing_much(noise: float) -> None:
    """A blank one is no reason to leave everything out; noise moves no side."""
    labels = mask(left=1)
    followed, plain = field(labels, picture(90, 90, noise)), field(labels)
    seen = [followed.look_up(np.array([place])).valid[0] for place, _ in SIDES.values()]
    moved = [distance_at_the_edge(followed, side) - distance_at_the_edge(plain, side) for side in SIDES]
    assert all(seen) and np.abs(moved).max() < (0.01 if noise == 0.0 else 0.5)


def test_two_edges_within_reach_leave_the_contour_where_it_is() -> None:
    """A stripe as broad as the mask's error: which of its edges is the object's?"""
    pixels = picture(160, 60, 2.0)
    pixels[TOP:BOTTOM, LEFT - 2 : LEFT + 2] = 110
    assert distance_at_the_edge(field(mask(), pixels), "left") == pytest.approx(0.0, abs=0.1)
    # Of the two the closer one, where the other is all but out of reach.
    assert distance_at_the_edge(field(mask(left=2), pixels), "left") == pytest.approx(-2.0, abs=0.15)


def test_sides_of_something_thin_are_not_mixed_up() -> None:
    """A pole of four pixels: each side follows its own edge."""
    pixels = np.full((HEIGHT, WIDTH, 3), 60, np.uint8)
    pixels[20:140, 100:104] = 160
    labels = np.zeros((HEIGHT, WIDTH), np.uint8)
    labels[20:140, 99:104] = VEHICLE
    feet = field(labels, pixels).look_up(np.array([[97.0, 80.0], [106.0, 80.0]]))
    np.testing.assert_allclose(feet.feet[:, 0], [99.5, 103.5], atol=0.25)


def test_where_the_picture_is_not_asked() -> None:
    labels = mask(left=2)
    plain = field(labels)
    for found in (
        field(labels, np.zeros((0, 0, 3), np.uint8)),
        field(labels, picture()[:-1]),
    ):
        assert found.edges is None and np.array_equal(found.distance, plain.distance)


def test_what_was_found_makes_the_same_field_again() -> None:
    labels = mask(left=2, bottom=1)
    labels[70:90, 150:170] = SemanticClass.OTHER
    first = field(labels, picture(seed=3))
    assert isinstance(first.edges, PictureEdges)
    again = ContourMap.of(labels, VEHICLE, edges=first.edges)
    assert again is not None
    assert np.array_equal(again.distance, first.distance) and np.array_equal(again.unknown, first.unknown)


def test_an_object_that_the_border_cuts() -> None:
    """It fills most of the border, which has no edge of its own; its free side is followed all the same."""
    pixels = picture()
    pixels[:, :LEFT] = pixels[TOP:BOTTOM, LEFT:RIGHT].mean(axis=(0, 1)).astype(np.uint8)
    pixels[:, LEFT:] = picture(60, 60)[:, LEFT:]
    labels = np.where(np.arange(WIDTH) < LEFT - 2, VEHICLE, 0).astype(np.uint8) * np.ones(
        (HEIGHT, 1), np.uint8
    )
    feet = field(labels, pixels).look_up(np.array([[LEFT + 3.0, 80.0]]))
    assert feet.valid[0] and feet.feet[0, 0] == pytest.approx(LEFT - 0.5, abs=0.15)


def test_a_very_long_contour() -> None:
    """Longer than what one call of OpenCV takes."""
    stripes = np.zeros((500, 2000), np.uint8)
    stripes[10:-10, np.arange(2000) % 12 < 5] = VEHICLE
    stripes[:, [0, -1]] = 0
    pixels = cv2.cvtColor(np.where(stripes > 0, 200, 30).astype(np.uint8), cv2.COLOR_GRAY2BGR)
    found = field(stripes, pixels)
    assert found.edges is not None and len(found.edges.shifts) > 70_000
    assert np.median(np.abs(found.edges.shifts)) < 0.1 and found.edges.seen.all()


@pytest.mark.parametrize("kind", ["board", "noise"])
def test_a_mask_of_noise_does_not_follow_the_picture(kind: str) -> None:
    """Every pixel lies on a contour: evaluated all along, a picture of 1242x375 px would take gigabytes."""
    rng = np.random.default_rng(0)
    board = np.indices((HEIGHT, WIDTH)).sum(axis=0) % 2
    labels = {"board": board, "noise": rng.integers(0, 2, (HEIGHT, WIDTH))}[kind].astype(np.uint8)
    found = field(labels, picture())
    assert found.edges is None
    np.testing.assert_array_equal(found.distance, field(labels).distance)


def test_a_few_wrong_pixels_are_no_noise() -> None:
    labels = mask()
    labels[np.random.default_rng(0).random(labels.shape) < 0.003] = VEHICLE
    assert field(labels, picture()).edges is not None

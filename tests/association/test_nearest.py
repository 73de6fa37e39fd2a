"""Nearest pixels and points against brute force; signs and weights of the frozen matches by hand."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from sst_graph.association.nearest import (
    ClassView,
    NearestPixels,
    match_nearest,
    nearest_points,
    sample_pixels,
)
from sst_graph.factors import PinholeCamera, frame_factor
from sst_graph.types import SemanticClass

CAMERA = PinholeCamera(60.0, 60.0, 31.5, 23.5, 64, 48)
VEHICLE = SemanticClass.VEHICLE
FORWARD = gtsam.Pose3()
STILL = np.zeros(6)


def blobs(seed: int) -> np.ndarray:
    """A mask with some scattered pixels of vehicles, and of other things."""
    rng = np.random.default_rng(seed)
    mask = rng.choice([0, 2, 255], (48, 64)).astype(np.uint8)
    mask[rng.integers(0, 48, 25), rng.integers(0, 64, 25)] = VEHICLE
    return mask


@pytest.mark.parametrize("seed", range(5))
def test_nearest_pixel_is_exact(seed: int) -> None:
    mask = blobs(seed)
    uvs = np.random.default_rng(seed).uniform([-0.5, -0.5], [63.499, 47.499], (400, 2))
    found = NearestPixels.of(mask == VEHICLE).at(uvs)
    assert (mask[found[:, 1].astype(int), found[:, 0].astype(int)] == VEHICLE).all()
    members = np.argwhere(mask == VEHICLE)[:, ::-1].astype(float)
    cells = np.floor(uvs + 0.5)
    brute = np.linalg.norm(cells[:, None] - members[None], axis=2).min(axis=1)
    np.testing.assert_allclose(np.linalg.norm(cells - found, axis=1), brute, atol=1e-12)


def test_no_pixel_of_a_class_has_no_map() -> None:
    assert NearestPixels.of(np.zeros((4, 5), np.bool_)) is None


def test_nearest_point_is_exact() -> None:
    rng = np.random.default_rng(0)
    uvs, pixels = rng.uniform(0, 64, (300, 2)), rng.uniform(0, 64, (200, 2))
    brute = np.linalg.norm(pixels[:, None] - uvs[None], axis=2).argmin(axis=1)
    np.testing.assert_array_equal(nearest_points(uvs, pixels), brute)


def test_pixels_are_sampled_from_the_class() -> None:
    mask = blobs(1)
    mask[10:30, 10:60] = VEHICLE
    total = int((mask == VEHICLE).sum())
    pixels = sample_pixels(mask == VEHICLE, 0.02, np.random.default_rng(0))
    assert len(pixels) == round(0.02 * total) and len(np.unique(pixels, axis=0)) == len(pixels)
    assert (mask[pixels[:, 1].astype(int), pixels[:, 0].astype(int)] == VEHICLE).all()
    assert len(sample_pixels(blobs(2) == VEHICLE, 1e-6, np.random.default_rng(0))) == 1


def view(mask: np.ndarray, lPs: np.ndarray, base_tau_s: float = 0.0, share: float = 1.0) -> ClassView:
    found = ClassView.of(CAMERA, lPs, base_tau_s, mask == VEHICLE, share, np.random.default_rng(0))
    assert found is not None
    return found


def test_matches_by_hand() -> None:
    """A block of pixels right of two points: both go to its left side, w_l n_p / n_i weighs the pixels."""
    mask = np.zeros((48, 64), np.uint8)
    mask[20:24, 40:43] = VEHICLE
    cPs = np.array([[0.0, 0.0, 10.0], [0.0, 0.25, 10.0], [0.0, 0.0, -5.0], [90.0, 0.0, 10.0]])
    matches = match_nearest(view(mask, cPs), FORWARD, 0.0, STILL, 6.0)
    assert matches is not None and matches.pixel_to_point is not None
    p2i, i2p = matches.point_to_pixel, matches.pixel_to_point
    np.testing.assert_array_equal(p2i.lPs, cPs[:2])
    np.testing.assert_array_equal(p2i.pixels, [[40.0, 23.0], [40.0, 23.0]])
    np.testing.assert_array_equal(p2i.weights, [1.0, 1.0])
    assert len(i2p) == 12
    np.testing.assert_array_equal(i2p.lPs, np.tile(cPs[0], (12, 1)))
    np.testing.assert_allclose(i2p.weights, 6.0 * 2 / 12)


@pytest.mark.parametrize("time_offset_s, base_tau_s", [(0.1, 0.0), (0.0, 0.1), (0.3, -0.2)])
def test_a_camera_that_drives_on_sees_points_come_nearer(time_offset_s: float, base_tau_s: float) -> None:
    """tau = offset + base_tau, and cP = cTl lP - tau v: 10 m become 9 m after 0.1 s at 10 m/s."""
    mask = np.zeros((48, 64), np.uint8)
    mask[:, 38:] = VEHICLE
    cPs = np.array([[0.98, 0.0, 10.0]])
    c_twist = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 10.0])
    still = match_nearest(view(mask, cPs), FORWARD, 0.0, c_twist, 0.0)
    moved = match_nearest(view(mask, cPs, base_tau_s), FORWARD, time_offset_s, c_twist, 0.0)
    assert still is not None and moved is not None and moved.pixel_to_point is None
    np.testing.assert_allclose(still.point_to_pixel.pixels[0], [38.0, 24.0])  # u = 31.5 + 60 * 0.098 = 37.4
    np.testing.assert_allclose(moved.point_to_pixel.pixels[0], [38.0, 24.0])  # u = 31.5 + 60 * 0.98/9 = 38.03
    values = gtsam.Values()
    values.insert(0, FORWARD)
    cost = frame_factor([moved.point_to_pixel], 0, time_offset_s, c_twist).error(values)
    r = np.array([31.5 + 60.0 * 0.98 / 9.0 - 38.0, 23.5 - 24.0])
    assert cost == pytest.approx(0.5 * float(r @ r), rel=1e-9)


def test_points_beyond_the_truncation_are_left_out() -> None:
    mask = np.zeros((48, 64), np.uint8)
    mask[24, 40] = VEHICLE
    cPs = np.array([[0.0, 0.0, 10.0], [1.0, 0.0, 10.0]])
    near = match_nearest(view(mask, cPs), FORWARD, 0.0, STILL, 0.0, max_px=5.0)
    assert near is not None
    np.testing.assert_array_equal(near.point_to_pixel.lPs, cPs[1:])
    assert match_nearest(view(mask, cPs), FORWARD, 0.0, STILL, 0.0, max_px=0.5) is None


def test_a_camera_that_sees_no_point_has_no_match() -> None:
    mask = np.full((48, 64), VEHICLE, np.uint8)
    assert match_nearest(view(mask, np.array([[0.0, 0.0, -3.0]])), FORWARD, 0.0, STILL, 5.0) is None
    assert ClassView.of(CAMERA, np.zeros((0, 3)), 0.0, mask == VEHICLE, 0.1, np.random.default_rng(0)) is None

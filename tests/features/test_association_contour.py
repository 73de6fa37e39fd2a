"""Distances to a drawn disc's contour."""

from __future__ import annotations

import numpy as np
import pytest

from sst_graph.features.mask_contour import ContourMap, signed_distance
from sst_graph.features.sampling import sampled
from sst_graph.types import SemanticClass

VEHICLE = SemanticClass.VEHICLE
CENTRE, RADIUS = np.array([80.3, 59.6]), 35.0


def disc() -> np.ndarray:
    v, u = np.mgrid[:120, :160]
    inside = np.hypot(u - CENTRE[0], v - CENTRE[1]) < RADIUS
    return np.where(inside, VEHICLE, SemanticClass.OTHER).astype(np.uint8)


def around(*radii: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels at radii from the disc's centre, their directions, their true distances."""
    angles = np.linspace(0.0, 2.0 * np.pi, 720, endpoint=False)
    ways = np.tile(np.stack([np.cos(angles), np.sin(angles)], axis=1), (len(radii), 1))
    r = np.repeat(radii, len(angles))
    return CENTRE + r[:, None] * ways, ways, r - RADIUS


def test_distances_of_a_disc() -> None:
    field = ContourMap.of(disc(), VEHICLE)
    assert field is not None
    uvs, ways, expected = around(27.0, 33.0, 34.0, 34.5, 35.0, 35.5, 36.0, 37.0, 45.0)
    feet = field.look_up(uvs)
    assert feet.valid.all()
    error = (feet.distances - expected).reshape(9, -1)
    # Where a fit ends, at the contour, the distance is true in the mean. A distance to pixels drawn with
    # steps falls short farther away, to either side alike.
    assert np.abs(error[2:7].mean(axis=1)).max() < 0.1
    assert abs(error[4].mean()) < 0.02
    assert np.abs(error.mean(axis=1)).max() < 0.3
    assert np.abs(error).max() < 0.5
    assert (feet.distances[expected < -0.4] < 0.0).all() and (feet.distances[expected > 0.4] > 0.0).all()
    assert (feet.normals * ways).sum(axis=1).min() > np.cos(np.radians(15.0))
    np.testing.assert_allclose(np.linalg.norm(feet.normals, axis=1), 1.0, atol=1e-6)
    radii = np.linalg.norm(feet.feet - CENTRE, axis=1).reshape(9, -1)
    assert np.abs(radii[2:7].mean(axis=1) - RADIUS).max() < 0.1


def test_a_straight_border_is_exact() -> None:
    inside = np.zeros((40, 60), np.uint8)
    inside[:, 20:] = 1
    distance = signed_distance(inside)
    np.testing.assert_allclose(distance[:, 15:25], np.tile(19.5 - np.arange(15, 25), (40, 1)), atol=1e-6)
    field = ContourMap.of(np.where(inside, VEHICLE, 0).astype(np.uint8), VEHICLE)
    assert field is not None
    feet = field.look_up(np.array([[12.25, 20.0], [27.75, 20.5]]))
    np.testing.assert_allclose(feet.distances, [7.25, -8.25], atol=1e-4)
    np.testing.assert_allclose(feet.normals, [[-1.0, 0.0]] * 2, atol=1e-4)
    np.testing.assert_allclose(feet.feet, [[19.5, 20.0], [19.5, 20.5]], atol=1e-3)


def test_ridge_border_and_nan_are_not_valid() -> None:
    field = ContourMap.of(disc(), VEHICLE)
    assert field is not None
    uvs = np.array([CENTRE, [2.0, 60.0], [157.0, 60.0], [80.0, 1.0], [-20.0, 500.0], [np.nan, 60.0]])
    assert not field.look_up(uvs).valid.any()
    assert field.look_up(np.array([[46.0, 60.0]])).valid.all()


def test_nothing_is_known_beyond_the_field_of_a_class() -> None:
    """The field ends 64 px around the class; the values at its border are not those of places farther out."""
    mask = np.zeros((400, 500), np.uint8)
    mask[150:250, 150:250] = VEHICLE
    field = ContourMap.of(mask, VEHICLE)
    assert field is not None
    far = np.array([[400.0, 300.0], [330.0, 120.0], [120.0, 30.0], [40.0, 290.0]])
    assert not field.look_up(far).valid.any()
    assert field.look_up(np.array([[312.0, 240.0], [200.0, 88.0]])).valid.all()


def test_contours_beside_ignored_pixels_are_not_valid() -> None:
    mask = disc()
    mask[:, 112:] = SemanticClass.IGNORE
    field = ContourMap.of(mask, VEHICLE)
    assert field is not None
    step = np.array([33.0, 0.0])
    right, left = CENTRE + step, CENTRE - step
    assert field.look_up(np.stack([right, left])).valid.tolist() == [False, True]


@pytest.mark.parametrize("value", [SemanticClass.OTHER, VEHICLE])
def test_no_contour_without_a_border(value: SemanticClass) -> None:
    assert ContourMap.of(np.full((20, 20), value, np.uint8), VEHICLE) is None


def test_bilinear_samples_beyond_one_batch() -> None:
    field = np.add.outer(3.0 * np.arange(50), 2.0 * np.arange(70)).astype(np.float32)
    uvs = np.random.default_rng(0).uniform([0.0, 0.0], [69.0, 49.0], (70_000, 2))
    # remap works in steps of 1/32 px
    found = sampled(field, uvs[None, :, 0], uvs[None, :, 1])[0]
    np.testing.assert_allclose(found, uvs @ [2.0, 3.0], atol=(2.0 + 3.0) / 32.0)

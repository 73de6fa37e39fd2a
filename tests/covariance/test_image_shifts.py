"""Pictures that shift from image to image: their variance, and what it does to an estimate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import csr_array

from sst_graph.association.edge_matching import SIDES
from sst_graph.covariance.image_shifts import ImageShifts, shifts_of
from sst_graph.covariance.level_edges import LevelEdges
from sst_graph.covariance.match_table import MatchTable

IMAGES, OBJECTS, POINTS, SIGMA_PX = 60, 5, 8, 0.5
UNITS = np.array([1.0, 1.0, 1e-3])
FloatArray = np.ndarray


def drawn(
    seed: int, shifts: FloatArray, of_side: float = 0.3, speed: float = 1.0
) -> tuple[MatchTable, FloatArray, FloatArray]:
    """Matches of objects with four sides, of three unknowns: the images' mean shifts; columns and images.

    Args:
        shifts: (n, 3) of each image across and down [px], and of its stamp [ms].
        speed: 1 for motions of 0.3 px/ms or so.
    """
    rng = np.random.default_rng(seed)
    images = np.repeat(np.arange(len(shifts)), OBJECTS * SIDES * POINTS)
    side = np.tile(np.repeat(np.arange(OBJECTS * SIDES), POINTS), len(shifts))
    angles = np.pi / 2 * (side % SIDES) + rng.normal(scale=0.2, size=len(side))
    normals = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    flows = speed * rng.normal(scale=0.3, size=(OBJECTS, 2))[side // SIDES]
    H = np.column_stack([normals, 1e3 * (normals * flows).sum(axis=1)]) / SIGMA_PX
    side_errors = of_side * rng.normal(size=(len(shifts), OBJECTS * SIDES))[images, side]
    r = (H * (shifts * UNITS)[images]).sum(axis=1) + side_errors + rng.normal(size=len(side))
    ones = np.ones(len(side))
    return MatchTable(csr_array(H), ones, ones, r, side, images, LevelEdges.none(len(side))), H, images


def estimated(table: MatchTable, H: FloatArray, images: FloatArray) -> tuple[FloatArray, ImageShifts]:
    """Least squares of the unknowns, and the shifts by what it leaves."""
    bread = np.linalg.inv(H.T @ H + np.diag([0.0, 0.0, 1.0]))
    x = bread @ (H.T @ table.r)
    return x, shifts_of(table.after(-x), bread, H, images)


def test_the_variances_are_those_drawn() -> None:
    rng = np.random.default_rng(1)
    table, H, images = drawn(2, rng.normal(size=(IMAGES, 3)) * [0.3, 0.8, 10.0])
    found = estimated(table, H, images)[1]
    np.testing.assert_allclose(found.sigmas / UNITS, [0.3, 0.8, 10.0], rtol=0.25)


def test_robust_weights_hide_no_part_of_the_shifts() -> None:
    """Weights that fall with the residual make a fit under them as they are fall short."""
    rng = np.random.default_rng(11)
    table, H, images = drawn(12, rng.normal(size=(IMAGES, 3)) * [0.3, 0.8, 0.0])
    u = (table.r / 3.0) ** 2
    weights, curvatures = (1.0 + u) ** -2, (1.0 - 3.0 * u) / (1.0 + u) ** 3  # Geman and McClure
    roots = np.sqrt(weights)
    robust = replace(table, J=csr_array(H * roots[:, None]), root_weights=roots, curvatures=curvatures)
    assert robust.weight_curvature_ratio > 1.3
    found = shifts_of(robust, np.eye(3), H * roots[:, None], images)
    np.testing.assert_allclose(found.sigmas[:2], [0.3, 0.8], rtol=0.3)


def test_nothing_is_found_where_nothing_shifts() -> None:
    """The sides' own errors are no shift of the picture, nor of its stamp."""
    found = [estimated(*drawn(seed, np.zeros((IMAGES, 3)), of_side=1.0))[1] for seed in range(30)]
    assert np.mean([(shifts.sigmas[:2]) ** 2 for shifts in found]) < 0.07**2
    assert np.mean([shifts.sigmas[2] ** 2 for shifts in found]) < 0.0005**2


def test_stamps_that_jitter_are_no_shift_of_the_picture() -> None:
    rng = np.random.default_rng(5)
    found = estimated(*drawn(6, rng.normal(size=(IMAGES, 3)) * [0.0, 0.0, 20.0]))[1]
    assert found.sigmas[2] == pytest.approx(0.02, rel=0.25) and found.sigmas[:2].max() < 0.15


def test_a_vehicle_that_stands_shows_no_jitter_but_shifts() -> None:
    rng = np.random.default_rng(7)
    shifts = rng.normal(size=(IMAGES, 3)) * [0.3, 0.8, 50.0]
    found = estimated(*drawn(8, shifts, speed=1e-6))[1]
    np.testing.assert_allclose(found.sigmas[:2], [0.3, 0.8], rtol=0.25)
    assert found.sigmas[2] == 0.0 and not found.parts[2].any()


def test_its_covariance_is_that_of_the_estimates() -> None:
    rng = np.random.default_rng(3)
    estimates, claimed = [], []
    for seed in range(300):
        shifts = rng.normal(size=(12, 3)) * [0.2, 1.0, 8.0]
        x, found = estimated(*drawn(seed, shifts))
        estimates.append(x / UNITS)
        claimed.append(np.diag(found.covariance) / UNITS**2)
    scatter, mean = np.var(np.array(estimates), axis=0), np.mean(claimed, axis=0)
    assert mean[1:] == pytest.approx(scatter[1:], rel=0.2)
    assert mean[0] < 0.15 * mean[1]


def test_a_single_image_tells_no_variance() -> None:
    found = estimated(*drawn(4, np.array([[1.0, 2.0, 3.0]])))[1]
    assert not found.covariance.any() and not found.sigmas.any()


def test_it_is_said_where_it_matters() -> None:
    parts = np.zeros((3, 7, 7))
    parts[1, 1, 1], parts[2, 6, 6] = 3e-6, 3e-6
    shifts = ImageShifts(np.array([0.04, 1.26, 0.0123]), parts)
    stamps, pictures = shifts.sentences(shifts.covariance + 1e-6 * np.eye(7))
    assert "jitter by 12.3 ms" in stamps and "0.0 px across and 1.3 px up or down" in pictures
    assert shifts.sentences(shifts.covariance + 1e-4 * np.eye(7)) == ()

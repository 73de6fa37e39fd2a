"""Pictures that shift from image to image: their variance, and what it does to an estimate."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import csr_array

from sst_graph.association.edge_matching import SIDES
from sst_graph.covariance.image_shifts import ImageShifts, shifts_of
from sst_graph.covariance.level_edges import LevelEdges
from sst_graph.covariance.match_table import MatchTable

IMAGES, OBJECTS, POINTS, SIGMA_PX = 60, 5, 8, 0.5
FloatArray = np.ndarray


def drawn(
    seed: int, shifts_px: FloatArray, of_side: float = 0.3
) -> tuple[MatchTable, FloatArray, FloatArray]:
    """Matches of objects with four sides, of two unknowns: the images' mean shift; columns and images."""
    rng = np.random.default_rng(seed)
    images = np.repeat(np.arange(len(shifts_px)), OBJECTS * SIDES * POINTS)
    side = np.tile(np.repeat(np.arange(OBJECTS * SIDES), POINTS), len(shifts_px))
    angles = np.pi / 2 * (side % SIDES) + rng.normal(scale=0.2, size=len(side))
    H = np.stack([np.cos(angles), np.sin(angles)], axis=1) / SIGMA_PX
    side_errors = of_side * rng.normal(size=(len(shifts_px), OBJECTS * SIDES))[images, side]
    r = (H * shifts_px[images]).sum(axis=1) + side_errors + rng.normal(size=len(side))
    ones = np.ones(len(side))
    return MatchTable(csr_array(H), ones, ones, r, side, images, LevelEdges.none(len(side))), H, images


def estimated(table: MatchTable, H: FloatArray, images: FloatArray) -> tuple[FloatArray, ImageShifts]:
    """Least squares of both unknowns, and the shifts by what it leaves."""
    bread = np.linalg.inv(H.T @ H)
    x = bread @ (H.T @ table.r)
    return x, shifts_of(table.after(-x), bread, H, images)


def test_the_variance_is_the_one_drawn() -> None:
    rng = np.random.default_rng(1)
    table, H, images = drawn(2, rng.normal(size=(IMAGES, 2)) * [0.3, 0.8])
    found = estimated(table, H, images)[1]
    np.testing.assert_allclose(found.sigmas_px, [0.3, 0.8], rtol=0.25)


def test_nothing_is_found_where_nothing_shifts() -> None:
    """The sides' own errors are no shift of the picture."""
    found = [estimated(*drawn(seed, np.zeros((IMAGES, 2)), of_side=1.0))[1] for seed in range(30)]
    assert np.mean([shifts.sigmas_px**2 for shifts in found]) < 0.07**2


def test_its_covariance_is_that_of_the_estimates() -> None:
    rng = np.random.default_rng(3)
    estimates, claimed = [], []
    for seed in range(300):
        shifts = rng.normal(size=(12, 2)) * [0.2, 1.0]
        x, found = estimated(*drawn(seed, shifts))
        estimates.append(x)
        claimed.append(found.covariance)
    scatter, mean = np.cov(np.array(estimates).T), np.mean(claimed, axis=0)
    assert mean[1, 1] == pytest.approx(scatter[1, 1], rel=0.2)
    assert mean[0, 0] < 0.15 * mean[1, 1]


def test_a_single_image_tells_no_variance() -> None:
    found = estimated(*drawn(4, np.array([[1.0, 2.0]])))[1]
    assert not found.covariance.any() and not found.sigmas_px.any()


def test_it_is_said_where_it_matters() -> None:
    shifts = ImageShifts(np.array([0.04, 1.26]), np.diag([0.0, 3e-6, 0.0, 0.0, 0.0, 0.0, 0.0]))
    assert "0.0 px across and 1.3 px up or down" in shifts.sentence(shifts.covariance + 1e-6 * np.eye(7))
    assert shifts.sentence(shifts.covariance + 1e-4 * np.eye(7)) == ""

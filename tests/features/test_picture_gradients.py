"""Edges of pictures in given directions."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest

from sst_graph.features.picture_gradients import (
    DIRECTIONS,
    EdgePlace,
    PictureGradients,
    direction_numbers,
    nearest_edges,
)


def step_picture(angle: float, place: float = 0.0) -> np.ndarray:
    """(120, 160, 3) two colours, apart by a line through the centre, ``place`` px along its normal's
    angle."""
    v, u = np.mgrid[:120, :160].astype(float)
    along = (u - 80.0) * np.cos(angle) + (v - 60.0) * np.sin(angle) - place
    share = np.clip(along + 0.5, 0.0, 1.0)[..., None]
    return np.rint((1.0 - share) * [60, 80, 100] + share * [160, 120, 140]).astype(np.uint8)


@pytest.mark.parametrize("degrees", [0.0, 30.0, 90.0, 200.0])
@pytest.mark.parametrize("away", [-2.0, 0.0, 1.5])
def test_the_centre_of_an_edge(degrees: float, away: float) -> None:
    """A window that is wide compared with the edge has its mass at the edge, drawn a little to its middle."""
    angle = np.radians(degrees)
    outward = np.array([[np.cos(angle), np.sin(angle)]])
    gradients = PictureGradients.of(step_picture(angle))
    pixels = np.array([[80.0, 60.0]]) + away * outward
    found = nearest_edges([gradients], [(0, 1)], pixels, outward, 6.0)
    assert found.valid[0]
    # Seen from outside, the edge lies inward by as much.
    assert found.distances[0] == pytest.approx(away, abs=0.25)
    np.testing.assert_allclose(found.feet[0], [80.0, 60.0], atol=0.25)


@pytest.mark.parametrize("scale_px", [1.2, 3.0, 6.0])
def test_the_peak_is_met_at_once(scale_px: float) -> None:
    """The centre of mass lies between pixel and peak, by the share that the peak's own width leaves."""
    gradients = PictureGradients.of(step_picture(0.0))
    outward, away = np.array([[1.0, 0.0]]), 0.8 * scale_px
    pixels = np.array([[80.0 + away, 60.0]])
    centre, peak = (
        nearest_edges([gradients], [(0, 1)], pixels, outward, scale_px, place)
        for place in get_args(EdgePlace)[:2]
    )
    assert abs(peak.feet[0, 0] - 80.0) < 0.12 * scale_px < 0.3 * away
    assert peak.distances[0] >= centre.distances[0]
    # the information of the step is that of the strengths' sum under the Gaussian: its second derivative
    stiffness = centre.distances[0] / peak.distances[0]
    assert peak.shares[0] == pytest.approx(stiffness * centre.shares[0], rel=1e-6)
    step = 0.05 * scale_px
    near = [
        nearest_edges([gradients], [(0, 1)], pixels + np.array([d, 0.0]), outward, scale_px).distances[0]
        for d in (-step, step)
    ]
    assert (near[1] - near[0]) / (2.0 * step) == pytest.approx(stiffness, abs=0.1)


@pytest.mark.parametrize("away", [-4.0, -0.7, 0.0, 3.3])
def test_the_strongest_edge_does_not_follow_the_pixel(away: float) -> None:
    """A faint edge beside the pixel and a strong one farther off: the strong one is met, wherever the pixel
    lies, by the whole distance."""
    picture = step_picture(0.0).astype(float)
    picture[:, 88:] += 12.0
    gradients = PictureGradients.of(np.rint(picture).astype(np.uint8))
    pixels, outward = np.array([[80.0 + away, 60.0]]), np.array([[1.0, 0.0]])
    found = nearest_edges([gradients], [(0, 1)], pixels, outward, 5.0, "strongest")
    assert found.valid[0] and 0.25 < found.shares[0] <= 1.0
    assert found.distances[0] == pytest.approx(away, abs=0.2)
    assert found.feet[0, 0] == pytest.approx(80.0, abs=0.2)
    centre = nearest_edges([gradients], [(0, 1)], pixels, outward, 1.2)
    assert abs(away) < 3.0 or not centre.valid[0] or abs(centre.distances[0]) < 0.8 * abs(away)


def test_no_edge_along_its_own_direction_or_on_plain_ground() -> None:
    gradients = PictureGradients.of(step_picture(0.0))
    pixels, outward = np.array([[80.0, 60.0], [30.0, 60.0]]), np.array([[0.0, 1.0], [1.0, 0.0]])
    found = nearest_edges([gradients], [(0, 2)], pixels, outward, 3.0)
    assert not found.valid.any()


def test_texture_is_worth_nothing_on_average() -> None:
    """The local mean is taken off: a wrong pose gains nothing by foliage."""
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 255, (240, 320, 3)).astype(np.uint8)
    field = PictureGradients.of(noise).blurred(6.0, 2)
    step = PictureGradients.of(step_picture(0.0)).blurred(6.0, 2)
    assert abs(float(field[:, 20:-20, 20:-20].mean())) < 0.03
    assert float(np.abs(field[:, 20:-20, 20:-20]).max()) < 0.5 * float(step[0].max())


def test_directions_are_those_of_lines() -> None:
    angles = np.arange(2 * DIRECTIONS) * np.pi / DIRECTIONS
    numbers = direction_numbers(np.stack([np.cos(angles), np.sin(angles)], axis=1))
    assert numbers.tolist() == [*range(DIRECTIONS), *range(DIRECTIONS)]


def test_pictures_of_4096_rows() -> None:
    """Eight fields of them, one below the other, have more rows than OpenCV samples at once."""
    rng = np.random.default_rng(0)
    tall = rng.integers(0, 255, (4096, 24, 3)).astype(np.uint8)
    uvs, angles = rng.uniform([6.0, 90.0], [17.0, 150.0], (40, 2)), rng.uniform(0.0, 2.0 * np.pi, 40)
    outward = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    feet = [
        nearest_edges([PictureGradients.of(picture)], [(0, 40)], uvs, outward, 2.0).feet
        for picture in (tall, tall[:300])
    ]
    np.testing.assert_allclose(feet[0], feet[1], atol=1e-3)


def test_no_edge_where_the_lens_ends() -> None:
    valid = np.ones((120, 160), np.bool_)
    valid[:, 80:] = False
    picture = step_picture(0.0)
    found = nearest_edges(
        [PictureGradients.of(picture, valid)], [(0, 1)], np.array([[79.0, 60.0]]), np.array([[1.0, 0.0]]), 2.0
    )
    assert not found.valid[0]

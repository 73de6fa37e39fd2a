"""What stays of the error of level edges: by drawing where edges lie between rings, and by hand."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from sst_graph.covariance.error_model import ErrorModel
from sst_graph.covariance.level_edges import MOMENTS, LevelEdges, shares_that_stay
from sst_graph.covariance.sums import ScoreSums
from sst_graph.factors.alignment import Alignment
from sst_graph.factors.camera import PinholeCamera
from sst_graph.types import FloatArray

GAP_M = 0.07
"""Between two rings at the edge."""
SIGMA_M = GAP_M / np.sqrt(12.0)


def moments_of(heights_m: FloatArray, sigma_m: float = SIGMA_M) -> FloatArray:
    """Of one edge, a match in each frame."""
    n = len(heights_m)
    level = LevelEdges(np.ones(n), heights_m[:, None] * [0.0, 0.0, 1.0], np.full(n, sigma_m))
    return level.moments(np.ones(n), np.arange(n), n).sum(axis=0)


def midpoints(edge_m: FloatArray, phase_m: float) -> FloatArray:
    """Half way between the rings around an edge, the rings a gap apart."""
    return (np.floor((edge_m - phase_m) / GAP_M) + 0.5) * GAP_M + phase_m


@pytest.mark.parametrize(
    ("passes", "least", "most"), [(0.0, 1.0, 1.0), (0.3, 0.5, 1.0), (1.0, 0.0, 0.15), (8.0, 0.0, 0.15)]
)
def test_an_error_stays_that_no_ring_passes(passes: float, least: float, most: float) -> None:
    """An edge keeps its height while so many rings pass it: what stays is the mean error over the frames."""
    rng, shares, means = np.random.default_rng(0), [], []
    for _ in range(400):
        rings = rng.uniform(0.0, GAP_M) + np.linspace(0.0, passes * GAP_M, 24)
        heights = np.array([midpoints(np.array([1.5]), phase)[0] for phase in rings])
        shares.append(shares_that_stay(moments_of(heights)[None])[0])
        means.append((heights.mean() - 1.5) ** 2)
    share = float(np.mean(shares))
    assert least - 1e-9 <= share <= most
    # Never below what is true of the mean, and near it.
    stays = float(np.mean(means)) / SIGMA_M**2
    assert stays - 0.05 <= share <= stays + 0.3


def test_a_single_frame_says_nothing_of_it() -> None:
    assert shares_that_stay(moments_of(np.array([1.5]))[None]).tolist() == [1.0]
    assert shares_that_stay(np.zeros((1, MOMENTS))).tolist() == [1.0]


def test_a_tilted_world_changes_nothing() -> None:
    """Edges are seen up to a metre from their middles; the world leans by 12 deg."""
    rng, edges, frames = np.random.default_rng(2), 20, 15
    upright = []
    for _ in range(edges):
        heights = midpoints(np.full(frames, 1.5), 0.01 * np.cumsum(rng.uniform(0.0, 0.4, frames)))
        upright.append(np.column_stack([rng.uniform(-1.0, 1.0, (frames, 2)), heights]))
    lean = gtsam.Rot3.Rodrigues(0.0, np.radians(12.0), np.radians(-5.0)).matrix()
    shares = []
    for wRg in (np.eye(3), lean):
        every = [LevelEdges(np.ones(frames), own @ wRg.T, np.full(frames, SIGMA_M)) for own in upright]
        sums = [own.moments(np.ones(frames), np.arange(frames), frames).sum(axis=0) for own in every]
        shares.append(shares_that_stay(np.stack(sums)))
    np.testing.assert_allclose(shares[1], shares[0], atol=0.02)
    assert 0.3 < np.mean(shares[0]) < 0.95
    # Without what all edges tell of up together, the lean would hide what stays.
    assert np.mean(shares_that_stay(np.stack(sums), 1e9 * np.diag([1.0, 1.0, 0.0]))) < 0.1


def test_the_mean_of_level_edges_errs_as_the_variance_says() -> None:
    """The height of a camera, by 12 edges that keep their rings in 10 frames: 6 matches each."""
    rng, edges, frames, points = np.random.default_rng(1), 12, 10, 6
    edge = np.repeat(np.arange(edges), frames * points)
    frame = np.tile(np.repeat(np.arange(frames), points), edges)
    J, roots = np.ones((len(edge), 1)), np.ones(len(edge))
    places = 0.01 * edge[:, None] * np.ones(3)
    level = LevelEdges(np.full(len(edge), 0.8), places, np.full(len(edge), SIGMA_M))
    sums = ScoreSums.of(J, roots, edge * 4 + 2, frame, level)
    bread = 1.0 / len(edge)
    predicted = bread**2 * sums.variance(ErrorModel(0.0, 0.0, 1.0))[0, 0]
    errors = []
    for _ in range(4000):
        shared = 0.8 * rng.uniform(-np.sqrt(3.0), np.sqrt(3.0), edges)
        errors.append(float((shared[edge] + rng.normal(size=len(edge))).mean()))
    assert np.var(errors) == pytest.approx(predicted, rel=0.08)
    alone = (
        bread**2 * ScoreSums.of(J, roots, edge * 4 + 2, frame, LevelEdges.none(len(edge))).independent[0, 0]
    )
    assert predicted > 30.0 * alone


def test_places_are_in_the_world() -> None:
    camera = PinholeCamera(700.0, 700.0, 600.0, 180.0, 1200, 370)
    lPs = np.array([[10.0, 0.0, 0.5], [10.0, 1.0, 0.5]])
    alignment = Alignment(
        camera=camera,
        lPs=lPs,
        base_taus_s=np.zeros(2),
        pixels=np.zeros((2, 2)),
        sigmas_px=np.array([2.0, 2.0]),
        normals=np.tile([0.0, 1.0], (2, 1)),
    )
    level_px = np.array([1.4, 0.0])
    level = LevelEdges.of(alignment, level_px, gtsam.Pose3(gtsam.Rot3(), np.array([5.0, 0.0, 2.0])))
    assert level.errors.tolist() == [0.7, 0.0]
    np.testing.assert_allclose(level.places, lPs + np.array([5.0, 0.0, 2.0]))
    np.testing.assert_allclose(level.sigmas_m, [1.4 * np.linalg.norm(lPs[0]) / 700.0, 0.0])
    assert not LevelEdges.of(alignment, level_px, None).places.any()
    moving = replace(alignment, l_velocities=np.array([[5.0, 0.0, 0.0], [0.0, 0.0, 0.0]]))
    places = LevelEdges.of(moving, level_px, gtsam.Pose3()).places
    np.testing.assert_allclose(places, [[0.0, 0.0, 0.5], lPs[1]])

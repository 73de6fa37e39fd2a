"""The casters against brute force, and the masks against closed form."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sst_graph.factors.camera import PinholeCamera
from sst_graph.simulator.camera.render import CameraView
from sst_graph.simulator.casting import cast_image, clip_near, compact, plane_of
from sst_graph.simulator.sweep import Columns, SweepMotion, cast_lidar
from sst_graph.types import FloatArray

CAMERA = PinholeCamera(120.0, 118.0, 70.3, 40.7, 140, 80)
SLOPES = np.tan(np.deg2rad(np.linspace(-25.0, 3.0, 40)))
COLUMNS = Columns(0.003, 2 * np.pi / 360, 360, SLOPES)


def brute_force(triangles: FloatArray, rays: FloatArray) -> tuple[np.ndarray, FloatArray]:
    """Nearest front face (-1: none) of each ray (m, 3) and the factor of the ray (Moeller-Trumbore)."""
    a, e1, e2 = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    p = np.cross(rays[:, None], e2[None])
    det = np.einsum("nk,mnk->mn", e1, p)
    with np.errstate(divide="ignore", invalid="ignore"):
        u = np.einsum("nk,mnk->mn", -a, p) / det
        q = np.cross(-a, e1)
        v = np.einsum("mk,nk->mn", rays, q) / det
        s = np.einsum("nk,nk->n", e2, q)[None] / det
    hit = (det > 0) & (u >= 0) & (v >= 0) & (u + v <= 1) & (s > 0)
    s = np.where(hit, s, np.inf)
    face = np.where(np.isfinite(s).any(axis=1), s.argmin(axis=1), -1)
    return face, s.min(axis=1)


def soup(rng: np.random.Generator, centres: FloatArray, size: float) -> FloatArray:
    """Random triangles about ``centres`` (n, 3), both orientations."""
    return centres[:, None, :] + rng.normal(0.0, size, (len(centres), 3, 3))


def test_image_agrees_with_brute_force() -> None:
    rng = np.random.default_rng(1)
    # Some of the triangles reach behind the camera.
    centres = np.column_stack([rng.uniform(-6, 6, 300), rng.uniform(-4, 4, 300), rng.uniform(0.5, 14, 300)])
    triangles = soup(rng, centres, 1.3)
    faces, depth = cast_image(triangles, CAMERA)
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], axis=2)
    expected, s = brute_force(triangles, rays.reshape(-1, 3))
    # What lies nearer than the near plane is clipped away: compare where nothing does.
    clear = s > 0.2
    assert clear.mean() > 0.8 and (expected[clear] >= 0).mean() > 0.5
    np.testing.assert_array_equal(faces.ravel()[clear], expected[clear])
    found = clear & (expected >= 0)
    np.testing.assert_allclose(depth.ravel()[found], s[found], rtol=2e-6)


def test_all_that_is_in_the_picture_is_in_sight() -> None:
    rng = np.random.default_rng(6)
    triangles = soup(rng, rng.uniform(-15.0, 15.0, (2000, 3)), 1.3)
    for rotation in Rotation.random(8, random_state=rng).as_matrix():
        view = CameraView(CAMERA, rotation, rng.normal(size=3))
        faces, depth = cast_image(view.to_camera(triangles), CAMERA)
        seen = view.in_sight(triangles)
        assert set(faces[faces >= 0]) <= set(seen) and len(seen) < 0.5 * len(triangles)
        again, same_depth = cast_image(view.to_camera(triangles[seen]), CAMERA)
        np.testing.assert_array_equal(np.append(seen, -1)[again], faces)
        np.testing.assert_array_equal(same_depth, depth)


def test_faces_above_all_rings_change_nothing() -> None:
    """They are left out before anything is cut; those beside the rings' highest are not."""
    rng = np.random.default_rng(7)
    world = lidar_world(rng)
    high = soup(rng, np.column_stack([rng.uniform(-9.0, 9.0, (50, 2)), rng.uniform(9.0, 12.0, 50)]), 0.5)
    (faces, reach), (with_them, same_reach) = (
        cast_lidar(triangles, COLUMNS)[0] for triangles in (world, np.concatenate([high, world]))
    )
    np.testing.assert_array_equal(with_them, np.where(faces >= 0, faces + len(high), -1))
    np.testing.assert_array_equal(same_reach, reach)


def lidar_world(rng: np.random.Generator) -> FloatArray:
    """Triangles all around, above and below, and a ground that the axis pierces."""
    azimuth, distance = rng.uniform(-np.pi, np.pi, 400), rng.uniform(3.0, 30.0, 400)
    centres = np.column_stack(
        [distance * np.cos(azimuth), distance * np.sin(azimuth), rng.uniform(-4, 2, 400)]
    )
    ground = np.array([[[-60.0, -50, -1.7], [70, -55, -1.8], [5, 80, -1.6]]])
    return np.concatenate([soup(rng, centres, 1.2), ground])


def test_lidar_agrees_with_brute_force() -> None:
    triangles = lidar_world(np.random.default_rng(2))
    shift = 0.002
    for turned, (faces, reach) in zip(
        (0.0, shift), cast_lidar(triangles, COLUMNS, (0.0, shift)), strict=True
    ):
        azimuth = COLUMNS.azimuths + turned
        rays = np.stack(
            np.broadcast_arrays(np.cos(azimuth)[None], np.sin(azimuth)[None], SLOPES[:, None]), axis=2
        ).reshape(-1, 3)
        expected, s = brute_force(triangles, rays)
        np.testing.assert_array_equal(faces.ravel(), expected)
        found = expected >= 0
        assert found.mean() > 0.7
        np.testing.assert_allclose(reach.ravel()[found], s[found], rtol=2e-6)


@pytest.mark.parametrize(
    ("sense", "cut", "named", "period_s"),
    [(-1.0, np.pi, 0.5, 0.1036), (1.0, 0.4, 0.0, 0.2), (-1.0, -2.0, 1.0, 0.05)],
)
def test_rolling_lidar_agrees_with_brute_force_at_each_columns_time(
    sense: float, cut: float, named: float, period_s: float
) -> None:
    rng = np.random.default_rng(3)
    triangles = lidar_world(rng)
    velocities = np.zeros_like(triangles)
    velocities[:150] = rng.uniform(-12.0, 12.0, (150, 1, 3)) * np.array([1.0, 1.0, 0.02])
    seconds = (np.mod(sense * (COLUMNS.azimuths - cut), 2 * np.pi) / (2 * np.pi) - named) * period_s
    yaw = 0.4 * seconds
    zero, one = np.zeros_like(yaw), np.ones_like(yaw)
    rotations = np.stack(
        [
            np.stack([np.cos(yaw), -np.sin(yaw), zero], axis=1),
            np.stack([np.sin(yaw), np.cos(yaw), zero], axis=1),
            np.stack([zero, zero, one], axis=1),
        ],
        axis=1,
    )
    positions = np.column_stack([14.0 * seconds, 0.5 * seconds, 0.1 * seconds])
    motion = SweepMotion(rotations, positions, seconds, velocities, cut)
    faces, reach = cast_lidar(triangles, COLUMNS, motion=motion)[0]
    for column in range(0, COLUMNS.count, 5):
        moved = triangles + velocities * seconds[column]
        here = (moved - positions[column]) @ rotations[column]
        azimuth = COLUMNS.azimuths[column]
        rays = np.column_stack([np.full(40, np.cos(azimuth)), np.full(40, np.sin(azimuth)), SLOPES])
        expected, s = brute_force(here, rays)
        np.testing.assert_array_equal(faces[:, column], expected)
        np.testing.assert_allclose(reach[expected >= 0, column], s[expected >= 0], rtol=2e-6)


def test_mask_borders_have_no_bias() -> None:
    """The mean of many masks' columns lies on the projected edge: pixel centres at whole numbers."""
    rng = np.random.default_rng(4)
    errors = []
    for _ in range(200):
        left, right = rng.uniform(20.0, 50.0), rng.uniform(80.0, 120.0)
        lean = rng.uniform(-6.0, 6.0)
        # A quadrilateral with the given edges in pixels, at a random slant in depth.
        uv = np.array([[left, -5.0], [right, -5.0], [right + lean, 90.0], [left + lean, 90.0]])
        z = rng.uniform(4.0, 12.0) + rng.uniform(-0.01, 0.01) * uv[:, 0]
        corners = np.column_stack(
            [(uv[:, 0] - CAMERA.cx) / CAMERA.fx * z, (uv[:, 1] - CAMERA.cy) / CAMERA.fy * z, z]
        )
        quad = np.stack([corners[[0, 2, 1]], corners[[0, 3, 2]]])
        quad = quad if plane_of(quad)[1][0] < 0 else quad[:, ::-1]
        inside = cast_image(quad, CAMERA)[0] >= 0
        rows = np.arange(CAMERA.height)
        first, last = inside.argmax(axis=1), CAMERA.width - 1 - inside[:, ::-1].argmax(axis=1)
        at = lean * (rows + 5.0) / 95.0
        errors.append(np.array([(first - 0.5 - left - at).mean(), (last + 0.5 - right - at).mean()]))
    assert np.abs(np.mean(errors, axis=0)).max() < 0.02


def test_a_pixel_on_a_shared_edge_is_taken_once() -> None:
    grid = np.stack(
        np.meshgrid(np.linspace(-3, 3, 13), np.linspace(-3, 3, 13), [5.0], indexing="ij"), axis=-1
    )[:, :, 0]
    a, b, c, d = grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]
    sheet = np.concatenate(
        [np.stack([a, c, b], axis=2).reshape(-1, 3, 3), np.stack([a, d, c], axis=2).reshape(-1, 3, 3)]
    )
    camera = PinholeCamera(100.0, 100.0, 50.0, 50.0, 101, 101)
    faces, depth = cast_image(sheet, camera)
    assert (faces >= 0).all()
    np.testing.assert_allclose(depth, 5.0, rtol=1e-6)


def test_clipping_keeps_area_in_front_and_orientation() -> None:
    triangle = np.array([[[0.0, 0.0, 1.1], [1.0, 0.0, -0.9], [0.0, 1.0, 1.1]]])
    pieces, face = clip_near(triangle)
    assert (face == 0).all() and pieces[:, :, 2].min() >= 0.1 - 1e-12
    whole, parts = plane_of(triangle)[0][0], plane_of(pieces)[0]
    # Half of the edge lies in front: a quarter of the area is cut off.
    np.testing.assert_allclose(parts.sum(axis=0), 0.75 * whole, rtol=1e-12)


@pytest.mark.parametrize("numbers", [[-1, 4, 4, 0], [2, 2], [-1, -1]])
def test_compact_is_unique_with_inverse(numbers: list[int]) -> None:
    seen, place = compact(np.array(numbers))
    expected = np.unique(numbers, return_inverse=True)
    np.testing.assert_array_equal(seen, expected[0])
    np.testing.assert_array_equal(place, expected[1])

"""Visual odometry on made tracks and made pictures: signs, scale, covariance, degenerate motion."""

from __future__ import annotations

from dataclasses import replace

import cv2
import gtsam
import numpy as np
import pytest
from numpy.typing import NDArray

from sst_graph.errors import DataError
from sst_graph.factors.camera import PinholeCamera
from sst_graph.odometry.depth import InverseDepths, inverse_depths
from sst_graph.odometry.features import FeatureTracker, Tracks, detect_corners
from sst_graph.odometry.metric import TrackErrors, consensus_translation, metric_motion, motion_from_depths
from sst_graph.odometry.relative import rays, relative_pose
from sst_graph.odometry.visual import image_pairs, metric_motions
from sst_graph.types import CameraImage, SemanticClass

FloatArray = NDArray[np.float64]

CAMERA = PinholeCamera(721.5, 721.5, 609.6, 172.9, 1242, 375)
PURE = TrackErrors(0.0, 0.0, 0.0)
"""Only what pixels and depths bring: the floors stand for what simulated tracks don't have."""


def made_tracks(
    rng: np.random.Generator,
    aTb: gtsam.Pose3,
    count: int = 400,
    noise_px: float = 0.2,
    depth_share: float = 0.5,
    depth_sigma: float = 0.01,
    outliers: float = 0.05,
) -> tuple[Tracks, InverseDepths]:
    """Tracks of points 5 to 60 m away, some with measured inverse depth, some wrong altogether."""
    uv_a = rng.uniform([0, 0], [1242, 375], (count, 2))
    depth = np.exp(rng.uniform(np.log(5.0), np.log(60.0), count))
    bPs = aTb.transformTo((rays(uv_a, CAMERA) * depth[:, None]).T).T
    uv_b = CAMERA.project(bPs) + rng.normal(0.0, noise_px, (count, 2))
    wrong = rng.random(count) < outliers
    uv_b[wrong] += rng.normal(0.0, 10.0, (int(wrong.sum()), 2))
    kept = np.isfinite(uv_b).all(axis=1) & CAMERA.in_image(uv_b)
    rho = 1.0 / depth[kept]
    sigma = depth_sigma * rho
    value = np.where(rng.random(len(rho)) < depth_share, rho + rng.normal(0.0, 1.0, len(rho)) * sigma, np.nan)
    return Tracks(0, 100_000_000, uv_a[kept], uv_b[kept]), InverseDepths(
        value, np.where(np.isnan(value), np.nan, sigma)
    )


def motion_of(rotation_rad: list[float], translation_m: list[float]) -> gtsam.Pose3:
    return gtsam.Pose3(gtsam.Rot3.Expmap(np.array(rotation_rad)), np.array(translation_m))


# --- signs by hand ----------------------------------------------------------------------------------------


def test_forward_motion_by_hand() -> None:
    # A camera that drives 1 m forward sees a point 10 m ahead and 1 m right move from f/10 to f/9 right.
    xs, ys, zs = np.meshgrid([-3.0, -1.0, 1.0, 3.0], [-1.0, 0.5, 1.5], [8.0, 10.0, 14.0])
    aPs = np.column_stack([xs.ravel(), ys.ravel(), zs.ravel()])
    uv_a, uv_b = CAMERA.project(aPs), CAMERA.project(aPs - [0.0, 0.0, 1.0])
    assert uv_b[np.all(aPs == [1.0, 0.5, 10.0], axis=1)][0, 0] == pytest.approx(609.6 + 721.5 / 9)
    tracks = Tracks(0, 100_000_000, uv_a, uv_b)
    direction = relative_pose(tracks, CAMERA)
    assert direction.ok
    np.testing.assert_allclose(direction.direction, [0.0, 0.0, 1.0], atol=1e-4)
    motion = motion_from_depths(
        tracks, direction, InverseDepths(1 / aPs[:, 2], 1e-4 / aPs[:, 2]), CAMERA, PURE
    )
    assert motion.ok
    np.testing.assert_allclose(motion.aTb.translation(), [0.0, 0.0, 1.0], atol=1e-5)
    np.testing.assert_allclose(motion.mean_twist, [0.0, 0.0, 0.0, 0.0, 0.0, 10.0], atol=1e-3)


def test_right_turn_by_hand() -> None:
    # The optical y axis points down: a turn to the right is positive about it; all points move left.
    tracks, depths = made_tracks(
        np.random.default_rng(0), motion_of([0, 0.02, 0], [0, 0, 0.8]), noise_px=0.0, outliers=0.0
    )
    centre = np.abs(tracks.uv_a[:, 0] - CAMERA.cx) < 50
    assert np.all(tracks.uv_b[centre, 0] < tracks.uv_a[centre, 0])
    direction = relative_pose(tracks, CAMERA)
    np.testing.assert_allclose(gtsam.Rot3.Logmap(direction.rotation), [0.0, 0.02, 0.0], atol=1e-5)
    np.testing.assert_allclose(direction.direction, [0.0, 0.0, 1.0], atol=1e-3)
    motion = motion_from_depths(tracks, direction, depths, CAMERA, PURE)
    np.testing.assert_allclose(gtsam.Rot3.Logmap(motion.aTb.rotation()), [0.0, 0.02, 0.0], atol=1e-5)


# --- covariance -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "aTb",
    [
        motion_of([0.0, 0.01, 0.0], [0.0, 0.0, 1.0]),
        motion_of([0.01, 0.2, 0.0], [0.1, 0.0, 0.6]),
        motion_of([0.0, 0.0, 0.0], [0.0, 0.0, 0.05]),
        motion_of([0.002, 0.0, 0.0], [0.0, 0.0, 0.0]),
    ],
    ids=["drive", "turn", "creep", "stand"],
)
def test_metric_covariance_holds(aTb: gtsam.Pose3) -> None:
    nees = []
    for seed in range(40):
        tracks, depths = made_tracks(np.random.default_rng(seed), aTb)
        motion = motion_from_depths(tracks, relative_pose(tracks, CAMERA), depths, CAMERA, PURE)
        error = gtsam.Pose3.Logmap(aTb.between(motion.aTb))
        nees.append(error @ np.linalg.solve(motion.covariance, error))
    # 40 runs of 6 dimensions: the mean of a perfect estimator lies within 6 +- 0.55
    assert 0.7 < np.mean(nees) / 6 < 1.4


def test_direction_covariance_holds() -> None:
    aTb = motion_of([0.0, 0.02, 0.0], [0.1, 0.0, 0.8])
    true_direction = gtsam.Unit3(aTb.translation())
    nees = []
    for seed in range(40):
        tracks, _ = made_tracks(np.random.default_rng(seed), aTb)
        motion = relative_pose(tracks, CAMERA)
        assert motion.ok
        turn = gtsam.Rot3.Logmap(aTb.rotation().between(motion.rotation))
        error = np.concatenate([turn, -gtsam.Unit3(motion.direction).localCoordinates(true_direction)])
        nees.append(error @ np.linalg.solve(motion.covariance, error))
    assert 0.7 < np.mean(nees) / 5 < 1.4


def test_the_direction_is_unknown_at_standstill() -> None:
    for seed in range(10):
        tracks, _ = made_tracks(np.random.default_rng(seed), motion_of([0.0, 0.01, 0.0], [0.0, 0.0, 0.002]))
        motion = relative_pose(tracks, CAMERA)
        assert not motion.ok
        assert np.sqrt(motion.covariance[3, 3]) > 3.0
        # the rotation is known all the same
        np.testing.assert_allclose(gtsam.Rot3.Logmap(motion.rotation), [0.0, 0.01, 0.0], atol=3e-4)


def test_wrong_depths_widen_the_covariance() -> None:
    tracks, depths = made_tracks(
        np.random.default_rng(1), motion_of([0, 0, 0], [0, 0, 1.0]), depth_sigma=0.05
    )
    direction = relative_pose(tracks, CAMERA)
    honest = motion_from_depths(tracks, direction, depths, CAMERA, PURE)
    lying = motion_from_depths(
        tracks, direction, InverseDepths(depths.value, depths.sigma / 20), CAMERA, PURE
    )
    assert lying.covariance[5, 5] > 0.25 * honest.covariance[5, 5]


def test_scale_sigma_acts_along_the_motion() -> None:
    tracks, depths = made_tracks(np.random.default_rng(2), motion_of([0, 0, 0], [0, 0, 1.0]))
    direction = relative_pose(tracks, CAMERA)
    pure = motion_from_depths(tracks, direction, depths, CAMERA, PURE)
    shared = motion_from_depths(tracks, direction, depths, CAMERA, TrackErrors(0.05, 0.0, 0.0))
    extra = shared.covariance - pure.covariance
    assert np.sqrt(extra[5, 5]) == pytest.approx(0.05, rel=0.02)
    assert abs(extra[3, 3]) < 1e-5


# --- what goes wrong --------------------------------------------------------------------------------------


def test_a_group_that_moves_by_itself_is_outvoted() -> None:
    # A third of the tracks with depth sits on a shadow that moves along.
    aTb = motion_of([0.0, 0.0, 0.0], [0.0, 0.0, 0.1])
    tracks, depths = made_tracks(np.random.default_rng(3), aTb, noise_px=0.1, outliers=0.0)
    shadow = (tracks.uv_a[:, 0] > 828) & depths.known
    uv_b = tracks.uv_b.copy()
    uv_b[shadow] = tracks.uv_a[shadow] + [0.5, 0.8]
    moved = replace(tracks, uv_b=uv_b)
    motion = motion_from_depths(moved, relative_pose(moved, CAMERA), depths, CAMERA, PURE)
    assert motion.aTb.translation()[2] == pytest.approx(0.1, abs=0.003)


def test_consensus_finds_the_translation_with_half_of_the_tracks_wrong() -> None:
    rng = np.random.default_rng(4)
    aTb = motion_of([0.0, 0.03, 0.0], [0.2, -0.05, 1.1])
    tracks, depths = made_tracks(
        rng, aTb, count=200, noise_px=0.1, depth_share=1.0, depth_sigma=0.001, outliers=0.5
    )
    found = consensus_translation(
        aTb.rotation(), rays(tracks.uv_a, CAMERA), rays(tracks.uv_b, CAMERA), depths.value, 0.1 / 721.5, 0.001
    )
    np.testing.assert_allclose(found, aTb.translation(), atol=0.01)


@pytest.mark.parametrize("count", [0, 1, 12])
def test_too_few_tracks_are_no_motion(count: int) -> None:
    tracks = Tracks(0, 100, np.full((count, 2), 100.0), np.full((count, 2), 100.0))
    direction = relative_pose(tracks, CAMERA)
    assert not direction.ok
    motion = metric_motion(tracks, direction, np.zeros((0, 3)), CAMERA)
    assert not motion.ok
    assert np.sqrt(motion.covariance[3, 3]) >= 1.0


def test_tracks_that_all_stand_on_one_pixel_do_not_break_the_estimation() -> None:
    tracks = Tracks(0, 100, np.full((60, 2), 300.0), np.full((60, 2), 300.0))
    direction = relative_pose(tracks, CAMERA)
    assert not direction.ok
    assert np.isfinite(direction.rotation.matrix()).all()


# --- depth ------------------------------------------------------------------------------------------------


def test_inverse_depth_of_a_plane() -> None:
    # ground 1.65 m below the camera, rows of points as a scanner sees them
    xs, zs = np.meshgrid(np.linspace(-6, 6, 200), np.linspace(6, 20, 60))
    cPs = np.column_stack([xs.ravel(), np.full(xs.size, 1.65), zs.ravel()])
    uvs = CAMERA.project(np.array([[0.33, 1.65, 8.1], [-2.2, 1.65, 9.77], [1.0, 1.65, 12.3]]))
    depths = inverse_depths(uvs, cPs, CAMERA)
    np.testing.assert_allclose(depths.value, [1 / 8.1, 1 / 9.77, 1 / 12.3], rtol=3e-4)
    assert np.all((depths.sigma > 0) & (depths.sigma < 0.02 * depths.value))


def test_no_depth_at_an_edge_far_from_points_or_outside() -> None:
    us, vs = np.meshgrid(np.arange(300.0, 900.0, 3.0), np.arange(100.0, 300.0, 5.0))
    depth = np.where(us < 600, 8.0, 25.0)
    uvs = np.column_stack([us.ravel(), vs.ravel()])
    cPs = rays(uvs, CAMERA) * depth.reshape(-1, 1)
    wanted = np.array([[450.0, 200.0], [750.0, 200.0], [599.0, 200.0], [1100.0, 200.0], [295.0, 200.0]])
    depths = inverse_depths(wanted, cPs, CAMERA)
    assert depths.known.tolist() == [True, True, False, False, False]
    np.testing.assert_allclose(depths.value[:2], [1 / 8.0, 1 / 25.0], rtol=1e-9)
    assert not inverse_depths(wanted, np.zeros((0, 3)), CAMERA).known.any()
    assert not inverse_depths(wanted, -cPs, CAMERA).known.any()


# --- pictures ---------------------------------------------------------------------------------------------


def textured(seed: int = 0, height: int = 200, width: int = 320) -> NDArray[np.uint8]:
    noise = np.random.default_rng(seed).uniform(0, 255, (height // 4, width // 4)).astype(np.float32)
    return np.asarray(
        cv2.resize(noise, (width, height), interpolation=cv2.INTER_CUBIC).clip(0, 255), np.uint8
    )


def as_image(gray: NDArray[np.uint8], stamp_ns: int, mask: NDArray[np.uint8] | None = None) -> CameraImage:
    mask = np.zeros(gray.shape, np.uint8) if mask is None else mask
    return CameraImage(stamp_ns, mask, np.repeat(gray[:, :, None], 3, axis=2))


def shifted(gray: NDArray[np.uint8], du: float, dv: float) -> NDArray[np.uint8]:
    matrix = np.array([[1.0, 0.0, du], [0.0, 1.0, dv]])
    return np.asarray(cv2.warpAffine(gray, matrix, gray.shape[::-1], flags=cv2.INTER_CUBIC), np.uint8)


def tracked(image_a: CameraImage, image_b: CameraImage) -> Tracks:
    """Corners of the first image, found again in the second."""
    tracker = FeatureTracker()
    tracker.add(image_a)
    tracks = tracker.add(image_b)
    assert tracks is not None
    return tracks


def test_tracks_follow_a_shift_to_a_tenth_of_a_pixel() -> None:
    gray = textured()
    tracks = tracked(as_image(gray, 0), as_image(shifted(gray, 5.25, -2.5), 100))
    assert len(tracks) > 40
    flow = tracks.uv_b - tracks.uv_a
    np.testing.assert_allclose(np.median(flow, axis=0), [5.25, -2.5], atol=0.05)
    assert np.quantile(np.linalg.norm(flow - [5.25, -2.5], axis=1), 0.9) < 0.15


def test_corners_are_spread_and_keep_off_vehicles() -> None:
    gray = textured()
    corners = detect_corners(gray, np.full(gray.shape, 255, np.uint8))
    cells = (corners // 32).astype(int)
    _, counts = np.unique(cells, axis=0, return_counts=True)
    assert counts.max() <= 2
    assert len(counts) >= (200 // 32) * (320 // 32)
    mask = np.zeros(gray.shape, np.uint8)
    mask[:, 160:] = SemanticClass.VEHICLE
    tracks = tracked(as_image(gray, 0, mask), as_image(shifted(gray, 2, 0), 100, mask))
    assert len(tracks) > 20
    assert tracks.uv_a[:, 0].max() < 160 - 5
    assert tracks.uv_b[:, 0].max() < 160


def test_a_blank_picture_has_no_tracks() -> None:
    blank = np.full((200, 320), 90, np.uint8)
    assert len(tracked(as_image(blank, 0), as_image(blank, 1))) == 0


def test_images_out_of_order_or_of_another_size_are_refused() -> None:
    gray = textured()
    with pytest.raises(DataError, match="one after 100 ns"):
        tracked(as_image(gray, 100), as_image(gray, 100))
    with pytest.raises(DataError, match="the size before"):
        tracked(as_image(gray, 0), as_image(gray[:100], 100))


def test_a_wall_seen_from_three_places_gives_metric_motion() -> None:
    # A camera moves 0.3 m to the right before a wall 6 m away: the picture moves left by f * 0.3 / 6.
    camera = PinholeCamera(200.0, 200.0, 160.0, 100.0, 320, 200)
    gray = textured()
    images = [as_image(shifted(gray, -10.0 * k, 0.0), 100_000_000 * k) for k in range(3)]
    us, vs = np.meshgrid(np.arange(0.0, 320.0, 4.0), np.arange(0.0, 200.0, 6.0))
    wall = rays(np.column_stack([us.ravel(), vs.ravel()]), camera) * 6.0
    together = metric_motions(image_pairs(images, camera), camera, lambda _: wall)
    assert [motion.ok for motion in together] == [True, True]
    for motion in together:
        np.testing.assert_allclose(motion.aTb.translation(), [0.3, 0.0, 0.0], atol=0.01)


def test_refreshed_depth_scales_the_motion() -> None:
    camera = PinholeCamera(200.0, 200.0, 160.0, 100.0, 320, 200)
    gray = textured()
    pairs = image_pairs([as_image(gray, 0), as_image(shifted(gray, -10.0, 0.0), 100_000_000)], camera)
    us, vs = np.meshgrid(np.arange(0.0, 320.0, 4.0), np.arange(0.0, 200.0, 6.0))
    wall = rays(np.column_stack([us.ravel(), vs.ravel()]), camera)
    lengths = [
        np.linalg.norm(metric_motions(pairs, camera, lambda _, d=depth: wall * d)[0].aTb.translation())
        for depth in (6.0, 9.0)
    ]
    assert lengths[1] / lengths[0] == pytest.approx(1.5, rel=0.02)
    failed = metric_motions(pairs, camera, lambda _: np.zeros((0, 3)))
    assert not failed[0].ok

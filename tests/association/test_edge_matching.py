"""Matches of points on a ring before the camera with the disc that they project to."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from sst_graph.association.edge_matching import (
    TOP,
    MatchConfig,
    ScanWithImage,
    SilhouetteMatches,
    level_sigmas,
    match_silhouettes,
    of_matched_objects,
    side_weights,
)
from sst_graph.factors import PinholeCamera, RobustKernel, residuals
from sst_graph.factors.motion import CameraTwist
from sst_graph.features.lidar_edges import Boundaries, Edge
from sst_graph.features.mask_contour import ContourMap
from sst_graph.types import Calibration, PixelStretch, SemanticClass

VEHICLE = SemanticClass.VEHICLE
CAMERA = PinholeCamera(300.0, 300.0, 160.3, 119.6, 320, 240)
DEPTH, RADIUS_PX = 10.0, 60.2
CTL = gtsam.Pose3(gtsam.Rot3.Ypr(0.2, -0.1, 0.3), np.array([0.3, -0.2, 0.1]))
STILL = CameraTwist(np.zeros(6), np.zeros(6))
KERNEL = RobustKernel("geman_mcclure", 5.0)


def ring(n: int = 90) -> Boundaries:
    """Points on the disc's rim, with ways out; the upper half is a top edge; offsets rise."""
    angles = np.linspace(0.0, 2.0 * np.pi, n, endpoint=False) + 0.01
    ways = np.stack([np.cos(angles), np.sin(angles), np.zeros(n)], axis=1)
    rim = ways * RADIUS_PX / CAMERA.fx * DEPTH + [0.0, 0.0, DEPTH]
    out = ways * (RADIUS_PX + 2.0) / CAMERA.fx * DEPTH + [0.0, 0.0, DEPTH]
    top = ways[:, 1] < -0.5
    lTc = CTL.inverse()
    return Boundaries(
        np.array([lTc.transformFrom(p) for p in rim]),
        np.array([lTc.transformFrom(p) for p in out]),
        np.full(n, 5),
        np.zeros(n),
        np.where(top, Edge.TOP, Edge.SIDE).astype(np.uint8),
        np.repeat([0, 1], [n // 2, n - n // 2]),
    )


def disc() -> ContourMap:
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    inside = np.hypot(u - CAMERA.cx, v - CAMERA.cy) < RADIUS_PX
    field = ContourMap.of(np.where(inside, VEHICLE, 0).astype(np.uint8), VEHICLE)
    assert field is not None
    return field


def match(
    points: Boundaries,
    cTl: gtsam.Pose3 = CTL,
    time_offset_s: float = 0.0,
    base_tau_s: float = 0.0,
    motion: CameraTwist = STILL,
    bias_px: float = 0.0,
    config: MatchConfig | None = None,
) -> SilhouetteMatches:
    pair = ScanWithImage({VEHICLE: points}, {VEHICLE: disc()}, CAMERA, base_tau_s, motion)
    found = match_silhouettes(
        pair, Calibration(cTl, time_offset_s), {VEHICLE: bias_px}, KERNEL, config or MatchConfig()
    )
    return found[VEHICLE]


def test_at_the_truth_the_residuals_have_no_mean() -> None:
    found = match(ring())
    assert len(found) == 90
    r = residuals(found.alignment, CTL, 0.0, np.zeros(6))[0].ravel()
    assert abs(r.mean()) < 0.05 and np.abs(r).max() < 0.5
    assert found.alignment.normals is not None
    uvs = found.alignment.pixels - [CAMERA.cx, CAMERA.cy]
    np.testing.assert_allclose(np.linalg.norm(uvs, axis=1), RADIUS_PX, atol=0.4)


def test_a_shift_shows_with_its_sign() -> None:
    # The points 2 px too far right: outside on the right (positive), inside on the left.
    moved = gtsam.Pose3(gtsam.Rot3(), np.array([2.0 / CAMERA.fx * DEPTH, 0.0, 0.0])).compose(CTL)
    found = match(ring(), moved)
    r = residuals(found.alignment, moved, 0.0, np.zeros(6))[0].ravel()
    along = found.alignment.normals @ [1.0, 0.0]
    assert np.polyfit(along, r, 1)[0] == pytest.approx(2.0, abs=0.2)
    assert abs(r.mean()) < 0.1


def test_points_move_to_the_images_instant() -> None:
    # The camera moves right at 2 m/s; seen 0.1 s later the points are 6 px to the left of the disc.
    motion = CameraTwist(np.array([0.0, 0.0, 0.0, 2.0, 0.0, 0.0]), np.zeros(6))
    for time_offset_s, base_tau_s, delays_s in ((0.1, 0.0, 0.0), (0.0, 0.1, 0.0), (0.15, 0.0, 0.05)):
        points = replace(ring(), offsets_s=np.full(90, delays_s))
        found = match(points, time_offset_s=time_offset_s, base_tau_s=base_tau_s, motion=motion)
        r = residuals(found.alignment, CTL, time_offset_s, motion.c_twist)[0].ravel()
        assert np.polyfit(found.alignment.normals @ [1.0, 0.0], r, 1)[0] == pytest.approx(-6.0, abs=0.5)


def test_gate_and_bias() -> None:
    grown = gtsam.Pose3(gtsam.Rot3(), np.array([0.0, 0.0, -1.8])).compose(CTL)
    # 60 px at 10 m are 73.2 px at 8.2 m: within the gate of 15 px, but not with a bias of 3 px on top.
    assert len(match(ring(), grown)) == 90
    pair = ScanWithImage({VEHICLE: ring()}, {VEHICLE: disc()}, CAMERA, 0.0, STILL)
    assert match_silhouettes(pair, Calibration(grown), {VEHICLE: 3.0}, KERNEL, MatchConfig()) == {}


def test_where_an_image_is_enlarged_its_masks_err_as_much_more() -> None:
    """Enlarged three times along u: a distance there is a third in the pixels that were taken."""
    squares = np.zeros((9, 11, 3), np.float32)
    squares[..., 0], squares[..., 2] = 9.0, 1.0
    stretch = PixelStretch(squares, 32)
    moved = gtsam.Pose3(gtsam.Rot3(), np.array([6.0 / CAMERA.fx * DEPTH, 0.0, 0.0])).compose(CTL)
    plain = disc()
    enlarged = replace(plain, stretch=stretch)
    one, other = (
        match_silhouettes(
            ScanWithImage({VEHICLE: ring()}, {VEHICLE: field}, CAMERA, 0.0, STILL),
            Calibration(moved),
            {VEHICLE: 0.3},
            KERNEL,
            MatchConfig(),
        )[VEHICLE]
        for field in (plain, enlarged)
    )
    np.testing.assert_array_equal(one.index, other.index)
    normals = one.alignment.normals
    assert normals is not None and other.alignment.stretches is not None
    wanted = np.sqrt(9.0 * normals[:, 0] ** 2 + normals[:, 1] ** 2)
    np.testing.assert_allclose(other.alignment.stretches, wanted, rtol=1e-6)
    r, s = (residuals(m.alignment, moved, 0.0, np.zeros(6), 0.3)[0].ravel() for m in (one, other))
    np.testing.assert_allclose(s - 0.3, (r - 0.3) / wanted, rtol=1e-6, atol=1e-9)
    # The step to the next beam counts in the same pixels as the mask's own error.
    steps = np.sqrt(one.alignment.sigmas_px**2 - 1.0)
    np.testing.assert_allclose(np.sqrt(other.alignment.sigmas_px**2 - 1.0), steps / wanted, rtol=1e-6)


def test_contours_that_face_another_direction_do_not_match() -> None:
    points = ring()
    inward = 2.0 * points.lPs - points.outward
    half = np.arange(90) % 2 == 0
    turned = replace(points, outward=np.where(half[:, None], inward, points.outward))
    assert match(turned).index.tolist() == np.flatnonzero(~half).tolist()


def test_sides_and_objects() -> None:
    points = ring()
    found = match(points)
    angles = np.linspace(0.0, 2.0 * np.pi, 90, endpoint=False) + 0.01
    top = np.sin(angles) < -0.5
    np.testing.assert_array_equal(found.sides, np.where(top, 2, (np.cos(angles) > 0.0).astype(int)))
    np.testing.assert_array_equal(found.objects, points.objects)


def test_an_object_without_a_mask_is_left_out() -> None:
    # The second object's points lie off the disc, but for three on its rim: less than a tenth of 45.
    points, stray = ring(), np.arange(90) >= 48
    shifted = points.lPs + stray[:, None] * np.array(CTL.rotation().unrotate(np.array([0.0, -1.83, 0.0])))
    found = match(replace(points, lPs=shifted, outward=points.outward + (shifted - points.lPs)))
    assert set(found.objects) == {0} and len(found) == 45 and found.seen == 90
    # With more of them it stays.
    stray = np.arange(90) >= 55
    shifted = points.lPs + stray[:, None] * np.array(CTL.rotation().unrotate(np.array([0.0, -1.83, 0.0])))
    found = match(replace(points, lPs=shifted, outward=points.outward + (shifted - points.lPs)))
    assert set(found.objects) == {0, 1} and len(found) >= 55


def test_shares_of_objects_by_hand() -> None:
    """Two of four points of object 0 meet a contour, one of three of object 2."""
    matched = np.array([True, True, False, False, True, False, False])
    owners, seen = np.array([0, 0, 0, 0, 2, 2, 2]), np.array([4, 0, 3])
    for share, left in ((0.3, [0, 1, 4]), (0.4, [0, 1]), (0.5, [0, 1]), (0.6, [])):
        assert np.flatnonzero(of_matched_objects(matched, owners, seen, share)).tolist() == left


def test_sigmas_and_weights() -> None:
    config = MatchConfig(mask_sigma_px=1.2, side_sigma_px=0.7)
    found = match(ring(), config=config)
    # Uniform over 1 px to either side (half the way to ``outward``, 2 px off): deviation 1 / sqrt(3).
    expected = np.hypot(1.2, 1.0 / np.sqrt(3.0))
    np.testing.assert_allclose(found.alignment.sigmas_px, expected, atol=0.02)
    for group in {(o, s) for o, s in zip(found.objects, found.sides, strict=True)}:
        members = (found.objects == group[0]) & (found.sides == group[1])
        sigmas, weights = found.alignment.sigmas_px[members], found.alignment.weights[members]
        # The mean of a group claims sigma^2 / n and what the side shares, no less: a level edge lies between
        # the same two rings all along.
        claimed = 1.0 / (weights / sigmas**2).sum()
        sampling = sigmas**2 - 1.2**2 if group[1] == TOP else np.zeros(len(sigmas))
        assert claimed == pytest.approx(1.0 / (sigmas**-2.0).sum() + 0.7**2 + sampling.mean(), rel=1e-3)


def test_what_different_rings_show_of_an_edge_errs_apart() -> None:
    """The mean of 12 matches of one ring, and of three each of four rings."""
    owners, sides, sigmas = np.zeros(12, np.intp), np.full(12, TOP), np.full(12, 2.0)
    config = MatchConfig(mask_sigma_px=1.0, side_sigma_px=0.7)
    level = level_sigmas(sides, sigmas, config)
    np.testing.assert_allclose(level, np.sqrt(3.0))
    for rings, apart in ((np.full(12, 7), 1), (np.repeat([7, 8, 9, 10], 3), 4)):
        weights = side_weights(owners, sides, sigmas, config, (level, rings))
        claimed = 1.0 / (weights / sigmas**2).sum()
        assert claimed == pytest.approx(4.0 / 12.0 + 0.7**2 + 3.0 / apart)
    assert level_sigmas(np.array([0, 1]), sigmas[:2], config).tolist() == [0.0, 0.0]


def test_classes_without_a_contour_have_no_match() -> None:
    pair = ScanWithImage({VEHICLE: ring()}, {SemanticClass.POLE: disc()}, CAMERA, 0.0, STILL)
    assert match_silhouettes(pair, Calibration(CTL), {}, KERNEL, MatchConfig()) == {}
    pair = replace(pair, contours={VEHICLE: disc()})
    behind = gtsam.Pose3(gtsam.Rot3.Ry(np.pi), np.zeros(3)).compose(CTL)
    assert match_silhouettes(pair, Calibration(behind), {}, KERNEL, MatchConfig()) == {}

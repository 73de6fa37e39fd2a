"""Many poses against silhouettes at once: by hand, and against the matches of one pose alone."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from streets import prepared_street, standing_street

from sst_graph.association.edge_matching import MatchConfig, Motion, match_silhouettes
from sst_graph.factors import PinholeCamera, RobustKernel
from sst_graph.features.lidar_edges import Boundaries
from sst_graph.features.mask_contour import ContourMap
from sst_graph.initialization.many_poses import Outlines, Poses, Views
from sst_graph.types import SemanticClass

VEHICLE = SemanticClass.VEHICLE
CAMERA = PinholeCamera(100.0, 100.0, 320.0, 100.0, 640, 200)


def kernel(scale_px: float) -> RobustKernel:
    return RobustKernel("geman_mcclure", scale_px)


def poses(*cTls: gtsam.Pose3, offset_s: float = 0.0) -> Poses:
    return Poses(
        np.stack([cTl.rotation().matrix() for cTl in cTls]),
        np.stack([cTl.translation() for cTl in cTls]),
        np.full(len(cTls), offset_s),
        np.zeros((len(cTls), 1)),
    )


def still(count: int, scans: int) -> Views:
    """Scan k with image k, nothing moves."""
    return Views(np.tile(np.arange(scans), (count, 1)), np.zeros((count, scans)), None, None)


def left_edge(u: float) -> tuple[Outlines, MatchConfig]:
    """Points of the left edge of an object 10 m ahead, seen at column u; its mask begins at column 200."""
    mask = np.zeros((200, 640), np.uint8)
    mask[20:180, 200:440] = VEHICLE
    contour = ContourMap.of(mask, VEHICLE)
    assert contour is not None
    y = np.linspace(-2.0, 2.0, 20)
    lPs = np.stack([np.full(20, (u - 320.0) / 10.0), y, np.full(20, 10.0)], axis=1)
    zeros = np.zeros(20, np.intp)
    points = Boundaries(
        lPs, lPs - [0.02, 0.0, 0.0], np.full(20, 0.01), np.zeros(20), zeros.astype(np.uint8), zeros
    )
    outlines = Outlines.gather([{VEHICLE: points}], [{VEHICLE: contour}], [VEHICLE], CAMERA)
    return outlines, MatchConfig(side_sigma_px=1e-3)


def test_an_edge_by_hand() -> None:
    """Seen 4 px outside its mask: residual +4, normal towards the left."""
    outlines, config = left_edge(195.5)
    steps = outlines.steps(poses(gtsam.Pose3()), still(1, 1), kernel(20.0), config)
    sigma = np.hypot(1.0, 0.5 * 0.2 / np.sqrt(3.0))
    weight = float(kernel(20.0).weight(4.0 / sigma))
    assert steps.seen[0] == 20.0 and steps.support[0] == pytest.approx(20.0 * weight, rel=1e-3)
    # A step of the object to the right by 1 m moves it 10 px inwards: dr / dx = -10, dr / dbias = 1.
    assert steps.g[0, 3] == pytest.approx(20.0 * weight / sigma**2 * 4.0 * -10.0, rel=1e-2)
    assert steps.H[0, 3, 3] == pytest.approx(20.0 * weight / sigma**2 * 100.0, rel=1e-2)
    assert steps.H[0, 3, 7] == pytest.approx(20.0 * weight / sigma**2 * -10.0, rel=1e-2)
    assert steps.H[0, 6, 6] == 0.0  # nothing moves: the offset says nothing


def test_what_is_far_or_faces_the_other_way_is_no_match() -> None:
    far, config = left_edge(130.0)
    steps = far.steps(poses(gtsam.Pose3()), still(1, 1), kernel(20.0), config)
    assert steps.seen[0] == 20.0 and steps.support[0] == 0.0 and not steps.H.any()
    near, config = left_edge(199.5)
    turned = replace(near, ways=-near.ways)
    assert turned.steps(poses(gtsam.Pose3()), still(1, 1), kernel(20.0), config).support[0] == 0.0
    unpaired = replace(still(1, 1), images=np.full((1, 1), -1))
    assert near.steps(poses(gtsam.Pose3()), unpaired, kernel(20.0), config).seen[0] == 0.0


def test_a_moving_edge_by_hand() -> None:
    """The LiDAR drives to the right at 2 m/s; 0.2 s later the edge is seen 0.4 m, or 4 px, farther left."""
    outlines, config = left_edge(199.5)
    twist = np.array([[[0.0, 0.0, 0.0, 2.0, 0.0, 0.0]]])
    views = Views(np.zeros((1, 1), np.intp), np.full((1, 1), 0.1), twist, np.zeros((1, 1, 6)))
    steps = outlines.steps(poses(gtsam.Pose3(), offset_s=0.1), views, kernel(20.0), config)
    # r = 10 px/m * 2 m/s * 0.2 s = 4 px and dr / doffset = 20 px/s: g[offset] / g[x] = 20 / -10.
    assert steps.g[0, 6] / steps.g[0, 3] == pytest.approx(-2.0, rel=1e-2)
    assert steps.g[0, 7] / steps.H[0, 7, 7] == pytest.approx(4.0, rel=1e-2)


@pytest.mark.parametrize("scale_px", [15.0, 3.0])
def test_each_pose_has_the_matches_that_it_has_alone(scale_px: float) -> None:
    drive, truth = prepared_street(), standing_street().truth.cTl
    scans, images = [s.boundaries for s in drive.scans], [i.contours for i in drive.images]
    outlines = Outlines.gather(scans, images, [VEHICLE], drive.camera)
    rng = np.random.default_rng(4)
    several = [truth.retract(0.004 * i * rng.standard_normal(6)) for i in range(4)]
    steps = outlines.steps(poses(*several), still(4, 3), kernel(scale_px), MatchConfig())
    for i, cTl in enumerate(several):
        matches, seen = 0.0, 0
        for boundaries, contours in zip(scans, images, strict=True):
            motion, args = Motion(np.zeros(6), np.zeros(6)), (kernel(scale_px), MatchConfig())
            found = match_silhouettes(boundaries, contours, drive.camera, cTl, 0.0, 0.0, motion, {}, *args)
            r = _distances(found[VEHICLE].alignment, cTl)
            matches += float(kernel(scale_px).weight(r / found[VEHICLE].alignment.sigmas_px).sum())
            seen += found[VEHICLE].seen
        assert steps.seen[i] == seen
        assert steps.support[i] == pytest.approx(matches, rel=0.05)


def _distances(alignment, cTl: gtsam.Pose3):  # type: ignore[no-untyped-def]
    uvs = alignment.camera.project(np.stack([cTl.transformFrom(p) for p in alignment.lPs]))
    return ((uvs - alignment.pixels) * alignment.normals).sum(axis=1)


def test_fewer_points_are_spread_over_all_scans() -> None:
    drive = prepared_street()
    outlines = Outlines.gather(
        [s.boundaries for s in drive.scans], [i.contours for i in drive.images], [VEHICLE], drive.camera
    )
    some = outlines.thinned(60)
    assert 40 <= len(some) <= 60 < len(outlines)
    assert set(some.scans.tolist()) == {0, 1, 2}

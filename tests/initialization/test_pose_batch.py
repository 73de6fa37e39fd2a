"""Many poses against silhouettes at once: by hand, and against the matches of one pose alone."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from streets import prepared_street, standing_street

from sst_graph.association.edge_matching import MatchConfig, ScanWithImage, match_silhouettes
from sst_graph.drive.preparation import Drive, ImageFeatures, ScanFeatures
from sst_graph.factors import CameraTwist, PinholeCamera, RobustKernel
from sst_graph.features.lidar_edges import Boundaries
from sst_graph.features.mask_contour import ContourMap
from sst_graph.graph.building import PRIOR_TRANSLATION_SIGMA_M
from sst_graph.graph.drive_motion import motions_of
from sst_graph.graph.frozen_problem import FrozenProblem
from sst_graph.graph.matching import GraphConfig, edges_of, match_all
from sst_graph.graph.state import State
from sst_graph.initialization.pose_batch import BatchEquations, PoseBatch, Poses
from sst_graph.types import Calibration, RelativeMotion, SemanticClass

VEHICLE = SemanticClass.VEHICLE
CAMERA = PinholeCamera(100.0, 100.0, 320.0, 100.0, 640, 200)
PERIOD_NS = 100_000_000


def kernel(scale_px: float) -> RobustKernel:
    return RobustKernel("geman_mcclure", scale_px)


def poses(*cTls: gtsam.Pose3, time_offset_s: float = 0.0) -> Poses:
    return Poses(
        np.stack([cTl.rotation().matrix() for cTl in cTls]),
        np.stack([cTl.translation() for cTl in cTls]),
        np.full(len(cTls), time_offset_s),
        np.zeros((len(cTls), 1)),
    )


def left_edge(u: float, turned: bool = False) -> tuple[Drive, GraphConfig]:
    """Points of the left edge of an object 10 m ahead, seen at column u; its mask begins at column 200."""
    mask = np.zeros((200, 640), np.uint8)
    mask[20:180, 200:440] = VEHICLE
    contour = ContourMap.of(mask, VEHICLE)
    assert contour is not None
    y = np.linspace(-2.0, 2.0, 20)
    lPs = np.stack([np.full(20, (u - 320.0) / 10.0), y, np.full(20, 10.0)], axis=1)
    zeros, outward = np.zeros(20, np.intp), np.array([0.02 if turned else -0.02, 0.0, 0.0])
    points = Boundaries(lPs, lPs + outward, zeros, np.zeros(20), zeros.astype(np.uint8), zeros)
    scan = scan_of(0, {VEHICLE: points})
    image = ImageFeatures(0, 0, mask, {VEHICLE: contour})
    config = GraphConfig(side_sigma_px=1e-3)
    return Drive("edge", CAMERA, (scan,), (image,), (), ()), config


def scan_of(index: int, boundaries: dict[SemanticClass, Boundaries]) -> ScanFeatures:
    """A scan every 0.1 s."""
    none, points, no_classes = np.zeros(0, np.float32), np.zeros((0, 3)), np.zeros(0, np.uint8)
    depth = points.astype(np.float32), none
    return ScanFeatures(index, index * PERIOD_NS, boundaries, points, no_classes, np.zeros(0), *depth)


def batch_of(drive: Drive, config: GraphConfig | None = None) -> PoseBatch:
    (edges,) = edges_of([drive], motions_of([drive]), config or GraphConfig())
    return PoseBatch(edges)


def equations(drive: Drive, config: GraphConfig, several: Poses, scale_px: float = 20.0) -> BatchEquations:
    return batch_of(drive, config).equations(several, kernel(scale_px))


def test_an_edge_by_hand() -> None:
    """Seen 4 px outside its mask: residual +4, normal towards the left."""
    found = equations(*left_edge(195.5), poses(gtsam.Pose3()))
    sigma = np.hypot(1.0, 0.5 * 0.2 / np.sqrt(3.0))
    weight = float(kernel(20.0).weight(4.0 / sigma))
    assert found.seen[0] == 20.0 and found.support[0] == pytest.approx(20.0 * weight, rel=1e-3)
    assert found.agreements[0] == pytest.approx(20.0 * weight**2, rel=1e-3)
    # A step of the object to the right by 1 m moves it 10 px inwards: dr / dx = -10, dr / dbias = 1.
    assert found.g[0, 3] == pytest.approx(20.0 * weight / sigma**2 * 4.0 * -10.0, rel=1e-2)
    assert found.H[0, 3, 3] == pytest.approx(20.0 * weight / sigma**2 * 100.0, rel=1e-2)
    assert found.H[0, 3, 7] == pytest.approx(20.0 * weight / sigma**2 * -10.0, rel=1e-2)
    assert found.H[0, 6, 6] == 0.0  # nothing moves: the offset says nothing


def test_what_is_far_or_faces_the_other_way_is_no_match() -> None:
    far = equations(*left_edge(130.0), poses(gtsam.Pose3()))
    assert far.seen[0] == 20.0 and far.support[0] == 0.0 and not far.H.any()
    assert equations(*left_edge(199.5), poses(gtsam.Pose3())).support[0] > 10.0
    assert equations(*left_edge(199.5, turned=True), poses(gtsam.Pose3())).support[0] == 0.0
    # An offset of half a second leaves the scan without an image.
    assert equations(*left_edge(199.5), poses(gtsam.Pose3(), time_offset_s=0.5)).seen[0] == 0.0


def test_a_moving_edge_by_hand() -> None:
    """The LiDAR drives to the right at 2 m/s; 0.2 s later the edge is seen 0.4 m, or 4 px, farther left."""
    drive, config = left_edge(199.5)
    step = gtsam.Pose3(gtsam.Rot3(), np.array([0.2, 0.0, 0.0]))
    motions = [RelativeMotion(k * PERIOD_NS, (k + 1) * PERIOD_NS, step, 1e-8 * np.eye(6)) for k in range(6)]
    image = replace(drive.images[0], stamp_ns=PERIOD_NS)
    drive = replace(
        drive,
        scans=(drive.scans[0], *(scan_of(k, {}) for k in range(1, 7))),
        images=(image, replace(image, index=1, stamp_ns=3 * PERIOD_NS)),  # so far apart, they reach so far
        lidar_motions=tuple(motions),
    )
    found = equations(drive, config, poses(gtsam.Pose3(), time_offset_s=0.1))
    # r = 10 px/m * 2 m/s * 0.2 s = 4 px and dr / doffset = 20 px/s: g[offset] / g[x] = 20 / -10.
    assert found.g[0, 6] / found.g[0, 3] == pytest.approx(-2.0, rel=1e-2)
    assert found.g[0, 7] / found.H[0, 7, 7] == pytest.approx(4.0, rel=1e-2)


@pytest.mark.parametrize("scale_px", [15.0, 3.0])
def test_each_pose_has_the_matches_that_it_has_alone(scale_px: float) -> None:
    drive, truth = prepared_street(), standing_street().truth.cTl
    rng = np.random.default_rng(4)
    several = [truth.retract(0.004 * i * rng.standard_normal(6)) for i in range(4)]
    together = equations(drive, GraphConfig(), poses(*several), scale_px)
    for i, cTl in enumerate(several):
        matches, seen = 0.0, 0
        for scan, image in zip(drive.scans, drive.images, strict=True):
            motion = CameraTwist(np.zeros(6), np.zeros(6))
            pair = ScanWithImage(scan.boundaries, image.contours, drive.camera, 0.0, motion)
            found = match_silhouettes(pair, Calibration(cTl), {}, kernel(scale_px), MatchConfig())
            r = _distances(found[VEHICLE].alignment, cTl)
            matches += float(kernel(scale_px).weight(r / found[VEHICLE].alignment.sigmas_px).sum())
            seen += found[VEHICLE].seen
        assert together.seen[i] == seen
        assert together.support[i] == pytest.approx(matches, rel=0.05)


@pytest.mark.parametrize("scale_px", [15.0, 4.0])
def test_normal_equations_are_the_graphs(scale_px: float) -> None:
    """Of extrinsic and mask bias, on a straight contour, where all ways to its normal agree."""
    drive, graph = left_edge(197.0)
    for step in (np.zeros(6), np.array([0.01, -0.02, 0.015, 0.02, 0.03, -0.1])):
        cTl = gtsam.Pose3.Expmap(step)
        found = equations(drive, graph, poses(cTl), scale_px)
        state = State(cTl)
        matches = match_all(edges_of([drive], motions_of([drive]), graph), state, kernel(scale_px))
        frozen = FrozenProblem(matches, state, graph)
        system = frozen.linearized(frozen.start)
        # By cP' = Exp(w) cP + v instead of cTl Exp(xi): [w, v] = [R xi_w, R xi_v - (R xi_w) x t].
        R, t = cTl.rotation().matrix(), cTl.translation()
        A = np.zeros((8, 8))
        A[:3, :3], A[3:6, 3:6] = R, R
        A[3:6, :3] = gtsam.Rot3.Hat(t) @ R
        A[6, 6] = A[7, 7] = 1.0
        H, g = A.T @ found.H[0] @ A, A.T @ found.g[0]
        # Without the weak priors: their means are the state.
        prior = [1.0, 1.0, 1.0, *[PRIOR_TRANSLATION_SIGMA_M**-2.0] * 3]
        expected = system.H - np.diag(
            [*prior, graph.time_offset_sigma_s**-2.0, graph.mask_bias_sigma_px**-2.0]
        )
        some = np.ix_([*range(6), 7], [*range(6), 7])
        assert np.abs(expected[some]).max() > 1.0
        np.testing.assert_allclose(H[some], expected[some], atol=2e-3 * np.abs(expected[some]).max())
        np.testing.assert_allclose(g, system.g, atol=2e-3 * np.abs(system.g).max())


def _distances(alignment, cTl: gtsam.Pose3):  # type: ignore[no-untyped-def]
    uvs = alignment.camera.project(np.stack([cTl.transformFrom(p) for p in alignment.lPs]))
    return ((uvs - alignment.pixels) * alignment.normals).sum(axis=1)


def test_fewer_points_are_spread_over_all_scans() -> None:
    whole = batch_of(prepared_street())
    some = whole.thinned(60)
    assert 40 <= len(some) <= 60 < len(whole)
    assert set(np.array(some.edges.scans)[some.edges.group_of].tolist()) == {0, 1, 2}

"""``align_frame``: from a scan and an image to the alignments of the user's own factor."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import gtsam
import numpy as np
import pytest
from stored import simulated

import sst_graph
from sst_graph.association.edge_matching import MatchConfig
from sst_graph.drive.preparation import PrepareConfig, ScanFeatures, image_features, scan_features
from sst_graph.errors import DataError
from sst_graph.factors import (
    Between,
    FactorError,
    RobustKernel,
    frame_factor,
    pose_alignment_factor,
    residuals,
)
from sst_graph.features.lidar_edges import Boundaries
from sst_graph.simulator import SimulatedDrive, SimulationConfig
from sst_graph.slam.align import CameraCalibration, FrameAlignments, FrameMatching, ScanMotion
from sst_graph.types import CameraImage, Scan, SemanticClass

VEHICLE = SemanticClass.VEHICLE
NARROW = RobustKernel("geman_mcclure", 5.0)


@cache
def drive() -> SimulatedDrive:
    return simulated(
        SimulationConfig(
            seed=4,
            frames=8,
            width=621,
            height=188,
            motion="constant",
            azimuth_limit_deg=60.0,
            azimuth_step_deg=0.25,
            vehicle_density=0.25,
            moving_fraction=0.0,
        )
    )


@cache
def frame(position: int) -> tuple[Scan, CameraImage]:
    found = drive()[position]
    assert found.scan is not None and found.image is not None
    return found.scan, found.image


def l_twist(position: int) -> np.ndarray:
    stamps = drive().stamps_ns[[position, position + 1]] * 1e-9
    a, b = (drive().wTl(t) for t in stamps)
    return np.asarray(gtsam.Pose3.Logmap(a.between(b)) / (stamps[1] - stamps[0]))


def motion(position: int) -> ScanMotion:
    return ScanMotion(l_twist(position))


def at_truth(time_offset_s: float = 0.05) -> CameraCalibration:
    return CameraCalibration(drive().camera, drive().truth.cTl, time_offset_s)


def mean_size_px(found: FrameAlignments, cTl: gtsam.Pose3, time_offset_s: float, twist: np.ndarray) -> float:
    sizes = [
        np.abs(residuals(a, cTl, time_offset_s, cTl.AdjointMap() @ twist, 0.0)[0]) for a in found.alignments
    ]
    return float(np.median(np.concatenate(sizes)))


def test_matches_at_the_truth_lie_on_the_contours() -> None:
    scan, image = frame(2)
    truth = drive().truth
    found = sst_graph.align_frame(scan, image, at_truth(), motion(2), FrameMatching(kernel=NARROW))
    assert found.classes == (VEHICLE,) and len(found) > 50
    size_px = mean_size_px(found, truth.cTl, 0.05, l_twist(2))
    assert size_px < 1.5
    # the same matches under a pose off by 0.5 deg, and without the delay
    off = truth.cTl.retract([0.0, 0.0, np.radians(0.5), 0.0, 0.0, 0.0])
    assert mean_size_px(found, off, 0.05, l_twist(2)) > 1.5 * size_px


def test_features_spare_the_work_and_change_nothing() -> None:
    scan, image = frame(2)
    direct = sst_graph.align_frame(scan, image, at_truth(), motion(2))
    prepared = sst_graph.align_frame(
        scan_features(2, scan, [VEHICLE], PrepareConfig()),
        image_features(2, image, [VEHICLE]),
        at_truth(),
        motion(2),
    )
    assert len(direct) == len(prepared) > 0
    for a, b in zip(direct.alignments, prepared.alignments, strict=True):
        np.testing.assert_array_equal(a.pixels, b.pixels)
        np.testing.assert_array_equal(a.lPs, b.lPs)


def test_the_mask_may_be_filled_anew_once_features_are_made() -> None:
    _, image = frame(2)
    mask = image.mask.copy()
    features = image_features(2, replace(image, mask=mask), [VEHICLE])
    mask[:] = SemanticClass.IGNORE
    np.testing.assert_array_equal(features.mask, image.mask)


def test_a_scan_of_another_time_is_the_same_scan_moved() -> None:
    # points carried by hand into the LiDAR frame at the stamp before the image give the same matches
    scan, image = frame(1)
    later_ns = int(drive().stamps_ns[4])
    image = frame(4)[1]
    truth = drive().truth
    lTs = drive().wTl(later_ns * 1e-9).between(drive().wTl(scan.stamp_ns * 1e-9))
    features = scan_features(1, scan, [VEHICLE], PrepareConfig())
    moved = ScanMotion(l_twist(4), lTs=lTs, from_ns=later_ns)
    found = sst_graph.align_frame(features, image, at_truth(), moved)
    by_hand = sst_graph.align_frame(_moved(features, lTs, later_ns), image, at_truth(), motion(4))
    assert len(found) == len(by_hand) > 50
    for a, b in zip(found.alignments, by_hand.alignments, strict=True):
        np.testing.assert_allclose(a.pixels, b.pixels, atol=1e-3)
        np.testing.assert_allclose(lTs.transformFrom(a.lPs.T).T, b.lPs, atol=1e-6)
        np.testing.assert_allclose(a.base_taus_s, b.base_taus_s, atol=1e-12)
    # and the factor on poses has the cost of the plain factor on the moved points
    values = gtsam.Values()
    for key, pose in ((0, gtsam.Pose3()), (1, gtsam.Pose3.Expmap(0.1 * l_twist(4))), (2, lTs)):
        values.insert(key, pose)
    values.insert(3, truth.cTl)
    between = Between(0, 1, 0.1, 1e-9 * (image.stamp_ns - later_ns), X_scan=2)
    on_poses = pose_alignment_factor(found.alignments, between, 3, 0.05)
    plain = frame_factor(by_hand.alignments, 3, 0.05, truth.cTl.AdjointMap() @ l_twist(4))
    assert on_poses.error(values) == pytest.approx(plain.error(values), rel=1e-3)


def test_a_moving_vehicle_is_moved_with_its_velocity() -> None:
    # moved by hand to where it is when the image is taken, it meets the same contours
    scan, image = frame(2)
    velocity, time_offset_s = np.array([0.8, -1.5, 0.1]), 0.05
    features = scan_features(2, scan, [VEHICLE], PrepareConfig())
    points, late_s = features.boundaries[VEHICLE], time_offset_s + 1e-9 * (image.stamp_ns - scan.stamp_ns)
    number = int(np.bincount(points.objects).argmax())
    moving = ScanMotion(l_twist(2), l_velocities={(VEHICLE, number): velocity})
    found = sst_graph.align_frame(features, image, at_truth(), moving)
    shift = np.where(points.objects[:, None] == number, late_s * velocity, 0.0)
    carried = replace(points, lPs=points.lPs + shift, outward=points.outward + shift)
    by_hand = sst_graph.align_frame(
        replace(features, boundaries={VEHICLE: carried}), image, at_truth(), motion(2)
    )
    (a,), (b,) = found.alignments, by_hand.alignments
    np.testing.assert_allclose(a.pixels, b.pixels, atol=1e-6)
    assert a.l_velocities is not None
    own = found.objects[0] == number
    assert 10 < np.count_nonzero(own) < len(own)
    np.testing.assert_array_equal(a.l_velocities, np.where(own[:, None], velocity, 0.0))
    standing = sst_graph.align_frame(features, image, at_truth(), motion(2))
    assert len(standing) != len(found) or not np.allclose(standing.alignments[0].pixels, a.pixels, atol=0.1)


def test_a_moving_vehicle_in_a_scan_of_another_time() -> None:
    # it goes on straight until the scan before the image, and from there to the image
    scan, image = frame(1)[0], frame(4)[1]
    later_ns, velocity = int(drive().stamps_ns[4]), np.array([0.4, -0.6, 0.0])
    lTs = drive().wTl(later_ns * 1e-9).between(drive().wTl(scan.stamp_ns * 1e-9))
    features = scan_features(1, scan, [VEHICLE], PrepareConfig())
    points = features.boundaries[VEHICLE]
    standing = sst_graph.align_frame(
        features, image, at_truth(), ScanMotion(l_twist(4), lTs=lTs, from_ns=later_ns)
    )
    number = int(np.bincount(standing.objects[0]).argmax())
    moving = {(VEHICLE, number): velocity}
    found = sst_graph.align_frame(
        features, image, at_truth(), ScanMotion(l_twist(4), None, moving, lTs, later_ns)
    )
    late_s = 1e-9 * (later_ns - scan.stamp_ns)
    shift = np.where(points.objects[:, None] == number, late_s * velocity, 0.0)
    there = replace(points, lPs=points.lPs + shift, outward=points.outward + shift)
    carried = _moved(replace(features, boundaries={VEHICLE: there}), lTs, later_ns)
    turned = {(VEHICLE, number): lTs.rotation().matrix() @ velocity}
    by_hand = sst_graph.align_frame(carried, image, at_truth(), ScanMotion(l_twist(4), None, turned))
    (a,), (b,) = found.alignments, by_hand.alignments
    assert len(found) == len(by_hand) > 50 and (found.objects[0] == number).any()
    np.testing.assert_allclose(a.pixels, b.pixels, atol=1e-3)
    assert len(standing) != len(found) or not np.allclose(standing.alignments[0].pixels, a.pixels, atol=0.1)


def _moved(features: ScanFeatures, lTs: gtsam.Pose3, stamp_ns: int) -> ScanFeatures:
    def carried(points: np.ndarray) -> np.ndarray:
        return np.asarray(lTs.transformFrom(points.T)).T

    def moved(b: Boundaries) -> Boundaries:
        return replace(b, lPs=carried(b.lPs), outward=carried(b.outward))

    boundaries = {c: moved(b) for c, b in features.boundaries.items()}
    return replace(features, stamp_ns=stamp_ns, boundaries=boundaries)


def test_a_side_of_an_object_counts_once() -> None:
    scan, image = frame(2)
    truth = drive().truth
    informations = []
    for config in (MatchConfig(side_sigma_px=0.0), MatchConfig(side_sigma_px=1.5)):
        found = sst_graph.align_frame(scan, image, at_truth(), motion(2), FrameMatching(config=config))
        values = gtsam.Values()
        values.insert(0, truth.cTl)
        factor = frame_factor(found.alignments, 0, 0.05, truth.cTl.AdjointMap() @ l_twist(2))
        informations.append(factor.linearize(values).information())
    assert (np.diag(informations[1]) < 0.6 * np.diag(informations[0])).all()


def test_a_frame_without_the_class_gives_no_match() -> None:
    scan, image = frame(2)
    bare = replace(scan, classes=np.zeros_like(scan.classes))
    found = sst_graph.align_frame(bare, image, at_truth(), ScanMotion(np.zeros(6)))
    assert len(found) == 0 and found.alignments == ()


def test_refuses_half_an_argument() -> None:
    still = np.zeros(6)
    with pytest.raises(DataError, match="both, or none"):
        ScanMotion(still, lTs=gtsam.Pose3())
    with pytest.raises(
        FactorError, match=r"l_twist of ScanMotion: found shape \(3,\), expected shape \(6,\)"
    ):
        ScanMotion(np.zeros(3))
    with pytest.raises(FactorError, match=r"l_acceleration of ScanMotion: found 6 values NaN or inf"):
        ScanMotion(still, np.full(6, np.nan))
    with pytest.raises(FactorError, match=r"l_velocities of ScanMotion.*shape \(3,\)"):
        ScanMotion(still, l_velocities={(VEHICLE, 1): np.ones(2)})


def test_objects_name_the_vehicle_of_each_match() -> None:
    scan, image = frame(2)
    found = sst_graph.align_frame(scan, image, at_truth(drive().config.time_offset_s), motion(2))
    (objects,), (alignment,) = found.objects, found.alignments
    assert objects.shape == (len(alignment),) and len(np.unique(objects)) > 1
    # matches of one object lie close together, as a vehicle does
    for number in np.unique(objects):
        size = np.ptp(alignment.lPs[objects == number], axis=0)
        assert np.linalg.norm(size) < 12.0
